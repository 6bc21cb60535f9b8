"""A glTF asset that takes poses: nodes moved by a clip, morph targets, skins (glTF 2.0, sections 3.7 and 3.11)."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from protocol.errors import DeltalightError
from render_server.scene.asset_check import read_gltf
from render_server.scene.gltf_animation import Clip, read_clips
from render_server.scene.gltf_document import faults_named
from render_server.scene.gltf_meshes import GltfPart, PartReader, Skin
from render_server.scene.gltf_nodes import NodeTree, read_nodes
from render_server.scene.normals import unit_or
from render_server.scene.triangle_mesh import MAX_COORDINATE_M, TriangleMesh, joined, joined_triangles

# Places in a clip where its bounds are looked up, beside its keys: a turn of 360 degrees is 6 degrees apart then, and
# an arc rises 0.1 % of its radius over the chord.
SWEEP_STEPS = 64
MAX_SWEEP_TIMES = 256
SWEEP_VERTICES = 20_000  # of larger meshes so many are followed
SWEEP_MARGIN = 0.02  # of the longest edge, for what lies between those times and vertices


@dataclass(frozen=True, eq=False)
class Pose:
    """Where all nodes stand in the asset's frame, and the morph weights of each."""

    asset_from_node: Float64[np.ndarray, "n 4 4"]
    weights: tuple[Float64[np.ndarray, " _"], ...]

    def equals(self, other: "Pose | None") -> bool:
        """Whether both are the same to the last bit."""
        return (
            other is not None
            and np.array_equal(self.asset_from_node, other.asset_from_node)
            and all(np.array_equal(a, b) for a, b in zip(self.weights, other.weights, strict=True))
        )


class GltfAsset:
    """Meshes of a document, one a material, in any pose of its clips. The file's axes and units."""

    def __init__(
        self, path: Path, nodes: NodeTree, parts: list[list[GltfPart]], clips: tuple[Clip, ...]
    ) -> None:
        self.clips = clips
        self._path = path
        self._nodes = nodes
        self._parts = parts
        self._rest = [joined([part.mesh for part in same]) for same in parts]
        self._bounds: dict[str, Float64[np.ndarray, "2 3"]] = {}

    def clip(self, wanted: int | str | None) -> Clip | None:
        """The clip of this number or name, the first one for None; None if there is none such."""
        if isinstance(wanted, str):
            return next((clip for clip in self.clips if clip.name == wanted), None)
        number = 0 if wanted is None else wanted
        return self.clips[number] if number < len(self.clips) else None

    def pose(self, clip: Clip | None, time_s: float) -> Pose:
        """The pose of a clip at a time, or the pose at rest."""
        rest = self._nodes.rest
        motion = rest if clip is None else clip.motion(rest, time_s)
        return Pose(self._nodes.asset_from_node(motion), motion.weights)

    def meshes(self, pose: Pose) -> list[TriangleMesh]:
        """The meshes in a pose."""
        return [_posed(rest, same, pose) for rest, same in zip(self._rest, self._parts, strict=True)]

    def bounds(self, clip: Clip) -> Float64[np.ndarray, "2 3"]:
        """Least and greatest coordinates of all poses of a clip, with a margin of 2 %; found once.

        Raises:
            DeltalightError: it moves vertices beyond 10 km.
        """
        if clip.name not in self._bounds:
            self._bounds[clip.name] = self._swept(clip)
        return self._bounds[clip.name]

    def _swept(self, clip: Clip) -> Float64[np.ndarray, "2 3"]:
        followed = [_followed(part, self._vertex_count) for same in self._parts for part in same]
        poses = [self.pose(clip, float(time_s)) for time_s in _sweep_times(clip)]
        points = [_placed(_morphed(part, pose), _matrices(part, pose)) for pose in poses for part in followed]
        low = np.min([part.min(axis=0) for part in points], axis=0).astype(np.float64)
        high = np.max([part.max(axis=0) for part in points], axis=0).astype(np.float64)
        if not np.abs([low, high]).max() <= MAX_COORDINATE_M:
            raise DeltalightError(f"{self._path} moves vertices beyond 10 km; scale its animation to metres.")
        margin = SWEEP_MARGIN * float(np.max(high - low))
        return np.stack([low - margin, high + margin])

    @property
    def _vertex_count(self) -> int:
        return sum(len(mesh.positions) for mesh in self._rest)


def load_gltf(path: Path) -> GltfAsset:
    """Read a .glb or .gltf file with its clips.

    Raises:
        DeltalightError: it is damaged, empty, or holds what cannot be shown.
    """
    file = read_gltf(path)
    with faults_named(path):
        nodes = read_nodes(file)
        together: dict[int | None, list[GltfPart]] = defaultdict(list)
        for material, part in PartReader(file, nodes).read():
            together[material].append(part)
        if not together:
            raise DeltalightError(f"{path} has no triangle with an area; export a triangle mesh.")
        return GltfAsset(path, nodes, list(together.values()), read_clips(file, nodes))


def _sweep_times(clip: Clip) -> Float64[np.ndarray, " k"]:
    times = np.union1d(clip.key_times, np.linspace(0, clip.duration_s, SWEEP_STEPS))
    return times if len(times) <= MAX_SWEEP_TIMES else np.linspace(0, clip.duration_s, MAX_SWEEP_TIMES)


def _followed(part: GltfPart, vertex_count: int) -> GltfPart:
    """A part with the vertices that triangles use, or some of them where the asset has many."""
    used = np.unique(part.mesh.triangles)
    return part.of_vertices(used[:: -(-vertex_count // SWEEP_VERTICES)])


def _posed(rest: TriangleMesh, parts: Sequence[GltfPart], pose: Pose) -> TriangleMesh:
    """The mesh of one material."""
    shaped = [_shaped(part, pose) for part in parts]
    return replace(
        rest,
        positions=np.concatenate([mesh.positions for mesh in shaped]),
        normals=np.concatenate([mesh.normals for mesh in shaped]),
        triangles=joined_triangles(
            [mesh.triangles for mesh in shaped], [len(mesh.positions) for mesh in shaped]
        ),
    )


def _shaped(part: GltfPart, pose: Pose) -> TriangleMesh:
    """One part: morphed, then placed by its skin or its node. A mirroring node turns the winding round."""
    matrices = _matrices(part, pose)
    positions = _placed(_morphed(part, pose), matrices)
    mirrored = part.skin is None and np.linalg.det(matrices[:3, :3]) < 0
    triangles = np.ascontiguousarray(part.mesh.triangles[:, ::-1]) if mirrored else part.mesh.triangles
    if part.smoothing is not None:
        normals = part.smoothing.normals(positions, triangles)
    else:
        normals = _turned(_morphed_normals(part, pose), matrices, part.mesh.normals, mirrored=mirrored)
    return replace(part.mesh, positions=positions, normals=normals, triangles=triangles)


def _matrices(part: GltfPart, pose: Pose) -> Float64[np.ndarray, "*n 4 4"]:
    """asset_from_mesh: one matrix, or with a skin one a vertex (n, 4, 4); a skin's node itself does not count."""
    if part.skin is None:
        return np.asarray(pose.asset_from_node[part.node])
    return _blended(part.skin, pose)


def _blended(skin: Skin, pose: Pose) -> Float64[np.ndarray, "n 4 4"]:
    """Linear blend of the joints' matrices."""
    asset_from_mesh = pose.asset_from_node[skin.joints] @ skin.joint_from_mesh
    return np.asarray((skin.shares @ asset_from_mesh.reshape(-1, 16)).reshape(-1, 4, 4))


def _placed(
    positions: Float32[np.ndarray, "n 3"], matrices: Float64[np.ndarray, "*n 4 4"]
) -> Float32[np.ndarray, "n 3"]:
    """Positions under one matrix, or one each."""
    turned = (matrices[..., :3, :3] @ positions[..., None].astype(np.float64))[..., 0]
    return np.asarray(turned + matrices[..., :3, 3], np.float32)


def _morphed(part: GltfPart, pose: Pose) -> Float32[np.ndarray, "n 3"]:
    if part.morph is None:
        return part.mesh.positions
    return _added(part.mesh.positions, part.morph.positions, pose.weights[part.node])


def _added(
    base: Float32[np.ndarray, "n 3"],
    deltas: Sequence[Float32[np.ndarray, "n 3"]],
    weights: Float64[np.ndarray, " t"],
) -> Float32[np.ndarray, "n 3"]:
    """Base plus weighted deltas."""
    total = base.copy()
    for delta, weight in zip(deltas, weights, strict=True):
        if weight != 0:
            total += np.float32(weight) * delta
    return total


def _morphed_normals(part: GltfPart, pose: Pose) -> Float32[np.ndarray, "n 3"]:
    if part.morph is None or part.morph.normals is None:
        return part.mesh.normals
    return _added(part.mesh.normals, part.morph.normals, pose.weights[part.node])


def _turned(
    normals: Float32[np.ndarray, "n 3"],
    matrices: Float64[np.ndarray, "*n 4 4"],
    instead: Float32[np.ndarray, "n 3"],
    *,
    mirrored: bool,
) -> Float32[np.ndarray, "n 3"]:
    """Unit normals under one matrix, or one each.

    They go by the cofactors, which are the inverse transpose but for a factor, and need no inverse: clips often hide
    things by a scale of 0. What has no normal left keeps the one of `instead`.
    """
    # Elements first (numbers, or one a vertex): twice as fast as a small product each.
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
