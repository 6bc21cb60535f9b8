"""Truncated signed distance field of many depth frames (Curless & Levoy 1996), in sparse blocks of voxels.

Distances are measured to the plane fitted around each pixel, not along the ray: oblique surfaces and rounding to
whole pixels then cause no error. Weights are inverse variances of depth noise. Observed free space is carved, so that
things which moved away disappear.

The pose of a depth image is refined against the field (Bylow et al. 2013). The board gives the colour camera's pose
with an error of millimetres at the distance of other things, and depth may be captured a little earlier or later than
colour: averaging frames by the board's pose alone would blur the surface.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from deltalight.protocol import short_axis
from deltalight.protocol.camera_model import CameraModel
from deltalight.render_server.scene.depth_surface import DepthSurface
from deltalight.render_server.view import LENSES_KEPT, NEAR_M, CameraView

BLOCK = 8  # voxels per edge of a block
GRID = 128  # blocks per edge of the largest box
# Weights saturate at this many frames, so that the field follows slow changes of the scene.
MAX_MEMORY_FRAMES = 32
# Truncation distance: gradients need three voxels, depth noise three sigma.
REACH_VOXELS, REACH_SIGMAS = 3.0, 3.0
CHUNK_BLOCKS = 128  # blocks updated at once: their arrays fit a core's cache
ALIGNMENT_SAMPLES = 4000
# Errors of neighbouring pixels are correlated (filters, calibration): this many count as one.
CORRELATED_PIXELS = 100
# Prior of the pose, standard deviations: some millimetres at a metre. Where shape is ambiguous, along a bare wall,
# say, the board's pose stays.
POSE_SIGMA_RAD, POSE_SIGMA_M = 0.005, 0.005
ALIGNMENT_ITERATIONS = 8
# Corrections below this fraction of a voxel end the search.
CONVERGED_VOXELS = 0.01
MIN_ALIGNMENT_SAMPLES = 50
CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])


@dataclass(frozen=True)
class TsdfPlacement:
    """A cube of voxels aligned with the world's axes.

    `origin` is the centre of the first voxel (m), `voxel_m` the edge of a voxel, `blocks` the cube's edge in blocks
    of 8 voxels. `max_blocks` bounds memory. Blocks inside `hole` (least and greatest coordinates, m) stay empty.
    """

    origin: tuple[float, float, float]
    voxel_m: float
    blocks: int
    max_blocks: int
    hole: Float64[np.ndarray, "2 3"] | None = None

    @property
    def block_m(self) -> float:
        """Edge of a block, m."""
        return BLOCK * self.voxel_m

    @property
    def box(self) -> Float64[np.ndarray, "2 3"]:
        """Least and greatest coordinates of the cube, m."""
        return np.array([self.origin, np.add(self.origin, self.blocks * self.block_m)])


@dataclass(frozen=True, eq=False)
class PixelPlanes:
    """The plane at each pixel in the optical frame: rows of (nx, ny, nz, n.P, noise, weight), and 1/z of the pixels.

    The last row is a sentinel for no pixel. `noise` is three standard deviations of depth, m; weights are inverse
    variances relative to the noise at 1 m.
    """

    rows: Float32[np.ndarray, "n+1 6"]
    inverse_depth: Float32[np.ndarray, " n"]

    @classmethod
    def of(cls, surface: DepthSurface, camera: CameraModel, noise_sigma: float) -> Self:
        """Builds from a frame's depth, registered to `camera`, with noise of `noise_sigma` m at 1 m."""
        inverse, rays = surface.inverse_depth.ravel(), _pixel_rays(camera)
        z = np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)
        normals = surface.normals.reshape(-1, 3)
        facing = -rays / short_axis.lengths(rays)[:, None]
        normals = np.where(short_axis.all_of(normals == 0)[:, None], facing, normals)
        rows = np.zeros((len(z) + 1, 6), np.float32)
        rows[:-1, :3] = normals
        rows[:-1, 3] = np.einsum("ni,ni->n", normals, rays) * z
        rows[:-1, 4] = REACH_SIGMAS * noise_sigma * z * z
        rows[:-1, 5] = inverse**4  # the variance of depth is (sigma z^2)^2
        return cls(rows, inverse)


class TsdfVolume:
    """Signed distances to the nearest surface, m: positive in front, truncated."""

    def __init__(self, placement: TsdfPlacement) -> None:
        self.placement = placement
        self.slots = np.full((placement.blocks,) * 3, -1, np.int32)
        """Index of the block at each place of the cube (x, y, z), -1 for none."""
        self.places: Int32[np.ndarray, "b 3"] = np.zeros((0, 3), np.int32)
        self.distance: Float32[np.ndarray, "b 512"] = np.zeros((0, BLOCK**3), np.float32)
        self.weight: Float32[np.ndarray, "b 512"] = np.zeros((0, BLOCK**3), np.float32)

    def integrate(self, planes: PixelPlanes, view: CameraView) -> None:
        """Averages one frame, seen from `view`, into the field."""
        self._allocate(planes, view)
        blocks = self._blocks_in_view(view)
        for start in range(0, len(blocks), CHUNK_BLOCKS):
            self._update(blocks[start : start + CHUNK_BLOCKS], planes, view)

    def known_distance(self) -> Float32[np.ndarray, "b 512"]:
        """Returns the distances, NaN where nothing was measured."""
        return np.where(self.weight > 0, self.distance, np.float32(np.nan))

    def _allocate(self, planes: PixelPlanes, view: CameraView) -> None:
        """Allocates blocks within the truncation distance of this frame's surfaces."""
        half_block = self.placement.block_m / 2
        chosen = _spread_pixels(planes, view, half_block)
        matrix = view.world_from_camera.astype(np.float32)
        points = _pixel_rays(view.camera)[chosen] / planes.inverse_depth[chosen, None]
        world = points @ matrix[:3, :3].T + matrix[:3, 3]
        held = _inside(world, self.placement.box)
        if self.placement.hole is not None:
            held &= ~_inside(world, self.placement.hole)
        rows = planes.rows[chosen[held]]
        reach = self._reach(rows[:, 4])
        count = int(np.ceil(2 * float(reach.max(initial=0)) / half_block)) + 1
        steps = np.linspace(-1, 1, count, dtype=np.float32)[:, None, None] * reach[:, None]
        self._add_blocks((world[held] + rows[:, :3] @ matrix[:3, :3].T * steps).reshape(-1, 3))

    def _add_blocks(self, world: Float32[np.ndarray, "n 3"]) -> None:
        placement = self.placement
        place = np.floor((world - placement.origin) / placement.block_m)
        inside = short_axis.all_of((place >= 0) & (place < placement.blocks))
        wanted = np.zeros(self.slots.shape, bool)
        wanted[tuple(place[inside].astype(np.intp).T)] = True
        fresh = np.argwhere(wanted & (self.slots < 0)).astype(np.int32)
        fresh = fresh[~_in_hole(fresh, placement)][: placement.max_blocks - len(self.places)]
        self.slots[tuple(fresh.T)] = len(self.places) + np.arange(len(fresh), dtype=np.int32)
        empty = np.zeros((len(fresh), BLOCK**3), np.float32)
        self.places = np.concatenate([self.places, fresh])
        self.distance = np.concatenate([self.distance, empty])
        self.weight = np.concatenate([self.weight, empty])

    def _blocks_in_view(self, view: CameraView) -> Int64[np.ndarray, " k"]:
        """Returns the blocks whose bounding sphere touches the view frustum."""
        edge = self.placement.block_m
        centre = (self.places + (0.5 - 0.5 / BLOCK)) * edge + self.placement.origin
        matrix = view.camera_from_world
        seen = centre @ matrix[:3, :3].T + matrix[:3, 3]
        (fx, fy, cx, cy), (width, height) = view.raster
        # Inward normals of the frustum's sides, not unit: (1, 0, slope) has length sqrt(1 + slope^2).
        slopes = np.array(
            [(cx + 0.5) / fx, (width - 0.5 - cx) / fx, (cy + 0.5) / fy, (height - 0.5 - cy) / fy]
        )
        x, y, z = seen.T
        inside = np.stack([x, -x, y, -y]) + slopes[:, None] * z
        radius = np.sqrt(3) / 2 * edge
        near = (inside > -radius * np.sqrt(1 + slopes**2)[:, None]).all(axis=0) & (z > -radius)
        return np.flatnonzero(near)

    def _update(self, blocks: Int64[np.ndarray, " k"], planes: PixelPlanes, view: CameraView) -> None:
        points = _voxels_in_camera(self.places[blocks], self.placement, view)
        row = _pixel_rows(points, view)
        known = np.flatnonzero(planes.rows[row, 5] > 0)
        x, y, z = points[:, known]
        nx, ny, nz, offset, noise, weight = planes.rows[row[known]].T
        reach = self._reach(noise)
        distance = nx * x + ny * y + nz * z - offset
        kept = distance > -reach  # voxels farther behind the surface are occluded
        known = known[kept]
        at = blocks[known // BLOCK**3] * BLOCK**3 + known % BLOCK**3
        self._average(at, np.minimum(distance, reach)[kept], reach[kept], weight[kept])

    def _reach(self, noise: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
        """Returns the truncation distance, m."""
        return np.asarray(np.maximum(noise, np.float32(REACH_VOXELS * self.placement.voxel_m)))

    def _average(
        self,
        at: Int64[np.ndarray, " n"],
        new: Float32[np.ndarray, " n"],
        reach: Float32[np.ndarray, " n"],
        weight: Float32[np.ndarray, " n"],
    ) -> None:
        distances, weights = self.distance.ravel(), self.weight.ravel()
        old, before = distances[at], weights[at]
        # A difference beyond the truncation distance is not noise: something moved. Halve the old weight.
        before = np.where(np.abs(new - old) > reach, before / 2, before)
        total = before + weight
        distances[at] = (old * before + new * weight) / total
        weights[at] = np.minimum(total, np.maximum(before, MAX_MEMORY_FRAMES * weight))


def _inside(points: Float32[np.ndarray, "n 3"], box: Float64[np.ndarray, "2 3"]) -> Bool[np.ndarray, " n"]:
    return short_axis.all_of((points >= box[0]) & (points <= box[1]))


def _in_hole(places: Int32[np.ndarray, "n 3"], placement: TsdfPlacement) -> Bool[np.ndarray, " n"]:
    """Returns which blocks lie entirely inside the hole."""
    if placement.hole is None:
        return np.zeros(len(places), bool)
    low = places * placement.block_m + placement.origin
    least, greatest = placement.hole
    return np.asarray(((low >= least) & (low + placement.block_m <= greatest)).all(axis=1))


def _spread_pixels(planes: PixelPlanes, view: CameraView, distance_m: float) -> Int64[np.ndarray, " k"]:
    """Returns pixels whose points lie at most `distance_m` apart: each 1st, 2nd, 4th... by its footprint."""
    camera, inverse = view.camera, planes.inverse_depth
    # A pixel is z / f wide, and longer by 1 / cos(slant) = z |ray| / |n.P|.
    cosine = np.abs(planes.rows[:-1, 3]) * inverse / np.linalg.norm(_pixel_rays(camera), axis=1)
    affordable = distance_m * float(camera.matrix[0, 0]) * inverse * cosine
    stride = np.exp2(np.floor(np.log2(np.clip(affordable, 1, 64)))).astype(np.int32)
    row, column = np.divmod(np.arange(inverse.size, dtype=np.int32), camera.width)
    return np.flatnonzero((inverse > 0) & (((row | column) & (stride - 1)) == 0))


@lru_cache(maxsize=LENSES_KEPT)
def _pixel_rays(camera: CameraModel) -> Float32[np.ndarray, "n 3"]:
    """Returns (x/z, y/z, 1) of each pixel."""
    rays = camera.rays().reshape(-1, 2)
    return np.column_stack([rays, np.ones(len(rays), np.float32)])


def _voxels_in_camera(
    places: Int32[np.ndarray, "k 3"], placement: TsdfPlacement, view: CameraView
) -> Float32[np.ndarray, "3 n"]:
    """Returns the voxel centres of blocks in the optical frame, m."""
    matrix = view.camera_from_world
    first = places * placement.block_m + np.array(placement.origin)
    starts = (first @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
    steps = (_lattice() * placement.voxel_m @ matrix[:3, :3].T).astype(np.float32)
    return np.stack([(starts[:, None, axis] + steps[None, :, axis]).ravel() for axis in range(3)])


@lru_cache(maxsize=1)
def _lattice() -> Int64[np.ndarray, "512 3"]:
    return np.stack(np.unravel_index(np.arange(BLOCK**3), (BLOCK,) * 3), axis=1)


def _pixel_rows(points: Float32[np.ndarray, "3 n"], view: CameraView) -> Int32[np.ndarray, " n"]:
    """Projects points of the optical frame to pixels (rows of `PixelPlanes`); the last row where none sees it."""
    (fx, fy, cx, cy), (width, height) = view.raster
    table = _pixel_table(view.camera)
    x, y, z = points
    inverse = 1 / np.maximum(z, np.float32(NEAR_M))
    column = x * inverse * np.float32(fx) + np.float32(cx + 0.5)
    row = y * inverse * np.float32(fy) + np.float32(cy + 0.5)
    seen = (z > NEAR_M) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    flat = np.where(seen, row, 0).astype(np.int32) * width + np.where(seen, column, 0).astype(np.int32)
    return np.where(seen, table[flat], np.int32(view.camera.width * view.camera.height))


@lru_cache(maxsize=LENSES_KEPT)
def _pixel_table(camera: CameraModel) -> Int32[np.ndarray, " n"]:
    """Returns for each texel of the view's pinhole raster the pixel with the same ray, width * height for none."""
    (fx, fy, cx, cy), (width, height) = CameraView(camera, np.eye(4)).raster
    none = camera.width * camera.height
    if not camera.has_distortion:
        return np.arange(none, dtype=np.int32)
    columns, rows = np.meshgrid((np.arange(width) - cx) / fx, (np.arange(height) - cy) / fy)
    rays = np.stack([columns, rows, np.ones_like(columns)], axis=-1).reshape(-1, 3)
    pixels = np.rint(np.nan_to_num(camera.project(rays), nan=-1.0)).clip(-1, 2**20).astype(np.int64)
    inside = short_axis.all_of((pixels >= 0) & (pixels < (camera.width, camera.height)))
    return np.where(inside, pixels[:, 1] * camera.width + pixels[:, 0], none).astype(np.int32)


def aligned_view(
    volumes: list[TsdfVolume], surface: DepthSurface, view: CameraView, noise_sigma: float
) -> CameraView:
    """Returns the view from which a depth image fits the volumes best; `view` itself where too few samples match.

    Args:
        volumes: the field so far.
        surface: the frame's depth.
        view: camera, and its pose by the board.
        noise_sigma: depth noise at 1 m, m.
    """
    points, sigma_m = _alignment_points(surface, view, noise_sigma)
    total = np.zeros(6)
    for _ in range(ALIGNMENT_ITERATIONS):
        matrix = _displaced(total, view.world_from_camera)
        step = _gauss_newton_step(
            volumes, points @ matrix[:3, :3].T + matrix[:3, 3], sigma_m, total, matrix[:3, 3]
        )
        if step is None:
            return view
        total += step
        if np.abs(step).max() < CONVERGED_VOXELS * volumes[0].placement.voxel_m:
            break
    return replace(view, world_from_camera=_displaced(total, view.world_from_camera))


def _displaced(
    motion: Float64[np.ndarray, "6"], pose: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "4 4"]:
    """Returns the pose rotated about the camera's centre (first three, rad) and translated (m), in world axes."""
    result = pose.copy()
    result[:3, :3] = cv2.Rodrigues(motion[:3])[0] @ pose[:3, :3]
    result[:3, 3] += motion[3:]
    return result


def _alignment_points(
    surface: DepthSurface, view: CameraView, noise_sigma: float
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """Returns points spread over the picture (optical frame, m), and their standard deviations along the ray, m."""
    stride = max(1, int(np.sqrt(surface.inverse_depth.size / ALIGNMENT_SAMPLES)))
    grid = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    inverse = surface.inverse_depth[grid]
    known = (inverse > 0) & short_axis.any_of(surface.normals[grid] != 0)
    z = 1 / inverse[known].astype(np.float64)
    rays = np.column_stack([view.camera.rays()[grid][known], np.ones(len(z))])
    return rays * z[:, None], noise_sigma * z * z


def _gauss_newton_step(
    volumes: list[TsdfVolume],
    world: Float64[np.ndarray, "n 3"],
    sigma_m: Float64[np.ndarray, " n"],
    total: Float64[np.ndarray, "6"],
    centre: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "6"] | None:
    """Returns one Gauss-Newton step of the motion; None where too few samples meet a known surface."""
    rows, residuals, information = [], [], []
    for volume in volumes:
        found, distance, gradient = interpolate(volume, world)
        # Interpolation is no better than a tenth of a voxel.
        sigma = np.hypot(sigma_m[found], 0.1 * volume.placement.voxel_m)
        # Cauchy weights: things that moved must not pull the camera along.
        information.append(1 / (sigma**2 * (1 + (distance / (3 * sigma)) ** 2) * CORRELATED_PIXELS))
        rows.append(np.hstack([np.cross(world[found] - centre, gradient), gradient]))
        residuals.append(distance)
    slopes, missed, weight = np.concatenate(rows), np.concatenate(residuals), np.concatenate(information)
    if len(missed) < MIN_ALIGNMENT_SAMPLES:
        return None
    prior = 1 / np.repeat([POSE_SIGMA_RAD, POSE_SIGMA_M], 3) ** 2
    normal = (slopes * weight[:, None]).T @ slopes + np.diag(prior)
    return np.asarray(np.linalg.solve(normal, -(slopes * weight[:, None]).T @ missed - prior * total))


def interpolate(
    volume: TsdfVolume, world: Float64[np.ndarray, "n 3"]
) -> tuple[Int64[np.ndarray, " m"], Float64[np.ndarray, " m"], Float64[np.ndarray, "m 3"]]:
    """Interpolates trilinearly: indices of points in known cells, their distances (m) and unit gradients."""
    placement = volume.placement
    at = (world - placement.origin) / placement.voxel_m
    found = np.flatnonzero(short_axis.all_of((at >= 0) & (at < placement.blocks * BLOCK - 1)))
    cell = np.floor(at[found]).astype(np.int64)
    fraction = at[found] - cell
    corners = np.stack([_at_voxels(volume, cell + step) for step in CORNERS], axis=1)
    known: Bool[np.ndarray, " m"] = np.isfinite(corners).all(axis=1)
    found, fraction, corners = found[known], fraction[known], corners[known]
    sides = np.where(CORNERS[None] == 1, fraction[:, None], 1 - fraction[:, None])
    distance = (corners * sides.prod(axis=2)).sum(axis=1)
    signs = 2.0 * CORNERS - 1
    slopes = [
        (corners * signs[:, axis] * np.delete(sides, axis, axis=2).prod(axis=2)).sum(axis=1)
        for axis in range(3)
    ]
    gradient = np.stack(slopes, axis=1)
    length = short_axis.lengths(gradient)
    # Truncated distances have no gradient.
    steep = length > 0.5 * placement.voxel_m
    return found[steep], distance[steep], gradient[steep] / length[steep, None]


def _at_voxels(volume: TsdfVolume, voxel: Int64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Returns the distances at voxels of the cube, NaN where unknown."""
    block, inside = np.divmod(voxel, BLOCK)
    slot = volume.slots[tuple(block.T)]
    index = np.ravel_multi_index(tuple(inside.T), (BLOCK,) * 3)
    if not len(volume.places):
        return np.full(len(voxel), np.nan)
    known = (slot >= 0) & (volume.weight[slot, index] > 0)
    return np.where(known, volume.distance[slot, index], np.nan).astype(np.float64)
