"""Emptying the voxels that a set had touched, instead of whole volumes."""

from collections.abc import Sequence
from pathlib import Path

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.gpu.textures import bind_images
from render_server.passes.volume import Pyramid, VolumePlacement
from render_server.passes.voxel_store import VoxelStore


class ClearVoxelsPass:
    """Gives back a set's slots and its texels of level 0 (in all `directions`)."""

    def __init__(self, gpu: GpuContext, directions: int) -> None:
        self._threads = list_threads(gpu)
        self._program = ComputeProgram(
            gpu, Path(__file__).with_name("clear_voxels.comp.glsl"), {"DIRECTIONS": directions}
        )

    def run(self, store: VoxelStore, pyramids: Sequence[Pyramid], placement: VolumePlacement) -> None:
        """Empty `store`, and its voxels' texels in each of the pyramids (at least one)."""
        store.bind()
        for index, pyramid in enumerate(pyramids):
            bind_images(pyramid.texture)
            is_last = index == len(pyramids) - 1
            self._program.run((self._threads,), free_slots=is_last, **placement.uniforms())
        store.start(0)

    def release(self) -> None:
        """Free the program."""
        self._program.release()
