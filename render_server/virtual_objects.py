"""The scene document's objects as one set of triangles in the world, animated to a frame's capture time."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from deltalight.protocol import short_axis
from deltalight.protocol.board import BoardSpec
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_objects import Animation, AnyMaterial, SceneObject
from deltalight.protocol.scene_objects import Material as MaterialDocument
from deltalight.render_server.geometry_state import DrawnMesh, GeometryState, ObjectExtent, PlacedObject
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.lights.light_models import Light
from deltalight.render_server.passes.mesh_buffers import MaterialTable, MeshBuffers
from deltalight.render_server.scene.gaussian_brdf import GaussianBrdf
from deltalight.render_server.scene.gltf_animation import Clip
from deltalight.render_server.scene.gltf_lamps import MOST_LAMPS
from deltalight.render_server.scene.gltf_meshes import GltfAsset
from deltalight.render_server.scene.gltf_posing import Pose
from deltalight.render_server.scene.gpu_mesh import GpuMesh, merged_again
from deltalight.render_server.scene.material_file import read_material
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.mesh_loading import Asset, load_asset
from deltalight.render_server.scene.moved_meshes import TurnedMesh, turned
from deltalight.render_server.scene.triangle_mesh import TriangleMesh, bounds_of

MARKER_FRAME = "marker:"
CORNER_PICKS = np.array(
    [[(index >> axis) & 1 for axis in range(3)] for index in range(8)]
)  # of least, greatest
EACH_AXIS = np.arange(3)


class AnimatedObject:
    """An object that plays a clip; `meshes` are in its current pose, in the asset's frame."""

    def __init__(self, asset: GltfAsset, clip: Clip, animation: Animation) -> None:
        self.asset, self.animation = asset, animation
        self._clip = clip
        self._pose: Pose | None = None
        self.meshes: Sequence[TriangleMesh] = ()

    def lamps(self, world_from_asset: Float64[np.ndarray, "4 4"]) -> tuple[Light, ...]:
        """Returns the asset's lights in the current pose, in the world."""
        return () if self._pose is None else self.asset.lamps(self._pose, world_from_asset)

    def plays(self, asset: GltfAsset, clip: Clip, animation: Animation) -> bool:
        """Whether that is what it plays."""
        return asset is self.asset and clip is self._clip and animation == self.animation

    @property
    def is_still(self) -> bool:
        """Whether its pose never changes."""
        return self.animation.speed == 0 or self._clip.duration_s == 0

    @property
    def bounds(self) -> Float64[np.ndarray, "2 3"]:
        """Least and greatest coordinates over the whole clip, in the asset's frame."""
        return self.asset.bounds(self._clip)

    def advance_to(self, capture_ns: int) -> bool:
        """Poses the meshes for a capture time; returns whether they changed."""
        time_s = self.animation.time_s(capture_ns, self._clip.duration_s)
        pose = self.asset.pose(self._clip, time_s)
        if pose.equals(self._pose):
            return False
        self._pose = pose
        self.meshes = self.asset.meshes(pose)
        return True


def clip_of(item: SceneObject, asset: GltfAsset | None) -> Clip | None:
    """Returns the clip that an object plays; None if it plays none.

    Raises:
        DeltalightError: the object names a clip that its asset does not have.
    """
    playing = item.playing
    if playing is None:
        return None
    clip = None if asset is None else asset.clip(playing.clip)
    if clip is not None or item.animation is None:
        return clip
    if asset is None or not asset.clips:
        raise DeltalightError(
            f"object `{item.id}`: {item.asset} has no animation; leave out `animation`, or export it with its clips."
        )
    names = ", ".join(f"`{each.name}`" for each in asset.clips)
    raise DeltalightError(f"object `{item.id}`: {item.asset} has no clip {playing.clip!r}; it has {names}.")


@dataclass(frozen=True, eq=False)
class _PlacedMeshes:
    """An object's meshes in the world, and the same to be placed elsewhere (`turned`); `points` enclose it."""

    item: PlacedObject
    turned: Sequence[TurnedMesh]
    meshes: Sequence[TriangleMesh]
    points: Float64[np.ndarray, "n 3"]

    @classmethod
    def of(cls, item: PlacedObject, before: "_PlacedMeshes | None") -> "_PlacedMeshes":
        """Places an object's meshes; of those `before` it takes what still holds."""
        matrix = item.world_from_asset
        if before is None or not before._is_turned_alike(item):
            meshes = _with_material(item.meshes, item.material)
            parts: Sequence[TurnedMesh] = [turned(mesh, matrix[:3, :3]) for mesh in meshes]
        elif np.array_equal(before.item.world_from_asset, matrix):
            return before
        else:
            parts = before.turned
        place = matrix[:3, 3]
        points = np.concatenate([_box_corners(part.bounds_at(place)) for part in parts])
        return cls(item, parts, [part.at(place) for part in parts], points)

    def _is_turned_alike(self, item: PlacedObject) -> bool:
        """Whether an object differs by its place alone."""
        own = self.item
        is_same = own.meshes == item.meshes and own.material is item.material
        return is_same and np.array_equal(own.world_from_asset[:3, :3], item.world_from_asset[:3, :3])


@dataclass(frozen=True, eq=False)
class _ObjectInWorld:
    """All that follows from an object's `document` and the `board`, and from its pose if it plays a clip.

    `extent` encloses it at all times; `lamps` are the lights that come with it (world, camera units).
    """

    document: SceneObject
    board: BoardSpec | None
    described: PlacedObject
    placed: _PlacedMeshes
    extent: ObjectExtent
    lamps: list[Light]


class VirtualObjects:
    """Loads assets once; moves them with the document and their clips."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._assets: dict[str, Asset] = {}
        self._buffers = MeshBuffers(gpu)
        self._materials: tuple[tuple[Material, ...], MaterialTable] | None = None
        self._given: dict[AnyMaterial, Material] = {}
        self._shown: tuple[SceneObject, ...] = ()
        self._board: BoardSpec | None = None
        self._moving: dict[str, AnimatedObject] = {}
        self._standing: dict[str, _ObjectInWorld] = {}
        self._kept_merged: tuple[Sequence[Sequence[TriangleMesh]], GpuMesh | None] = (), None
        self.state: GeometryState | None = None

    def load(self, objects: Sequence[SceneObject]) -> None:
        """Loads the assets of all visible objects, so that a bad file is reported before the first frame.

        Raises:
            DeltalightError: an asset or a precomputed material cannot be read, an asset lacks the requested clip, or
                there are too many lamps.
        """
        for item in objects:
            if item.visible:
                if item.asset not in self._assets:
                    self._assets[item.asset] = load_asset(Path(item.asset))
                moving = self._animated(item)
                if moving is not None:
                    _ = moving.bounds
                self._check_material(item)
        self._check_lamps(objects)

    def lamps_of(self, objects: Sequence[SceneObject]) -> list[Light]:
        """Returns the lights that come with loaded objects, in the assets' own coordinates."""
        lit = (item for item in objects if item.visible and item.lamps)
        return [lamp for item in lit for lamp in self._assets[item.asset].lamps(np.eye(4))]

    def _check_lamps(self, objects: Sequence[SceneObject]) -> None:
        count = len(self.lamps_of(objects))
        if count > MOST_LAMPS:
            raise DeltalightError(
                f"the objects bring {count} lamps, more than {MOST_LAMPS}; switch some off with `lamps: 0`."
            )

    def _check_material(self, item: SceneObject) -> None:
        material = self._given_material(item)
        if material is None or material.by_light is None:
            return
        if any(mesh.uv is None for mesh in self._assets[item.asset].meshes):
            raise DeltalightError(
                f"object `{item.id}`: its material's texture needs texture coordinates, and {item.asset} has none; "
                "unwrap the mesh, or take another material."
            )

    def left_out(self, objects: Sequence[SceneObject]) -> list[str]:
        """Returns a sentence for each loaded asset of which something is not shown."""
        loaded = [self._assets[item.asset] for item in objects if item.asset in self._assets]
        return [asset.left_out for asset in loaded if asset.left_out is not None]

    def _animated(self, item: SceneObject) -> AnimatedObject | None:
        """Returns the object animated by its clip: as before if it plays the same; None if it plays none."""
        asset = self._assets[item.asset].animated
        clip = clip_of(item, asset)
        if asset is None or clip is None or item.playing is None:
            return None
        before = self._moving.get(item.id)
        if before is not None and before.plays(asset, clip, item.playing):
            return before
        return AnimatedObject(asset, clip, item.playing)

    def update(
        self, objects: Sequence[SceneObject], board: BoardSpec | None, capture_ns: int
    ) -> GeometryState | None:
        """Returns the visible objects' triangles at that capture time; None if there are none."""
        shown = tuple(item for item in objects if item.visible)
        is_new = shown != self._shown or board != self._board
        if is_new:
            self._shown, self._board = shown, board
            animated = {item.id: self._animated(item) for item in shown}
            self._moving = {name: moving for name, moving in animated.items() if moving is not None}
            names = {item.id for item in shown}
            self._standing = {name: kept for name, kept in self._standing.items() if name in names}
            used = _materials(shown)
            self._given = {each: made for each, made in self._given.items() if each in used}
        moved = [moving.advance_to(capture_ns) for moving in self._moving.values()]
        if is_new or any(moved):
            self.state = self._build() if shown else None
        return self.state

    def _build(self) -> GeometryState | None:
        """Merges and uploads the triangles; returns None if all are degenerate."""
        each = [self._in_world(item) for item in self._shown]
        merged = self._merged([item.placed.meshes for item in each])
        lasting = np.concatenate([item.extent.points for item in each])
        low, high = short_axis.bounds(lasting)
        if not (low < high).any():
            return None
        self._buffers.write(merged)
        materials = self._material_table(merged)
        self._buffers.cutouts = materials.bindings
        return GeometryState(
            DrawnMesh(self._buffers, merged),
            np.concatenate([item.placed.points for item in each]),
            materials,
            objects=tuple(item.described for item in each),
            lamps=tuple(lamp for item in each for lamp in item.lamps),
            swept_points=lasting if any(item.described.moves for item in each) else None,
            extents=tuple(item.extent for item in each),
        )

    def _in_world(self, item: SceneObject) -> _ObjectInWorld:
        """Returns an object in the world: as it was before if it neither was moved nor plays a clip."""
        before, wanted = self._standing.get(item.id), (item, self._board)
        if before is not None and item.id not in self._moving and (before.document, before.board) == wanted:
            return before
        described = self._described(item)
        placed = _PlacedMeshes.of(described, None if before is None else before.placed)
        upright = np.array(short_axis.bounds(self._upright(item, described)))
        extent = ObjectExtent(self._swept(described, placed.points), upright)
        lamps = self._lamps(item, described.world_from_asset)
        found = _ObjectInWorld(item, self._board, described, placed, extent, lamps)
        self._standing[item.id] = found
        return found

    def _material_table(self, merged: GpuMesh) -> MaterialTable:
        """Returns the table on the GPU, rebuilt only if the materials changed."""
        before = self._materials
        if before is not None:
            same = len(before[0]) == len(merged.materials)
            if same and all(a is b for a, b in zip(before[0], merged.materials, strict=True)):
                return before[1]
            before[1].release()
        table = MaterialTable(self._gpu, merged)
        self._materials = merged.materials, table
        return table

    def _described(self, item: SceneObject) -> PlacedObject:
        """Describes the object on its own, as precomputation needs it."""
        moving = self._moving.get(item.id)
        return PlacedObject(
            item.id,
            tuple(self._assets[item.asset].meshes if moving is None else moving.meshes),
            world_from_frame(item, self._board) @ item.world_from_object(),
            self._given_material(item),
            moves=moving is not None and not moving.is_still,
        )

    def _lamps(self, item: SceneObject, world_from_asset: Float64[np.ndarray, "4 4"]) -> list[Light]:
        """Returns the lights that come with an object, as bright as the document wants them; none if they are off."""
        if not item.lamps:
            return []
        moving = self._moving.get(item.id)
        shining = (self._assets[item.asset] if moving is None else moving).lamps(world_from_asset)
        factor = np.full(3, item.lamps, np.float32)
        return [lamp.scaled(factor) for lamp in shining]

    def _given_material(self, item: SceneObject) -> Material | None:
        """Returns the document's material, if it gives one; the same object for the same document."""
        if item.material is None:
            return None
        if item.material not in self._given:
            self._given[item.material] = given_material(item.material)
        return self._given[item.material]

    def _merged(self, objects: Sequence[Sequence[TriangleMesh]]) -> GpuMesh:
        """Merges the meshes of all objects, each object's into a part."""
        before, merged = self._kept_merged
        self._kept_merged = objects, merged_again(merged, before, objects)
        return self._kept_merged[1]

    def _swept(self, item: PlacedObject, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "k 3"]:
        """Returns points that enclose the object at all times."""
        if not item.moves:
            return points
        matrix = item.world_from_asset
        corners = _box_corners(self._moving[item.id].bounds)
        return np.asarray(corners @ matrix[:3, :3].T + matrix[:3, 3])

    def _upright(self, item: SceneObject, placed: PlacedObject) -> Float64[np.ndarray, "8 3"]:
        """Returns the corners of the object's box at all times, about its middle in the world but not turned."""
        corners = _box_corners(self._lasting_bounds(item))
        middle, matrix = short_axis.mean(corners), placed.world_from_asset
        from_middle = (corners - middle) @ item.asset_rotation.T * item.pose.scale
        return np.asarray(matrix[:3, :3] @ middle + matrix[:3, 3] + from_middle)

    def _lasting_bounds(self, item: SceneObject) -> np.ndarray:
        """Returns the least and greatest coordinates of an object at all times, in the asset's frame."""
        moving = self._moving.get(item.id)
        if moving is None:
            return self._assets[item.asset].bounds
        return bounds_of(moving.meshes) if moving.is_still else moving.bounds

    def release(self) -> None:
        """Frees the GL objects."""
        self._buffers.release()
        if self._materials is not None:
            self._materials[1].release()


def given_material(document: AnyMaterial) -> Material:
    """Returns the material that a scene document gives an object, if need be from its file.

    Raises:
        DeltalightError: the file cannot be used.
    """
    if isinstance(document, MaterialDocument):
        return Material.from_document(document)
    read = read_material(Path(document.precomputed))
    if isinstance(read, GaussianBrdf):
        return Material.from_measured(read)
    return Material.from_texture_by_light(read)


def _with_material(meshes: Sequence[TriangleMesh], material: Material | None) -> Sequence[TriangleMesh]:
    """Returns the meshes with the material that replaces their own, if there is one."""
    if material is None:
        return meshes
    return [each.changed(material=material, colors=None, opacity=None, tangents=None) for each in meshes]


def _materials(objects: Sequence[SceneObject]) -> set[AnyMaterial]:
    """Returns the materials that the document gives its objects."""
    return {item.material for item in objects if item.material is not None}


def world_from_frame(item: SceneObject, board: BoardSpec | None) -> Float64[np.ndarray, "4 4"]:
    """Returns the frame of an object's pose: the world, or a board marker (origin at its top-left corner)."""
    matrix = np.eye(4)
    if not item.frame.startswith(MARKER_FRAME):
        return matrix
    marker = int(item.frame.removeprefix(MARKER_FRAME))
    corners = board.corner_points() if board is not None else {}
    if marker not in corners:
        raise DeltalightError(
            f"object `{item.id}` stands on marker {marker}, which the board does not have: "
            "use `frame: world` or one of the board's ids."
        )
    matrix[:3, 3] = corners[marker][0]
    return matrix


def _box_corners(bounds: np.ndarray) -> Float64[np.ndarray, "8 3"]:
    """Returns the eight corners of a box given as (least, greatest)."""
    return np.asarray(np.asarray(bounds, np.float64)[CORNER_PICKS, EACH_AXIS])
