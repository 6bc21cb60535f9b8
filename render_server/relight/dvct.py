"""Delta voxel cone tracing, the exact operator (METHOD 3 and 4)."""

from functools import partial
from typing import Any

import moderngl

from protocol.scene_method import DvctMethod
from render_server.gpu.context import GpuContext
from render_server.passes.trace_cones import TraceConesPass, bind_pyramids
from render_server.passes.volume import Pyramid, VolumePlacement
from render_server.relight.defaults import ResolvedSettings, march_defines
from render_server.relight.dvct_base import DvctBase
from render_server.relight.frame import RelightInput
from render_server.relight.mirrored_objects import MirroredObjects
from render_server.relight.voxel_scene import DIRECTIONS, VoxelScene


class DvctExact(DvctBase):
    """Dual march through one-sided directional voxels."""

    directions = DIRECTIONS

    def __init__(
        self, gpu: GpuContext, settings: DvctMethod, resolved: ResolvedSettings, size: tuple[int, int]
    ) -> None:
        super().__init__(gpu, settings, resolved, size)
        defines = march_defines(settings)
        self._tracing = TraceConesPass(gpu, self._grid.size, defines)
        self._mirrored = MirroredObjects(gpu, self._grid, self._objects, "gather", defines)
        placement = VolumePlacement((0.0, 0.0, 0.0), 1.0, resolved.volume_size)
        self._voxels = VoxelScene(gpu, placement, settings)

    def _rebuild_real(
        self, frame: RelightInput, placement: VolumePlacement, uniforms: dict[str, Any]
    ) -> None:
        self._voxels.rebuild_real(frame, self.table, placement, uniforms)

    def _rebuild_virtual(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        self._voxels.rebuild_virtual(frame, self.table, uniforms)

    def _trace(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        voxels, own = self._voxels, self._bind_march(uniforms)
        with frame.timers.measure("cones real"):
            self._tracing.trace_real(self._cones, self._grid, voxels.mu, voxels.rho, own)
        with frame.timers.measure("cones virtual"):
            self._tracing.trace_virtual(self._cones, self._grid, voxels.mu, voxels.rho, own)

    def _reflect(self, frame: RelightInput, uniforms: dict[str, Any]) -> moderngl.Texture | None:
        voxels, own = self._voxels, self._bind_march(uniforms)
        wanted = self._settings.reflections == "rays"
        return self._mirrored.run(frame, partial(bind_pyramids, voxels.mu, voxels.rho), own, wanted=wanted)

    def _bind_march(self, uniforms: dict[str, Any]) -> dict[str, Any]:
        """Bind what march.glsl reads beside mu and rho; return the uniforms of passes that march."""
        self._voxels.bind_support()
        self._voxels.far.pyramid.texture.use(location=16)
        bind_pyramids(self._voxels.mu, self._voxels.rho)
        return {**uniforms, **self._voxels.far.uniforms(), "cone_count": self._settings.cone_count}

    def _joint(self) -> Pyramid:
        return self._voxels.rho
