"""Differential rendering: two full solutions by one renderer, subtracted ([D] 3.1.1, METHOD 6).

Solution mu knows the real scene alone, solution rho real and virtual surfaces together. Each has voxels, shadow maps
of all of its geometry, and one march a cone of its own; nothing is skipped because objects seem not to reach it. So
this is slow, and what `dvct` must agree with.
"""

from copy import copy
from functools import partial
from typing import Any

import moderngl
import numpy as np

from protocol.scene_method import DifferentialMethod
from render_server.gpu.context import GpuContext
from render_server.passes.direct_light_pair import DirectLightPairPass
from render_server.passes.light_table import LightTable
from render_server.passes.trace_cones import ConeFields, TraceConesPass, bind_pyramids
from render_server.passes.volume import Pyramid, VolumePlacement, place_volume
from render_server.relight.defaults import ResolvedSettings, march_defines
from render_server.relight.frame import RelightInput
from render_server.relight.mirrored_objects import MirroredObjects
from render_server.relight.relight_base import SELF_SHADOW_TEXELS, RelightBase, shadow_receivers
from render_server.relight.voxel_scene import DIRECTIONS
from render_server.relight.voxel_solutions import VoxelSolutions


class Differential(RelightBase):
    """E_rho - E_mu and S_rho - S_mu of two solutions; `table` has the maps of rho."""

    directions = DIRECTIONS

    def __init__(
        self, gpu: GpuContext, settings: DifferentialMethod, resolved: ResolvedSettings, size: tuple[int, int]
    ) -> None:
        self._pair = DirectLightPairPass(gpu, size)
        super().__init__(
            gpu,
            resolved,
            size,
            settings.shadow_samples,
            self._pair,
            screen_space=settings.screen_space,
            march=march_defines(settings),
        )
        self._settings = settings
        self._mu_table = LightTable(gpu, resolved.rsm_size, settings.shadow_samples)
        defines = march_defines(settings)
        self._tracing = TraceConesPass(gpu, self._grid.size, defines)
        self._unused = ConeFields(gpu, self._grid.size)
        self._mirrored = MirroredObjects(gpu, self._grid, self._objects, "gather", defines)
        placement = VolumePlacement((0.0, 0.0, 0.0), 1.0, resolved.volume_size)
        self._voxels = VoxelSolutions(gpu, placement, settings)

    def _placement(self, frame: RelightInput) -> VolumePlacement:
        low, high = frame.virtual.lasting_bounds
        return place_volume(low, high, self._resolved.volume_size, self._settings.volume_edge_m)

    def _uniforms(self, frame: RelightInput, placement: VolumePlacement) -> dict[str, Any]:
        centre = np.mean(np.stack(frame.virtual.bounds), axis=0)
        own = {"normal_offset": SELF_SHADOW_TEXELS * self.table.real_texel_m(centre), "everywhere": True}
        return {**super()._uniforms(frame, placement), **own}

    def _place_lights(self, frame: RelightInput) -> None:
        """Both solutions look through the same views, so that their maps differ by the objects alone."""
        receivers = frame.real.points if frame.everywhere else shadow_receivers(frame)
        receivers, points = (
            np.concatenate([real, frame.virtual.lasting_points]) for real in (receivers, frame.real.points)
        )
        for table in (self._mu_table, self.table):
            if self._environment_version != frame.lights_version:
                table.set_environment(frame.lights.environment)
            table.place(list(frame.lights.lights), points, receivers, np.zeros((0, 3)))
        self._environment_version = frame.lights_version

    def _draw_real_maps(self, frame: RelightInput) -> None:
        """Nothing: maps are drawn when either geometry changes."""

    def _draw_virtual_maps(self, frame: RelightInput) -> None:
        """Nothing either."""

    def _rebuild_real(
        self, frame: RelightInput, placement: VolumePlacement, uniforms: dict[str, Any]
    ) -> None:
        """Nothing: solution mu is not kept while objects move, its light is gathered in step with rho's."""

    def _rebuild_virtual(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        """Both solutions."""
        real, virtual = frame.real.buffers, frame.virtual.buffers
        with frame.timers.measure("shadow maps"):
            for table, meshes in ((self._mu_table, [real]), (self.table, [real, virtual])):
                table.bind_records()
                self._shadow_maps.run(table.real_atlas, meshes, table.real_views, 0)
        self._voxels.rebuild(frame, (self._mu_table, self.table), self._placement(frame), uniforms)

    def _trace(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        """Each solution's cones through its own voxels; the fields are put together."""
        voxels, own, unused = self._voxels, self._bind_march(uniforms), self._unused
        mu, rho = copy(self._cones), copy(self._cones)
        mu.rho, mu.specular_rho = unused.rho, unused.specular_rho
        rho.mu, rho.specular_mu = unused.mu, unused.specular_mu
        with frame.timers.measure("cones real"):
            self._tracing.trace_real(mu, self._grid, voxels.mu, voxels.mu, own)
            self._tracing.trace_real(rho, self._grid, voxels.rho, voxels.rho, own)
        with frame.timers.measure("cones virtual"):
            self._tracing.trace_virtual(self._cones, self._grid, voxels.rho, voxels.rho, own)

    def _light_directly(self, uniforms: dict[str, Any]) -> None:
        self._pair.run_both(self._mu_table, self.table, uniforms)

    def _reflect(self, frame: RelightInput, uniforms: dict[str, Any]) -> moderngl.Texture | None:
        voxels, own = self._voxels, self._bind_march(uniforms)
        wanted = self._settings.reflections == "rays"
        return self._mirrored.run(frame, partial(bind_pyramids, voxels.mu, voxels.rho), own, wanted=wanted)

    def _bind_march(self, uniforms: dict[str, Any]) -> dict[str, Any]:
        """Bind what march.glsl reads beside one solution's voxels; return the uniforms of passes that march."""
        self._voxels.bind_support(everywhere=False)
        self._voxels.far.pyramid.texture.use(location=16)
        bind_pyramids(self._voxels.mu, self._voxels.rho)
        return {**uniforms, **self._voxels.far.uniforms(), "cone_count": self._settings.cone_count}

    def _joint(self) -> Pyramid:
        return self._voxels.rho
