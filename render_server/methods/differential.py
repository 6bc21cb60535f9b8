"""Differential rendering: the difference of two full solutions ([D] 3.1.1, docs/method.md 6).

Solution mu contains the real scene alone, solution rho real and virtual surfaces together. Each has its own voxels,
shadow maps of all its geometry, and cone march; nothing is skipped because objects seem not to reach it. It is slow,
and the reference for `dvct`.
"""

from copy import copy
from dataclasses import dataclass
from operator import eq

import moderngl
import numpy as np

from deltalight.protocol.scene_method import DifferentialMethod
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.geometry_state import GeometryState, ObjectExtent
from deltalight.render_server.gpu.clearing import clear_buffer
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.light_models import Light
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.methods.light_maps import (
    LitScene,
    object_extent,
    object_lamps,
    shadow_receivers,
)
from deltalight.render_server.methods.method import (
    RelightingMethod,
    ResolvedSettings,
    Setup,
    march_defines,
    resolve_joint_maps,
)
from deltalight.render_server.methods.surface_shading import (
    Layers,
    MethodStages,
    ShadingOptions,
    SurfaceShading,
    shading_stages,
)
from deltalight.render_server.methods.volume_placement import Placements, only_one, volume_placements
from deltalight.render_server.methods.voxel_sets import (
    FAR_SIZE,
    SURFEL_SHADOW_SAMPLES,
    VoxelSet,
    surfel_scene,
)
from deltalight.render_server.methods.voxel_volumes import DirectionalVoxels, joint_voxels, placed_volume
from deltalight.render_server.passes.caustics import Caustics
from deltalight.render_server.passes.cones import ConeFields, LowResGrid, TraceRealCones, TraceVirtualCones
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.passes.object_bvh import ObjectBvh
from deltalight.render_server.passes.shading import DirectLightPair
from deltalight.render_server.passes.shadow_maps import ShadowMaps
from deltalight.render_server.passes.voxel_light import AlbedoTexture
from deltalight.render_server.passes.voxels import DIRECTIONS, VoxelMipmap, memory_statement
from deltalight.render_server.view import NOWHERE, Rectangle


class SolutionVoxels(DirectionalVoxels):
    """Voxels of two full solutions: the real scene alone (mu), real and virtual together (rho) (docs/method.md 6).

    Each solution sums all its light and opacity under its own maps. Both share the pieces of the real triangles, the
    camera's measurements on them (which give solution rho its reflectance), and the scene beyond the volume, which
    objects do not change.
    """

    def voxelize_both(self, real: VoxelSet, objects: VoxelSet) -> tuple[VoxelSet, VoxelSet]:
        """Groups the surfels of both sets after voxelisation."""
        real.groups.reset(real.store)
        if self._bounces > 0:
            self._group.run(real.store, real.groups, real.volume.bindings)
        return real, objects

    def mu_scene(
        self,
        seen: Observation,
        albedo: AlbedoTexture,
        _lights: LightSet,
        lights: LightBuffers,
        _environment: tuple[moderngl.TextureArray, ...],
        voxels: VoxelSet,
    ) -> dict[str, Binding]:
        """Bindings of what lights the real scene's voxels under one solution's maps."""
        seen.image.build_levels()
        scene = surfel_scene(seen, lights, albedo, measured=self._measured)
        return {**scene, **voxels.volume.bindings, "has_caustics": False}

    def rho_scene(self, scene: Bindings, objects: GeometryState, lights: LightBuffers) -> dict[str, Binding]:
        """Bindings of what lights the voxels of both."""
        own = {**lights.bindings, "shadow_samples": SURFEL_SHADOW_SAMPLES}
        return {**scene, **own, **objects.materials.bindings}

    def light(
        self, _voxels: tuple[VoxelSet, VoxelSet], _far: VoxelSet, mu: Bindings, rho: Bindings
    ) -> "SolutionVoxels":
        """Lights, resolves and filters mu, then rho; with bounces, what is gathered from mu is both's first guess."""
        self.objects.forget_light()
        self._light_mu(mu, gathered=False)
        self._light_rho(rho, gathered=False)
        if self._bounces > 0:
            marching = {**mu, **self.march_bindings(1)}
            for each in (self.real, self.objects):
                self._gather.gather(each.store, each.groups, self.mu, marching)
            self._light_mu(mu, gathered=True)
            self._light_rho(rho, gathered=True)
        return self

    def bounce(self, _lit: "SolutionVoxels", mu: Bindings, rho: Bindings) -> "SolutionVoxels":
        """Gathers light from each solution's own voxels, relights them with it, and finds the bounces' tail."""
        self.set_support(everywhere=True)
        marching = {**mu, **self.march_bindings(1)}
        for _ in range(self._bounces):
            self._gather.gather(self.real.store, self.real.groups, self.mu, marching)
            self._gather.gather(self.real.store, self.real.groups, self.rho, marching, keeps_mu=True)
            self._gather.gather(self.objects.store, self.objects.groups, self.rho, marching)
            self._light_mu(mu, gathered=True)
            self._light_rho(rho, gathered=True)
        self._find_tail(marching)
        return self

    def _light_mu(self, scene: Bindings, *, gathered: bool) -> None:
        real = self.real
        occupied = None if gathered else self.mu.occupied
        self._light.light_solution(
            real.store, scene, real.groups, with_objects=False, gathered=gathered, occupied=occupied
        )
        self._fill_mu(is_first=not gathered)

    def _light_rho(self, scene: Bindings, *, gathered: bool) -> None:
        real, objects, light = self.real, self.objects, self._light
        light.light_solution(real.store, scene, real.groups, with_objects=True, gathered=gathered)
        occupied = None if gathered else self._begin_rho()
        light.light_virtual(objects.store, scene, objects.groups, gathered=gathered, occupied=occupied)
        clear_buffer(self._gpu, real.store.delta_sums)
        if gathered:
            self._fill_rho()
        else:
            self._fill_first_rho()

    def set_support(self, *, everywhere: bool) -> None:
        """Sets the bounds within which march.glsl distinguishes mu from rho: the whole volume or nothing."""
        size = self.real.volume.placement.size
        low, high = (0, size - 1) if everywhere else (size, -1)
        # Unlike those of a delta, these bounds do not depend on the light.
        self._light.reset_support(np.array([low, low, low, -high, -high, -high], np.int32))


def solution_stages(
    g: Graph,
    s: FrameResources,
    voxels: SolutionVoxels,
    placement: Resource[Placements],
    mu_maps: Resource[LightBuffers],
    rho_maps: Resource[LightBuffers],
    environment: Resource[tuple[moderngl.TextureArray, ...]],
) -> Resource[SolutionVoxels]:
    """Declares voxelisation of both geometries, then lighting and bounces in step."""
    real = g.stage("voxelize real", voxels.voxelize_real, s.real, placement)
    beyond = g.stage("voxelize far", voxels.far.voxelize, s.real)
    objects = g.stage("voxelize objects", voxels.voxelize_objects, s.objects, placement)
    both = g.stage("group surfels", voxels.voxelize_both, real, objects)
    given = s.measured, s.albedo, s.lights, mu_maps, environment, real
    mu = g.value("voxel scene mu", voxels.mu_scene, *given)
    rho = g.value("voxel scene rho", voxels.rho_scene, mu, s.objects, rho_maps)
    far = g.stage("light far voxels", voxels.far.light, beyond, mu)
    lit = g.stage("light voxels", voxels.light, both, far, mu, rho)
    return g.stage("bounces", voxels.bounce, lit, mu, rho)


class SolutionLights:
    """The lights' maps of the real scene alone (mu) and with the objects (rho)."""

    def __init__(self, gpu: GpuContext, settings: DifferentialMethod, resolved: ResolvedSettings) -> None:
        self.mu, self.rho = (
            LightBuffers(gpu, resolved.rsm_size, settings.shadow_samples, is_joint=is_joint)
            for is_joint in (False, True)
        )
        self._maps = ShadowMaps(gpu)

    def set_environment(self, lights: LightSet) -> tuple[moderngl.TextureArray, ...]:
        """Uploads the residual environment to both."""
        return tuple(buffers.set_environment(lights.environment) for buffers in (self.mu, self.rho))

    def fit_views(
        self,
        lights: LightSet,
        lamps: tuple[Light, ...],
        real: GeometryState,
        extent: ObjectExtent,
        area: Rectangle,
    ) -> bytes:
        """Fits the views: those of the scene's lights are the same for both, so maps differ by the objects alone.

        Returns their records, which tell whether the maps are still those of the views.
        """
        is_around_objects = area == NOWHERE and not lamps
        receivers = shadow_receivers(real, extent.upright) if is_around_objects else real.points
        receivers, points = (np.concatenate([each, extent.points]) for each in (receivers, real.points))
        for buffers, own in ((self.mu, ()), (self.rho, lamps)):
            buffers.place(list(lights.lights), points, receivers, np.zeros((0, 3)), object_lamps=own)
        return self.rho.real_records

    def draw_mu(self, _views: bytes, real: GeometryState) -> LightBuffers:
        """Draws the real scene alone as the lights see it."""
        return self._drawn(self.mu, real.buffers)

    def draw_rho(self, _views: bytes, real: GeometryState, objects: GeometryState) -> LightBuffers:
        """Draws the real scene with the objects as the lights see both."""
        return self._drawn(self.rho, real.buffers, objects.buffers)

    def _drawn(self, buffers: LightBuffers, *meshes: MeshBuffers) -> LightBuffers:
        self._maps.run(buffers.real_atlas, meshes, buffers.real_views)
        return buffers

    def release(self) -> None:
        """Frees the GL objects."""
        for item in (self.mu, self.rho, self._maps):
            item.release()


@dataclass(frozen=True, eq=False)
class SolutionDirectLight:
    """Direct light at one camera's pixels in both solutions."""

    lights: SolutionLights
    pair: DirectLightPair

    def light_directly(
        self,
        scene: Bindings,
        grid: LowResGrid,
        _caustics: Caustics | None,
        _voxels: VoxelMipmap | None,
        _objects: ObjectBvh,
    ) -> DirectLightPair:
        """Lights the real surfaces under each solution's own maps."""
        self.pair.run_both(self.lights.mu, self.lights.rho, grid, scene)
        return self.pair


class SolutionCones:
    """Marches each solution's cones through its own voxels."""

    def __init__(
        self, gpu: GpuContext, settings: DifferentialMethod, voxels: SolutionVoxels, fields: ConeFields
    ) -> None:
        self._voxels, self._fields, self._cone_count = voxels, fields, settings.cone_count
        size, defines = fields.mu.size, march_defines(settings)
        self._real, self._virtual = TraceRealCones(gpu, size, defines), TraceVirtualCones(gpu, size, defines)
        self._unused = ConeFields(gpu, size)

    def marching(self, voxels: SolutionVoxels) -> dict[str, Binding]:
        """Bindings of what cones march through: one solution's voxels, the same twice."""
        voxels.set_support(everywhere=False)
        return voxels.march_bindings(self._cone_count)

    def trace(self, scene: Bindings, grid: LowResGrid, marching: Bindings) -> ConeFields:
        """Traces cones at real surfaces, a solution after the other, and at the objects; puts the fields together."""
        fields, voxels = self._fields, self._voxels
        mu, rho, own = copy(fields), copy(fields), {**scene, **marching}
        mu.rho, mu.specular_rho = self._unused.rho, self._unused.specular_rho
        rho.mu, rho.specular_mu = self._unused.mu, self._unused.specular_mu
        self._real.run(mu, grid, voxels.mu, voxels.mu, own)
        self._real.run(rho, grid, voxels.rho, voxels.rho, own)
        self._virtual.run(fields, grid, voxels.rho, voxels.rho, own)
        return fields

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._real, self._virtual, self._unused)


def differential(g: Graph, s: FrameResources, setup: Setup[DifferentialMethod]) -> Layers:
    """E_rho - E_mu and S_rho - S_mu of two full solutions; everything shared uses the maps of rho."""
    settings, resolved, size = setup.settings, setup.resolved, setup.picture_size
    g.section("lights")
    lights = g.shared("lights", lambda: SolutionLights(g.gpu, settings, resolved))
    direct = SolutionDirectLight(lights, DirectLightPair(g.gpu, size))
    environment = g.stage("environment", lights.set_environment, s.lights)
    fitted = s.lights, object_lamps(g, s), s.real, object_extent(g, s), s.lit_area
    views = g.stage("light views", lights.fit_views, *fitted, same=eq)
    mu_maps = g.stage("shadow maps mu", lights.draw_mu, views, s.real)
    rho_maps = g.stage("shadow maps rho", lights.draw_rho, views, s.real, s.objects)
    g.section("voxels")
    placement = volume_placements(g, s, only_one(resolved.volume_size), settings.volume_edge_m, settings.tier)
    voxels = g.shared("voxels", lambda: SolutionVoxels(g.gpu, settings, resolved.volume_size))
    lit_voxels = solution_stages(g, s, voxels, placement, mu_maps, rho_maps, environment)
    options = ShadingOptions(
        screen_space=settings.screen_space,
        mirror_gather="gather" if settings.reflections == "rays" else None,
        march=march_defines(settings),
        lists_cones=True,
        is_everywhere=True,
        texel_m=lights.rho.real_texel_m,
    )
    shading = SurfaceShading(g.gpu, size, resolved, lights.rho, direct.pair, options)
    cones = SolutionCones(g.gpu, settings, voxels, shading.cones)
    marching = g.value("marching", cones.marching, lit_voxels)

    def trace(scene: Resource[Bindings], grid: Resource[LowResGrid]) -> Resource[ConeFields]:
        return g.stage("cones", cones.trace, scene, grid, marching)

    lit = LitScene(lights.rho, environment, rho_maps, mu_maps)
    volume = g.value("volume", placed_volume, "voxelize real")
    joint = g.value("joint voxels", joint_voxels, lit_voxels)
    own = MethodStages(volume, trace, joint, marching, light_directly=direct.light_directly)
    return shading_stages(g, s, shading, lit, own)


def state_memory(settings: DifferentialMethod, resolved: ResolvedSettings) -> str:
    """One sentence on the memory of one solution's volumes.

    Raises:
        DeltalightError: it is beyond the budget.
    """
    return memory_statement(resolved.volume_size, DIRECTIONS, settings.memory_budget_mb, FAR_SIZE)


DIFFERENTIAL = RelightingMethod(DifferentialMethod, differential, resolve_joint_maps, state_memory)
