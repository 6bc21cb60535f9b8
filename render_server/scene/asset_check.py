"""Checks of mesh files before a loader may trust them: sizes, references, glTF structure."""

import io
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from protocol.errors import DeltalightError

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
MAX_FILE_BYTES = 512 << 20
MAX_TRIANGLES = 20_000_000
_GLB_MAGIC, _JSON_CHUNK, _BIN_CHUNK = b"glTF", 0x4E4F534A, 0x004E4942
_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_FLOAT = 5126
# Extensions that a file may call required although only part of them (or none) changes what is loaded.
_HARMLESS_EXTENSIONS = re.compile(r"KHR_materials_\w+|KHR_lights_punctual|EXT_texture_webp")


class _FaultError(Exception):
    """What is wrong inside a glTF document; becomes a sentence with the file's name."""


@dataclass(frozen=True)
class CheckedGltf:
    """A glTF document whose sizes hold, and a stream of it whose materials are named by their index."""

    document: dict[str, Any]
    stream: io.BytesIO
    file_type: str


def check_mesh_file(path: Path) -> str:
    """Return the suffix of a mesh file that exists, is of a known type and of a bearable size.

    Raises:
        DeltalightError: otherwise.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise DeltalightError(f"{path} is not a mesh file; use one of {', '.join(MESH_SUFFIXES)}.")
    if not path.is_file():
        raise DeltalightError(f"the mesh file {path} does not exist; correct the path.")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise DeltalightError(f"{path} is larger than {MAX_FILE_BYTES >> 20} MB; simplify the mesh.")
    if suffix == ".ply":
        _check_ply_counts(path)
    return suffix


def _check_ply_counts(path: Path) -> None:
    """Every element of a PLY file takes at least a byte, so that its counts cannot exceed the file's size."""
    with path.open("rb") as file:
        header = file.read(1 << 16).split(b"end_header")[0]
    counts = re.findall(rb"^\s*element\s+\S+\s+(\d{1,18})\s*$", header, re.MULTILINE)
    if sum(map(int, counts)) > path.stat().st_size:
        raise DeltalightError(f"{path} announces more elements than it can hold; export the mesh again.")


def read_gltf(path: Path) -> CheckedGltf:
    """Read a .gltf or .glb file and check every count in it against the bytes that are there.

    Loaders allocate by accessor counts; a few hundred bytes can otherwise ask for gigabytes.

    Raises:
        DeltalightError: the document is malformed, refers to files outside its folder, or needs extensions
            that are not supported.
    """
    try:
        is_binary = path.suffix.lower() == ".glb"
        document, binary = _split_glb(path.read_bytes()) if is_binary else (_json(path.read_bytes()), b"")
        _check_document(document, binary, path.parent)
    except _FaultError as fault:
        raise DeltalightError(f"{path}: {fault}; export the mesh again.") from fault
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise DeltalightError(f"{path} is not a valid glTF 2 file ({error!r}); export it again.") from error
    named = {**document, "materials": _named_by_index(document.get("materials", []))}
    text = json.dumps(named).encode()
    stream = io.BytesIO(_join_glb(text, binary) if is_binary else text)
    return CheckedGltf(document, stream, path.suffix.lower()[1:])


def _named_by_index(materials: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{**material, "name": str(index)} for index, material in enumerate(materials)]


def _json(data: bytes) -> dict[str, Any]:
    document = json.loads(data.decode("utf-8-sig"))
    if not isinstance(document, dict):
        raise _FaultError("it does not hold a JSON object")
    return document


def _split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    if data[:4] != _GLB_MAGIC or _uint32(data, 4) != 2:
        raise _FaultError("it is not a binary glTF 2 file")
    chunks: dict[int, bytes] = {}
    offset = 12
    while offset + 8 <= len(data):
        size, kind = _uint32(data, offset), _uint32(data, offset + 4)
        if offset + 8 + size > len(data):
            raise _FaultError("a chunk reaches beyond the end of the file")
        chunks.setdefault(kind, data[offset + 8 : offset + 8 + size])
        offset += 8 + size
    return _json(chunks[_JSON_CHUNK]), chunks.get(_BIN_CHUNK, b"")


def _uint32(data: bytes, offset: int) -> int:
    return int.from_bytes(data[offset : offset + 4], "little")


def _join_glb(text: bytes, binary: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    chunks = _chunk(_JSON_CHUNK, text) + (_chunk(_BIN_CHUNK, binary) if binary else b"")
    return _GLB_MAGIC + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks


def _chunk(kind: int, data: bytes) -> bytes:
    return len(data).to_bytes(4, "little") + kind.to_bytes(4, "little") + data


def _check_document(document: dict[str, Any], binary: bytes, folder: Path) -> None:
    version = str(document["asset"]["version"])
    if not version.startswith("2."):
        raise _FaultError(f"glTF {version} is not supported, only 2.x")
    for name in document.get("extensionsRequired", []):
        if not _HARMLESS_EXTENSIONS.fullmatch(str(name)):
            raise _FaultError(f"the extension {name} that it requires is not supported")
    _check_uris(document.get("images", []), folder)
    sizes = [_buffer_size(buffer, binary, folder) for buffer in document.get("buffers", [])]
    views = [_check_view(view, sizes) for view in document.get("bufferViews", [])]
    for index, accessor in enumerate(document.get("accessors", [])):
        _check_accessor(index, accessor, document["bufferViews"], views)
    _check_triangles(document)


def _count(value: object) -> int:
    if type(value) is not int or value < 0:
        raise _FaultError(f"{value!r} stands where a count belongs")
    return value


def _check_uris(images: list[dict[str, Any]], folder: Path) -> None:
    for image in images:
        if "uri" in image and not image["uri"].startswith("data:"):
            _file_inside(image["uri"], folder)


def _file_inside(uri: str, folder: Path) -> Path:
    path = (folder / unquote(uri)).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise _FaultError(f"it refers to {uri}, outside its own folder")
    return path


def _buffer_size(buffer: dict[str, Any], binary: bytes, folder: Path) -> int:
    size, uri = _count(buffer["byteLength"]), buffer.get("uri")
    if uri is None:
        held = len(binary)
    elif uri.startswith("data:"):
        held = len(uri.partition("base64,")[2]) * 3 // 4
    else:
        path = _file_inside(uri, folder)
        held = path.stat().st_size if path.is_file() else -1
        if held < 0 or held > MAX_FILE_BYTES:
            raise _FaultError(f"its buffer {uri} is missing or too large")
    if size > held:
        raise _FaultError(f"a buffer of {size} bytes holds only {held}")
    return size


def _check_view(view: dict[str, Any], buffer_sizes: list[int]) -> int:
    offset, size = _count(view.get("byteOffset", 0)), _count(view["byteLength"])
    if offset + size > buffer_sizes[_count(view["buffer"])]:
        raise _FaultError("a buffer view reaches beyond its buffer")
    if not 1 <= _count(view.get("byteStride", 1)) <= 252:
        raise _FaultError("a buffer view has a stride outside 1..252 bytes")
    return size


def _check_accessor(
    index: int, accessor: dict[str, Any], views: list[dict[str, Any]], sizes: list[int]
) -> None:
    if "sparse" in accessor or "bufferView" not in accessor:
        raise _FaultError(f"accessor {index} is sparse or has no data, which is not supported")
    view = _count(accessor["bufferView"])
    element = _COMPONENT_BYTES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
    count, stride = _count(accessor["count"]), _count(views[view].get("byteStride", element))
    needed = _count(accessor.get("byteOffset", 0)) + max(count - 1, 0) * stride + element * (count > 0)
    if needed > sizes[view]:
        raise _FaultError(f"accessor {index} wants {needed} bytes where {sizes[view]} are")


def _check_triangles(document: dict[str, Any]) -> None:
    """Bound the triangles of all instances; nodes must form trees, or a loader may never end."""
    nodes = document.get("nodes", [])
    children = [_count(child) for node in nodes for child in node.get("children", [])]
    if len(set(children)) != len(children) or any(child >= len(nodes) for child in children):
        raise _FaultError("its nodes do not form a tree")
    accessors = document.get("accessors", [])
    sizes = [
        sum(_primitive_triangles(primitive, accessors) for primitive in mesh["primitives"])
        for mesh in document.get("meshes", [])
    ]
    if sum(sizes[_count(node["mesh"])] for node in nodes if "mesh" in node) > MAX_TRIANGLES:
        raise _FaultError(f"its nodes show more than {MAX_TRIANGLES} triangles")


def _primitive_triangles(primitive: dict[str, Any], accessors: list[dict[str, Any]]) -> int:
    position = accessors[_count(primitive["attributes"]["POSITION"])]
    if position["type"] != "VEC3" or position["componentType"] != _FLOAT:
        raise _FaultError("its positions are not three floats each (quantised meshes are not supported)")
    indexed = accessors[_count(primitive["indices"])] if "indices" in primitive else position
    return int(indexed["count"])
