"""Delta light propagation volumes ([P2], docs/method.md 5)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import moderngl

from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.gpu.clearing import clear_buffer
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.gpu_scene import GeometryState
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.methods.light_maps import LitScene, light_stages
from deltalight.render_server.methods.lighting import (
    SURFEL_SHADOW_SAMPLES,
    Layers,
    Shading,
    ShadingOptions,
    bounced_later,
    casts_caustics,
    shading_stages,
    surfel_scene,
)
from deltalight.render_server.methods.lpv_memory import PrintedSizes, state_memory
from deltalight.render_server.methods.method import RelightingMethod, ResolvedSettings, Setup
from deltalight.render_server.methods.volume_placement import volume_placement
from deltalight.render_server.passes.cones import ConeFields, LowResGrid
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.lpv import (
    LightVolume,
    LpvBoxFilter,
    LpvCoverFaces,
    LpvPropagate,
    LpvShow,
    LpvStart,
    LpvTransmit,
    covered_sums,
    injected_sums,
    lobe_weights,
    moment_weights,
    transmitted_fractions,
)
from deltalight.render_server.passes.lpv_lighting import (
    LpvBounce,
    LpvBounceTail,
    LpvFields,
    LpvInjectMaps,
    LpvInjectSurfaces,
    query_bindings,
)
from deltalight.render_server.passes.shading import DirectLight
from deltalight.render_server.passes.split_injection import RealAlbedo
from deltalight.render_server.passes.volumes import PlacedVolume, VolumePlacement
from deltalight.render_server.passes.voxel_light import AlbedoTexture
from deltalight.render_server.passes.voxelize import Meshes, Voxelize
from deltalight.render_server.passes.voxels import VoxelMipmap, VoxelStore


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
        edge = cube.voxel_edge * cube.size / self.size
        self.volume.place(VolumePlacement(cube.origin, edge, self.size))
        self._half_cells.place(VolumePlacement(cube.origin, edge / 2, 2 * self.size))
        return self.volume

    def voxelize_real(self, real: GeometryState, volume: PlacedVolume) -> VoxelStore:
        """Voxelises the real scene into surfels, if anything reads them."""
        if self._has_geometry or self._blocks_environment or self._settings.resolved_bounces > 0:
            self._surfels(self.real, real.solid_parts(volume.placement.voxel_edge))
        return self.real

    def voxelize_objects(self, objects: GeometryState, _volume: PlacedVolume) -> VoxelStore:
        """Voxelises the objects into surfels."""
        self._surfels(self.objects, objects.parts)
        return self.objects

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
    ) -> moderngl.Texture3D | None:
        """Computes the transmittance between cells with the objects; None: nothing is blocked."""
        if not self._has_geometry:
            return None
        self._cover.run(self._virtual_covered, objects, volume.placement, state.buffers.cutouts)
        self._transmit.run(self._through_joint, self.size, self._real_covered, self._virtual_covered)
        return self._through_joint

    def release(self) -> None:
        """Frees the GL objects."""
        _release_all(self)


def _release_all(owner: object) -> None:
    release_all(*(item for name, item in vars(owner).items() if name != "_gpu" and hasattr(item, "release")))


@dataclass(frozen=True, eq=False)
class CellStages:
    """The resources of cells of one size (`cell_stages`); `through` is what lets light pass between them."""

    volume: Resource[PlacedVolume]
    joint: Resource[dict[str, Binding]]
    real_light: Resource[moderngl.Buffer]
    change: Resource[moderngl.Buffer]
    through: Resource[moderngl.Texture3D | None]


def cell_stages(
    g: Graph,
    s: FrameResources,
    lit: LitScene,
    cells: LpvCells,
    cube: Resource[VolumePlacement],
    suffix: str = "",
) -> CellStages:
    """Declares placement, injection and blocking of cells that fill the `cube`; `suffix` tells sizes apart."""
    volume = g.value(f"volume{suffix}", cells.place, cube)
    real = g.stage(f"voxelize real{suffix}", cells.voxelize_real, s.real, volume)
    inputs = (s.measured, s.albedo, volume, s.lights, lit.environment, lit.real_maps)
    scene = g.value(f"inject scene{suffix}", cells.real_scene, *inputs)
    real_light = g.stage(f"inject real{suffix}", cells.inject_real, real, scene, lit.real_maps)
    through_real = g.stage(f"geometry volume real{suffix}", cells.cover_real, real, volume)
    objects = g.stage(f"voxelize objects{suffix}", cells.voxelize_objects, s.objects, volume)
    joint = g.value(f"inject scene joint{suffix}", cells.joint_scene, scene, s.objects, lit.object_maps)
    change = g.stage(
        f"inject change{suffix}", cells.inject_change, objects, joint, lit.object_maps, real_light
    )
    through = g.stage(f"geometry volume{suffix}", cells.cover_joint, objects, s.objects, volume, through_real)
    return CellStages(volume, joint, real_light, change, through)


class Propagated:
    """A light volume and its steps."""

    def __init__(self, gpu: GpuContext, settings: DlpvMethod, cells: int, steps: int) -> None:
        has_moments = settings.resolved_propagation == "moments"
        self._weights, self._steps = moment_weights(cells) if has_moments else lobe_weights(), steps
        self.light = LightVolume(gpu, cells)
        self._start = LpvStart(gpu)
        self._propagate = LpvPropagate(gpu)

    def run(self, through: moderngl.Texture3D | None, *injected: moderngl.Buffer) -> LightVolume:
        """Propagates the light of one to three injected sums, added up; without `through` nothing blocks it."""
        self._start.run(self.light, *injected)
        self._propagate.run(self.light, self._weights, self._steps, through)
        return self.light

    def release(self) -> None:
        """Frees the GL objects."""
        _release_all(self)


class DifferenceVolumes:
    """V_rho and V_mu.

    V_mu starts from the real scene's light without objects, V_rho from that and the change due to them. Each bounce
    propagates V_rho again with the light that surfaces reflect of it; the last one, if there are two, with what all
    later ones would add. `shown` is the injected change, for debug view `volume`.
    """

    def __init__(self, gpu: GpuContext, settings: DlpvMethod, cells: LpvCells) -> None:
        self._gpu, self._settings, self._cells = gpu, settings, cells
        steps = settings.steps or cells.size
        self._mu, self._rho = (Propagated(gpu, settings, cells.size, steps) for _ in range(2))
        self._bounced, self._before = (injected_sums(gpu, cells.size) for _ in range(2))
        self._bounce = LpvBounce(gpu)
        self._tail = LpvBounceTail(gpu)
        self._shown = VoxelMipmap(gpu, cells.size, 1)
        self._show = LpvShow(gpu)

    def propagate_mu(self, injected: moderngl.Buffer, through: moderngl.Texture3D | None) -> LightVolume:
        """Propagates V_mu."""
        return self._mu.run(through, injected)

    def propagate_rho(
        self, real: moderngl.Buffer, change: moderngl.Buffer, through: moderngl.Texture3D | None
    ) -> LightVolume:
        """Propagates V_rho."""
        return self._rho.run(through, real, change)

    def bounce(
        self,
        rho: LightVolume,
        mu: LightVolume,
        injected: moderngl.Buffer,
        change: moderngl.Buffer,
        scene: Bindings,
        through: moderngl.Texture3D | None,
    ) -> LightVolume:
        """Propagates V_rho again, with the light that surfaces reflect of the previous pass."""
        own = {**scene, **query_bindings(self._settings)}
        last = self._settings.resolved_bounces
        for number in range(1, last + 1):
            self._bounced, self._before = self._before, self._bounced
            clear_buffer(self._gpu, self._bounced)
            self._bounce.run(self._bounced, (self._cells.real, self._cells.objects), (mu, rho), own)
            if number == 2:
                self._tail.measure(self._before, self._bounced)
            if number == last > 1:
                self._tail.extend(self._before, self._bounced)
            self._rho.run(through, injected, change, self._bounced)
        return rho

    def show(self, change: moderngl.Buffer) -> VoxelMipmap:
        """Draws the injected change into cells."""
        self._show.run(self._shown, change)
        return self._shown

    def release(self) -> None:
        """Frees the GL objects."""
        _release_all(self)


class PrintedVolumes:
    """The volumes of [P2] 4.3: V_rho for the objects, V_delta of the indirect change, and one of the direct change.

    The direct change is injected apart from the indirect one, so that it can have steps of its own (none in 4.3.2,
    "n" in section 7, five in fig. 7). `shown` is what was injected of both, for debug view `volume`.
    """

    def __init__(self, gpu: GpuContext, settings: DlpvMethod, sizes: PrintedSizes) -> None:
        self._gpu, self._settings = gpu, settings
        steps, own_steps = settings.steps, settings.objects_steps or settings.steps
        self._rho = Propagated(gpu, settings, sizes.objects, own_steps or sizes.objects)
        self._delta = Propagated(gpu, settings, sizes.indirect, steps or sizes.indirect)
        self._direct: Propagated | None = None
        if settings.resolved_shadow == "lobe":
            self._direct = Propagated(gpu, settings, sizes.direct, settings.resolved_direct_steps)
        self._maps = LpvInjectMaps(gpu)
        self._direct_light = injected_sums(gpu, sizes.direct)
        self._filter = LpvBoxFilter(gpu)
        self._shown = VoxelMipmap(gpu, sizes.indirect, 1)
        self._show = LpvShow(gpu)

    def propagate_rho(
        self, real: moderngl.Buffer, change: moderngl.Buffer, through: moderngl.Texture3D | None
    ) -> LightVolume:
        """Propagates V_rho."""
        return self._rho.run(through, real, change)

    def propagate_delta(self, change: moderngl.Buffer, through: moderngl.Texture3D | None) -> LightVolume:
        """Propagates the indirect change ([P2] 4.3.1)."""
        return self._delta.run(through, change)

    def inject_direct(self, scene: Bindings, lights: LightBuffers) -> moderngl.Buffer:
        """Injects the direct change ([P2] 4.3.2); nothing where shadow maps bring it."""
        if self._direct is not None:
            clear_buffer(self._gpu, self._direct_light)
            self._maps.add_direct(self._direct_light, lights, scene)
        return self._direct_light

    def propagate_direct(
        self, injected: moderngl.Buffer, through: moderngl.Texture3D | None
    ) -> LightVolume | None:
        """Propagates and filters the direct change; None where shadow maps bring it."""
        if self._direct is None:
            return None
        light = self._direct.run(through, injected)
        self._filter.run(light, self._settings.direct_filter or 0)
        return light

    def show(self, change: moderngl.Buffer, direct: moderngl.Buffer) -> VoxelMipmap:
        """Draws the injected change into cells."""
        self._show.run(self._shown, change, direct)
        return self._shown

    def release(self) -> None:
        """Frees the GL objects."""
        _release_all(self)


@dataclass(frozen=True, eq=False)
class LitCells:
    """What a form of the method hands to shading: a reader of fields, V_rho and its volume, that of the change."""

    read: Callable[[LpvFields, Resource[Bindings], Resource[LowResGrid]], Resource[ConeFields]]
    rho: Resource[LightVolume]
    rho_volume: Resource[PlacedVolume]
    volume: Resource[PlacedVolume]
    shown: Resource[VoxelMipmap]


def difference_stages(
    g: Graph, s: FrameResources, lit: LitScene, settings: DlpvMethod, cube: Resource[VolumePlacement]
) -> LitCells:
    """V_mu is subtracted from V_rho."""
    cells = g.shared("cells", lambda: LpvCells(g.gpu, settings, settings.volume_size))
    volumes = g.shared("volumes", lambda: DifferenceVolumes(g.gpu, settings, cells))
    mu = g.stage("propagate mu", volumes.propagate_mu, "inject real", "geometry volume real")
    c = cell_stages(g, s, lit, cells, cube)
    first = g.stage("propagate rho", volumes.propagate_rho, c.real_light, c.change, c.through)
    rho = g.stage("bounces", volumes.bounce, first, mu, c.real_light, c.change, c.joint, c.through)
    shown = g.stage("shown cells", volumes.show, c.change)

    def read(
        fields: LpvFields, scene: Resource[Bindings], grid: Resource[LowResGrid]
    ) -> Resource[ConeFields]:
        return g.stage("cones", fields.read_difference, scene, grid, mu, rho)

    return LitCells(read, rho, c.volume, c.volume, shown)


def printed_stages(
    g: Graph, s: FrameResources, lit: LitScene, settings: DlpvMethod, cube: Resource[VolumePlacement]
) -> LitCells:
    """The change alone is propagated, direct light after and apart from the indirect one ([P2] 4.3)."""
    sizes = PrintedSizes.of(settings)
    size, counts = sizes.indirect, sizes.counts
    volumes = g.shared("volumes", lambda: PrintedVolumes(g.gpu, settings, sizes))
    cells = {n: g.shared(f"cells {n}", partial(LpvCells, g.gpu, settings, n)) for n in counts}
    stages = {n: cell_stages(g, s, lit, cells[n], cube, "" if n == size else f" {n}") for n in counts}
    own, indirect, direct = stages[sizes.objects], stages[sizes.indirect], stages[sizes.direct]
    rho = g.stage("propagate rho", volumes.propagate_rho, own.real_light, own.change, own.through)
    delta = g.stage("propagate delta", volumes.propagate_delta, indirect.change, indirect.through)
    injected = g.stage("inject direct", volumes.inject_direct, direct.joint, lit.object_maps)
    after = g.stage("propagate direct", volumes.propagate_direct, injected, direct.through)
    shown = g.stage("shown cells", volumes.show, indirect.change, injected)

    def read(
        fields: LpvFields, scene: Resource[Bindings], grid: Resource[LowResGrid]
    ) -> Resource[ConeFields]:
        return g.stage("cones", fields.read_printed, scene, grid, delta, after, rho, own.volume)

    return LitCells(read, rho, own.volume, indirect.volume, shown)


def dlpv(g: Graph, s: FrameResources, setup: Setup[DlpvMethod]) -> Layers:
    """Subtracts V_mu from V_rho, or uses the paper's volume of the change."""
    settings, resolved, size = setup.settings, setup.resolved, setup.picture_size
    lit = light_stages(g, s, resolved, settings.shadow_samples, settings.tier)
    g.section("propagation volumes")
    declare = printed_stages if settings.operator == "paper" else difference_stages
    with bounced_later(g, s, lit, settings.tier):
        cube = volume_placement(g, s, resolved.volume_size, settings.volume_edge_m, settings.tier)
        cells = declare(g, s, lit, settings, cube)
    options = ShadingOptions(
        tier=settings.tier,
        caustics=settings.resolved_caustics,
        screen_space=settings.resolved_screen_space,
        mirror_gather="gather_lpv" if settings.resolved_reflections == "rays" else None,
    )
    reuses = settings.tier.refresh_tiles > 0
    direct = DirectLight(g.gpu, size, objects_shadow=settings.resolved_shadow == "map", reuses=reuses)
    shading = Shading(g.gpu, size, resolved, lit.buffers, direct, options)
    fields = LpvFields(g.gpu, settings, shading.cones)
    marching = g.value("marching", fields.marching, cells.rho, cells.rho_volume)

    def read(scene: Resource[Bindings], grid: Resource[LowResGrid]) -> Resource[ConeFields]:
        return cells.read(fields, scene, grid)

    return shading_stages(g, s, shading, lit, cells.volume, read, voxels=cells.shown, marching=marching)


def resolve(settings: DlpvMethod, defaults: ResolvedSettings) -> ResolvedSettings:
    """Takes the document's values, or the machine's defaults where it says null."""
    return ResolvedSettings(
        settings.volume_size,
        settings.query_scale or defaults.cone_scale,
        settings.rsm_size or defaults.rsm_size,
        settings.triangle_budget or defaults.triangle_budget,
    )


DLPV = RelightingMethod(DlpvMethod, dlpv, resolve, state_memory)
