"""Formats of uploads, recognised by their first bytes, never by the name alone."""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from deltalight.services.storage.faults import RejectedAssetError

AssetKind = Literal["mesh", "map", "material"]
Facts = dict[str, Any]  # facts about a loaded file, as JSON
HEAD_BYTES = 4096
MAX_NAME_LENGTH = 200
_STL_HEADER_BYTES, _STL_TRIANGLE_BYTES = 84, 50
# A line that only Wavefront OBJ files have; the format has no magic number.
_OBJ_LINE = re.compile(rb"^(v|vn|vt|f|o|g|mtllib|usemtl)[ \t]+\S", re.MULTILINE)
_NOT_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1f]")


@dataclass(frozen=True)
class AssetFormat:
    """A supported file format; `media_type` is its registered or customary one."""

    name: str
    kind: AssetKind
    media_type: str
    matches: Callable[[bytes, int], bool]

    @property
    def suffix(self) -> str:
        """The suffix by which loaders recognise the format."""
        return f".{self.name}"


def _is_glb(head: bytes, size: int) -> bool:
    return head[:4] == b"glTF" and size >= 20


def _is_ply(head: bytes, _size: int) -> bool:
    return re.match(rb"ply\r?\n", head) is not None


def _is_stl(head: bytes, size: int) -> bool:
    """Whether it is an STL file.

    A binary file has as many bytes as its triangle count says; a text file begins with `solid` and has facets.
    """
    if len(head) >= _STL_HEADER_BYTES:
        (triangles,) = struct.unpack_from("<I", head, 80)
        if size == _STL_HEADER_BYTES + triangles * _STL_TRIANGLE_BYTES:
            return True
    return head.lstrip()[:5].lower() == b"solid" and b"facet" in head and not _NOT_TEXT.search(head)


def _is_hdr(head: bytes, _size: int) -> bool:
    return head.startswith((b"#?RADIANCE", b"#?RGBE"))


def _is_exr(head: bytes, _size: int) -> bool:
    return head[:4] == b"\x76\x2f\x31\x01"


def _is_dlmat(head: bytes, _size: int) -> bool:
    return head.startswith(b"deltalight material ")


def _is_obj(head: bytes, _size: int) -> bool:
    return not _NOT_TEXT.search(head) and _OBJ_LINE.search(head) is not None


FORMATS = (
    AssetFormat("glb", "mesh", "model/gltf-binary", _is_glb),
    AssetFormat("ply", "mesh", "model/ply", _is_ply),
    AssetFormat("stl", "mesh", "model/stl", _is_stl),
    AssetFormat("hdr", "map", "image/vnd.radiance", _is_hdr),
    AssetFormat("exr", "map", "image/x-exr", _is_exr),
    AssetFormat("dlmat", "material", "application/octet-stream", _is_dlmat),
    AssetFormat("obj", "mesh", "model/obj", _is_obj),  # last: the loosest rule
)
BY_NAME = {each.name: each for each in FORMATS}


def is_archive(head: bytes) -> bool:
    """Whether a file with this beginning is a .zip (APPNOTE 4.3.7; an empty one has no such record)."""
    return head[:4] == b"PK\x03\x04"


def recognise(head: bytes, size_bytes: int, name: str) -> AssetFormat:
    """Returns the format of a file with this beginning.

    Raises:
        RejectedAssetError: its format is not supported, or its name claims another one.
    """
    found = next((each for each in FORMATS if each.matches(head, size_bytes)), None)
    if found is None:
        raise RejectedAssetError(_advice(head, name))
    said = Path(name).suffix.lower().removeprefix(".")
    if said in BY_NAME and said != found.name:
        raise RejectedAssetError(f"{name} is a {found.name.upper()} file and not {said.upper()}; rename it.")
    return found


def _advice(head: bytes, name: str) -> str:
    if head.lstrip()[:1] == b"{":
        return f"{name} looks like a glTF document, referring to other files; pack them in a .zip, or export a .glb."
    known = ", ".join(each.name.upper() for each in FORMATS)
    return f"{name} is not in a known format; upload one of {known}, or a ZIP with a glTF document and its files."


def clean_name(name: str) -> str:
    """Returns the last part of a file name for display, without control characters.

    Raises:
        RejectedAssetError: nothing is left of it.
    """
    last = re.split(r"[/\\]", name)[-1]
    shown = "".join(character for character in last if character.isprintable()).strip()[:MAX_NAME_LENGTH]
    if shown in ("", ".", "..") or shown.startswith("sha256:"):
        raise RejectedAssetError("an upload needs the file's own name, such as chair.glb; give it as `name`.")
    return shown
