"""Covered faces -> what gets into each cell from its neighbours."""

from pathlib import Path

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.passes.voxel_store import bind_storage

SHADER = Path(__file__).with_name("lpv_transmit.comp.glsl")


class LpvTransmitPass:
    """Shares of light for the real scene alone, and for real and virtual surfaces together."""

    def __init__(self, gpu: GpuContext) -> None:
        self._real = ComputeProgram(gpu, SHADER)
        self._joint = ComputeProgram(gpu, SHADER, {"JOINT": 1})

    def run(
        self, out: moderngl.Buffer, cells: int, real: moderngl.Buffer, virtual: moderngl.Buffer | None = None
    ) -> None:
        """Fill `out` from the covered faces of the real scene, and of the objects if given."""
        bind_storage({8: real, 9: real if virtual is None else virtual, 10: out})
        program = self._real if virtual is None else self._joint
        program.run((cells**3,), cells=cells)

    def release(self) -> None:
        """Free the programs."""
        self._real.release()
        self._joint.release()
