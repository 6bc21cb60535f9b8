"""Differential rendering: the difference of two full solutions ([D] 3.1.1, docs/method.md 6).

Solution mu contains the real scene alone, solution rho real and virtual surfaces together. Each has its own voxels,
shadow maps of all its geometry, and cone march; nothing is skipped because objects seem not to reach it. It is slow,
and the reference for `dvct`.
"""

from copy import copy

import numpy as np

from protocol.scene_method import DifferentialMethod
from render_server.frame import FrameResources
from render_server.gpu.context import GpuContext
from render_server.gpu.kernel import Binding, Bindings
from render_server.gpu_scene import GeometryState
from render_server.graph import Graph, Resource
from render_server.lights.lights import LightSet
from render_server.methods.lighting import (
    Layers,
    LitScene,
    Points,
    Shading,
    ShadingOptions,
    object_extent,
    shading_stages,
    shadow_receivers,
    volume_placement,
)
from render_server.methods.settings import ResolvedSettings, Setup, march_defines
from render_server.methods.voxel_volumes import SolutionVoxels, solution_stages
from render_server.passes.caustics import Caustics
from render_server.passes.cones import ConeFields, LowResGrid, TraceCones
from render_server.passes.lights import LightBuffers
from render_server.passes.shading import DirectLightPair
from render_server.passes.shadow_maps import ShadowMaps
from render_server.passes.voxels import VoxelMipmap


class TwoSolutions:
    """Shadow maps, direct light and cones of both solutions."""

    def __init__(
        self,
        gpu: GpuContext,
        settings: DifferentialMethod,
        resolved: ResolvedSettings,
        size: tuple[int, int],
        voxels: SolutionVoxels,
    ) -> None:
        self.mu, self.rho = (LightBuffers(gpu, resolved.rsm_size, settings.shadow_samples) for _ in range(2))
        self.direct = DirectLightPair(gpu, size)
        self._voxels, self._cone_count = voxels, settings.cone_count
        self._maps = ShadowMaps(gpu)
        self._gpu, self._defines = gpu, march_defines(settings)
        self._tracing: TraceCones | None = None
        self._unused: ConeFields | None = None

    def set_environment(self, lights: LightSet) -> LightBuffers:
        """Uploads the residual environment to both solutions."""
        for buffers in (self.mu, self.rho):
            buffers.set_environment(lights.environment)
        return self.rho

    def fit_views(
        self, lights: LightSet, real: GeometryState, extent: Points, everywhere: bool
    ) -> LightBuffers:
        """Fits one set of views for both solutions, so that their maps differ by the objects alone."""
        receivers = real.points if everywhere else shadow_receivers(real, extent)
        receivers, points = (np.concatenate([each, extent]) for each in (receivers, real.points))
        for buffers in (self.mu, self.rho):
            buffers.place(list(lights.lights), points, receivers, np.zeros((0, 3)))
        return self.rho

    def draw_maps(
        self, _views: LightBuffers, real: GeometryState, objects: GeometryState
    ) -> tuple[LightBuffers, LightBuffers]:
        """Draws the maps of the real scene alone, and of the real scene with the objects."""
        for buffers, meshes in ((self.mu, [real.buffers]), (self.rho, [real.buffers, objects.buffers])):
            self._maps.run(buffers.real_atlas, meshes, buffers.real_views, 0, buffers.bindings)
        return self.mu, self.rho

    def marching(self, voxels: SolutionVoxels) -> dict[str, Binding]:
        """Returns the bindings for marching one solution's voxels: the same voxels as mu and as rho."""
        voxels.set_support(everywhere=False)
        return voxels.march_bindings(self._cone_count)

    def trace(self, fields: ConeFields, scene: Bindings, grid: LowResGrid, marching: Bindings) -> ConeFields:
        """Traces each solution's cones through its own voxels and combines the results."""
        if self._tracing is None or self._unused is None:
            self._tracing = TraceCones(self._gpu, grid.size, self._defines)
            self._unused = ConeFields(self._gpu, grid.size)
        mu, rho, own, voxels = copy(fields), copy(fields), {**scene, **marching}, self._voxels
        mu.rho, mu.specular_rho = self._unused.rho, self._unused.specular_rho
        rho.mu, rho.specular_mu = self._unused.mu, self._unused.specular_mu
        self._tracing.trace_real(mu, grid, voxels.mu, voxels.mu, own)
        self._tracing.trace_real(rho, grid, voxels.rho, voxels.rho, own)
        self._tracing.trace_virtual(fields, grid, voxels.rho, voxels.rho, own)
        return fields

    def light_directly(
        self, scene: Bindings, grid: LowResGrid, _caustics: Caustics | None, _voxels: VoxelMipmap
    ) -> DirectLightPair:
        """Computes direct light, each solution under its own maps."""
        self.direct.run_both(self.mu, self.rho, grid, scene)
        return self.direct

    def release(self) -> None:
        """Frees the GL objects."""
        for item in (self.mu, self.rho, self._maps, self._tracing, self._unused):
            if item is not None:
                item.release()


def differential(g: Graph, s: FrameResources, setup: Setup[DifferentialMethod]) -> Layers:
    """E_rho - E_mu and S_rho - S_mu of two full solutions; everything shared uses the maps of rho."""
    settings, resolved, size = setup.settings, setup.resolved, setup.picture_size
    voxels = SolutionVoxels(g.gpu, settings, resolved.volume_size)
    two = TwoSolutions(g.gpu, settings, resolved, size, voxels)
    environment = g.stage("environment", two.set_environment, s.lights)
    views = g.stage("light views", two.fit_views, s.lights, s.real, object_extent(g, s), s.everywhere)
    mu_maps, rho_maps = g.stages(
        "shadow maps", two.draw_maps, views, s.real, s.objects, outputs=("shadow maps mu", "shadow maps rho")
    )
    placement = volume_placement(g, s, resolved.volume_size, settings.volume_edge_m)
    lit_voxels = solution_stages(g, s, voxels, placement, mu_maps, rho_maps)
    lit = LitScene(two.rho, environment, rho_maps, mu_maps, environment)
    options = ShadingOptions(
        screen_space=settings.screen_space,
        mirror_gather="gather" if settings.reflections == "rays" else None,
        march=march_defines(settings),
    )
    shading = Shading(g.gpu, size, resolved, two.rho, two.direct, options)
    shading.normal_offset = two.rho.real_texel_m
    shading.is_everywhere = True
    marching = g.stage("marching", two.marching, lit_voxels)
    fields = g.stage("cone fields", lambda _: shading.cones, s.view)

    def trace(scene: Resource[Bindings], grid: Resource[LowResGrid]) -> Resource[ConeFields]:
        return g.stage("cones", two.trace, fields, scene, grid, marching)

    volume = g.stage("volume", lambda voxels: voxels.real.volume, lit_voxels)
    joint = g.stage("joint voxels", lambda voxels: voxels.rho, lit_voxels)
    return shading_stages(g, s, shading, lit, volume, joint, marching, trace, two.light_directly)
