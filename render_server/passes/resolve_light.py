"""Sums of split-inject -> level 0 of V_delta and V_rho, with the marker of V_eta ([P1] 3.2)."""

from pathlib import Path

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.gpu.textures import bind_images
from render_server.passes.volume import Pyramid, VolumePlacement
from render_server.passes.voxel_store import VoxelStore, bind_storage


class ResolveLightPass:
    """Walks the real set, then what only the virtual set touched."""

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._program = ComputeProgram(gpu, Path(__file__).with_name("resolve_light.comp.glsl"))

    def run(
        self,
        delta: Pyramid,
        rho: Pyramid,
        real: VoxelStore,
        virtual: VoxelStore,
        placement: VolumePlacement,
    ) -> None:
        """Write the texels of all touched voxels."""
        bind_images(delta.texture, rho.texture)
        for own, other, skip_shared in ((real, virtual, False), (virtual, real, True)):
            own.bind()
            bind_storage({8: own.delta_sums, 9: other.grid, 10: other.delta_sums})
            self._program.run((self._threads,), skip_shared=skip_shared, **placement.uniforms())

    def release(self) -> None:
        """Free the program."""
        self._program.release()
