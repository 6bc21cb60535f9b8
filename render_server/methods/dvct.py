"""Delta voxel cone tracing with the exact operator (docs/method.md 3 and 4); `dvct_paper.py` has the paper's."""

from collections.abc import Callable
from dataclasses import replace

import moderngl

from deltalight.protocol.scene_method import DvctMethod
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.methods.dvct_paper import InjectedVoxels, dvct_paper
from deltalight.render_server.methods.light_maps import lagging_behind_objects, light_stages
from deltalight.render_server.methods.method import (
    RelightingMethod,
    ResolvedSettings,
    Setup,
    march_defines,
    resolve_voxel_cones,
)
from deltalight.render_server.methods.surface_shading import (
    Layers,
    MethodStages,
    ShadingOptions,
    SurfaceShading,
    shading_stages,
)
from deltalight.render_server.methods.voxel_sets import (
    FAR_SIZE,
    affordable_size,
    sets_memory_mb,
    voxel_placements,
)
from deltalight.render_server.methods.voxel_volumes import DeltaVoxels, delta_voxel_stages, placed_volume
from deltalight.render_server.passes.cones import (
    ConeFields,
    FilterBothCones,
    LowResGrid,
    TraceRealCones,
    TraceVirtualCones,
)
from deltalight.render_server.passes.distant import DistantChange
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.object_bvh import ObjectBvh
from deltalight.render_server.passes.shading import DirectLight
from deltalight.render_server.passes.volumes import MOST_VOLUMES
from deltalight.render_server.passes.voxel_light import NO_SUPPORT
from deltalight.render_server.passes.voxels import DIRECTIONS, VoxelMipmap, memory_statement


class ExactCones:
    """Marches every cone through mu and rho at once.

    On a GPU, what is traced at real surfaces is filtered together with what is at the objects; in software, every
    workgroup would pay for entering the longer kernel.
    """

    def __init__(
        self, gpu: GpuContext, settings: DvctMethod, voxels: DeltaVoxels, fields: ConeFields
    ) -> None:
        size, defines, reuses = fields.mu.size, march_defines(settings), settings.tier.refresh_tiles > 0
        self._voxels, self._fields, self._cone_count = voxels, fields, settings.cone_count
        self._real = TraceRealCones(gpu, size, defines, reuses=reuses)
        self._virtual = TraceVirtualCones(gpu, size, defines, reuses=reuses)
        self._filter_both = None if gpu.is_software else FilterBothCones(gpu, reuses=reuses)
        if reuses:
            fields.keep_irradiance(gpu)

    def marching(self, _mu: VoxelMipmap, _rho: VoxelMipmap) -> dict[str, Binding]:
        """Returns the bindings that cones march with."""
        return self._voxels.march_bindings(self._cone_count)

    def trace_real(self, scene: Bindings, grid: LowResGrid, marching: Bindings) -> ConeFields:
        """Traces the cones at real surfaces: E_mu, E_rho, and the specular cones."""
        voxels, run = self._voxels, self._real.run if self._filter_both is None else self._real.trace
        run(self._fields, grid, voxels.mu, voxels.rho, {**scene, **marching})
        return self._fields

    def refract(
        self,
        fields: ConeFields,
        objects: GeometryState,
        scene: Bindings,
        grid: LowResGrid,
        direct: DirectLight,
        bvh: ObjectBvh,
        seen: Observation,
        marching: Bindings,
    ) -> ConeFields:
        """Bends the cones at real surfaces that meet transparent objects, if there are any."""
        if objects.materials.transmits:
            seen.image.build_levels()
            lit = {**scene, **marching, "direct_mu": direct.light.mu, "direct_rho": direct.light.rho}
            rho = self._voxels.rho
            return self._real.refract(fields, grid, rho, bvh, lit, cone_count=self._cone_count)
        return fields

    def trace_objects(
        self, fields: ConeFields, scene: Bindings, grid: LowResGrid, marching: Bindings
    ) -> ConeFields:
        """Traces the cones at the objects: E_rho and the specular cone."""
        voxels, both = self._voxels, {**scene, **marching}
        if self._filter_both is None:
            self._virtual.run(fields, grid, voxels.mu, voxels.rho, both)
        else:
            self._virtual.trace(fields, grid, voxels.mu, voxels.rho, both)
            self._filter_both.run(fields, grid, (self._real, self._virtual), both)
        return fields

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._real, self._virtual, self._filter_both)


class UnchangedCones:
    """Marches the cones at real surfaces through mu alone, so that no voxels of the objects need light.

    Estimates of light read E_mu under trial lights; nothing is made before the first of them.
    """

    def __init__(
        self, gpu: GpuContext, settings: DvctMethod, voxels: DeltaVoxels, size: tuple[int, int]
    ) -> None:
        self._gpu, self._voxels, self._cone_count = gpu, voxels, settings.cone_count
        self._size, self._defines = size, march_defines(settings)
        self._made: tuple[TraceRealCones, ConeFields, moderngl.Buffer] | None = None

    def trace(self, scene: Bindings, grid: LowResGrid, mu: VoxelMipmap) -> ConeFields:
        """Traces E_mu and the specular cones; those of rho are the same."""
        if self._made is None:
            self._made = (
                TraceRealCones(self._gpu, self._size, self._defines),
                ConeFields(self._gpu, self._size),
                self._gpu.ctx.buffer(NO_SUPPORT),
            )
        tracing, fields, support = self._made
        marching = {**self._voxels.march_bindings(self._cone_count), "Support": support}
        tracing.run(fields, grid, mu, mu, {**scene, **marching})
        return fields

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(*(self._made or ()))


def _shading(gpu: GpuContext, setup: Setup[DvctMethod], lights: LightBuffers) -> SurfaceShading:
    settings, size = setup.settings, setup.picture_size
    shadow_cones = DIRECTIONS if settings.resolved_shadow == "cone" else None
    direct = DirectLight(
        gpu,
        size,
        shadow_cones=shadow_cones,
        ray_shadows=shadow_cones is None and settings.tier.glass_rays,
        reuses=settings.tier.refresh_tiles > 0,
    )
    options = ShadingOptions(
        tier=settings.tier,
        caustics=settings.caustics,
        screen_space=settings.screen_space,
        mirror_gather="gather" if settings.reflections == "rays" else None,
        march=march_defines(settings),
        lists_cones=True,
    )
    return SurfaceShading(gpu, size, setup.resolved, lights, direct, options)


def dvct_exact(g: Graph, s: FrameResources, setup: Setup[DvctMethod]) -> Layers:
    """Marches both solutions at once through one-sided directional voxels."""
    settings, resolved = setup.settings, setup.resolved
    lit = light_stages(
        g, s, resolved, settings.shadow_samples, settings.tier, mirrors=settings.mirrored_lights
    )
    g.section("voxels")
    voxels = g.shared("voxels", lambda: DeltaVoxels(g.gpu, settings, resolved.volume_size))
    with lagging_behind_objects(g, s, lit, settings.tier):
        placement = voxel_placements(g, s, setup, DIRECTIONS)
        mu, rho = delta_voxel_stages(g, s, lit, voxels, placement)
    shading = _shading(g.gpu, setup, lit.buffers)
    cones = ExactCones(g.gpu, settings, voxels, shading.cones)
    marching = g.value("marching", cones.marching, mu, rho)

    def trace(scene: Resource[Bindings], grid: Resource[LowResGrid]) -> Resource[ConeFields]:
        real = g.stage("cones real", cones.trace_real, scene, grid, marching)
        return g.stage("cones", cones.trace_objects, real, scene, grid, marching)

    volume = g.value("volume", placed_volume, "voxelize real")
    distant: Callable[..., Bindings] | None = None
    if settings.tier.distant_light:
        distant = DistantChange(g.gpu, shading.grid.size, march_defines(settings)).trace
    refract = cones.refract if settings.tier.glass_rays else None
    own = MethodStages(volume, trace, rho, marching, find_distant=distant, refract=refract)
    layers = shading_stages(g, s, shading, lit, own)
    unchanged = UnchangedCones(g.gpu, settings, voxels, shading.cones.mu.size)
    return replace(layers, cones_mu=g.stage("cones mu", unchanged.trace, "shading scene", layers.grid, mu))


def dvct(g: Graph, s: FrameResources, setup: Setup[DvctMethod]) -> Layers:
    """The operator that the settings name."""
    declare = dvct_exact if setup.settings.operator == "exact" else dvct_paper
    return declare(g, s, setup)


def state_memory(settings: DvctMethod, resolved: ResolvedSettings) -> str:
    """One sentence on the volumes' memory.

    Raises:
        DeltalightError: it is beyond the budget.
    """
    size, budget_mb = resolved.volume_size, settings.memory_budget_mb
    directions = DIRECTIONS if settings.operator == "exact" else InjectedVoxels.directions
    stated = memory_statement(size, directions, budget_mb, FAR_SIZE if directions == DIRECTIONS else 0)
    divided = affordable_size(size, MOST_VOLUMES, budget_mb, directions=directions)
    if settings.volume_edge_m is not None or not divided:
        return stated
    divided_mb = sets_memory_mb(divided, MOST_VOLUMES, directions)
    return f"{stated}; objects far apart: up to {MOST_VOLUMES} of {divided}^3, {divided_mb} MB"


DVCT = RelightingMethod(DvctMethod, dvct, resolve_voxel_cones, state_memory)
