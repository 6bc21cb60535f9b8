"""Delta voxel cone tracing, the operator as printed in [P1] 3, in radiometric units."""

from typing import Any

from protocol.scene_method import DvctMethod
from render_server.gpu.context import GpuContext
from render_server.passes.trace_paper import TracePaperPass
from render_server.passes.volume import Pyramid, VolumePlacement
from render_server.relight.defaults import ResolvedSettings
from render_server.relight.delta_volume import DIRECTIONS, DeltaVolume
from render_server.relight.dvct_base import DvctBase
from render_server.relight.frame import RelightInput


class DvctPaper(DvctBase):
    """Split-inject into V_delta and V_rho (`volume`), visibility from the joint V_eta, nine diffuse cones."""

    directions = DIRECTIONS

    def __init__(
        self, gpu: GpuContext, settings: DvctMethod, resolved: ResolvedSettings, size: tuple[int, int]
    ) -> None:
        super().__init__(gpu, settings, resolved, size)
        self._tracing = TracePaperPass(gpu)
        self.volume = DeltaVolume(gpu, VolumePlacement((0.0, 0.0, 0.0), 1.0, resolved.volume_size))

    def _rebuild_real(
        self, frame: RelightInput, placement: VolumePlacement, uniforms: dict[str, Any]
    ) -> None:
        self.volume.rebuild_real(frame, self.table, placement, uniforms)

    def _rebuild_virtual(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        self.volume.rebuild_virtual(frame, self.table, uniforms)

    def _trace(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        delta, rho = self.volume.delta, self.volume.rho
        with frame.timers.measure("cones real"):
            self._tracing.trace_real(self._cones, self._grid, delta, frame.picture.linear, uniforms)
        with frame.timers.measure("cones virtual"):
            self._tracing.trace_virtual(self._cones, self._grid, rho, uniforms)

    def _joint(self) -> Pyramid:
        return self.volume.rho
