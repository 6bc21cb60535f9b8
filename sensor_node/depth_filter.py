"""Edge-preserving smoothing of inverse depth with the colour image as guide; pixels may be unknown.

Works on inverse depth because there planes are linear in pixel coordinates and the noise of stereo and structured
light, sigma(z) = s z^2, becomes the constant s. In every window the model `a x + b y + d I + c` (I: colour guide, as
in the guided image filter, He, Sun & Tang 2013; x, y keep slopes out of the colour term) is fitted to the known
pixels only, and each pixel averages the windows that contain it, weighted by how well they fit: windows across a
depth step that colour does not explain drop out, so the step stays sharp. Fits run on cells of 2x2 pixels (as the
fast guided filter, He & Sun 2015).
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

Grid = Float32[np.ndarray, "rows columns"]
# Keeps the fit solvable in windows with one known column or row; in square cells.
SLOPE_RIDGE = 0.05
EMPTY = 1e-9


class NoiseModel(NamedTuple):
    """Standard deviation of a depth reading: sqrt((sigma_m z^2)^2 + floor_m^2), z and result in metres."""

    sigma_m: float
    floor_m: float

    def of_inverse_depth(self, inverse_depth: Float32[np.ndarray, "*size"]) -> Float32[np.ndarray, "*size"]:
        """Returns the standard deviation of 1/z at 1/z, in 1/m (d(1/z) = dz / z^2)."""
        step = self.floor_m * inverse_depth * inverse_depth
        return np.asarray(np.sqrt(self.sigma_m**2 + step * step), np.float32)


@dataclass(frozen=True)
class _Cells:
    """Cells of 2x2 pixels: number of known pixels, mean inverse depth, mean guide, position."""

    count: Grid
    depth: Grid
    guide: Grid
    x: Float32[np.ndarray, "1 columns"]
    y: Float32[np.ndarray, "rows 1"]


@dataclass(frozen=True)
class _Fits:
    """One local model per window: slope_x x + slope_y y + level + gain (I - tone), x and y in cells.

    `level` and `count` (known pixels) come with `variance`, what the model leaves unexplained.
    """

    slope_x: Grid
    slope_y: Grid
    gain: Grid
    tone: Grid
    level: Grid
    count: Grid
    variance: Grid


@dataclass(frozen=True)
class SmoothedDepth:
    """Result of the fit at every pixel, known or not.

    `inverse_depth` in 1/m. `confidence` 0..1 of the 2x2 cells is the weight that the windows around them
    had: near 1 on smooth surfaces, near 0 at steps and where nothing is known.
    """

    inverse_depth: Float32[np.ndarray, "h w"]
    confidence: Grid
    _noise: NoiseModel
    _cells: _Cells
    _fits: _Fits
    _weight: Grid
    _reach: int

    def explains(
        self, inverse_depth: Float32[np.ndarray, "h w"], confidence: float, sigmas: float
    ) -> Bool[np.ndarray, "h w"]:
        """Returns where the cell is more confident than `confidence` or the fit within `sigmas` of a value."""
        tolerance = sigmas * self._noise.of_inverse_depth(self._cells.depth)
        tolerance[self.confidence > confidence] = np.inf
        size = 2 * tolerance.shape[1], 2 * tolerance.shape[0]
        height, width = inverse_depth.shape
        limit = cv2.resize(tolerance, size, interpolation=cv2.INTER_NEAREST)[:height, :width]
        return np.asarray(np.abs(self.inverse_depth - inverse_depth) <= limit)

    def spread(
        self, rows: Int64[np.ndarray, " n"], columns: Int64[np.ndarray, " n"]
    ) -> Float32[np.ndarray, " n"]:
        """Returns the standard deviation between nine windows that contain a pixel, in 1/m.

        Large where surfaces of different depth reach the pixel.
        """
        rows, columns, (height, width) = rows // 2, columns // 2, self._weight.shape
        steps = np.array([[-self._reach], [0], [self._reach]])
        window_rows, window_columns = (
            np.clip(centres + steps, 0, size - 1) for centres, size in ((rows, height), (columns, width))
        )
        windows = (window_rows[:, None] * width + window_columns).reshape(9, -1)
        slope_x, slope_y, level, weight = (
            each.take(windows)
            for each in (self._fits.slope_x, self._fits.slope_y, self._fits.level, self._weight)
        )
        value = slope_x * self._cells.x[0, columns] + slope_y * self._cells.y[rows, 0] + level
        normalized = weight / np.maximum(weight.sum(axis=0), EMPTY)
        mean = (normalized * value).sum(axis=0)
        return np.asarray(np.sqrt((normalized * (value - mean) ** 2).sum(axis=0)))


def smooth_inverse_depth(
    inverse_depth: Float32[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"],
    guide: Float32[np.ndarray, "h w"],
    *,
    noise: NoiseModel,
    radius_px: int,
    guide_contrast: float,
) -> SmoothedDepth:
    """Fits local models to inverse depth and evaluates them at every pixel.

    Args:
        inverse_depth: 1/m; anything where not valid.
        valid: which pixels are known.
        guide: grey picture, 0..1.
        noise: windows with larger residuals at the known pixels lose their weight.
        radius_px: half the edge of the windows in pixels, at least 2.
        guide_contrast: contrast of the guide (standard deviation in a window) below which it counts little.
    """
    height, width = inverse_depth.shape
    padding = ((0, height % 2), (0, width % 2))
    if height % 2 or width % 2:
        inverse_depth, valid = np.pad(inverse_depth, padding), np.pad(valid, padding)
        guide = np.pad(guide, padding, mode="edge")
    cells = _to_cells(inverse_depth, valid, guide)
    reach = max(1, round(radius_px / 2))
    fits = _fit_windows(cells, 2 * reach + 1, guide_contrast**2)
    excess = fits.variance / noise.of_inverse_depth(cells.depth) ** 2
    weight = fits.count / (1 + excess * excess) ** 2
    smoothed, confidence = _blend(cells, fits, weight, 2 * reach + 1, guide)
    return SmoothedDepth(smoothed[:height, :width], confidence, noise, cells, fits, weight, reach)


def _quarters(image: Float32[np.ndarray, "h w"]) -> list[Grid]:
    """Returns views of the four pixels of every cell: top-left, top-right, bottom-left, bottom-right."""
    return [image[row::2, column::2] for row in (0, 1) for column in (0, 1)]


def _to_cells(
    inverse_depth: Float32[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"],
    guide: Float32[np.ndarray, "h w"],
) -> _Cells:
    weights = [quarter.astype(np.float32) for quarter in _quarters(valid)]
    count = weights[0] + weights[1] + weights[2] + weights[3]
    norm = 1 / np.maximum(count, 1)

    def mean(image: Float32[np.ndarray, "h w"]) -> Grid:
        parts = [weight * part for weight, part in zip(weights, _quarters(image), strict=True)]
        return np.asarray((parts[0] + parts[1] + parts[2] + parts[3]) * norm)

    # Coordinates from the middle of the picture: small numbers keep the moments exact in single precision.
    rows, columns = count.shape
    x = np.arange(columns, dtype=np.float32)[None] - columns // 2
    y = np.arange(rows, dtype=np.float32)[:, None] - rows // 2
    return _Cells(count, mean(inverse_depth), mean(guide), x, y)


def _window_sum(image: Grid, size: int) -> Grid:
    summed = cv2.boxFilter(image, -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed)


def _depth_variance(cells: _Cells, size: int) -> Grid:
    """Returns the variance of the inverse depth in every window; in double precision, because means cancel."""
    count, depth = cells.count.astype(np.float64), cells.depth.astype(np.float64)
    weighted: Float64[np.ndarray, "rows columns"] = count * depth
    total = np.maximum(_window_sum(count, size), EMPTY)
    mean = _window_sum(weighted, size) / total
    return np.asarray(_window_sum(weighted * depth, size) / total - mean * mean, np.float32)


def _fit_windows(cells: _Cells, size: int, ridge: float) -> _Fits:
    """Fits depth on (x, y, guide) in every window by weighted least squares: elimination of the 3x3 system."""
    count = _window_sum(cells.count, size)
    norm = 1 / np.maximum(count, EMPTY)

    def mean(image: Grid) -> Grid:
        return np.asarray(_window_sum(image, size) * norm)

    x, y, p, g = cells.x, cells.y, cells.depth, cells.guide
    weighted_x, weighted_y, weighted_p = cells.count * x, cells.count * y, cells.count * p
    weighted_g = cells.count * g
    mean_x, mean_y, mean_p, mean_g = mean(weighted_x), mean(weighted_y), mean(weighted_p), mean(weighted_g)
    xx = mean(weighted_x * x) - mean_x * mean_x + SLOPE_RIDGE
    xy = mean(weighted_x * y) - mean_x * mean_y
    yy = mean(weighted_y * y) - mean_y * mean_y + SLOPE_RIDGE
    xg = mean(weighted_g * x) - mean_x * mean_g
    yg = mean(weighted_g * y) - mean_y * mean_g
    gg = mean(weighted_g * g) - mean_g * mean_g + ridge
    xp = mean(weighted_p * x) - mean_x * mean_p
    yp = mean(weighted_p * y) - mean_y * mean_p
    gp = mean(weighted_p * g) - mean_g * mean_p

    by_x = xy / xx
    yy_left, yg_left, yp_left = yy - by_x * xy, yg - by_x * xg, yp - by_x * xp
    by_x, by_y = xg / xx, yg_left / yy_left
    gain = (gp - by_x * xp - by_y * yp_left) / (gg - by_x * xg - by_y * yg_left)
    slope_y = (yp_left - gain * yg_left) / yy_left
    slope_x = (xp - slope_y * xy - gain * xg) / xx
    unexplained = _depth_variance(cells, size) - slope_x * xp - slope_y * yp - gain * gp
    level = mean_p - slope_x * mean_x - slope_y * mean_y
    return _Fits(slope_x, slope_y, gain, mean_g, level, count, np.maximum(unexplained, 0))


def _blend(
    cells: _Cells, fits: _Fits, weight: Grid, size: int, guide: Float32[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "h w"], Grid]:
    """Averages the models of all windows that hold a cell; evaluates them at its pixels, with confidence."""
    total = _window_sum(weight, size)
    norm = 1 / np.maximum(total, EMPTY)

    def average(image: Grid) -> Grid:
        return np.asarray(_window_sum(weight * image, size) * norm)

    slope_x, slope_y, gain = average(fits.slope_x), average(fits.slope_y), average(fits.gain)
    centre = slope_x * cells.x + slope_y * cells.y + average(fits.level - fits.gain * fits.tone)
    right, down = slope_x / 4, slope_y / 4  # pixels lie a quarter of a cell from its centre on either axis
    smoothed = np.empty(guide.shape, np.float32)
    offsets = (-right - down, right - down, down - right, right + down)
    for target, offset, tone in zip(_quarters(smoothed), offsets, _quarters(guide), strict=True):
        np.add(centre + offset, gain * tone, out=target)
    return smoothed, total / np.maximum(_window_sum(fits.count, size), EMPTY)
