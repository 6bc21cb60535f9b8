"""Parts of a glTF document in a pose: morph targets, skins and nodes (glTF 2.0, sections 3.7.2.2 and 3.7.3)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64, Int64

from deltalight.render_server.scene.triangle_mesh import (
    Smoothing,
    TriangleMesh,
    joined_tangents,
    joined_triangles,
    turned_tangents,
    unit_or,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, eq=False)
class Morph:
    """Offsets of each morph target at weight 1: to positions and, where the file has them, normals and tangents."""

    positions: tuple[Float32[np.ndarray, "n 3"], ...]
    normals: tuple[Float32[np.ndarray, "n 3"], ...] | None
    tangents: tuple[Float32[np.ndarray, "n 3"], ...] | None


@dataclass(frozen=True, eq=False)
class Skin:
    """Joints of a mesh: their nodes, their inverse bind matrices, and the weight of each joint at each vertex.

    `weights` is sparse (n x j); its rows sum to 1.
    """

    joints: Int64[np.ndarray, " j"]
    joint_from_mesh: Float64[np.ndarray, "j 4 4"]
    weights: "csr_array"


@dataclass(frozen=True, eq=False)
class GltfPart:
    """One primitive at one node: its mesh in the node's frame, before morphing and skinning.

    `smoothing` recomputes the normals of a posed mesh where the file has none.
    """

    node: int
    mesh: TriangleMesh
    smoothing: Smoothing | None
    morph: Morph | None
    skin: Skin | None

    def of_vertices(self, rows: Int64[np.ndarray, " k"]) -> "GltfPart":
        """Returns the part with some of its vertices only, to track their positions."""
        morph, skin = self.morph, self.skin
        if morph is not None:
            morph = Morph(tuple(delta[rows] for delta in morph.positions), None, None)
        if skin is not None:
            skin = replace(skin, weights=skin.weights[rows])
        mesh = replace(
            self.mesh, positions=self.mesh.positions[rows], normals=self.mesh.normals[rows], tangents=None
        )
        return replace(self, mesh=mesh, morph=morph, skin=skin, smoothing=None)


@dataclass(frozen=True, eq=False)
class Pose:
    """Global transforms and morph weights of all nodes."""

    asset_from_node: Float64[np.ndarray, "n 4 4"]
    weights: tuple[Float64[np.ndarray, " _"], ...]

    def equals(self, other: "Pose | None") -> bool:
        """Whether both poses are bit-identical."""
        return (
            other is not None
            and np.array_equal(self.asset_from_node, other.asset_from_node)
            and all(np.array_equal(a, b) for a, b in zip(self.weights, other.weights, strict=True))
        )


def posed(rest: TriangleMesh, parts: Sequence[GltfPart], pose: Pose) -> TriangleMesh:
    """Returns the mesh of one material in a pose."""
    shaped = [_shaped(part, pose) for part in parts]
    return replace(
        rest,
        positions=np.concatenate([mesh.positions for mesh in shaped]),
        normals=np.concatenate([mesh.normals for mesh in shaped]),
        triangles=joined_triangles(
            [mesh.triangles for mesh in shaped], [len(mesh.positions) for mesh in shaped]
        ),
        tangents=joined_tangents(shaped),
    )


def _shaped(part: GltfPart, pose: Pose) -> TriangleMesh:
    """Morphs a part, then places it by its skin or its node. A mirroring node reverses the winding."""
    matrices = matrices_of(part, pose)
    positions = placed(morphed(part, pose), matrices)
    mirrored = part.skin is None and bool(np.linalg.det(matrices[:3, :3]) < 0)
    triangles = np.ascontiguousarray(part.mesh.triangles[:, ::-1]) if mirrored else part.mesh.triangles
    if part.smoothing is not None:
        normals = part.smoothing.normals(positions, triangles)
    else:
        normals = _turned(_morphed_normals(part, pose), matrices, part.mesh.normals, mirrored=mirrored)
    tangents = _morphed_tangents(part, pose)
    if tangents is not None:
        tangents = turned_tangents(tangents, matrices[..., :3, :3], mirrored)
    return replace(part.mesh, positions=positions, normals=normals, triangles=triangles, tangents=tangents)


def matrices_of(part: GltfPart, pose: Pose) -> Float64[np.ndarray, "*n 4 4"]:
    """Returns asset_from_mesh: one matrix, or one per vertex of a skinned mesh, whose node has no effect."""
    if part.skin is None:
        return np.asarray(pose.asset_from_node[part.node])
    return _blended(part.skin, pose)


def _blended(skin: Skin, pose: Pose) -> Float64[np.ndarray, "n 4 4"]:
    """Blends the joints' matrices linearly."""
    asset_from_mesh = pose.asset_from_node[skin.joints] @ skin.joint_from_mesh
    return np.asarray((skin.weights @ asset_from_mesh.reshape(-1, 16)).reshape(-1, 4, 4))


def placed(
    positions: Float32[np.ndarray, "n 3"], matrices: Float64[np.ndarray, "*n 4 4"]
) -> Float32[np.ndarray, "n 3"]:
    """Transforms positions by one matrix, or one each."""
    turned = (matrices[..., :3, :3] @ positions[..., None].astype(np.float64))[..., 0]
    return np.asarray(turned + matrices[..., :3, 3], np.float32)


def morphed(part: GltfPart, pose: Pose) -> Float32[np.ndarray, "n 3"]:
    """Returns the positions of a part's vertices in its mesh's frame."""
    if part.morph is None:
        return part.mesh.positions
    return _added(part.mesh.positions, part.morph.positions, pose.weights[part.node])


def _added(
    base: Float32[np.ndarray, "n 3"],
    deltas: Sequence[Float32[np.ndarray, "n 3"]],
    weights: Float64[np.ndarray, " t"],
) -> Float32[np.ndarray, "n 3"]:
    """Adds weighted deltas."""
    total = base.copy()
    for delta, weight in zip(deltas, weights, strict=True):
        if weight != 0:
            total += np.float32(weight) * delta
    return total


def _morphed_normals(part: GltfPart, pose: Pose) -> Float32[np.ndarray, "n 3"]:
    if part.morph is None or part.morph.normals is None:
        return part.mesh.normals
    return _added(part.mesh.normals, part.morph.normals, pose.weights[part.node])


def _morphed_tangents(part: GltfPart, pose: Pose) -> Float32[np.ndarray, "n 4"] | None:
    tangents, morph = part.mesh.tangents, part.morph
    if tangents is None or morph is None or morph.tangents is None:
        return tangents
    along = _added(tangents[:, :3], morph.tangents, pose.weights[part.node])
    return np.column_stack([along, tangents[:, 3]])


def _turned(
    normals: Float32[np.ndarray, "n 3"],
    matrices: Float64[np.ndarray, "*n 4 4"],
    instead: Float32[np.ndarray, "n 3"],
    *,
    mirrored: bool,
) -> Float32[np.ndarray, "n 3"]:
    """Transforms normals by one matrix, or one each, to unit length.

    Uses the cofactor matrix, which is the inverse transpose but for a factor and exists for singular matrices too:
    clips often hide things by a scale of 0. A normal of length 0 is replaced by that of `instead`.
    """
    # Matrix elements first (scalars, or one per vertex): twice as fast as one small product per vertex.
    a = np.ascontiguousarray(np.moveaxis(matrices[..., :3, :3], (-2, -1), (0, 1)))
    x, y, z = normals.T.astype(np.float64)
    turned = np.empty((len(normals), 3))
    for i in range(3):
        p, q = a[(i + 1) % 3], a[(i + 2) % 3]
        turned[:, i] = (
            (p[1] * q[2] - p[2] * q[1]) * x
            + (p[2] * q[0] - p[0] * q[2]) * y
            + (p[0] * q[1] - p[1] * q[0]) * z
        )
    turned *= -1 if mirrored else 1
    return unit_or(turned, instead)
