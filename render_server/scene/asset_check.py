"""Checks of mesh files before a loader may trust them: sizes, references, glTF structure."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import is_file
from deltalight.protocol.scene_objects import MESH_SUFFIXES
from deltalight.render_server.scene.gltf_document import (
    COMPONENT_TYPES,
    COMPONENTS,
    GltfDocument,
    GltfFaultError,
    faults_named,
    file_inside,
    uri_bytes,
)

MAX_FILE_BYTES = 512 << 20
MAX_TRIANGLES = 20_000_000
_GLB_MAGIC, _JSON_CHUNK, _BIN_CHUNK = b"glTF", 0x4E4F534A, 0x004E4942
_COMPONENT_BYTES = {kind: int(name[-1]) for kind, name in COMPONENT_TYPES.items()}
_INDEX_TYPES = (5121, 5123, 5125)
LIGHTS_EXTENSION = "KHR_lights_punctual"
DRAWN_EXTENSIONS = frozenset(
    {
        "EXT_texture_webp",
        LIGHTS_EXTENSION,
        "KHR_materials_clearcoat",
        "KHR_materials_emissive_strength",
        "KHR_materials_ior",
        "KHR_materials_sheen",
        "KHR_materials_specular",
        "KHR_materials_transmission",
        "KHR_materials_unlit",
        "KHR_materials_volume",
        "KHR_mesh_quantization",
        "KHR_texture_transform",
    }
)
# What a file may require although it is left out: the object's shape, place and texture do not depend on it.
LEFT_OUT_EXTENSIONS = frozenset(
    {
        "KHR_materials_anisotropy",
        "KHR_materials_diffuse_transmission",
        "KHR_materials_dispersion",
        "KHR_materials_iridescence",
        "KHR_materials_variants",
    }
)


def check_mesh_file(path: Path) -> str:
    """Returns the suffix of a mesh file that exists, is of a known type and not too large.

    Raises:
        DeltalightError: otherwise.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise DeltalightError(f"{path} is not a mesh file; use one of {', '.join(MESH_SUFFIXES)}.")
    if not is_file(path):
        raise DeltalightError(f"the mesh file {path} does not exist; correct the path.")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise DeltalightError(f"{path} is larger than {MAX_FILE_BYTES >> 20} MB; simplify the mesh.")
    if suffix == ".ply":
        _check_ply_counts(path)
    return suffix


def _check_ply_counts(path: Path) -> None:
    """Checks the element counts of a PLY file: every element takes at least a byte."""
    with path.open("rb") as file:
        header = file.read(1 << 16).split(b"end_header")[0]
    counts = re.findall(rb"^\s*element\s+\S+\s+(\d{1,18})\s*$", header, re.MULTILINE)
    if sum(map(int, counts)) > path.stat().st_size:
        raise DeltalightError(f"{path} announces more elements than it can hold; export the mesh again.")


def read_gltf(path: Path) -> GltfDocument:
    """Reads a .gltf or .glb file and checks every count in it against the bytes that are there.

    Loaders allocate by accessor counts; otherwise a few hundred bytes could request gigabytes.

    Raises:
        DeltalightError: the document is malformed, refers to files outside its folder, or needs extensions
            that are not supported.
    """
    with faults_named(path):
        data = path.read_bytes()
        document, binary = _split_glb(data) if path.suffix.lower() == ".glb" else (_json(data), None)
        return _checked(path, document, binary)


def left_out(gltf: GltfDocument) -> str | None:
    """Returns a sentence about what a document uses and no picture shows; None if that is nothing."""
    names = [str(name) for name in gltf.root.get("extensionsUsed", []) if name not in DRAWN_EXTENSIONS]
    return f"{gltf.path} is shown without {', '.join(dict.fromkeys(names))}." if names else None


def _json(data: bytes) -> dict[str, Any]:
    document = json.loads(data.decode("utf-8-sig"))
    if not isinstance(document, dict):
        raise GltfFaultError("it does not hold a JSON object")
    return document


def _split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    if data[:4] != _GLB_MAGIC or _uint32(data, 4) != 2:
        raise GltfFaultError("it is not a binary glTF 2 file")
    chunks: dict[int, bytes] = {}
    offset = 12
    while offset + 8 <= len(data):
        size, kind = _uint32(data, offset), _uint32(data, offset + 4)
        if offset + 8 + size > len(data):
            raise GltfFaultError("a chunk reaches beyond the end of the file")
        chunks.setdefault(kind, data[offset + 8 : offset + 8 + size])
        offset += 8 + size
    return _json(chunks[_JSON_CHUNK]), chunks.get(_BIN_CHUNK, b"")


def _uint32(data: bytes, offset: int) -> int:
    return int.from_bytes(data[offset : offset + 4], "little")


def _checked(path: Path, document: dict[str, Any], binary: bytes | None) -> GltfDocument:
    version = str(document["asset"]["version"])
    if not version.startswith("2."):
        raise GltfFaultError(f"glTF {version} is not supported, only 2.x")
    for name in document.get("extensionsRequired", []):
        if name not in DRAWN_EXTENSIONS | LEFT_OUT_EXTENSIONS:
            raise GltfFaultError(f"the extension {name} that it requires is not supported")
    _check_uris(document.get("images", []), path.parent)
    buffers = [_buffer(buffer, binary, path.parent) for buffer in document.get("buffers", [])]
    views = document.get("bufferViews", [])
    sizes = [_check_view(view, [len(data) for data in buffers]) for view in views]
    _check_accessors(document.get("accessors", []), _Views(views, sizes))
    _check_nodes(document.get("nodes", []))
    _check_triangles(document)
    return GltfDocument(path, document, tuple(buffers))


def _count(value: object) -> int:
    if type(value) is not int or value < 0:
        raise GltfFaultError(f"{value!r:.60} stands where a count belongs")
    return value


def _check_uris(images: list[dict[str, Any]], folder: Path) -> None:
    for image in images:
        if "uri" in image and not image["uri"].startswith("data:"):
            file_inside(image["uri"], folder)


def _buffer(buffer: dict[str, Any], binary: bytes | None, folder: Path) -> bytes:
    size, uri = _count(buffer["byteLength"]), buffer.get("uri")
    if uri is None:
        held = binary or b""
    elif not uri.startswith("data:") and _file_size(uri, folder) > MAX_FILE_BYTES:
        raise GltfFaultError(f"its buffer {uri} is too large")
    else:
        held = uri_bytes(uri, folder)
    if size > len(held):
        raise GltfFaultError(f"a buffer of {size} bytes holds only {len(held)}")
    return held


def _file_size(uri: str, folder: Path) -> int:
    path = file_inside(uri, folder)
    return path.stat().st_size if is_file(path) else 0


def _check_view(view: dict[str, Any], buffer_sizes: list[int]) -> int:
    offset, size = _count(view.get("byteOffset", 0)), _count(view["byteLength"])
    if offset + size > buffer_sizes[_count(view["buffer"])]:
        raise GltfFaultError("a buffer view reaches beyond its buffer")
    if not 1 <= _count(view.get("byteStride", 1)) <= 252:
        raise GltfFaultError("a buffer view has a stride outside 1..252 bytes")
    return size


@dataclass(frozen=True)
class _Views:
    """Buffer views and how many bytes each has."""

    views: list[dict[str, Any]]
    sizes: list[int]

    def check(self, index: int, place: dict[str, Any], count: int, element: int) -> None:
        """Checks that `count` elements of `element` bytes lie within the view that part of an accessor names."""
        view = _count(place["bufferView"])
        stride = _count(self.views[view].get("byteStride", element))
        needed = _count(place.get("byteOffset", 0)) + max(count - 1, 0) * stride + element * (count > 0)
        if needed > self.sizes[view]:
            raise GltfFaultError(f"accessor {index} wants {needed} bytes where {self.sizes[view]} are")


def _check_accessors(accessors: list[dict[str, Any]], views: _Views) -> None:
    stored, added = 0, 0
    for index, accessor in enumerate(accessors):
        element = _COMPONENT_BYTES[accessor["componentType"]] * COMPONENTS[accessor["type"]]
        count = _count(accessor["count"])
        if "bufferView" in accessor:
            views.check(index, accessor, count, element)
            stored = max(stored, count)
        elif "sparse" not in accessor:
            raise GltfFaultError(f"accessor {index} has no data, which is not supported")
        if "sparse" in accessor:
            _check_sparse(index, accessor, element, views)
            added += count * element
    longest = max((accessor["count"] for accessor in accessors), default=0)
    if longest > stored or added > MAX_FILE_BYTES:
        raise GltfFaultError("its sparse accessors grow beyond what the file holds")


def _check_sparse(index: int, accessor: dict[str, Any], element: int, views: _Views) -> None:
    sparse = accessor["sparse"]
    count, kind = _count(sparse["count"]), sparse["indices"]["componentType"]
    if count > accessor["count"] or kind not in _INDEX_TYPES:
        raise GltfFaultError(f"accessor {index} has malformed sparse values")
    views.check(index, sparse["indices"], count, _COMPONENT_BYTES[kind])
    views.check(index, sparse["values"], count, element)


def _check_nodes(nodes: list[dict[str, Any]]) -> None:
    """Checks that nodes form trees, so that traversals end."""
    children = [_count(child) for node in nodes for child in node.get("children", [])]
    if len(set(children)) != len(children) or any(child >= len(nodes) for child in children):
        raise GltfFaultError("its nodes do not form a tree")
    reached = sorted(set(range(len(nodes))) - set(children))
    for index in reached:
        reached.extend(nodes[index].get("children", []))
    if len(reached) < len(nodes):
        raise GltfFaultError("its nodes form a circle")


def _check_triangles(document: dict[str, Any]) -> None:
    """Bounds the triangles of all instances."""
    accessors = document.get("accessors", [])
    sizes = [
        sum(_primitive_triangles(primitive, accessors) for primitive in mesh["primitives"])
        for mesh in document.get("meshes", [])
    ]
    nodes = document.get("nodes", [])
    if sum(sizes[_count(node["mesh"])] for node in nodes if "mesh" in node) > MAX_TRIANGLES:
        raise GltfFaultError(f"its nodes show more than {MAX_TRIANGLES} triangles")


def _primitive_triangles(primitive: dict[str, Any], accessors: list[dict[str, Any]]) -> int:
    position = accessors[_count(primitive["attributes"]["POSITION"])]
    if position["type"] != "VEC3":
        raise GltfFaultError("its positions are not three numbers each")
    indexed = accessors[_count(primitive["indices"])] if "indices" in primitive else position
    return int(indexed["count"])
