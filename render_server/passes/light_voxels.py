"""Lighting of the voxels: radiance and opacity of each surfel, summed per direction (METHOD 4.3)."""

from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.passes.voxel_store import VoxelStore

SHADER = Path(__file__).with_name("light_voxels.comp.glsl")


class LightVoxelsPass:
    """Three variants of one walk over the surfels: real without objects, real's change, virtual."""

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._real = ComputeProgram(gpu, SHADER, {"REAL": 1})
        self._real_delta = ComputeProgram(gpu, SHADER, {"REAL_DELTA": 1})
        self._virtual = ComputeProgram(gpu, SHADER, {"VIRTUAL": 1})
        self.support = gpu.ctx.buffer(reserve=24, dynamic=True)

    def light_real(self, store: VoxelStore, uniforms: dict[str, Any]) -> None:
        """Sum c_mu and a_real."""
        store.bind()
        self._real.run((self._threads,), **uniforms)

    def light_real_delta(
        self, store: VoxelStore, bounds: np.ndarray[Any, np.dtype[np.int32]], uniforms: dict[str, Any]
    ) -> None:
        """Sum c_rho - c_mu of real surfaces; `bounds` (voxels of the objects) grow to the support of the delta."""
        self.support.write(bounds.tobytes())
        store.delta_sums.clear()
        store.bind()
        store.delta_sums.bind_to_storage_buffer(8)
        self.support.bind_to_storage_buffer(9)
        self._real_delta.run((self._threads,), **uniforms)

    def light_virtual(self, store: VoxelStore, uniforms: dict[str, Any]) -> None:
        """Sum c and a of the virtual surfaces."""
        store.bind()
        self._virtual.run((self._threads,), **uniforms)

    def bind_support(self) -> None:
        """Bind the support's bounds to the place that march.glsl names."""
        self.support.bind_to_storage_buffer(9)

    def release(self) -> None:
        """Free the GL objects."""
        for item in (self._real, self._real_delta, self._virtual, self.support):
            item.release()


def bind_picture(linear_picture: moderngl.Texture, real_position: moderngl.Texture) -> None:
    """Bind what picture.glsl reads."""
    linear_picture.use(location=8)
    real_position.use(location=9)
