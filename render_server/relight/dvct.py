"""Delta voxel cone tracing, the exact operator (METHOD 3 and 4)."""

from typing import Any

from protocol.scene_method import DvctMethod
from render_server.gpu.context import GpuContext
from render_server.passes.trace_cones import TraceConesPass
from render_server.passes.volume import Pyramid, VolumePlacement
from render_server.relight.defaults import ResolvedDvct
from render_server.relight.dvct_base import DvctBase
from render_server.relight.frame import RelightInput
from render_server.relight.voxel_scene import DIRECTIONS, VoxelScene


class DvctExact(DvctBase):
    """Dual march through one-sided directional voxels."""

    directions = DIRECTIONS

    def __init__(
        self, gpu: GpuContext, settings: DvctMethod, resolved: ResolvedDvct, size: tuple[int, int]
    ) -> None:
        super().__init__(gpu, settings, resolved, size)
        self._tracing = TraceConesPass(gpu)
        self._voxels = VoxelScene(gpu, VolumePlacement((0.0, 0.0, 0.0), 1.0, resolved.volume_size))

    def _rebuild_real(
        self, frame: RelightInput, placement: VolumePlacement, uniforms: dict[str, Any]
    ) -> None:
        self._voxels.rebuild_real(frame, self.table, placement, uniforms)

    def _rebuild_virtual(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        self._voxels.rebuild_virtual(frame, self.table, uniforms)

    def _trace(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        voxels = self._voxels
        voxels.bind_support()
        voxels.far.pyramid.texture.use(location=16)
        own = {**uniforms, **voxels.far.uniforms(), "cone_count": self._settings.cone_count}
        with frame.timers.measure("cones real"):
            self._tracing.trace_real(self._cones, self._grid, voxels.mu, voxels.rho, own)
        with frame.timers.measure("cones virtual"):
            self._tracing.trace_virtual(self._cones, self._grid, voxels.mu, voxels.rho, own)

    def _joint(self) -> Pyramid:
        return self._voxels.rho
