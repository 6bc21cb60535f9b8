"""Meshes of a glTF document in a pose of its nodes, morph targets and skins (glTF 2.0, sections 3.7 and 3.11)."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, Float64, Int64

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.lights.light_models import Light
from deltalight.render_server.scene.asset_check import left_out, read_gltf
from deltalight.render_server.scene.gltf_animation import Clip, read_clips
from deltalight.render_server.scene.gltf_document import (
    GltfDocument,
    GltfFaultError,
    NodeTree,
    faults_named,
    read_nodes,
)
from deltalight.render_server.scene.gltf_lamps import GltfLamp, dark_lamps, read_lamps
from deltalight.render_server.scene.gltf_posing import (
    GltfPart,
    Morph,
    Pose,
    Skin,
    matrices_of,
    morphed,
    placed,
    posed,
)
from deltalight.render_server.scene.materials import AlphaMode, Material
from deltalight.render_server.scene.texture_maps import TextureReader
from deltalight.render_server.scene.triangle_mesh import (
    MAX_COORDINATE_M,
    ConvertedMesh,
    FileGeometry,
    TriangleMesh,
    converted,
    joined,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
# Times at which the bounds of a clip are sampled beside its keys: a full turn then has steps of 6 degrees, and an arc
# rises 0.1 % of its radius over the chord.
SWEEP_STEPS = 64
MAX_SWEEP_TIMES = 256
MAX_SWEEP_VERTICES = 20_000  # sampled of larger meshes
SWEEP_MARGIN = 0.02  # of the longest edge, for what lies between the sampled times and vertices


class PartReader:
    """Reads each primitive and each material once, however many nodes use it."""

    def __init__(self, gltf: GltfDocument, nodes: NodeTree) -> None:
        self._gltf = gltf
        self._nodes = nodes
        self._textures = TextureReader(gltf)
        self._materials: dict[int | None, Material] = {}
        self._primitives: dict[tuple[int, int], ConvertedMesh | None] = {}

    def read(self) -> list[tuple[int | None, GltfPart]]:
        """Reads the parts of all shown nodes, with the index of their material.

        Raises:
            GltfFaultError: attributes that do not fit each other, or joints that do not exist.
            DeltalightError: geometry or materials that cannot be used.
        """
        parts = []
        for node in self._nodes.shown:
            description = self._gltf.root["nodes"][node]
            if "mesh" not in description:
                continue
            mesh = self._gltf.root["meshes"][description["mesh"]]
            for number, primitive in enumerate(mesh["primitives"]):
                made = self._primitive(description["mesh"], number, primitive)
                if made is not None:
                    parts.append((primitive.get("material"), self._part(node, description, primitive, made)))
        return parts

    def _part(
        self, node: int, description: dict[str, Any], primitive: dict[str, Any], made: ConvertedMesh
    ) -> GltfPart:
        count = len(self._nodes.rest.weights[node])
        morph = _morph(self._gltf, primitive, made, count) if count else None
        skin = None
        if "skin" in description and "JOINTS_0" in primitive["attributes"]:
            skin = self._skin(self._gltf.root["skins"][description["skin"]], primitive, made)
        return GltfPart(node, made.mesh, made.smoothing, morph, skin)

    def _primitive(self, mesh: int, number: int, primitive: dict[str, Any]) -> ConvertedMesh | None:
        key = mesh, number
        if key not in self._primitives:
            material = self._material(primitive.get("material"))
            given = _geometry(self._gltf, primitive, material)
            # What has no area in the mesh itself may have one when it is morphed.
            keeps = "targets" in primitive
            self._primitives[key] = (
                None if given is None else converted(given, material, self._gltf.path, keeps_degenerate=keeps)
            )
        return self._primitives[key]

    def _material(self, index: int | None) -> Material:
        if index not in self._materials:
            self._materials[index] = self._read_material(index).checked(str(self._gltf.path))
        return self._materials[index]

    def _read_material(self, index: int | None) -> Material:
        if index is None:
            return Material(base_color=np.ones(3, np.float32), name="default")
        return Material.from_gltf(
            self._gltf.root["materials"][index],
            self._textures,
            vertices_have_alpha=any(
                _has_alpha(self._gltf, part["attributes"]) for part in self._primitives_of(index)
            ),
        )

    def _primitives_of(self, material: int) -> list[dict[str, Any]]:
        primitives = [part for mesh in self._gltf.entries("meshes") for part in mesh["primitives"]]
        return [part for part in primitives if part.get("material") == material]

    def _skin(self, skin: dict[str, Any], primitive: dict[str, Any], made: ConvertedMesh) -> Skin:
        joints = np.array(skin["joints"], np.int64)
        if not len(joints) or joints.min() < 0 or joints.max() >= len(self._nodes.parents):
            raise GltfFaultError("a skin names joints that do not exist")
        joint_from_mesh = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            columns = self._gltf.floats(skin["inverseBindMatrices"], 16).astype(np.float64)
            if len(columns) < len(joints):
                raise GltfFaultError("a skin has fewer inverse bind matrices than joints")
            joint_from_mesh = columns[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
        weights = _joint_weights(self._gltf, primitive, len(joints))[made.source]
        return Skin(joints, joint_from_mesh, weights)


def _geometry(gltf: GltfDocument, primitive: dict[str, Any], material: Material) -> FileGeometry | None:
    """Returns the geometry of a primitive, with what its material needs; None for points and lines."""
    mode = primitive.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP, _FAN):
        return None
    attributes = primitive["attributes"]
    positions = gltf.array(attributes["POSITION"]).astype(np.float32)
    count = len(positions)
    return FileGeometry(
        positions,
        _triangles(gltf, primitive, mode, count),
        _attribute(gltf, attributes, "NORMAL", count, 3),
        _uv(gltf, attributes, "TEXCOORD_0", count),
        _attribute(gltf, attributes, "COLOR_0", count, 3),
        _uv(gltf, attributes, "TEXCOORD_1", count) if material.has_second_uv else None,
        _opacity(gltf, attributes, count) if _shows_opacity(material) else None,
        _attribute(gltf, attributes, "TANGENT", count, 4) if material.has_normal_maps else None,
    )


def _shows_opacity(material: Material) -> bool:
    return material.alpha_mode == AlphaMode.BLEND or material.vertex_cutoff is not None


def _opacity(gltf: GltfDocument, attributes: dict[str, int], count: int) -> Float32[np.ndarray, "n 1"] | None:
    """Returns the alpha of the vertices' colours; None where they have none."""
    rgba = _attribute(gltf, attributes, "COLOR_0", count, 4) if _has_alpha(gltf, attributes) else None
    return None if rgba is None else rgba[:, 3:]


def _has_alpha(gltf: GltfDocument, attributes: dict[str, int]) -> bool:
    """Whether the vertices' colours have an alpha."""
    return "COLOR_0" in attributes and gltf.root["accessors"][attributes["COLOR_0"]]["type"] == "VEC4"


def _triangles(
    gltf: GltfDocument, primitive: dict[str, Any], mode: int, count: int
) -> Int64[np.ndarray, "m 3"]:
    given = gltf.array(primitive["indices"])[:, 0].astype(np.int64) if "indices" in primitive else None
    indices = np.arange(count) if given is None else given
    if mode == _TRIANGLES:
        if len(indices) % 3:
            raise GltfFaultError(f"{len(indices)} indices are not a whole number of triangles")
        return indices.reshape(-1, 3)
    if len(indices) < 3:
        return np.zeros((0, 3), np.int64)
    first, second, third = indices[:-2], indices[1:-1], indices[2:]
    if mode == _FAN:
        return np.stack([np.full(len(first), indices[0]), second, third], axis=1)
    odd = (np.arange(len(first)) % 2).astype(bool)  # each second triangle of a strip is wound the other way
    return np.stack([first, np.where(odd, third, second), np.where(odd, second, third)], axis=1)


def _attribute(
    gltf: GltfDocument, attributes: dict[str, int], name: str, count: int, columns: int
) -> Float32[np.ndarray, "n c"] | None:
    """Returns the first columns of an attribute (integer colours as 0..1); None where the primitive lacks it."""
    if name not in attributes:
        return None
    rows = gltf.array(attributes[name])
    if len(rows) != count or rows.shape[1] < columns:
        raise GltfFaultError(f"the attribute {name} does not fit the mesh's {count} vertices")
    scale = np.iinfo(rows.dtype).max if name == "COLOR_0" and rows.dtype.kind == "u" else 1
    return (rows[:, :columns] / np.float32(scale)).astype(np.float32)


def _uv(
    gltf: GltfDocument, attributes: dict[str, int], name: str, count: int
) -> Float32[np.ndarray, "n 2"] | None:
    uv = _attribute(gltf, attributes, name, count, 2)
    return uv if uv is not None and np.isfinite(uv).all() else None


def _morph(gltf: GltfDocument, primitive: dict[str, Any], made: ConvertedMesh, count: int) -> Morph:
    """Returns the morph targets of a primitive, for the vertices of its converted mesh."""
    targets: Sequence[dict[str, int]] = primitive.get("targets", [])
    if len(targets) != count:
        raise GltfFaultError("the primitives of a mesh have different numbers of morph targets")
    positions = tuple(_delta(gltf, target, "POSITION", made) for target in targets)
    normals = _deltas(gltf, targets, "NORMAL", made) if made.smoothing is None else None
    tangents = _deltas(gltf, targets, "TANGENT", made) if made.mesh.tangents is not None else None
    return Morph(positions, normals, tangents)


def _deltas(
    gltf: GltfDocument, targets: Sequence[dict[str, int]], name: str, made: ConvertedMesh
) -> tuple[Float32[np.ndarray, "n 3"], ...] | None:
    """Returns an attribute's offsets; None if no target has it."""
    if not any(name in target for target in targets):
        return None
    return tuple(_delta(gltf, target, name, made) for target in targets)


def _delta(
    gltf: GltfDocument, target: dict[str, int], name: str, made: ConvertedMesh
) -> Float32[np.ndarray, "n 3"]:
    if name not in target:
        return np.zeros_like(made.mesh.positions)
    rows = gltf.floats(target[name], 3)
    if made.source.max() >= len(rows):
        raise GltfFaultError(f"a morph target has {len(rows)} vertices, fewer than its mesh")
    return np.asarray(rows[made.source])


def _joint_weights(gltf: GltfDocument, primitive: dict[str, Any], joint_count: int) -> "csr_array":
    """Returns the weight of each joint at each of the file's vertices."""
    attributes = primitive["attributes"]
    sets = [name.removeprefix("JOINTS_") for name in sorted(attributes) if name.startswith("JOINTS_")]
    joints = np.hstack([gltf.array(attributes[f"JOINTS_{name}"]) for name in sets]).astype(np.int64)
    weights = np.hstack([gltf.floats(attributes[f"WEIGHTS_{name}"], 4) for name in sets])
    if (
        joints.shape != weights.shape
        or len(joints) != gltf.root["accessors"][attributes["POSITION"]]["count"]
    ):
        raise GltfFaultError("the joints and weights of a skinned mesh do not fit its vertices")
    if (weights < 0).any():
        raise GltfFaultError("a skinned mesh has weights below 0")
    joints[weights == 0] = 0
    if joints.max(initial=0) >= joint_count:
        raise GltfFaultError(f"a skinned mesh hangs on joint {joints.max()} of a skin of {joint_count}")
    sums = weights.sum(axis=1, keepdims=True)
    weights[sums[:, 0] == 0, 0] = 1.0  # as viewers do: vertices without weights move with their first joint
    weights /= np.where(sums == 0, 1, sums)
    from scipy.sparse import csr_array

    rows = np.repeat(np.arange(len(joints)), joints.shape[1])
    # Duplicates are added up, and entries of a row sorted: the same file gives the same sums.
    matrix = csr_array((weights.ravel(), (rows, joints.ravel())), shape=(len(joints), joint_count))
    matrix.eliminate_zeros()
    return matrix


class GltfAsset:
    """Meshes of a document, one per material, in any pose of its clips, in the file's axes and units.

    `left_out` says what of the document is not shown.
    """

    def __init__(
        self,
        path: Path,
        nodes: NodeTree,
        parts: list[list[GltfPart]],
        clips: tuple[Clip, ...],
        *,
        left_out: str | None = None,
        lamps: tuple[GltfLamp, ...] = (),
    ) -> None:
        self.clips, self.left_out = clips, left_out
        self._lamps = lamps
        self._path = path
        self._nodes = nodes
        self._parts = parts
        self._rest = [joined([part.mesh for part in same]) for same in parts]
        self._bounds: dict[str, Float64[np.ndarray, "2 3"]] = {}

    def clip(self, wanted: int | str | None) -> Clip | None:
        """Returns the clip of this number or name (None: the first); None if there is none."""
        if isinstance(wanted, str):
            return next((clip for clip in self.clips if clip.name == wanted), None)
        number = 0 if wanted is None else wanted
        return self.clips[number] if number < len(self.clips) else None

    def pose(self, clip: Clip | None, time_s: float) -> Pose:
        """Returns the pose of a clip at a time, or the rest pose."""
        rest = self._nodes.rest
        motion = rest if clip is None else clip.motion(rest, time_s)
        return Pose(self._nodes.asset_from_node(motion), motion.weights)

    def meshes(self, pose: Pose) -> list[TriangleMesh]:
        """Returns the meshes in a pose."""
        return [posed(rest, same, pose) for rest, same in zip(self._rest, self._parts, strict=True)]

    def lamps(self, pose: Pose, world_from_asset: Float64[np.ndarray, "4 4"]) -> tuple[Light, ...]:
        """Returns the lights in a pose, in the world."""
        return tuple(lamp.placed(world_from_asset @ pose.asset_from_node[lamp.node]) for lamp in self._lamps)

    def bounds(self, clip: Clip) -> Float64[np.ndarray, "2 3"]:
        """Returns least and greatest coordinates over a whole clip, with a margin of 2 %; computed once.

        Raises:
            DeltalightError: it moves vertices beyond 10 km.
        """
        if clip.name not in self._bounds:
            self._bounds[clip.name] = self._swept(clip)
        return self._bounds[clip.name]

    def _swept(self, clip: Clip) -> Float64[np.ndarray, "2 3"]:
        followed = [_sampled_vertices(part, self._vertex_count) for same in self._parts for part in same]
        poses = [self.pose(clip, float(time_s)) for time_s in _sweep_times(clip)]
        points = [placed(morphed(part, pose), matrices_of(part, pose)) for pose in poses for part in followed]
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
    """Reads a .glb or .gltf file with its clips.

    Raises:
        DeltalightError: it is damaged, empty, or holds what cannot be shown.
    """
    gltf = read_gltf(path)
    with faults_named(path):
        nodes = read_nodes(gltf)
        together: dict[int | None, list[GltfPart]] = defaultdict(list)
        for material, part in PartReader(gltf, nodes).read():
            together[material].append(part)
        if not together:
            raise DeltalightError(f"{path} has no triangle with an area; export a triangle mesh.")
        lamps = read_lamps(gltf, nodes)
        sentences = left_out(gltf), dark_lamps(path, lamps, nodes)
        return GltfAsset(
            path,
            nodes,
            list(together.values()),
            read_clips(gltf, nodes),
            left_out=" ".join(each for each in sentences if each is not None) or None,
            lamps=lamps,
        )


def _sweep_times(clip: Clip) -> Float64[np.ndarray, " k"]:
    times = np.union1d(clip.key_times, np.linspace(0, clip.duration_s, SWEEP_STEPS))
    return times if len(times) <= MAX_SWEEP_TIMES else np.linspace(0, clip.duration_s, MAX_SWEEP_TIMES)


def _sampled_vertices(part: GltfPart, vertex_count: int) -> GltfPart:
    """Returns a part with the vertices that triangles use, or a subset where the asset has many."""
    used = np.unique(part.mesh.triangles)
    return part.of_vertices(used[:: -(-vertex_count // MAX_SWEEP_VERTICES)])
