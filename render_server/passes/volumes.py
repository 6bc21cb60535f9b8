"""Where the volumes around the objects lie: cubes of voxels along the world axes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from deltalight.protocol import short_axis
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding
from deltalight.render_server.gpu.uniform_block import Block, Float, Int, Mat4, UniformBlock, Vec3

# Of a volume that stays while its objects move: the light around them changes that far at least.
SPARE_EDGE = 0.125
SNAP_VOXELS = 0.01
# Of the edge: how far planes at whole voxels from the world's origin (a floor, sides of a box) lie in the next voxel.
# On the border of two, rounding would decide between them, and otherwise for a surface than for the light on it.
ABOVE_BORDERS = 1e-5


@dataclass(frozen=True, eq=False)
class VolumeBlock(Block):
    """Uniform block `Volume` of shaders/common/volume.glsl."""

    volume_origin: Vec3
    voxel_edge: Float
    volume_size: Int
    volume_levels: Int


MOST_VOLUMES = 4  # columns of a matrix


@dataclass(frozen=True, eq=False)
class VolumesBlock(Block):
    """Uniform block `Volumes` of shaders/common/volume.glsl; a column of `volume_places` for each volume."""

    volume_places: Mat4
    volume_size: Int
    volume_levels: Int
    volume_count: Int


@dataclass(frozen=True, eq=False)
class FarVolumeBlock(Block):
    """Uniform block `FarVolume` of shaders/common/march.glsl: the coarse volume beyond; size 0 if unused."""

    far_origin: Vec3
    far_edge: Float
    far_size: Int
    far_levels: Int


@dataclass(frozen=True)
class VolumePlacement:
    """A cube of `size`^3 voxels of edge `voxel_edge` m; its low corner `origin` (world, m) is snapped to voxels."""

    origin: tuple[float, float, float]
    voxel_edge: float
    size: int

    @property
    def levels(self) -> int:
        """Number of mip levels: halvings that leave whole cells, down to 2 or 3 cells per edge."""
        levels, cells = 1, self.size
        while cells % 2 == 0 and cells > 2:
            cells //= 2
            levels += 1
        return levels

    def block(self) -> VolumeBlock:
        """Returns the placement's uniform block."""
        return VolumeBlock(self.origin, self.voxel_edge, self.size, self.levels)

    def far_block(self, *, is_used: bool) -> FarVolumeBlock:
        """Returns the placement's block as the coarse volume beyond; cones end before it unless it `is_used`."""
        return FarVolumeBlock(self.origin, self.voxel_edge, self.size if is_used else 0, self.levels)

    def divided(self, size: int) -> "VolumePlacement":
        """Returns the same cube of `size`^3 voxels."""
        return VolumePlacement(self.origin, self.voxel_edge * self.size / size, size)

    def meets(self, low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"]) -> bool:
        """Whether a box (world, m) reaches into the volume."""
        origin, edge = np.array(self.origin), self.size * self.voxel_edge
        return bool((low < origin + edge).all() and (high > origin).all())

    @property
    def corners(self) -> Float64[np.ndarray, "8 3"]:
        """World, m; the least coordinates first, the greatest last."""
        unit = np.indices((2, 2, 2), float).reshape(3, 8).T
        return np.asarray(np.array(self.origin) + self.size * self.voxel_edge * unit)

    def distance_from_middle(self, point: Float64[np.ndarray, "3"]) -> float:
        """Returns how far a point (world, m) is from the middle, by the edge: 0.5 at the border (enter_volume)."""
        relative = (point - np.array(self.origin)) / (self.size * self.voxel_edge)
        return float(np.abs(relative - 0.5).max())

    def voxel_bounds(self, points: Float64[np.ndarray, "n 3"]) -> np.ndarray[Any, np.dtype[np.int32]]:
        """Returns (min x, y, z, -max x, y, z) of the voxels that hold the world points, clipped to the volume."""
        low, high = (
            map(self._voxel, box, self.origin) for box in map(np.ndarray.tolist, short_axis.bounds(points))
        )
        return np.array([*low, *(-each for each in high)], np.int32)

    def _voxel(self, place: float, origin: float) -> int:
        """Returns the number of the voxel at a place along one axis, or of the nearest."""
        return min(max(math.floor((place - origin) / self.voxel_edge), 0), self.size - 1)


def place_volume(
    low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"], size: int, edge_m: float | None
) -> VolumePlacement:
    """Places a cube around the objects' bounds: twice their longest edge ([P1]) unless `edge_m` is given.

    Snapping to voxels (less ABOVE_BORDERS) keeps the grid fixed in the world while the objects move; rounding errors
    of a place on the border between two voxels do not move it.
    """
    edge = edge_m if edge_m is not None else 2.0 * float(np.max(high - low))
    voxel = edge / size
    origin = np.floor(((low + high) / 2 - edge / 2) / voxel + SNAP_VOXELS) * voxel - ABOVE_BORDERS * edge
    return VolumePlacement((float(origin[0]), float(origin[1]), float(origin[2])), voxel, size)


def keep_placement(
    old: VolumePlacement,
    low: Float64[np.ndarray, "3"],
    high: Float64[np.ndarray, "3"],
    wanted: VolumePlacement,
) -> bool:
    """Returns whether objects that move may stay in the volume that was placed around them before.

    They must keep away from its border by SPARE_EDGE of its edge, and its voxels must be of about the `wanted` size.
    """
    edge = old.size * old.voxel_edge
    origin, spare = np.array(old.origin), SPARE_EDGE * edge
    fits = bool((low >= origin + spare).all() and (high <= origin + edge - spare).all())
    return fits and old.size == wanted.size and 0.8 < wanted.voxel_edge / old.voxel_edge < 1.25


def volumes_block(placements: Sequence[VolumePlacement]) -> VolumesBlock:
    """Returns the block of volumes of one size."""
    places = np.zeros((4, MOST_VOLUMES))
    for column, each in enumerate(placements):
        places[:, column] = *each.origin, each.voxel_edge
    return VolumesBlock(places, placements[0].size, placements[0].levels, len(placements))


class PlacedVolume:
    """Where a volume is now, or several of one size, for the shaders."""

    def __init__(self, gpu: GpuContext, *placements: VolumePlacement) -> None:
        self.placements = placements
        self._block = UniformBlock(gpu, self.placement.block())
        self._several = UniformBlock(gpu, volumes_block(placements))

    @property
    def placement(self) -> VolumePlacement:
        """The current placement, of several the first: all have its size and levels."""
        return self.placements[0]

    @property
    def bindings(self) -> dict[str, Binding]:
        """The uniform blocks of volume.glsl."""
        is_several = len(self.placements) > 1
        return {"Volume": self._block, "Volumes": self._several, "SEVERAL_VOLUMES": is_several}

    def place(self, *placements: VolumePlacement) -> "PlacedVolume":
        """Moves the volume, or replaces it by these, and returns it."""
        if placements != self.placements:
            self.placements = placements
            self._block.write(self.placement.block())
            self._several.write(volumes_block(placements))
        return self

    def release(self) -> None:
        """Frees the blocks."""
        self._block.release()
        self._several.release()
