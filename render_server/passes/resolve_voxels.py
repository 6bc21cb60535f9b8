"""Fixed-point sums -> texels of level 0."""

from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.gpu.textures import bind_images
from render_server.passes.volume import Pyramid
from render_server.passes.voxel_store import VoxelStore, bind_storage

RESOLVE = Path(__file__).with_name("resolve_voxels.comp.glsl")


class ResolveVoxelsPass:
    """Writes the mu set (real alone) and the rho set (real with its changed light, and virtual)."""

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._mu = ComputeProgram(gpu, RESOLVE)
        self._rho_real = ComputeProgram(gpu, RESOLVE, {"RHO_REAL": 1})
        self._rho_virtual = ComputeProgram(gpu, RESOLVE, {"RHO_VIRTUAL": 1})

    def resolve_mu(self, pyramid: Pyramid, real: VoxelStore, uniforms: dict[str, Any]) -> None:
        """(c_mu, a_real)."""
        bind_images(pyramid.texture)
        real.bind()
        self._mu.run((self._threads,), **uniforms)

    def resolve_rho(
        self, pyramid: Pyramid, real: VoxelStore, virtual: VoxelStore, uniforms: dict[str, Any]
    ) -> None:
        """(c_rho, a_real + a_virtual)."""
        bind_images(pyramid.texture)
        real.bind()
        bind_storage({8: real.delta_sums, 9: virtual.grid, 10: virtual.sums})
        self._rho_real.run((self._threads,), **uniforms)
        virtual.bind()
        bind_storage({9: real.grid})
        self._rho_virtual.run((self._threads,), **uniforms)

    def release(self) -> None:
        """Free the programs."""
        for program in (self._mu, self._rho_real, self._rho_virtual):
            program.release()
