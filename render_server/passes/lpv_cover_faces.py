"""Geometry volume: how much of each cell face surfaces cover (after Kaplanyan & Dachsbacher 2010)."""

from pathlib import Path

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.passes.volume import VolumePlacement
from render_server.passes.voxel_store import VoxelStore


class LpvCoverFacesPass:
    """Sums the surfels of a store that was filled at half a cell an edge."""

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._program = ComputeProgram(gpu, Path(__file__).with_name("lpv_cover_faces.comp.glsl"))

    def run(self, covered: moderngl.Buffer, store: VoxelStore, cells: VolumePlacement) -> None:
        """Replace the sums of `covered`; `cells` is the placement of the cells."""
        covered.clear()
        store.bind()
        covered.bind_to_storage_buffer(8)
        self._program.run((self._threads,), cells=cells.size, cell_edge=cells.voxel_edge)

    def release(self) -> None:
        """Free the program."""
        self._program.release()
