"""The voxel volume: where it lies, how much memory it takes, its pyramids."""

import math
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float64

from protocol.errors import DeltalightError
from render_server.gpu.context import GpuContext

MEGABYTE = 1_000_000


@dataclass(frozen=True)
class VolumePlacement:
    """A cube of `size`^3 voxels of edge `voxel_edge` m; its low corner `origin` (world, m) is snapped to voxels."""

    origin: tuple[float, float, float]
    voxel_edge: float
    size: int

    @property
    def levels(self) -> int:
        """Pyramid levels: halvings that leave whole cells, down to 2 or 3 cells an edge."""
        levels, cells = 1, self.size
        while cells % 2 == 0 and cells > 2:
            cells //= 2
            levels += 1
        return levels

    def uniforms(self) -> dict[str, Any]:
        """Every uniform that shaders read of the volume."""
        return {
            "volume_origin": self.origin,
            "voxel_edge": self.voxel_edge,
            "volume_size": self.size,
            "volume_levels": self.levels,
        }

    def voxel_bounds(self, points: Float64[np.ndarray, "n 3"]) -> np.ndarray[Any, np.dtype[np.int32]]:
        """(min x, y, z, -max x, y, z) of the voxels that hold the world points, clipped to the volume."""
        voxels = np.floor((points - np.array(self.origin)) / self.voxel_edge)
        voxels = np.clip(voxels, 0, self.size - 1)
        return np.concatenate([voxels.min(axis=0), -voxels.max(axis=0)]).astype(np.int32)


def place_volume(
    low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"], size: int, edge_m: float | None
) -> VolumePlacement:
    """Cube around the objects' bounds: twice their longest edge ([P1]) unless `edge_m` is given, snapped to voxels.

    Snapping keeps the grid still in the world while the objects move.
    """
    edge = edge_m if edge_m is not None else 2.0 * float(np.max(high - low))
    voxel = edge / size
    origin = np.floor(((low + high) / 2 - edge / 2) / voxel) * voxel
    return VolumePlacement((float(origin[0]), float(origin[1]), float(origin[2])), voxel, size)


def pyramid_shape(size: int, directions: int) -> tuple[int, int, int]:
    """Texels (x, y, z) of the texture that holds all levels of all directions (passes/common/volume.glsl)."""
    return size, size, directions * size + math.ceil(directions / 2) * size // 2


def volume_memory_bytes(size: int, directions: int) -> int:
    """Bytes of a volume set: two RGBA16F pyramids and two slot grids."""
    return 2 * math.prod(pyramid_shape(size, directions)) * 8 + 2 * size**3 * 4


def memory_statement(size: int, directions: int, budget_mb: int) -> str:
    """One sentence that states the memory of the volume set.

    Raises:
        DeltalightError: it is beyond the budget.
    """
    needed = math.ceil(volume_memory_bytes(size, directions) / MEGABYTE)
    if needed > budget_mb:
        raise DeltalightError(
            f"A volume set of {size}^3 voxels takes {needed} MB, beyond the budget of {budget_mb} MB: "
            "lower method.volume_size or raise method.memory_budget_mb."
        )
    return f"volume set {size}^3: {needed} MB of a budget of {budget_mb} MB"


class Pyramid:
    """One RGBA16F volume with its levels: premultiplied radiance and coverage, a direction a slab."""

    def __init__(self, gpu: GpuContext, size: int, directions: int) -> None:
        shape = pyramid_shape(size, directions)
        limit = gpu.ctx.info["GL_MAX_3D_TEXTURE_SIZE"]
        if max(shape) > limit:
            raise DeltalightError(
                f"This GPU's 3-D textures end at {limit} texels, {size}^3 voxels need {max(shape)}: "
                "lower method.volume_size."
            )
        self.directions = directions
        self.texture = gpu.ctx.texture3d(shape, 4, dtype="f2")
        self.texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self.texture.repeat_x = self.texture.repeat_y = self.texture.repeat_z = False
        self.texture.write(bytes(math.prod(shape) * 8))

    def release(self) -> None:
        """Free the texture."""
        self.texture.release()
