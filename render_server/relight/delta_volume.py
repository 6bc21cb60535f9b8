"""V_delta and V_rho with the joint opacity of V_eta, as split-inject fills them ([P1] 3.2)."""

from typing import Any

from render_server.gpu.context import GpuContext
from render_server.passes.filter_isotropic import FilterIsotropicPass
from render_server.passes.light_table import LightTable
from render_server.passes.real_albedo import RealAlbedoPass
from render_server.passes.resolve_light import ResolveLightPass
from render_server.passes.split_inject import SplitInjectPass
from render_server.passes.volume import Pyramid, VolumePlacement
from render_server.relight.frame import RelightInput
from render_server.relight.voxel_sets import VoxelSets, bind_lighting, lighting_uniforms

DIRECTIONS = 1


class DeltaVolume(VoxelSets):
    """Two isotropic pyramids: (V_delta, V_eta) with signed radiance, and (V_rho, V_eta)."""

    def __init__(self, gpu: GpuContext, placement: VolumePlacement) -> None:
        super().__init__(gpu, placement, DIRECTIONS)
        self.delta = Pyramid(gpu, placement.size, DIRECTIONS)
        self.rho = Pyramid(gpu, placement.size, DIRECTIONS)
        self._albedo = RealAlbedoPass(gpu)
        self._inject = SplitInjectPass(gpu)
        self._resolve = ResolveLightPass(gpu)
        self._filter = FilterIsotropicPass(gpu)

    def rebuild_real(
        self, frame: RelightInput, table: LightTable, placement: VolumePlacement, uniforms: dict[str, Any]
    ) -> None:
        """Voxelise the real scene and find its albedo."""
        with frame.timers.measure("voxelize"):
            self._voxelize_real(frame.real.corners, placement, [self.delta, self.rho])
        with frame.timers.measure("real albedo"):
            frame.picture.build_levels()
            bind_lighting(frame, table)
            self._albedo.run(table, lighting_uniforms(frame, uniforms))

    def rebuild_virtual(self, frame: RelightInput, table: LightTable, uniforms: dict[str, Any]) -> None:
        """Voxelise the objects, inject the light of all maps, filter."""
        with frame.timers.measure("voxelize"):
            self._voxelize_virtual(frame.virtual, [self.delta, self.rho])
        with frame.timers.measure("split inject"):
            bind_lighting(frame, table)
            lighting = lighting_uniforms(frame, uniforms)
            self._inject.run(self._real, self._virtual, table, self._albedo.atlas, lighting)
        with frame.timers.measure("filter"):
            self._resolve.run(self.delta, self.rho, self._real, self._virtual, self.placement)
            self._filter.run(self.delta, self.rho, self.placement)
