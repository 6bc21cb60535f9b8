"""Sharpening by a camera: measured at the board's edges, and put on the virtual part of a picture.

Cameras sharpen last, behind their tone curve, by an unsharp mask: to the codes Y of luma they add
a (Y - G_s Y), where G_s is a Gaussian of s pixels, sampled at pixels. An edge overshoots on both sides then, and its
MTF is that of lens and pixel times 1 + a (1 - K), where K is the transform of G_s. A lens alone never overshoots.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol.frames import decode_lut
from deltalight.render_server.post_effects.camera_blur import (
    LEAST_EDGES,
    PIXEL_VARIANCE,
    SIGNIFICANT,
    Color,
    Coverage,
    continued,
)
from deltalight.render_server.post_effects.camera_edges import BIN_PX, EdgeProfile, EdgeStep

RADII_PX = np.array([0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.4])
MASKS, ENOUGH = 5, 0.97
"""The first radii are those of masks. They must explain that much of what wider ones do, which fit JPEG's ringing."""
VARIANCES = np.geomspace(0.01, 1.0, 25)
"""Of a lens, px^2, besides a pixel's area. Behind a softer one, an unsharp mask of these radii hardly overshoots."""
AMOUNTS = np.linspace(0.0, 2.0, 41)
OUTLIER_POWER = 9.0
"""Times the median: an edge that is so much unlike a step shows something else."""
LEAST_OVERSHOOT = 0.02
"""Of an edge's contrast: less is no more than noise, and could be the shape of a lens's blur."""
GRID_PX = np.arange(-128, 128) / 8
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Of R, G and B (ITU-R BT.601)."""

Table = Float64[np.ndarray, "variances radii"]


@dataclass(frozen=True)
class Sharpening:
    """Amount a and radius s (px) of an unsharp mask, and the variance of the blur before it, px^2.

    That is the median over the edges, a pixel's own area included.
    """

    amount: float
    radius_px: float
    variance: float


class CameraSharpening:
    """Learns a camera's sharpening from the board's edges in its frames."""

    def __init__(self) -> None:
        self._fits: list[_Fit] = []
        self.model: Sharpening | None = None

    def observe(self, edges: Sequence[EdgeStep], response: Float32[np.ndarray, "256 3"] | None) -> None:
        """Takes the edges of a frame; `response` as that of `decode_lut`."""
        profiles = [each.profile for each in edges if each.profile is not None]
        if len(profiles) >= LEAST_EDGES:
            self._fits += _fits(profiles, decode_lut(response)[:, 1])
            self.model = _best(self._fits)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Least squares of one edge: its power, its correlation with the halo of an unsharp mask, and the halo's power.

    All without what a soft step, its shift, and slopes on both sides explain; for all VARIANCES and RADII_PX.
    """

    power: Table
    correlation: Table
    halo: Table


def _best(fits: Sequence[_Fit]) -> Sharpening | None:
    """Returns the sharpening that explains most, each edge having a blur of its own: some may be out of focus.

    None if there are few edges, or if the amount is within its error or hardly overshoots.
    """
    powers, correlations, halos = (
        np.stack([getattr(fit, name) for fit in fits]) for name in ("power", "correlation", "halo")
    )
    least = powers[..., 0].min(axis=1)
    kept = least <= OUTLIER_POWER * np.median(least)
    kept &= powers[..., 0].argmin(axis=1) < len(VARIANCES) - 1
    if kept.sum() < LEAST_EDGES:
        return None
    powers, correlations, halos = powers[kept], correlations[kept], halos[kept]
    misfits = [powers - amount * (2 * correlations - amount * halos) for amount in AMOUNTS]
    sums = np.array([each.min(axis=1).sum(axis=0) for each in misfits])
    explained = sums[0] - sums.min(axis=0)
    column = int(explained[:MASKS].argmax())
    step = int(sums[:, column].argmin())
    blurs = misfits[step][..., column].argmin(axis=1)
    correlation, halo = (each[np.arange(len(blurs)), blurs, column] for each in (correlations, halos))
    amount = float(correlation.sum() / halo.sum())
    error = np.sqrt(((correlation - amount * halo) ** 2).sum()) / halo.sum()
    sharp, middle = np.quantile(VARIANCES[blurs], [0.25, 0.5]) + PIXEL_VARIANCE
    found = Sharpening(amount, float(RADII_PX[column]), float(middle))
    sure = amount > SIGNIFICANT * error and explained[column] >= ENOUGH * explained.max()
    return found if sure and _overshoot(replace(found, variance=sharp)) >= LEAST_OVERSHOOT else None


def _overshoot(sharpening: Sharpening) -> float:
    """Returns how far an edge along the pixels exceeds its bright side, as a fraction of its contrast."""
    step = _soft_steps(np.array([sharpening.variance - PIXEL_VARIANCE]))
    halo = _halos(step, np.array([1.0, 0.0]), np.array([sharpening.radius_px]))[:, 0]
    return float((step + sharpening.amount * halo).max() - 1)


def _fits(profiles: Sequence[EdgeProfile], lut: Float32[np.ndarray, " 256"]) -> list[_Fit]:
    """Returns the fits of edges of about equal contrast, whose lens blurs light and whose camera sharpens codes."""
    dark, bright = np.median([each.levels for each in profiles], axis=0)
    low, high = np.interp([dark, bright], np.arange(256), lut)
    light = low + (high - low) * _soft_steps(VARIANCES + BIN_PX**2 / 12)
    steps = (np.interp(light, lut, np.arange(256)) - dark) / (bright - dark)
    halfway = np.array([np.interp(0.5, step, GRID_PX) for step in steps])
    return [_fit(each, steps, halfway) for each in profiles]


def _fit(profile: EdgeProfile, steps: Float64[np.ndarray, "v g"], halfway: Float64[np.ndarray, " v"]) -> _Fit:
    x = profile.distance_px
    at = x + halfway[:, None]
    step, slope = _at(steps, at), _at(np.gradient(steps, GRID_PX, axis=1), at)
    halos = _at(_halos(steps, profile.across, RADII_PX), at[:, None])
    root = np.sqrt(profile.pixels / profile.pixels.sum())
    known = np.stack([np.ones_like(step), step, slope, step * x, (1 - step) * x], axis=-1)
    basis, _ = np.linalg.qr(known * root[:, None])

    def rest(values: Float64[np.ndarray, "v r n"]) -> Float64[np.ndarray, "v r n"]:
        return np.asarray(values - values @ basis @ basis.swapaxes(1, 2))

    seen = rest(np.broadcast_to(profile.code * root, (len(steps), 1, len(x))))
    halos = rest(halos * root)
    return _Fit((seen**2).sum(axis=-1), (seen * halos).sum(axis=-1), (halos**2).sum(axis=-1))


def _soft_steps(variances: Float64[np.ndarray, " v"]) -> Float64[np.ndarray, "v g"]:
    """Returns a step blurred by Gaussians and the width of a pixel, at GRID_PX: integrals of erf."""
    from scipy.special import erf

    sigma = np.sqrt(variances)[:, None]
    ends = GRID_PX + np.array([-0.5, 0.5])[:, None, None]
    integral = ends * (1 + erf(ends / (np.sqrt(2) * sigma))) / 2
    integral += sigma / np.sqrt(2 * np.pi) * np.exp(-((ends / sigma) ** 2) / 2)
    return np.asarray(integral[1] - integral[0])


def _halos(
    steps: Float64[np.ndarray, "v g"], across: Float64[np.ndarray, " 2"], radii_px: Float64[np.ndarray, " r"]
) -> Float64[np.ndarray, "v r g"]:
    """Returns what unsharp masks of amount 1 add to steps across a direction in the picture.

    Along a line across the edge a kernel that is sampled at pixels has the transform K(f cos) K(f sin).
    """
    closed = np.concatenate([steps, steps[:, ::-1]], axis=1)  # down again, so that it is periodic
    frequency = np.fft.rfftfreq(closed.shape[1], GRID_PX[1] - GRID_PX[0])
    kept = np.ones((len(radii_px), len(frequency)))
    for part in across:
        kept *= [_transform(radius, part * frequency) for radius in radii_px]
    spectrum = np.fft.rfft(closed, axis=1)[:, None] * (1 - kept)
    return np.fft.irfft(spectrum, closed.shape[1], axis=-1)[..., : len(GRID_PX)]


def _transform(radius_px: float, frequency: Float64[np.ndarray, " f"]) -> Float64[np.ndarray, " f"]:
    """Returns the transform of the mask's kernel along rows or columns, as OpenCV samples it."""
    size = _size(radius_px)
    offsets = np.arange(size) - size // 2
    return np.asarray(
        cv2.getGaussianKernel(size, radius_px)[:, 0] @ np.cos(2 * np.pi * np.outer(offsets, frequency))
    )


def _size(radius_px: float) -> int:
    return 2 * int(np.ceil(3 * radius_px)) + 1


def _at(tables: Float64[np.ndarray, "*v g"], x: Float64[np.ndarray, "*v n"]) -> Float64[np.ndarray, "*v n"]:
    """Returns functions tabulated at GRID_PX elsewhere, linearly."""
    place = (x - GRID_PX[0]) / (GRID_PX[1] - GRID_PX[0])
    index = np.broadcast_to(place.astype(int), (*tables.shape[:-1], x.shape[-1]))
    below, above = (np.take_along_axis(tables, index + step, axis=-1) for step in (0, 1))
    return np.asarray(below + (place - index) * (above - below))


def sharpened(color: Color, coverage: Coverage, sharpening: Sharpening) -> Color:
    """Returns a picture whose virtual part, which covers `coverage` of each pixel, is sharpened, with its halos.

    The camera's own picture is sharpened already, so what it would get without objects is left out: the detail of
    what is behind them, which continues the picture around. Pixels that no halo changes stay as they are, to the bit.
    """
    rows, columns = np.nonzero(coverage > 0)
    if not len(rows):
        return color
    size = _size(sharpening.radius_px)
    box = tuple(slice(max(int(each.min()) - size, 0), int(each.max()) + size + 1) for each in (rows, columns))
    codes, known = color[box].astype(np.float32), coverage[box] <= 0
    behind = continued(codes, known, 2 * size - 1)
    reached = cv2.dilate(known.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    detail, behinds = (_detail(each @ LUMA, sharpening.radius_px) for each in (codes, behind))
    halo = sharpening.amount * (detail - np.where(reached, behinds, 0))
    result = color.copy()
    result[box] = np.clip(np.rint(codes + halo[..., None]), 0, 255).astype(np.uint8)
    return result


def _detail(luma: Float32[np.ndarray, "h w"], radius_px: float) -> Float32[np.ndarray, "h w"]:
    size = (_size(radius_px),) * 2
    return np.asarray(luma - cv2.GaussianBlur(luma, size, radius_px, borderType=cv2.BORDER_REPLICATE))
