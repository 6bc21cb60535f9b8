"""Surface normals and discontinuities of a depth image, from inverse depth.

In inverse depth w = 1/z a plane is an affine function of the ray (x/z, y/z), and the noise of stereo and
structured light, sigma z^2, is the same everywhere (sigma). Both make w the quantity to fit and to compare.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage
from deltalight.render_server.scene.threads import by_bands
from deltalight.render_server.view import LENSES_KEPT

ASSUMED_NOISE_SIGMA_M = 0.002
MAX_SLOPE = float(np.tan(np.radians(80.0)))
NOISE_SIGMAS = 3.0
MAX_TILT_ERROR_RAD = 0.05
MAX_RADIUS = 5
SAMPLE_STEP = 4  # rows and columns between the pixels that give the mean depth
SHIFTS = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
# Least spread of a window's valid pixels relative to a full window (determinant of their covariance).
MIN_SUPPORT = 0.01
# What a box of windows with gaps costs beside its pixels, as so many of them.
BOX_COST_PX = 16384
# Beyond this fraction of the picture, taking every window for one with gaps costs less, so many rows at a time.
MOST_GAPPY = 0.7
CACHED_ROWS = 120

Map = Float32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
Pixels = slice | Int64[np.ndarray, "k w"]  # flat indices
Window = tuple[slice, slice]  # rows and columns
Weights = Float64[np.ndarray, " n"]
Jumps = tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]


@dataclass(frozen=True, eq=False)
class DepthSurface:
    """The surface at every pixel of `camera`.

    `inverse_depth` is as measured, 0 where invalid and where a pixel stands alone. `gradient` is its change
    by ray coordinate (x/z, y/z), fitted to the surroundings (NaN where unknown), and `fitted_depth` is
    `inverse_depth` where it is known, 0 elsewhere.
    """

    inverse_depth: Float32[np.ndarray, "h w"]
    gradient: Float32[np.ndarray, "2 h w"]
    fitted_depth: Float32[np.ndarray, "h w"]
    camera: CameraModel

    @cached_property
    def normals(self) -> Float32[np.ndarray, "h w 3"]:
        """Unit vectors in the optical frame towards the camera, zero where they are unknown."""
        return surface_normals(self.inverse_depth, self.gradient, self.camera)


def noise_sigma(depth: DepthImage) -> float:
    """Returns the depth noise at 1 m, metres (if unknown 2 mm, between structured light and stereo)."""
    return ASSUMED_NOISE_SIGMA_M if depth.noise_sigma_m is None else depth.noise_sigma_m


def depth_surface(depth: DepthImage, camera: CameraModel) -> DepthSurface:
    """Fits a plane to the surroundings of every valid pixel by least squares, without crossing edges.

    The window grows with the noise until normals are good to about 3 degrees at the mean distance. Where it
    would hold a discontinuity, the window is moved aside to one that holds the pixel but no discontinuity
    (if there is one).
    """
    shape, radius, terms = depth.depth_m.shape, window_radius(depth, camera), jump_terms(depth, camera)
    inverse, fitted, crossed = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, bool)
    by_pixel, gradient = (np.empty((2, *shape), np.float32) for _ in range(2))

    def fit(rows: slice) -> None:
        around, own = _with_margin(rows, radius + 1)
        near, valid, jumps = _clean_inverse(depth.depth_m[around], depth.valid[around], terms)
        inverse[rows] = near[own]
        _fit_windows(near, valid, radius, own, by_pixel[:, rows])
        crossed[rows] = valid[own] & _crosses_edge(jumps, valid, radius)[own]

    def move(rows: slice) -> None:
        moved = by_pixel[:, rows].copy()
        _move_windows(by_pixel, crossed, radius, rows, moved)
        gradient[:, rows] = by_ray(moved, camera, slice(rows.start * shape[1], rows.stop * shape[1]))
        np.multiply(inverse[rows], np.isfinite(moved[0]), out=fitted[rows])

    if camera.has_distortion:
        _pixel_from_ray(camera)  # once, before threads ask for it
    by_bands(fit, shape[0])
    by_bands(move, shape[0])
    return DepthSurface(inverse, gradient, fitted, camera)


def _with_margin(rows: slice, margin: int) -> tuple[slice, slice]:
    """Returns rows with those around them, and where they are among these."""
    around = slice(max(rows.start - margin, 0), rows.stop + margin)
    return around, slice(rows.start - around.start, rows.stop - around.start)


def _clean_inverse(
    depth_m: Float32[np.ndarray, "h w"], is_valid: Mask, terms: tuple[float, float]
) -> tuple[Map, Mask, Jumps]:
    """Returns inverse depth (0 where unknown) without pixels that stand alone, where it is known, and its jumps.

    The jumps are those with all valid pixels. `terms`: those of `jump_threshold`.
    """
    valid = is_valid & (depth_m > 0)
    inverse = np.empty(depth_m.shape, np.float32)
    with np.errstate(divide="ignore"):
        np.divide(1, depth_m, out=inverse)
    inverse[~valid] = 0
    jumps = _jumps(inverse, _threshold(inverse, terms), valid)
    valid &= ~_lonely(jumps)
    inverse *= valid
    return inverse, valid, jumps


def jump_threshold(
    depth: DepthImage,
    camera: CameraModel,
    inverse_depth: Float32[np.ndarray, "h w"],
    step_px: float | Float32[np.ndarray, "h w"] = 1.0,
) -> Float32[np.ndarray, "h w"]:
    """Returns the change of w over `step_px` pixels beyond which two points are not on one surface.

    Three sigma of a difference, and the change on a surface that is 80 degrees from facing the camera:
    |dw| = w tan(slope) / f.
    """
    return _threshold(inverse_depth, jump_terms(depth, camera), step_px)


def _threshold(
    inverse_depth: Float32[np.ndarray, "*s"],
    terms: tuple[float, float],
    step_px: float | Float32[np.ndarray, "*s"] = 1.0,
) -> Float32[np.ndarray, "*s"]:
    slope, least = terms
    return inverse_depth * (step_px * np.float32(slope)) + np.float32(least)


def jump_terms(depth: DepthImage, camera: CameraModel) -> tuple[float, float]:
    """Returns the terms of `jump_threshold`: by w and pixel, and the constant one (1/m)."""
    return jump_terms_of(noise_sigma(depth), camera)


def jump_terms_of(sigma: float, camera: CameraModel) -> tuple[float, float]:
    """Returns the terms of `jump_threshold` for depth with noise of `sigma` m at 1 m."""
    focal = math.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
    return MAX_SLOPE / focal, NOISE_SIGMAS * math.sqrt(2) * sigma


def window_radius(depth: DepthImage, camera: CameraModel) -> int:
    """Returns the least radius whose slope error, sigma f z / sqrt(sum of squared offsets), is acceptable, pixels."""
    sampled = depth.depth_m[::SAMPLE_STEP, ::SAMPLE_STEP]
    known = sampled[depth.valid[::SAMPLE_STEP, ::SAMPLE_STEP] & (sampled > 0)]
    mean = float(np.mean(1 / known, dtype=np.float64)) if known.size else 0.0
    error = noise_sigma(depth) * float(camera.matrix[0, 0]) / max(mean, 1e-6)
    for radius in range(1, MAX_RADIUS):
        if error <= MAX_TILT_ERROR_RAD * math.sqrt((2 * radius + 1) ** 2 * radius * (radius + 1) / 3):
            return radius
    return MAX_RADIUS


def _fit_windows(
    inverse: Float32[np.ndarray, "h w"],
    valid: Mask,
    radius: int,
    rows: slice,
    gradient: Float32[np.ndarray, "2 k w"],
) -> None:
    """Fills the slopes of w by pixel of some rows: least squares over a square window, valid pixels only.

    The rows around them that their windows hold are given too. Where pixels are too few or in a line, the slope is
    NaN. Offsets count from the pixel itself, so that no large numbers cancel.
    """
    square = np.ones((2 * radius + 1,) * 2, np.uint8)
    is_whole = cv2.erode(valid.view(np.uint8), square, borderValue=1).view(bool)
    boxes, cost = _boxes(valid[rows] & ~is_whole[rows])
    _, height, width = gradient.shape
    if cost < MOST_GAPPY * height * width:
        _fit_whole_windows(inverse, radius, rows, gradient)
        np.copyto(gradient, np.nan, where=~valid[rows])
    else:
        ends = [*range(0, height, CACHED_ROWS), height]
        boxes = [(lines, slice(0, width)) for lines in map(slice, ends[:-1], ends[1:])]
    for down, right in boxes:
        lines, own_lines = _with_margin(slice(rows.start + down.start, rows.start + down.stop), radius)
        columns, own_columns = _with_margin(right, radius)
        _fit_gappy_windows(
            inverse[lines, columns],
            valid[lines, columns].astype(np.float32),
            radius,
            (own_lines, own_columns),
            gradient[:, down, right],
        )


def _fit_whole_windows(
    inverse: Float32[np.ndarray, "h w"], radius: int, rows: slice, gradient: Float32[np.ndarray, "2 k w"]
) -> None:
    """Fills the slopes as if all pixels were valid: the moments of windows are known, and few are needed of w."""
    one, ramp = _weights(radius)
    w = _filtered(inverse, one, one)[rows]
    means, factors = _moments_of_whole_windows(inverse.shape, radius)
    offsets = means[0], means[1][rows]
    for axis, weights in enumerate(((ramp, one), (one, ramp))):
        slope = gradient[axis]
        np.multiply(w, offsets[axis], out=slope)
        np.subtract(_filtered(inverse, *weights)[rows], slope, out=slope)
        slope *= factors[axis][rows]


@lru_cache(maxsize=LENSES_KEPT)
def _moments_of_whole_windows(shape: tuple[int, int], radius: int) -> tuple[list[Map], list[Map]]:
    """Returns mean offsets of the pixels in windows, by column and by row, and what makes sums over them slopes.

    Pixels beyond the border are in none. The factors are the reciprocal variances, NaN where pixels are too few.
    """
    counts, means, spreads = [], [], []
    for length, axes in zip(reversed(shape), ((1, -1), (-1, 1)), strict=True):
        place = np.arange(length)
        low, high = np.maximum(-radius, -place), np.minimum(radius, length - 1 - place)
        count = (high - low + 1.0).reshape(axes)
        counts.append(count)
        means.append(((low + high) / 2).reshape(axes).astype(np.float32))
        spreads.append(count * (count**2 - 1) / 12)
    variances = counts[1] * spreads[0], counts[0] * spreads[1]
    is_known = variances[0] * variances[1] > MIN_SUPPORT * _full_variance(radius) ** 2
    return means, [np.where(is_known, 1 / each, np.nan).astype(np.float32) for each in variances]


def _boxes(mask: Mask, down: int = 0, right: int = 0) -> tuple[list[Window], int]:
    """Returns boxes that hold all that is set, and what they cost (pixels): as few and as small as is cheapest."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    if not width:
        return [], 0
    down, right = down + top, right + left
    whole, cost = [(slice(down, down + height), slice(right, right + width))], BOX_COST_PX + width * height
    if width * height <= BOX_COST_PX:
        return whole, cost
    box = mask[top : top + height, left : left + width]
    if height > width:
        half = height // 2
        parts = _boxes(box[:half], down, right), _boxes(box[half:], down + half, right)
    else:
        half = width // 2
        parts = _boxes(box[:, :half], down, right), _boxes(box[:, half:], down, right + half)
    (first, first_cost), (second, second_cost) = parts
    return (first + second, first_cost + second_cost) if first_cost + second_cost < cost else (whole, cost)


def _fit_gappy_windows(
    inverse: Float32[np.ndarray, "h w"],
    mask: Float32[np.ndarray, "h w"],
    radius: int,
    part: Window,
    gradient: Float32[np.ndarray, "2 k l"],
) -> None:
    """Fills the slopes of a part as `_fit_windows` does, whichever pixels are valid (1 in `mask`)."""
    one, ramp = _weights(radius)

    def summed(values: Map, across: Weights, down: Weights) -> Map:
        return _filtered(values, across, down)[part]

    per_pixel = 1 / np.maximum(summed(mask, one, one), 1)
    w = summed(inverse, one, one)
    mu, mv = summed(mask, ramp, one), summed(mask, one, ramp)
    wu, wv = summed(inverse, ramp, one), summed(inverse, one, ramp)
    uu, vv = summed(mask, ramp**2, one), summed(mask, one, ramp**2)
    uv = summed(mask, ramp, ramp)
    mean_u, mean_v = mu * per_pixel, mv * per_pixel
    uu -= mean_u * mu
    vv -= mean_v * mv
    uv -= mean_u * mv
    wu -= w * mean_u
    wv -= w * mean_v
    determinant = uu * vv - uv * uv
    known = (determinant > MIN_SUPPORT * _full_variance(radius) ** 2) & (mask[part] > 0)
    inverted = np.divide(1, determinant, out=np.full_like(determinant, np.nan), where=known)
    np.multiply(wu * vv - wv * uv, inverted, out=gradient[0])
    np.multiply(wv * uu - wu * uv, inverted, out=gradient[1])


def _weights(radius: int) -> tuple[Weights, Weights]:
    """Returns what sums a window along an edge, and what sums offsets."""
    return np.ones(2 * radius + 1), np.arange(-radius, radius + 1.0)


def _full_variance(radius: int) -> float:
    """Returns the sum of squared offsets along an edge in a window."""
    return (2 * radius + 1) ** 2 * radius * (radius + 1) / 3


def _filtered(
    values: Float32[np.ndarray, "h w"], across: Weights, down: Weights
) -> Float32[np.ndarray, "h w"]:
    return np.asarray(cv2.sepFilter2D(values, cv2.CV_32F, across, down, borderType=cv2.BORDER_CONSTANT))


def _jumps(inverse: Map, threshold: Map, valid: Mask) -> Jumps:
    """Returns where a pixel and the next one down, and right, are valid but on different surfaces (1)."""
    down, right = np.zeros((2, *valid.shape), np.uint8)
    down[:-1] = (np.abs(inverse[1:] - inverse[:-1]) > threshold[:-1]) & valid[1:] & valid[:-1]
    right[:, :-1] = (
        (np.abs(inverse[:, 1:] - inverse[:, :-1]) > threshold[:, :-1]) & valid[:, 1:] & valid[:, :-1]
    )
    return down, right


def _lonely(jumps: Jumps) -> Mask:
    """Whether a pixel jumps to at least three of its neighbours: a spike, or a flying pixel between surfaces."""
    down, right = jumps
    count = down + right
    count[1:] += down[:-1]
    count[:, 1:] += right[:, :-1]
    return np.asarray(count >= 3)


def _crosses_edge(jumps: Jumps, valid: Mask, radius: int) -> Mask:
    """Whether the window around a pixel holds a jump between two valid neighbours."""
    down, right = jumps
    down[:-1] &= valid[1:] & valid[:-1]
    right[:, :-1] &= valid[:, 1:] & valid[:, :-1]
    crossed = np.zeros(valid.shape, np.uint8)
    for axis, jump in enumerate(jumps):
        # The jump between i and i + 1 lies in the windows of the pixels i + 1 - radius to i + radius.
        size = [2 * radius + 1, 2 * radius + 1]
        size[axis] = 2 * radius
        crossed |= cv2.dilate(jump, np.ones(size, np.uint8), anchor=(radius, radius))
    return crossed > 0


def _move_windows(
    gradient: Float32[np.ndarray, "2 h w"],
    crossed: Mask,
    radius: int,
    rows: slice,
    moved: Float32[np.ndarray, "2 k w"],
) -> None:
    """Gives pixels of some rows whose window crosses an edge the slope of a shifted one that does not, in `moved`."""
    width, first = crossed.shape[1], rows.start * crossed.shape[1]
    slopes, own = gradient.reshape(2, -1), moved.reshape(2, -1)
    pending = np.flatnonzero(crossed[rows]) + first
    columns = pending % width
    for down, right in SHIFTS:
        column = columns + radius * right
        source = np.clip(pending + radius * (down * width + right), 0, crossed.size - 1)
        is_clean = ~crossed.ravel().take(source) & np.isfinite(slopes[0].take(source))
        hit = is_clean & (column >= 0) & (column < width)
        own[:, pending[hit] - first] = slopes.take(source[hit], axis=1)
        pending, columns = pending[~hit], columns[~hit]


def by_ray(
    by_pixel: Float32[np.ndarray, "2 k w"], camera: CameraModel, pixels: Pixels
) -> Float32[np.ndarray, "2 k w"]:
    """Turns a change by pixel, at these pixels (flat indices), into a change by ray coordinate."""
    if not camera.has_distortion:
        return by_pixel * camera.matrix[[0, 1], [0, 1]].astype(np.float32)[:, None, None]
    inverse = _pixel_from_ray(camera)[:, :, pixels].reshape(2, *by_pixel.shape)
    return np.stack([(by_pixel * inverse[:, ray]).sum(axis=0) for ray in (0, 1)])


@lru_cache(maxsize=LENSES_KEPT)
def _pixel_from_ray(camera: CameraModel) -> Float32[np.ndarray, "2 2 n"]:
    """Returns the change of pixel coordinates (first axis) by ray coordinates (second) at every pixel."""
    rays = camera.rays().astype(np.float64)
    jacobian = np.stack([np.gradient(rays, axis=1), np.gradient(rays, axis=0)], axis=-1)
    return np.ascontiguousarray(np.linalg.inv(jacobian).transpose(2, 3, 0, 1), np.float32).reshape(2, 2, -1)


def surface_normals(
    inverse: Float32[np.ndarray, "h w"],
    gradient: Float32[np.ndarray, "2 h w"],
    camera: CameraModel,
) -> Float32[np.ndarray, "h w 3"]:
    """Returns unit normals of inverse depth and its change by ray at every pixel; zero where unknown."""
    normals = np.empty((*inverse.shape, 3), np.float32)
    rays = ray_planes(camera)

    def fill(rows: slice) -> None:
        cv2.merge(normals_along(inverse[rows], gradient[:, rows], rays[:, rows]), normals[rows])

    by_bands(fill, len(inverse))
    return normals


def normals_along(
    inverse: Float32[np.ndarray, "h w"],
    gradient: Float32[np.ndarray, "2 h w"],
    rays: Float32[np.ndarray, "2 h w"],
) -> list[Float32[np.ndarray, "h w"]]:
    """Returns x, y and z of the unit normals of inverse depth and its change by ray, along these rays.

    They are in the optical frame, towards the camera; zero where unknown. A plane n.P = d has
    w = (n/d).(x/z, y/z, 1), so n is along (gradient, w - gradient.ray).
    """
    x, y = gradient
    z = inverse - x * rays[0] - y * rays[1]
    scale = x * x + y * y + z * z
    scale = -1 / np.sqrt(scale, out=scale)
    unknown = ~(scale > -np.inf)
    parts = [part * scale for part in (x, y, z)]
    for part in parts:
        part[unknown] = 0
    return parts


@lru_cache(maxsize=LENSES_KEPT)
def ray_planes(camera: CameraModel) -> Float32[np.ndarray, "2 h w"]:
    """Returns x/z and y/z of the ray through every pixel."""
    return np.ascontiguousarray(camera.rays().transpose(2, 0, 1))
