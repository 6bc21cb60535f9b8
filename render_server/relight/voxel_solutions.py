"""The voxels of two full solutions: the real scene alone (mu), and real and virtual together (rho) (METHOD 6)."""

from typing import Any

import numpy as np

from protocol.scene_method import VoxelConeSettings
from render_server.gpu.context import GpuContext
from render_server.passes.filter_voxels import FilterVoxelsPass
from render_server.passes.gather_voxels import GatherVoxelsPass
from render_server.passes.group_surfels import GroupSurfelsPass, SurfelGroups
from render_server.passes.light_table import LightTable
from render_server.passes.light_voxels import LightVoxelsPass
from render_server.passes.resolve_voxels import ResolveVoxelsPass
from render_server.passes.volume import Pyramid, VolumePlacement
from render_server.relight.defaults import march_defines
from render_server.relight.frame import RelightInput
from render_server.relight.voxel_scene import DIRECTIONS, FarScene
from render_server.relight.voxel_sets import VoxelSets, bind_lighting, lighting_uniforms


class VoxelSolutions(VoxelSets):
    """Each solution sums all of its light and opacity, under its own maps, as often as light is gathered.

    Shared are the pieces of the real triangles and what the camera measured there, which tells solution rho what
    a surface gives back of its light; the scene beyond the volume, which objects do not change.
    """

    def __init__(self, gpu: GpuContext, placement: VolumePlacement, settings: VoxelConeSettings) -> None:
        super().__init__(gpu, placement, DIRECTIONS)
        self.mu = Pyramid(gpu, placement.size, DIRECTIONS)
        self.rho = Pyramid(gpu, placement.size, DIRECTIONS)
        self.far = FarScene(gpu, is_used=settings.far_volume)
        self._bounces = settings.bounces
        self._measured = settings.radiance == "measured"
        self._real_groups = SurfelGroups(gpu, placement.size)
        self._virtual_groups = SurfelGroups(gpu, placement.size)
        self._light = LightVoxelsPass(gpu)
        self._group = GroupSurfelsPass(gpu)
        self._gather = GatherVoxelsPass(gpu, march_defines(settings))
        self._resolve = ResolveVoxelsPass(gpu)
        self._filter = FilterVoxelsPass(gpu)

    def rebuild(
        self,
        frame: RelightInput,
        tables: tuple[LightTable, LightTable],
        placement: VolumePlacement,
        uniforms: dict[str, Any],
    ) -> None:
        """Voxelise both geometries, then light, filter and gather in step; `tables` are those of mu and rho."""
        timers = frame.timers
        with timers.measure("voxelize"):
            self._voxelize_real(
                frame.real.solid_corners(placement.voxel_edge), placement, [self.mu, self.rho]
            )
            self.far.voxelize(frame, self._voxelize, self._clear)
            self._voxelize_virtual(frame.virtual, [self.rho])
            self._real_groups.start(self._real)
            self._virtual_groups.start(self._virtual)
        frame.picture.build_levels()
        lighting = lighting_uniforms(frame, uniforms, measured=self._measured)
        self._light_far(frame, tables[0], lighting)
        self._light_both(frame, tables, lighting, gathered=False)
        for bounce in range(self._bounces):
            with timers.measure("bounces"):
                if bounce == 0:
                    self._group.run(self._real, self._real_groups, lighting, has_seen=False)
                    self._group.run(self._virtual, self._virtual_groups, lighting, has_seen=False)
                self._gather_both(lighting)
            self._light_both(frame, tables, lighting, gathered=True)

    def _light_far(self, frame: RelightInput, table: LightTable, lighting: dict[str, Any]) -> None:
        with frame.timers.measure("light voxels"):
            bind_lighting(frame, table)
            self.far.light(frame, table, self._light, lighting)
            self.far.filter(self._resolve, self._filter)

    def _light_both(
        self,
        frame: RelightInput,
        tables: tuple[LightTable, LightTable],
        lighting: dict[str, Any],
        *,
        gathered: bool,
    ) -> None:
        """Light, resolve and filter mu, then rho."""
        with frame.timers.measure("light voxels"):
            bind_lighting(frame, tables[0])
            self._light.light_solution(
                self._real, lighting, self._real_groups, with_objects=False, gathered=gathered
            )
            self._resolve.resolve_mu(self.mu, self._real, self.placement.uniforms())
            bind_lighting(frame, tables[1])
            self._light.light_solution(
                self._real, lighting, self._real_groups, with_objects=True, gathered=gathered
            )
            self._light.light_virtual(self._virtual, lighting, self._virtual_groups, gathered=gathered)
            self._real.delta_sums.clear()
            self._resolve.resolve_rho(self.rho, self._real, self._virtual, self.placement.uniforms())
        with frame.timers.measure("filter"):
            self._filter.run(self.mu, self.placement)
            self._filter.run(self.rho, self.placement)

    def _gather_both(self, lighting: dict[str, Any]) -> None:
        """Irradiance of all groups of surfels, each solution's from its own voxels."""
        self.bind_support(everywhere=True)
        self.far.pyramid.texture.use(location=16)
        marching = {**lighting, **self.far.uniforms()}
        self._gather.gather_real(self._real, self._real_groups, self.mu, self.rho, marching)
        self._gather.gather_virtual(self._virtual, self._virtual_groups, self.rho, marching)

    def bind_support(self, *, everywhere: bool) -> None:
        """Bind bounds inside which march.glsl takes mu and rho for different: the whole volume, or nowhere, where
        both are the same.
        """
        size = self.placement.size
        low, high = (0, size - 1) if everywhere else (size, -1)
        # Unlike those of a delta, they are known before anything is lit.
        self._light.start_support(np.array([low, low, low, -high, -high, -high], np.int32))
        self._light.bind_support()
