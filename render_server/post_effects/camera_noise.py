"""The camera's noise, measured in pictures of a still scene, and put on the virtual part of a picture ([D] 6.2).

In the sensor's linear units (1 = white) the variance of a pixel of intensity I is a + b I by channel: read noise and
the photons' (Foi et al. 2008). A camera whose response is not known exactly departs from that line, so the variance
is kept as a curve over intensity: the line, times what bins of intensity show beside it. Demosaicking and compression
correlate neighbours: the model is white noise after a filter [k 1 k] along rows and columns, whose correlation
of neighbours is 2 k / (1 + 2 k^2).
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from deltalight.protocol.frames import ViewFrame, decode_lut

BINS, LEAST_PIXELS = 24, 500
CODES = (4, 251)
"""Codes outside are clipped, in the picture or by its noise."""
BLOCK_PX = 16
STILL_SIGMAS = 4.0
"""A block has moved if its mean changed by more, in standard errors."""
MOST_SHIFTED = 0.1
"""A block has moved if a shift of the picture explains more than this fraction of its change."""
LEAST_STILL = 0.5
"""Fraction of the blocks that must not have moved."""
UNSEEN_SHIFT_PX, UNSEEN_FRACTION = 0.2, 0.05
"""A shift that small may go unseen: pixels whose variance it would raise by more than that fraction are too steep."""
MOST_PAIRS = 16
GAUSSIAN = 1.4826
"""Standard deviation over median absolute deviation."""
MOST_CORRELATION = 0.7
LEVELS = np.linspace(0, 1, 33) ** 2
"""Intensities at which variances are kept."""

Color = UInt8[np.ndarray, "h w 3"]
Plane = Float64[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """`variances` at LEVELS of intensity, R G B, in units of sensor white; `correlation` along rows and columns.

    The correlation is that of neighbours.
    """

    variances: Float64[np.ndarray, "k 3"]
    correlation: tuple[float, float]

    def variance(self, intensity: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """Returns the variance at linear intensities, R G B."""
        curves = [np.interp(intensity[..., c], LEVELS, self.variances[:, c]) for c in range(3)]
        return np.stack(curves, axis=-1)

    def before_filter(self, kept: Float64[np.ndarray, " 3"]) -> "NoiseModel":
        """Returns the independent noise that a filter keeping these fractions of variance, R G B, turns into this."""
        return NoiseModel(self.variances / kept, (0.0, 0.0))


def estimate_noise(
    first: Color, second: Color, response: Float32[np.ndarray, "256 3"] | None
) -> NoiseModel | None:
    """Returns the noise of two pictures of a still scene; None if too much moves, or too little is exposed well."""
    lut = decode_lut(response)
    pair = [lut[each, np.arange(3)].astype(np.float64) for each in (first, second)]
    difference, mean = (pair[0] - pair[1]) / np.sqrt(2), (pair[0] + pair[1]) / 2
    change = _Change.of(difference.mean(axis=2), mean.mean(axis=2))
    still = change.still
    exposed = ((np.minimum(first, second) >= CODES[0]) & (np.maximum(first, second) <= CODES[1])).all(axis=2)
    used = still & exposed & change.flat
    if still.mean() < LEAST_STILL or used.sum() < LEAST_PIXELS:
        return None
    bins = _bins((first[used].astype(np.float64) + second[used]) / 2)
    steps = np.gradient(lut.astype(np.float64), axis=0)
    curves = [
        _fit_curve(bins[:, c], mean[used, c], difference[used, c], lut[:, c], steps[:, c]) for c in range(3)
    ]
    correlation = _correlation(difference, used, 1), _correlation(difference, used, 0)
    return NoiseModel(np.stack(curves, axis=1), correlation)


@dataclass(frozen=True, eq=False)
class _Change:
    """How two pictures differ: `luma` by pixel, and by the block around it.

    `mean` and `variance` are those of the change, `gradients` (columns, rows) those of the picture.
    """

    mean: Plane
    variance: Plane
    luma: Plane
    gradients: tuple[Plane, Plane]

    @classmethod
    def of(cls, luma: Plane, picture: Plane) -> "_Change":
        mean = _block_mean(luma)
        variance = np.maximum(_block_mean(luma**2) - mean**2, 0)
        columns, rows = (cv2.Sobel(picture, -1, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
        return cls(mean, variance, luma, (columns, rows))

    @cached_property
    def still(self) -> Bool[np.ndarray, "h w"]:
        """The pixels whose block changed by no more than noise explains: neither its mean, nor by a shift."""
        # Correlated neighbours make means noisier than independent ones: by up to a factor of 2 along each axis.
        error = 2 * np.sqrt(self.variance) / BLOCK_PX
        is_even = np.abs(self.mean) <= STILL_SIGMAS * error
        return np.asarray(is_even & (self._shifted <= MOST_SHIFTED * self.variance))

    @property
    def flat(self) -> Bool[np.ndarray, "h w"]:
        """The pixels that a shift too small to be seen would hardly change."""
        columns, rows = (cv2.GaussianBlur(each, (0, 0), 1.0) for each in self.gradients)
        by_shift = UNSEEN_SHIFT_PX**2 * (columns**2 + rows**2)
        return np.asarray((by_shift <= UNSEEN_FRACTION * self.variance) | (self.variance == 0))

    @property
    def _shifted(self) -> Plane:
        """Variance that the best shift of each block explains (Lucas and Kanade 1981)."""
        columns, rows = self.gradients
        xx, xy, yy = (_block_mean(a * b) for a, b in ((columns, columns), (columns, rows), (rows, rows)))
        off = self.luma - self.mean
        x, y = (_block_mean(each * off) for each in (columns, rows))
        least = 1e-3 * self.variance + 1e-12  # where there is no gradient, nothing shows a shift
        xx, yy = xx + least, yy + least
        return np.asarray((x * x * yy - 2 * x * y * xy + y * y * xx) / (xx * yy - xy * xy))


def _block_mean(values: Plane) -> Plane:
    return np.asarray(cv2.blur(values, (BLOCK_PX, BLOCK_PX)))


def _bins(codes: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, "n 3"]:
    """Returns each mean code's bin, about equally full ones of whole codes.

    Pairs whose mean is a whole code differ by an even number of codes, others by an odd one: a bin must hold both.
    """
    edges = [np.unique(np.floor(np.quantile(each, np.linspace(0, 1, BINS + 1)[1:-1]))) for each in codes.T]
    return np.stack(
        [np.searchsorted(part, each, side="right") for part, each in zip(edges, codes.T, strict=True)], 1
    )


def _fit_curve(
    which: Int64[np.ndarray, " n"],
    mean: Float64[np.ndarray, " n"],
    difference: Float64[np.ndarray, " n"],
    lut: Float64[np.ndarray, " 256"],
    steps: Float64[np.ndarray, " 256"],
) -> Float64[np.ndarray, " k"]:
    """Returns variances at LEVELS by those of bins of intensity, without what rounding to codes adds."""
    rows: list[tuple[float, float, float]] = []
    for number in range(BINS):
        inside = which == number
        count = int(np.count_nonzero(inside))
        if count < LEAST_PIXELS // BINS:
            continue
        centre = float(mean[inside].mean())
        rounding = float(np.interp(centre, lut, steps)) ** 2 / 12
        rows.append((centre, max(_robust_variance(difference[inside]) - rounding, 0.0), np.sqrt(count)))
    centres, variances, weights = np.array(rows).T
    scale = weights / np.maximum(variances, 1e-3 * variances.max() + 1e-12)  # relative errors count alike
    a, b = _non_negative_line(centres, variances, scale)
    beside = _smoothed(variances / np.maximum(a + b * centres, 1e-12), weights**2)
    return np.asarray((a + b * LEVELS) * np.interp(LEVELS, centres, beside))


def _smoothed(
    values: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Returns means of each value and its neighbours, [1 2 1]: single bins hold few pixels."""
    kernel = np.array([1.0, 2.0, 1.0])
    inside = slice(1, -1)  # `same` would be as long as the kernel for fewer values
    return np.asarray((np.convolve(values * weights, kernel) / np.convolve(weights, kernel))[inside])


def _non_negative_line(
    x: Float64[np.ndarray, " n"], y: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"]
) -> tuple[float, float]:
    columns = np.stack([np.ones_like(x), x], axis=1) * weights[:, None]
    a, b = np.linalg.lstsq(columns, y * weights, rcond=None)[0]
    square = weights**2
    if a < 0:
        return 0.0, max(float((square * x * y).sum() / (square * x * x).sum()), 0.0)
    if b < 0:
        return float((square * y).sum() / square.sum()), 0.0
    return float(a), float(b)


def _robust_variance(values: Float64[np.ndarray, " n"]) -> float:
    """Returns the mean square of deviations up to 4 robust sigmas: codes are too coarse for the median alone."""
    sigma = GAUSSIAN * float(np.median(np.abs(values)))
    kept = values[np.abs(values) <= 4 * sigma] if sigma > 0 else values
    return float(np.mean(kept**2))


def _correlation(difference: Float64[np.ndarray, "h w 3"], used: Bool[np.ndarray, "h w"], axis: int) -> float:
    ahead, behind = (
        tuple(slice(*cut) if each == axis else slice(None) for each in (0, 1)) for cut in ((1, None), (0, -1))
    )
    both = used[ahead] & used[behind]
    one, other = difference[ahead][both], difference[behind][both]
    power = float((one**2).mean() + (other**2).mean()) / 2
    return float(np.clip((one * other).mean() / power, 0, MOST_CORRELATION)) if power > 0 else 0.0


def add_noise(
    color: Color,
    coverage: Float32[np.ndarray, "h w"],
    model: NoiseModel,
    frame_id: int,
    response: Float32[np.ndarray, "256 3"] | None,
) -> Color:
    """Returns a picture with noise where virtual objects cover it; other pixels are the same to the bit.

    The real part of an edge's pixel has noise already; what is added completes its variance. Equal frame ids
    give equal noise.
    """
    rows, columns = np.nonzero(coverage > 0)
    if not len(rows):
        return color
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    cover, codes = coverage[box], color[box]
    lut = decode_lut(response).astype(np.float64)
    intensity = lut[codes, np.arange(3)]
    sigma = np.sqrt(model.variance(intensity) * (1 - (1 - np.clip(cover, 0, 1)) ** 2)[..., None])
    noisy = intensity + sigma * _unit_noise(codes.shape, model.correlation, frame_id)
    coded = np.stack([np.interp(noisy[..., c], lut[:, c], np.arange(256)) for c in range(3)], axis=-1)
    result = color.copy()
    result[box] = np.where(cover[..., None] > 0, np.rint(coded), codes).astype(np.uint8)
    return result


def _unit_noise(
    shape: tuple[int, ...], correlation: tuple[float, float], frame_id: int
) -> Float64[np.ndarray, "h w 3"]:
    white = np.random.default_rng(frame_id).standard_normal(shape)
    along_rows, along_columns = (_kernel(each) for each in correlation)
    filtered = cv2.sepFilter2D(white, -1, along_rows, along_columns, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(filtered)


def _kernel(correlation: float) -> Float64[np.ndarray, " 3"]:
    """Returns [k 1 k], scaled so that white noise keeps its variance."""
    k = 0.0 if correlation <= 0 else (1 - np.sqrt(1 - 2 * correlation**2)) / (2 * correlation)
    return np.asarray(np.array([k, 1, k]) / np.sqrt(1 + 2 * k * k))


class CameraNoise:
    """Learns a camera's noise from its frames: of pairs between which little moved, until it has seen enough."""

    def __init__(self) -> None:
        self._last: ViewFrame | None = None
        self._found: list[NoiseModel] = []

    def forget(self) -> None:
        """Forgets everything: other frames come from another camera."""
        self._last, self._found = None, []

    def observe(self, frame: ViewFrame) -> None:
        """Compares a frame with the one before."""
        last = self._last
        if last is frame or len(self._found) >= MOST_PAIRS:
            return
        self._last = frame
        if last is None or last.frame_id == frame.frame_id or last.color.shape != frame.color.shape:
            return
        if last.exposure_scale == frame.exposure_scale:
            found = estimate_noise(last.color, frame.color, frame.response)
            self._found += [] if found is None else [found]

    @property
    def model(self) -> NoiseModel | None:
        """The mean of what was found; None before."""
        if not self._found:
            return None
        variances = np.mean([each.variances for each in self._found], axis=0)
        rows, columns = np.mean([each.correlation for each in self._found], axis=0)
        return NoiseModel(variances, (float(rows), float(columns)))
