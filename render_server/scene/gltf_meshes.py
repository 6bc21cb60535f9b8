"""The meshes of a glTF document where its nodes show them, with their morph targets and skins."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.sparse import csr_array

from render_server.scene.gltf_document import GltfFaultError, GltfFile
from render_server.scene.gltf_nodes import NodeTree
from render_server.scene.materials import Material
from render_server.scene.normals import Smoothing
from render_server.scene.triangle_mesh import ConvertedMesh, FileGeometry, TriangleMesh, converted

_TRIANGLES, _STRIP, _FAN = 4, 5, 6


@dataclass(frozen=True, eq=False)
class Morph:
    """What each target adds to vertices and, if the file says so, to their normals, at weight 1."""

    positions: tuple[Float32[np.ndarray, "n 3"], ...]
    normals: tuple[Float32[np.ndarray, "n 3"], ...] | None


@dataclass(frozen=True, eq=False)
class Skin:
    """Joints that a mesh hangs on: their nodes, where the mesh's vertices are in each joint's frame, and the share of
    each joint in each vertex (sparse, n x j, rows sum to 1).
    """

    joints: Int64[np.ndarray, " j"]
    joint_from_mesh: Float64[np.ndarray, "j 4 4"]
    shares: csr_array


@dataclass(frozen=True, eq=False)
class GltfPart:
    """One primitive at one node: its mesh in the node's frame, without morphing and skin.

    `smoothing` is there if the file gives no normals; then they follow the shape.
    """

    node: int
    mesh: TriangleMesh
    smoothing: Smoothing | None
    morph: Morph | None
    skin: Skin | None

    def of_vertices(self, rows: Int64[np.ndarray, " k"]) -> "GltfPart":
        """Some of the vertices alone, to follow where they go."""
        morph, skin = self.morph, self.skin
        if morph is not None:
            morph = Morph(tuple(delta[rows] for delta in morph.positions), None)
        if skin is not None:
            skin = replace(skin, shares=skin.shares[rows])
        mesh = replace(self.mesh, positions=self.mesh.positions[rows], normals=self.mesh.normals[rows])
        return replace(self, mesh=mesh, morph=morph, skin=skin, smoothing=None)


class PartReader:
    """Reads each primitive and each material once, however many nodes show it."""

    def __init__(self, file: GltfFile, nodes: NodeTree) -> None:
        self._file = file
        self._nodes = nodes
        self._materials: dict[int | None, Material] = {}
        self._primitives: dict[tuple[int, int], ConvertedMesh | None] = {}

    def read(self) -> list[tuple[int | None, GltfPart]]:
        """All that nodes show, with the index of its material.

        Raises:
            GltfFaultError: attributes that do not fit each other, or joints that do not exist.
            DeltalightError: geometry or materials that cannot be used.
        """
        parts = []
        for node in self._nodes.shown:
            description = self._file.document["nodes"][node]
            if "mesh" not in description:
                continue
            mesh = self._file.document["meshes"][description["mesh"]]
            for number, primitive in enumerate(mesh["primitives"]):
                made = self._primitive(description["mesh"], number, primitive)
                if made is not None:
                    parts.append((primitive.get("material"), self._part(node, description, primitive, made)))
        return parts

    def _part(
        self, node: int, description: dict[str, Any], primitive: dict[str, Any], made: ConvertedMesh
    ) -> GltfPart:
        count = len(self._nodes.rest.weights[node])
        morph = _morph(self._file, primitive, made, count) if count else None
        skin = None
        if "skin" in description and "JOINTS_0" in primitive["attributes"]:
            skin = self._skin(self._file.document["skins"][description["skin"]], primitive, made)
        return GltfPart(node, made.mesh, made.smoothing, morph, skin)

    def _primitive(self, mesh: int, number: int, primitive: dict[str, Any]) -> ConvertedMesh | None:
        key = mesh, number
        if key not in self._primitives:
            material = self._material(primitive.get("material"))
            given = _geometry(self._file, primitive)
            # What has no area in the mesh itself may have one when it is morphed.
            keeps = "targets" in primitive
            self._primitives[key] = (
                None if given is None else converted(given, material, self._file.path, keeps_degenerate=keeps)
            )
        return self._primitives[key]

    def _material(self, index: int | None) -> Material:
        if index not in self._materials:
            self._materials[index] = _material(self._file, index).checked(str(self._file.path))
        return self._materials[index]

    def _skin(self, skin: dict[str, Any], primitive: dict[str, Any], made: ConvertedMesh) -> Skin:
        joints = np.array(skin["joints"], np.int64)
        if not len(joints) or joints.min() < 0 or joints.max() >= len(self._nodes.parents):
            raise GltfFaultError("a skin names joints that do not exist")
        joint_from_mesh = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            columns = self._file.floats(skin["inverseBindMatrices"], 16).astype(np.float64)
            if len(columns) < len(joints):
                raise GltfFaultError("a skin has fewer inverse bind matrices than joints")
            joint_from_mesh = columns[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
        shares = _joint_shares(self._file, primitive, len(joints))[made.source]
        return Skin(joints, joint_from_mesh, shares)


def _material(file: GltfFile, index: int | None) -> Material:
    if index is None:
        return Material(base_color=np.ones(3, np.float32), name="default")
    description = file.document["materials"][index]
    texture = description.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    return Material.from_gltf(description, None if texture is None else file.texture(texture["index"]))


def _geometry(file: GltfFile, primitive: dict[str, Any]) -> FileGeometry | None:
    """A primitive's own shape; None if it is made of points or lines."""
    mode = primitive.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP, _FAN):
        return None
    attributes = primitive["attributes"]
    positions = file.array(attributes["POSITION"]).astype(np.float32)
    count = len(positions)
    return FileGeometry(
        positions,
        _triangles(file, primitive, mode, count),
        _attribute(file, attributes, "NORMAL", count, 3),
        _uv(file, attributes, count),
        _attribute(file, attributes, "COLOR_0", count, 3),
    )


def _triangles(file: GltfFile, primitive: dict[str, Any], mode: int, count: int) -> Int64[np.ndarray, "m 3"]:
    given = file.array(primitive["indices"])[:, 0].astype(np.int64) if "indices" in primitive else None
    indices = np.arange(count) if given is None else given
    if mode == _TRIANGLES:
        if len(indices) % 3:
            raise GltfFaultError(f"{len(indices)} indices are no whole number of triangles")
        return indices.reshape(-1, 3)
    if len(indices) < 3:
        return np.zeros((0, 3), np.int64)
    first, second, third = indices[:-2], indices[1:-1], indices[2:]
    if mode == _FAN:
        return np.stack([np.full(len(first), indices[0]), second, third], axis=1)
    odd = (np.arange(len(first)) % 2).astype(bool)  # each second triangle of a strip is wound the other way
    return np.stack([first, np.where(odd, third, second), np.where(odd, second, third)], axis=1)


def _attribute(
    file: GltfFile, attributes: dict[str, int], name: str, count: int, columns: int
) -> Float32[np.ndarray, "n c"] | None:
    """The first columns of an attribute (integers as shares of their greatest value), None where there is none."""
    if name not in attributes:
        return None
    rows = file.array(attributes[name])
    if len(rows) != count or rows.shape[1] < columns:
        raise GltfFaultError(f"the attribute {name} does not fit the mesh's {count} vertices")
    scale = np.iinfo(rows.dtype).max if name == "COLOR_0" and rows.dtype.kind == "u" else 1
    return (rows[:, :columns] / np.float32(scale)).astype(np.float32)


def _uv(file: GltfFile, attributes: dict[str, int], count: int) -> Float32[np.ndarray, "n 2"] | None:
    uv = _attribute(file, attributes, "TEXCOORD_0", count, 2)
    return uv if uv is not None and np.isfinite(uv).all() else None


def _morph(file: GltfFile, primitive: dict[str, Any], made: ConvertedMesh, count: int) -> Morph:
    """Targets of a primitive, for the vertices that were made of it."""
    targets: Sequence[dict[str, int]] = primitive.get("targets", [])
    if len(targets) != count:
        raise GltfFaultError("the primitives of a mesh have different numbers of morph targets")
    positions = tuple(_delta(file, target, "POSITION", made) for target in targets)
    gives_normals = made.smoothing is None and any("NORMAL" in target for target in targets)
    normals = tuple(_delta(file, target, "NORMAL", made) for target in targets) if gives_normals else None
    return Morph(positions, normals)


def _delta(
    file: GltfFile, target: dict[str, int], name: str, made: ConvertedMesh
) -> Float32[np.ndarray, "n 3"]:
    if name not in target:
        return np.zeros_like(made.mesh.positions)
    rows = file.floats(target[name], 3)
    if made.source.max() >= len(rows):
        raise GltfFaultError(f"a morph target has {len(rows)} vertices, fewer than its mesh")
    return np.asarray(rows[made.source])


def _joint_shares(file: GltfFile, primitive: dict[str, Any], joint_count: int) -> csr_array:
    """Share of each joint in each of the file's vertices."""
    attributes = primitive["attributes"]
    sets = [name.removeprefix("JOINTS_") for name in sorted(attributes) if name.startswith("JOINTS_")]
    joints = np.hstack([file.array(attributes[f"JOINTS_{name}"]) for name in sets]).astype(np.int64)
    weights = np.hstack([file.floats(attributes[f"WEIGHTS_{name}"], 4) for name in sets])
    if (
        joints.shape != weights.shape
        or len(joints) != file.document["accessors"][attributes["POSITION"]]["count"]
    ):
        raise GltfFaultError("the joints and weights of a skinned mesh do not fit its vertices")
    if (weights < 0).any():
        raise GltfFaultError("a skinned mesh has weights below 0")
    joints[weights == 0] = 0
    if joints.max(initial=0) >= joint_count:
        raise GltfFaultError(f"a skinned mesh hangs on joint {joints.max()} of a skin of {joint_count}")
    sums = weights.sum(axis=1, keepdims=True)
    weights[sums[:, 0] == 0, 0] = (
        1.0  # as viewers do with vertices that hang on nothing: on their first joint
    )
    weights /= np.where(sums == 0, 1, sums)
    rows = np.repeat(np.arange(len(joints)), joints.shape[1])
    # Duplicates are added up, and entries of a row sorted: the same file gives the same sums.
    shares = csr_array((weights.ravel(), (rows, joints.ravel())), shape=(len(joints), joint_count))
    shares.eliminate_zeros()
    return shares
