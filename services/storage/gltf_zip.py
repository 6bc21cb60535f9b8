"""Conversion of a .zip with one glTF and its files to one .glb (glTF 2.0, sections 3.6.1.2 and 4.4)."""

import base64
import binascii
import json
import posixpath
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.archive import Archive, unpacking
from deltalight.services.storage.asset_kinds import Facts

MAX_ENTRIES = 1000
CONTENTS = "one glTF and its files"
_JSON_CHUNK, _BIN_CHUNK = 0x4E4F534A, 0x004E4942
_IMAGE_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".webp": "image/webp"}


def repack(path: Path, out: str, limit: str) -> Facts:
    """Writes the glTF of an archive as one .glb file (in the worker); `limit` is its greatest size unpacked, bytes.

    The same archive always gives the same bytes.

    Raises:
        DeltalightError: the archive is wrong; the sentence says how.
    """
    with unpacking(path), zipfile.ZipFile(path) as archive:
        glb = _repacked(Archive(archive, path, int(limit), MAX_ENTRIES, CONTENTS))
    Path(out).write_bytes(glb)
    return {"size_bytes": len(glb)}


def _repacked(archive: Archive) -> bytes:
    models = [name for name in archive.entries if name.lower().endswith((".gltf", ".glb"))]
    if len(models) != 1:
        found = "two or more glTF files" if models else "no glTF file"
        raise DeltalightError(f"{archive.path} holds {found}; pack one .gltf with the files that it names.")
    data = archive.read(models[0])
    if models[0].lower().endswith(".glb"):
        return data
    try:
        document = json.loads(data.decode("utf-8-sig"))
        joined, binary = _joined(document, archive, posixpath.dirname(models[0]))
        return _glb(json.dumps(joined, separators=(",", ":")).encode(), binary)
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise DeltalightError(
            f"{archive.path} holds no valid glTF 2 file ({error!r:.100}); export it again."
        ) from error


def _joined(document: dict[str, Any], archive: Archive, folder: str) -> tuple[dict[str, Any], bytes]:
    """Joins all buffers, then all pictures, into one; buffer views are shifted accordingly."""
    binary, starts = bytearray(), []
    for buffer in document.get("buffers", []):
        starts.append(_append(binary, _content(buffer["uri"], archive, folder)[: int(buffer["byteLength"])]))
    views = [
        {**view, "buffer": 0, "byteOffset": view.get("byteOffset", 0) + starts[view["buffer"]]}
        for view in document.get("bufferViews", [])
    ]
    images = []
    for image in document.get("images", []):
        if "uri" not in image:
            images.append(image)
            continue
        content = _content(image["uri"], archive, folder)
        views.append({"buffer": 0, "byteOffset": _append(binary, content), "byteLength": len(content)})
        rest = {key: value for key, value in image.items() if key != "uri"}
        images.append({**rest, "bufferView": len(views) - 1, "mimeType": _image_type(image)})
    made = {"buffers": [{"byteLength": len(binary)}], "bufferViews": views, "images": images}
    return {**document, **{key: value for key, value in made.items() if value and binary}}, bytes(binary)


def _append(binary: bytearray, content: bytes) -> int:
    """Appends a piece and returns its offset; every accessor type is aligned to four bytes."""
    start = len(binary)
    binary += content + bytes(-len(content) % 4)
    return start


def _content(uri: str, archive: Archive, folder: str) -> bytes:
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition("base64,")[2], validate=True)
        except binascii.Error as error:
            raise DeltalightError(
                f"{archive.path} holds a glTF with damaged data in it; export it again."
            ) from error
    return archive.read(posixpath.normpath(posixpath.join(folder, unquote(uri))))


def _image_type(image: dict[str, Any]) -> str:
    uri = str(image["uri"])
    if uri.startswith("data:"):
        return uri[5:].partition(";")[0]
    return str(image.get("mimeType") or _IMAGE_TYPES.get(posixpath.splitext(uri.lower())[1], "image/png"))


def _glb(text: bytes, binary: bytes) -> bytes:
    chunks = _chunk(_JSON_CHUNK, text + b" " * (-len(text) % 4))
    if binary:
        chunks += _chunk(_BIN_CHUNK, binary)
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks


def _chunk(kind: int, data: bytes) -> bytes:
    return len(data).to_bytes(4, "little") + kind.to_bytes(4, "little") + data
