"""Cells of light propagation volumes: the light injected into them, and what blocks it between them."""

from dataclasses import dataclass
from functools import partial

import moderngl

from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.gpu.clearing import Start, clear_buffer, clear_for_later
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.methods.caustic_beams import casts_caustics
from deltalight.render_server.methods.light_maps import LitScene
from deltalight.render_server.methods.per_volume import ForEachVolume, PerVolume, volume_pool
from deltalight.render_server.methods.voxel_sets import SURFEL_SHADOW_SAMPLES, surfel_scene
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.lpv import (
    LpvCoverFaces,
    LpvTransmit,
    covered_sums,
    injected_sums,
    transmitted_fractions,
)
from deltalight.render_server.passes.lpv_lighting import LpvInjectMaps, LpvInjectSurfaces
from deltalight.render_server.passes.split_injection import RealAlbedo
from deltalight.render_server.passes.volumes import PlacedVolume, VolumePlacement
from deltalight.render_server.passes.voxel_light import AlbedoTexture
from deltalight.render_server.passes.voxelize import Meshes, Voxelize
from deltalight.render_server.passes.voxels import VoxelStore


class LpvCells:
    """Cells of one size: the surfels of both geometries, what these block, and the light injected from them and maps.

    Two sums are injected: the real scene's light without objects, and the change due to the objects.
    """

    def __init__(self, gpu: GpuContext, settings: DlpvMethod, size: int) -> None:
        self._gpu, self._settings, self.size = gpu, settings, size
        nowhere = VolumePlacement((0.0, 0.0, 0.0), 1.0, size)
        self.volume, self._half_cells = PlacedVolume(gpu, nowhere), PlacedVolume(gpu, nowhere)
        self._real_light, self._change_light = (injected_sums(gpu, size) for _ in range(2))
        self._real_covered, self._virtual_covered = (covered_sums(gpu, size) for _ in range(2))
        self._through_real, self._through_joint = (transmitted_fractions(gpu, size) for _ in range(2))
        self.real, self.objects = (VoxelStore(gpu, 2 * size) for _ in range(2))
        self._voxelize = Voxelize(gpu)
        self._albedo = RealAlbedo(gpu)
        self._maps = LpvInjectMaps(gpu)
        self._surfaces = LpvInjectSurfaces(gpu)
        self._cover = LpvCoverFaces(gpu)
        self._transmit = LpvTransmit(gpu)

    @property
    def _has_geometry(self) -> bool:
        """Whether surfaces block light between cells."""
        return self._settings.resolved_geometry_volume

    @property
    def _blocks_environment(self) -> bool:
        return self._settings.resolved_ambient == "blocked"

    def place(self, cube: VolumePlacement) -> PlacedVolume:
        """Fills the cube with the cells, and the half-size cells for surfels."""
        self.volume.place(cube.divided(self.size))
        self._half_cells.place(cube.divided(2 * self.size))
        return self.volume

    def voxelize_real(self, real: GeometryState, volume: PlacedVolume) -> VoxelStore:
        """Voxelises the real scene into surfels, if anything reads them; all sums of these cells follow it."""
        own = _whole(self.real.grid, self._real_light, self._real_covered)
        clear_for_later(self._gpu, *own, *self._filled_by_objects)
        if self._has_geometry or self._blocks_environment or self._settings.resolved_bounces > 0:
            self._surfels(self.real, real.solid_parts(volume.placement.voxel_edge))
        return self.real

    def voxelize_objects(self, objects: GeometryState, _volume: PlacedVolume) -> VoxelStore:
        """Voxelises the objects into surfels, which the sums of their change follow."""
        clear_for_later(self._gpu, *self._filled_by_objects)
        self._surfels(self.objects, objects.parts)
        return self.objects

    @property
    def _filled_by_objects(self) -> list[Start]:
        return _whole(self.objects.grid, self._change_light, self._virtual_covered)

    def _surfels(self, store: VoxelStore, meshes: Meshes) -> None:
        """Voxelises at half a cell; only the store's surfels are used."""
        clear_buffer(self._gpu, store.grid)
        self._voxelize.run(store, meshes, self._half_cells)

    def real_scene(
        self,
        seen: Observation,
        albedo: AlbedoTexture,
        volume: PlacedVolume,
        _lights: LightSet,
        _environment: moderngl.TextureArray,
        lights: LightBuffers,
    ) -> dict[str, Binding]:
        """Returns the bindings for injecting the real scene's light."""
        seen.image.build_levels()
        own = {"blocks_environment": self._blocks_environment}
        return {**surfel_scene(seen, lights, albedo), **volume.bindings, **own}

    def inject_real(self, real: VoxelStore, scene: Bindings, lights: LightBuffers) -> moderngl.Buffer:
        """Injects the real scene's light without objects."""
        self._albedo.run(lights, scene)
        clear_buffer(self._gpu, self._real_light)
        self._maps.add_real(self._real_light, lights, self._albedo.atlas, scene)
        if self._blocks_environment:
            self._surfaces.add_real(self._real_light, real, scene)
        return self._real_light

    def cover_real(self, real: VoxelStore, volume: PlacedVolume) -> moderngl.Texture3D | None:
        """Computes the transmittance between cells of the real scene; None: nothing is blocked."""
        if not self._has_geometry:
            return None
        self._cover.run(self._real_covered, real, volume.placement)
        self._transmit.run(self._through_real, self.size, self._real_covered)
        return self._through_real

    def joint_scene(
        self, scene: Bindings, objects: GeometryState, lights: LightBuffers
    ) -> dict[str, Binding]:
        """Returns the bindings for injecting the objects' change."""
        return {
            **scene,
            **lights.bindings,
            "shadow_samples": SURFEL_SHADOW_SAMPLES,
            **objects.materials.bindings,
            "has_caustics": self._settings.resolved_caustics and casts_caustics(objects),
        }

    def inject_change(
        self, objects: VoxelStore, scene: Bindings, lights: LightBuffers, _real: moderngl.Buffer
    ) -> moderngl.Buffer:
        """Injects the change due to the objects."""
        clear_buffer(self._gpu, self._change_light)
        self._maps.add_change(self._change_light, lights, self._albedo.atlas, scene)
        self._surfaces.add_virtual(self._change_light, objects, scene)
        return self._change_light

    def cover_joint(
        self,
        objects: VoxelStore,
        state: GeometryState,
        volume: PlacedVolume,
        _real: moderngl.Texture3D | None,
    ) -> tuple[moderngl.Texture3D | None, moderngl.Buffer | None]:
        """Computes the transmittance between cells with the objects, and the sums of faces that these cover.

        None: nothing is blocked.
        """
        if not self._has_geometry:
            return None, None
        self._cover.run(self._virtual_covered, objects, volume.placement, state.buffers.cutouts)
        self._transmit.run(self._through_joint, self.size, self._real_covered, self._virtual_covered)
        return self._through_joint, self._virtual_covered

    def release(self) -> None:
        """Frees the GL objects."""
        release_held(self)


def _whole(*buffers: moderngl.Buffer) -> list[Start]:
    return [(buffer, buffer.size) for buffer in buffers]


def release_held(owner: object) -> None:
    """Frees what the owner's attributes hold."""
    release_all(*(item for name, item in vars(owner).items() if name != "_gpu" and hasattr(item, "release")))


@dataclass(frozen=True, eq=False)
class CellStages:
    """The resources of cells of one size (`cell_stages`), each of all volumes.

    `through` is what lets light pass between cells, `through_real` without the objects, `covered` what the objects
    cover of their faces; `real` and `objects` are surfels.
    """

    real: Resource[PerVolume[VoxelStore]]
    objects: Resource[PerVolume[VoxelStore]]
    joint: Resource[PerVolume[dict[str, Binding]]]
    real_light: Resource[PerVolume[moderngl.Buffer]]
    change: Resource[PerVolume[moderngl.Buffer]]
    through_real: Resource[PerVolume[moderngl.Texture3D | None]]
    through: Resource[PerVolume[moderngl.Texture3D | None]]
    covered: Resource[PerVolume[moderngl.Buffer | None]]


def cell_stages(
    g: Graph,
    s: FrameResources,
    lit: LitScene,
    settings: DlpvMethod,
    cubes: Resource[PerVolume[VolumePlacement]],
    size: int,
) -> CellStages:
    """Declares placement, injection and blocking of `size`^3 cells that fill each of the `cubes`."""
    suffix = "" if size == settings.volume_size else f" {size}"
    pool = volume_pool(g, f"cells{suffix}", partial(LpvCells, g.gpu, settings, size))
    volume = g.value(f"cells{suffix}", ForEachVolume(pool, LpvCells.place), cubes)
    real = g.stage(f"voxelize real{suffix}", ForEachVolume(pool, LpvCells.voxelize_real), s.real, volume)
    inputs = (s.measured, s.albedo, volume, s.lights, lit.environment, lit.real_maps)
    scene = g.value(f"inject scene{suffix}", ForEachVolume(pool, LpvCells.real_scene), *inputs)
    inject_real = ForEachVolume(pool, LpvCells.inject_real)
    real_light = g.stage(f"inject real{suffix}", inject_real, real, scene, lit.real_maps)
    through_real = g.stage(
        f"geometry volume real{suffix}", ForEachVolume(pool, LpvCells.cover_real), real, volume
    )
    objects = g.stage(
        f"voxelize objects{suffix}", ForEachVolume(pool, LpvCells.voxelize_objects), s.objects, volume
    )
    joint_scene = ForEachVolume(pool, LpvCells.joint_scene)
    joint = g.value(f"inject scene joint{suffix}", joint_scene, scene, s.objects, lit.object_maps)
    changed = (objects, joint, lit.object_maps, real_light)
    change = g.stage(f"inject change{suffix}", ForEachVolume(pool, LpvCells.inject_change), *changed)
    blocking = (objects, s.objects, volume, through_real)
    names = f"geometry volume{suffix}", f"covered by objects{suffix}"
    cover = ForEachVolume(pool, LpvCells.cover_joint, outputs=len(names))
    through, covered = g.stages(names[0], cover, *blocking, outputs=names)
    return CellStages(real, objects, joint, real_light, change, through_real, through, covered)
