"""Voxelisation: triangles -> surfels, touched voxels (METHOD 4.2)."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.passes.volume import VolumePlacement
from render_server.passes.voxel_store import VoxelStore
from render_server.scene.gpu_mesh import split_triangles

LONGEST_EDGE_VOXELS = 8.0  # longer ones are split before: balances the threads, bounds each one's loops


class VoxelizePass:
    """Clips triangles against the voxels they touch."""

    def __init__(self, gpu: GpuContext) -> None:
        self._ctx = gpu.ctx
        self._program = ComputeProgram(gpu, Path(__file__).with_name("voxelize.comp.glsl"))
        self._triangles = gpu.ctx.buffer(reserve=64)

    def run(
        self, store: VoxelStore, corners: Float32[np.ndarray, "m 3 10"], placement: VolumePlacement
    ) -> None:
        """Fill `store` (empty before) with the surfels of the triangles inside the volume."""
        pieces, bound = pieces_in_volume(corners, placement)
        store.start(bound)
        if not len(pieces):
            return
        self._triangles.orphan(pieces.nbytes)
        self._triangles.write(pieces.tobytes())
        store.bind()
        self._triangles.bind_to_storage_buffer(7)
        self._program.run((len(pieces),), triangle_count=len(pieces), **placement.uniforms())

    def release(self) -> None:
        """Free the GL objects."""
        self._program.release()
        self._triangles.release()


def pieces_in_volume(
    corners: Float32[np.ndarray, "m 3 10"], placement: VolumePlacement
) -> tuple[Float32[np.ndarray, "k 3 10"], int]:
    """Triangles that meet the volume, long ones split, and the greatest number of surfels that they can make."""
    low, high = _voxel_extents(corners, placement)
    met = np.all((high >= 0) & (low < placement.size), axis=1)
    short = np.all(high - low < LONGEST_EDGE_VOXELS / 2, axis=1)
    kept = met & short
    split = split_triangles(corners[met & ~short], LONGEST_EDGE_VOXELS * placement.voxel_edge)
    bound = _voxels_in(low[kept], high[kept], placement) + _voxels_in(
        *_voxel_extents(split, placement), placement
    )
    return np.concatenate([corners[kept], split]), bound


def _voxel_extents(
    corners: Float32[np.ndarray, "m 3 10"], placement: VolumePlacement
) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3"]]:
    """Lowest and highest voxel coordinates of each triangle."""
    a, b, c = (np.floor((corners[:, i, :3] - placement.origin) / placement.voxel_edge) for i in range(3))
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _voxels_in(
    low: Float64[np.ndarray, "m 3"], high: Float64[np.ndarray, "m 3"], placement: VolumePlacement
) -> int:
    """Number of voxels in the boxes, as far as they are in the volume."""
    first, last = (np.clip(v, 0, placement.size - 1) for v in (low, high))
    return int(np.prod(last - first + 1, axis=1).sum())
