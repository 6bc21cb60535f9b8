"""The nodes of a glTF document: where each stands, at rest or as a clip moves it (glTF 2.0, section 3.5)."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from render_server.scene.gltf_document import GltfFaultError, GltfFile


@dataclass(frozen=True, eq=False)
class NodeMotion:
    """Translation, rotation (unit quaternions x y z w), scale and morph weights of every node."""

    translation: Float64[np.ndarray, "n 3"]
    rotation: Float64[np.ndarray, "n 4"]
    scale: Float64[np.ndarray, "n 3"]
    weights: tuple[Float64[np.ndarray, " _"], ...]

    def copy(self) -> "NodeMotion":
        """One that may be written to."""
        weights = tuple(values.copy() for values in self.weights)
        return NodeMotion(self.translation.copy(), self.rotation.copy(), self.scale.copy(), weights)


@dataclass(frozen=True, eq=False)
class NodeTree:
    """Nodes at rest. `levels` holds the nodes of each depth, roots first; `shown` those of the document's scene.

    Nodes that `has_matrix` stand as `matrices` says, whatever their motion.
    """

    parents: Int64[np.ndarray, " n"]
    levels: tuple[Int64[np.ndarray, " _"], ...]
    shown: tuple[int, ...]
    rest: NodeMotion
    matrices: Float64[np.ndarray, "n 4 4"]
    has_matrix: Bool[np.ndarray, " n"]

    def asset_from_node(self, motion: NodeMotion) -> Float64[np.ndarray, "n 4 4"]:
        """Where the nodes stand in the asset's frame."""
        matrices = np.tile(np.eye(4), (len(self.parents), 1, 1))
        matrices[:, :3, :3] = _rotations(motion.rotation) * motion.scale[:, None, :]
        matrices[:, :3, 3] = motion.translation
        matrices[self.has_matrix] = self.matrices[self.has_matrix]
        for level in self.levels[1:]:
            matrices[level] = matrices[self.parents[level]] @ matrices[level]
        return matrices


def read_nodes(file: GltfFile) -> NodeTree:
    """Take over the nodes of a document; they form trees (asset_check.py).

    Raises:
        GltfFaultError: numbers that are not finite, a rotation of length 0, or a wrong number of weights.
    """
    nodes = file.entries("nodes")
    rest = NodeMotion(
        _vectors(nodes, "translation", (0, 0, 0)),
        _vectors(nodes, "rotation", (0, 0, 0, 1)),
        _vectors(nodes, "scale", (1, 1, 1)),
        tuple(_rest_weights(file, node) for node in nodes),
    )
    lengths = np.linalg.norm(rest.rotation, axis=1, keepdims=True)
    if (lengths < 1e-6).any():
        raise GltfFaultError("a node has a rotation of length 0")
    rest = replace(rest, rotation=rest.rotation / lengths)
    columns = _vectors(nodes, "matrix", np.eye(4).ravel())
    has_matrix = np.array(["matrix" in node for node in nodes], bool)
    parents, levels = _levels(nodes)
    matrices = columns.reshape(-1, 4, 4).transpose(0, 2, 1)
    return NodeTree(parents, levels, _shown(file, nodes), rest, matrices, has_matrix)


def target_count(mesh: dict[str, Any]) -> int:
    """How many morph targets a mesh has."""
    return len(mesh["primitives"][0].get("targets", []))


def _vectors(nodes: list[dict[str, Any]], key: str, default: Any) -> Float64[np.ndarray, "n c"]:  # noqa: ANN401
    width = len(default)
    values = np.array([node.get(key, default) for node in nodes], np.float64).reshape(-1, width)
    if not np.isfinite(values).all():
        raise GltfFaultError(f"a node's {key} is not finite")
    return values


def _rest_weights(file: GltfFile, node: dict[str, Any]) -> Float64[np.ndarray, " t"]:
    """The node's own weights, else the mesh's, else none."""
    if "mesh" not in node:
        return np.zeros(0)
    mesh = file.document["meshes"][node["mesh"]]
    count = target_count(mesh)
    weights = np.array(node.get("weights", mesh.get("weights", [0] * count)), np.float64)
    if weights.shape != (count,) or not np.isfinite(weights).all():
        raise GltfFaultError(f"a mesh of {count} morph targets has the weights {weights.tolist()}")
    return weights


def _levels(nodes: list[dict[str, Any]]) -> tuple[Int64[np.ndarray, " n"], tuple[np.ndarray, ...]]:
    """The parent of each node, -1 for roots, and the nodes of each depth."""
    parents = np.full(len(nodes), -1)
    for index, node in enumerate(nodes):
        parents[node.get("children", [])] = index
    levels, level = [], np.flatnonzero(parents < 0)
    while len(level):
        levels.append(level)
        level = np.flatnonzero(np.isin(parents, level))
    return parents, tuple(levels)


def _shown(file: GltfFile, nodes: list[dict[str, Any]]) -> tuple[int, ...]:
    """Nodes of the default scene in depth-first order; all of them where there is no scene."""
    scenes = file.entries("scenes")
    if not scenes:
        return tuple(range(len(nodes)))
    pending = list(reversed(scenes[file.document.get("scene", 0)].get("nodes", [])))
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
