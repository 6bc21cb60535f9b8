"""A glTF 2 document: its arrays (glTF 2.0, section 3.6) and its tree of nodes (section 3.5)."""

import base64
import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Shaped

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import is_file

if TYPE_CHECKING:
    from PIL import Image

COMPONENT_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
IMAGE_TYPES = {"image/png": "PNG", "image/jpeg": "JPEG", "image/webp": "WEBP"}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


class GltfFaultError(Exception):
    """A fault inside a glTF document; `faults_named` adds the file's name."""


@contextmanager
def faults_named(path: Path) -> Iterator[None]:
    """Turns everything that a malformed document can raise into a DeltalightError that names the file."""
    try:
        yield
    except GltfFaultError as fault:
        raise DeltalightError(f"{path}: {fault}; export the mesh again.") from fault
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise DeltalightError(
            f"{path} is not a valid glTF 2 file ({error!r:.300}); export it again."
        ) from error


@dataclass(frozen=True, eq=False)
class GltfDocument:
    """The JSON object `root` and its buffers; all sizes were checked (asset_check.py)."""

    path: Path
    root: dict[str, Any]
    buffers: tuple[bytes, ...]

    def entries(self, name: str) -> list[dict[str, Any]]:
        """Returns a top-level list of the document."""
        return list(self.root.get(name, []))

    def array(self, index: int) -> Shaped[np.ndarray, "n c"]:
        """Returns the rows of an accessor: as stored, or float32 in -1..1 or 0..1 if it is normalised."""
        accessor = self.root["accessors"][index]
        columns, kind = COMPONENTS[accessor["type"]], np.dtype(COMPONENT_TYPES[accessor["componentType"]])
        if "bufferView" in accessor:
            rows = self._rows(accessor, accessor["count"], columns, kind)
        else:
            rows = np.zeros((accessor["count"], columns), kind)
        if "sparse" in accessor:
            rows = self._with_sparse(rows, accessor["sparse"])
        return _normalized(rows) if accessor.get("normalized", False) else rows

    def floats(self, index: int, columns: int) -> Float32[np.ndarray, "n c"]:
        """Returns the rows of an accessor as float32.

        Raises:
            GltfFaultError: it has another number of columns or holds what is not finite.
        """
        rows = self.array(index).astype(np.float32)
        if rows.shape[1] != columns:
            raise GltfFaultError(f"accessor {index} has {rows.shape[1]} components where {columns} belong")
        if not np.isfinite(rows).all():
            raise GltfFaultError(f"accessor {index} holds numbers that are not finite")
        return rows

    def _rows(
        self, place: dict[str, Any], count: int, columns: int, kind: np.dtype[Any]
    ) -> Shaped[np.ndarray, "n c"]:
        view = self.root["bufferViews"][place["bufferView"]]
        offset = view.get("byteOffset", 0) + place.get("byteOffset", 0)
        width = columns * kind.itemsize
        stride = view.get("byteStride", width)
        data = np.frombuffer(self.buffers[view["buffer"]], np.uint8)[offset:]
        rows = np.lib.stride_tricks.as_strided(data, (count, width), (stride, 1), writeable=False)
        return np.ascontiguousarray(rows).view(kind)

    def _with_sparse(
        self, rows: Shaped[np.ndarray, "n c"], sparse: dict[str, Any]
    ) -> Shaped[np.ndarray, "n c"]:
        kind = np.dtype(COMPONENT_TYPES[sparse["indices"]["componentType"]])
        places = self._rows(sparse["indices"], sparse["count"], 1, kind)[:, 0]
        replaced = rows.copy()
        replaced[places] = self._rows(sparse["values"], sparse["count"], rows.shape[1], rows.dtype)
        return replaced

    def image_of(self, texture: int) -> int | None:
        """Returns the image of a texture; None for unsupported kinds."""
        entry = self.root["textures"][texture]
        webp = entry.get("extensions", {}).get("EXT_texture_webp", {})
        source = webp.get("source", entry.get("source"))
        return None if source is None else int(source)

    def sampler(self, texture: int) -> dict[str, Any]:
        """Returns the sampler of a texture; an empty one if it names none."""
        index = self.root["textures"][texture].get("sampler")
        return {} if index is None else dict(self.root["samplers"][index])

    def image(self, index: int) -> "Image.Image":
        """Opens an image without decoding it.

        Raises:
            GltfFaultError: it is missing, no picture, or another kind of picture than it says.
        """
        from PIL import Image

        entry = self.root["images"][index]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # MAX_TEXTURE_PIXELS is lower
                image = Image.open(io.BytesIO(self._image_bytes(entry)), formats=tuple(IMAGE_TYPES.values()))
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise GltfFaultError(f"its image {index} cannot be read ({error})") from error
        said = entry.get("mimeType")
        if said is not None and IMAGE_TYPES.get(said) != image.format:
            raise GltfFaultError(f"its image {index} is called {said} and holds {image.format}")
        return image

    def _image_bytes(self, image: dict[str, Any]) -> bytes:
        if "uri" in image:
            return uri_bytes(image["uri"], self.path.parent)
        view = self.root["bufferViews"][image["bufferView"]]
        start = view.get("byteOffset", 0)
        return bytes(self.buffers[view["buffer"]][start : start + view["byteLength"]])


def uri_bytes(uri: str, folder: Path) -> bytes:
    """Reads what a URI refers to: embedded data, or a file inside the document's folder."""
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition("base64,")[2])
    path = file_inside(uri, folder)
    if not is_file(path):
        raise GltfFaultError(f"the file {uri} that it refers to is missing")
    return path.read_bytes()


def file_inside(uri: str, folder: Path) -> Path:
    """Resolves the file that a URI names; it must lie inside `folder`."""
    path = (folder / unquote(uri)).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise GltfFaultError(f"it refers to {uri}, outside its own folder")
    return path


def _normalized(rows: Shaped[np.ndarray, "n c"]) -> Float32[np.ndarray, "n c"]:
    """Converts integers to fractions of their greatest value (glTF 2.0, section 3.11)."""
    if rows.dtype.kind == "f":
        return rows.astype(np.float32)
    fractions = rows.astype(np.float32) / np.float32(np.iinfo(rows.dtype).max)
    return np.asarray(np.maximum(fractions, np.float32(-1)))


@dataclass(frozen=True, eq=False)
class NodeMotion:
    """Translation, rotation (unit quaternions x y z w), scale and morph weights of every node."""

    translation: Float64[np.ndarray, "n 3"]
    rotation: Float64[np.ndarray, "n 4"]
    scale: Float64[np.ndarray, "n 3"]
    weights: tuple[Float64[np.ndarray, " _"], ...]

    def copy(self) -> "NodeMotion":
        """Returns a deep copy."""
        weights = tuple(values.copy() for values in self.weights)
        return NodeMotion(self.translation.copy(), self.rotation.copy(), self.scale.copy(), weights)


@dataclass(frozen=True, eq=False)
class NodeTree:
    """Nodes in the rest pose. `levels` holds the nodes of each depth, roots first; `shown` those of the scene.

    Nodes with `has_matrix` keep their matrix in `matrices`, whatever their motion.
    """

    parents: Int64[np.ndarray, " n"]
    levels: tuple[Int64[np.ndarray, " _"], ...]
    shown: tuple[int, ...]
    rest: NodeMotion
    matrices: Float64[np.ndarray, "n 4 4"]
    has_matrix: Bool[np.ndarray, " n"]

    def asset_from_node(self, motion: NodeMotion) -> Float64[np.ndarray, "n 4 4"]:
        """Returns the global transform of each node."""
        matrices = np.tile(np.eye(4), (len(self.parents), 1, 1))
        matrices[:, :3, :3] = _rotations(motion.rotation) * motion.scale[:, None, :]
        matrices[:, :3, 3] = motion.translation
        matrices[self.has_matrix] = self.matrices[self.has_matrix]
        for level in self.levels[1:]:
            matrices[level] = matrices[self.parents[level]] @ matrices[level]
        return matrices


def read_nodes(gltf: GltfDocument) -> NodeTree:
    """Reads the nodes of a document; they form trees (asset_check.py).

    Raises:
        GltfFaultError: numbers that are not finite, a rotation of length 0, or a wrong number of weights.
    """
    nodes = gltf.entries("nodes")
    rest = NodeMotion(
        _vectors(nodes, "translation", (0, 0, 0)),
        _vectors(nodes, "rotation", (0, 0, 0, 1)),
        _vectors(nodes, "scale", (1, 1, 1)),
        tuple(_rest_weights(gltf, node) for node in nodes),
    )
    lengths = np.linalg.norm(rest.rotation, axis=1, keepdims=True)
    if (lengths < 1e-6).any():
        raise GltfFaultError("a node has a rotation of length 0")
    rest = replace(rest, rotation=rest.rotation / lengths)
    columns = _vectors(nodes, "matrix", np.eye(4).ravel())
    has_matrix = np.array(["matrix" in node for node in nodes], bool)
    parents, levels = _levels(nodes)
    matrices = columns.reshape(-1, 4, 4).transpose(0, 2, 1)
    return NodeTree(parents, levels, _shown(gltf, nodes), rest, matrices, has_matrix)


def target_count(mesh: dict[str, Any]) -> int:
    """Returns the number of morph targets of a mesh."""
    return len(mesh["primitives"][0].get("targets", []))


def _vectors(nodes: list[dict[str, Any]], key: str, default: Any) -> Float64[np.ndarray, "n c"]:  # noqa: ANN401
    width = len(default)
    values = np.array([node.get(key, default) for node in nodes], np.float64).reshape(-1, width)
    if not np.isfinite(values).all():
        raise GltfFaultError(f"a node's {key} is not finite")
    return values


def _rest_weights(gltf: GltfDocument, node: dict[str, Any]) -> Float64[np.ndarray, " t"]:
    """Returns the node's own morph weights, else the mesh's, else none."""
    if "mesh" not in node:
        return np.zeros(0)
    mesh = gltf.root["meshes"][node["mesh"]]
    count = target_count(mesh)
    weights = np.array(node.get("weights", mesh.get("weights", [0] * count)), np.float64)
    if weights.shape != (count,) or not np.isfinite(weights).all():
        raise GltfFaultError(f"a mesh of {count} morph targets has the weights {weights.tolist()}")
    return weights


def _levels(nodes: list[dict[str, Any]]) -> tuple[Int64[np.ndarray, " n"], tuple[np.ndarray, ...]]:
    """Returns the parent of each node, -1 for roots, and the nodes of each depth."""
    parents = np.full(len(nodes), -1)
    for index, node in enumerate(nodes):
        parents[node.get("children", [])] = index
    levels, level = [], np.flatnonzero(parents < 0)
    while len(level):
        levels.append(level)
        level = np.flatnonzero(np.isin(parents, level))
    return parents, tuple(levels)


def _shown(gltf: GltfDocument, nodes: list[dict[str, Any]]) -> tuple[int, ...]:
    """Returns the nodes of the default scene in depth-first order; all nodes where there is no scene."""
    scenes = gltf.entries("scenes")
    if not scenes:
        return tuple(range(len(nodes)))
    pending = list(reversed(scenes[gltf.root.get("scene", 0)].get("nodes", [])))
    shown: dict[int, None] = {}
    while pending:
        index = pending.pop()
        if index not in shown:
            shown[index] = None
            pending += reversed(nodes[index].get("children", []))
    return tuple(shown)


def _rotations(quaternions: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 3 3"]:
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
