"""A camera's blur on the virtual part of a picture ([D] 6.2): its lens's, measured at the board's edges, and motion.

The response to an edge is taken as Gaussian, a pixel's own area included, so the MTF is exp(-2 (pi sigma f)^2). One
figure holds lens, focus at the board's distance, demosaicking and sharpening; camera_defocus.py, camera_mosaic.py and
camera_sharpening.py tell some of it apart where they find it. By lateral chromatic aberration the picture in red and
in blue is a little larger or smaller than in green. During an exposure the picture moves in a straight line.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from deltalight.protocol.frames import decode_lut
from deltalight.render_server.post_effects.camera_edges import EdgeStep

PIXEL_VARIANCE = 1 / 12
"""Of a pixel's area; objects are rendered with it, so that much of the camera's blur is there already."""
LEAST_EDGES = 8
NO_MOTION = np.zeros(2)
NARROW_PX = np.linspace(0.01, 1.0, 100)
SOLID, LEAST_COVERAGE = 0.99, 1 / 512
TINY_COVERAGE = 1e-6
LEAST_MOTION_PX, LEAST_SHIFT_PX = 0.25, 0.05
SIGNIFICANT = 3.0
"""Standard errors by which red or blue must differ in size from green."""

Color = UInt8[np.ndarray, "h w 3"]
Coverage = Float32[np.ndarray, "h w"]
Layer = Float32[np.ndarray, "h w 3"]
Part = tuple[Float64[np.ndarray, "3 k k"], Coverage]


def mtf50(sigma_px: float) -> float:
    """Returns the frequency (cycles a pixel) at which a Gaussian blur halves contrast."""
    return float(np.sqrt(np.log(2) / 2) / (np.pi * sigma_px))


@dataclass(frozen=True)
class LensBlur:
    """A lens's blur, standard deviation in px, and by how much red and blue are larger than green, as a fraction."""

    sigma_px: float
    red: float = 0.0
    blue: float = 0.0

    def shifts_px(self, from_centre_px: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, "3 2"]:
        """Returns how far R, G and B lie from green at a place, from the principal point."""
        return np.outer([self.red, 0.0, self.blue], from_centre_px)

    def without(self, variance: float) -> "LensBlur":
        """Returns what is left of the blur without a part of its variance, px^2."""
        return replace(self, sigma_px=float(np.sqrt(max(self.sigma_px**2 - variance, 0.0))))


def measure_blur(edges: Sequence[EdgeStep]) -> LensBlur | None:
    """Returns the blur across a frame's edges, and how colours differ in size; None if they are few."""
    if len(edges) < LEAST_EDGES:
        return None
    radii, red, blue = np.array([(each.across_px, each.red_px, each.blue_px) for each in edges]).T
    sigma = float(np.median([each.sigma_px for each in edges]))
    return LensBlur(sigma, _magnification(radii, red), _magnification(radii, blue))


def _magnification(radius: Float64[np.ndarray, " n"], shift: Float64[np.ndarray, " n"]) -> float:
    """Returns the slope of shifts over the distance from the principal point; 0 if it is within its own error."""
    power = float(radius @ radius)
    slope = float(radius @ shift) / power
    error = np.sqrt(np.mean((shift - slope * radius) ** 2) / power)
    return slope if abs(slope) > SIGNIFICANT * error else 0.0


def blur_kernels(
    lens: LensBlur | None, motion_px: Float64[np.ndarray, " 2"], from_centre_px: Float64[np.ndarray, " 2"]
) -> Float64[np.ndarray, "3 k k"] | None:
    """Returns what rendered objects lack of a camera's blur, R G B; None if that is nothing.

    `lens` None: unknown. `motion_px` is how far (columns, rows) the picture moves in an exposure, `from_centre_px`
    where the objects are from the principal point.
    """
    lacks = 0.0 if lens is None else lens.sigma_px**2 - PIXEL_VARIANCE
    shifts = (lens or LensBlur(0.0)).shifts_px(from_centre_px)
    length, apart = float(np.linalg.norm(motion_px)), float(np.abs(shifts).max())
    if lacks <= PIXEL_VARIANCE / 4 and length < LEAST_MOTION_PX and apart < LEAST_SHIFT_PX:
        return None
    sigma = _kernel_sigma(lacks)
    radius = int(np.ceil(3 * sigma + length / 2 + apart + 1))
    steps = 8 * int(np.ceil(length)) + 1
    moments = (np.arange(steps) + 0.5) / steps - 0.5
    kernels = []
    for shift in shifts:
        columns, rows = (
            _integrals(moments * moved + at, sigma, radius)
            for moved, at in zip(motion_px, shift, strict=True)
        )  # a row for each moment of the exposure
        kernels.append(np.einsum("tr,tc->rc", rows, columns))
    return np.asarray([kernel / kernel.sum() for kernel in kernels])


def _kernel_sigma(variance: float) -> float:
    """Returns the Gaussian (px) to integrate over texels for what rendered objects lack of a blur's variance, px^2.

    A wide one gets a texel's variance by that. Of a narrow one, texels keep too much contrast, so it is chosen by the
    frequency at which the whole blur halves contrast, or the highest that pixels show.
    """
    if variance >= NARROW_PX[-1] ** 2 + PIXEL_VARIANCE:
        return float(np.sqrt(variance - PIXEL_VARIANCE))
    whole = max(variance, 0.0) + PIXEL_VARIANCE
    frequency = min(mtf50(np.sqrt(whole)), 0.5)
    wanted = np.exp(-2 * whole * (np.pi * frequency) ** 2) / np.sinc(frequency)
    kept = _narrow_kernels() @ np.cos(2 * np.pi * frequency * np.arange(-6, 7))
    return float(np.interp(-wanted, -kept, NARROW_PX))


@cache
def _narrow_kernels() -> Float64[np.ndarray, "n k"]:
    return np.concatenate([_integrals(np.zeros(1), sigma, 6) for sigma in NARROW_PX])


def _integrals(centres: Float64[np.ndarray, " t"], sigma: float, radius: int) -> Float64[np.ndarray, "t k"]:
    """Returns Gaussians at `centres`, integrated over texels -radius..radius."""
    from scipy.special import erf

    edges = np.arange(-radius, radius + 2) - 0.5
    return np.asarray(np.diff(erf((edges - centres[:, None]) / (np.sqrt(2) * sigma)), axis=1) / 2)


def blurred(
    color: Color,
    coverage: Coverage,
    kernels: Float64[np.ndarray, "3 k k"],
    response: Float32[np.ndarray, "256 3"] | None,
) -> tuple[Color, Coverage]:
    """Returns a picture whose virtual part went through `kernels`, in linear light, and how much that covers then.

    Objects and what is behind them are told apart by coverage: the picture around them is the camera's and has its
    blur. Behind an object's edges it is as near them. Pixels that the blurred objects do not reach are the same to
    the bit.
    """
    return blurred_in_parts(color, coverage, [(kernels, np.ones_like(coverage))], response)


def blurred_in_parts(
    color: Color, coverage: Coverage, parts: Sequence[Part], response: Float32[np.ndarray, "256 3"] | None
) -> tuple[Color, Coverage]:
    """Returns a picture as `blurred` does, with several blurs: kernels, and their weights in what covers a pixel.

    Weights of a pixel sum to 1.
    """
    rows, columns = np.nonzero(coverage > 0)
    if not len(rows):
        return color, coverage
    reach = max(kernels.shape[1] for kernels, _ in parts) // 2
    box = tuple(
        slice(max(int(each.min()) - reach, 0), int(each.max()) + reach + 1) for each in (rows, columns)
    )
    codes, cover = color[box], np.clip(coverage[box], 0, 1)
    lut = decode_lut(response)
    linear = lut[codes, np.arange(3)].astype(np.float32)
    covering, own, behind = _merged(
        [_blurred_part(linear, cover, kernels, weight[box]) for kernels, weight in parts],
        [_by_channel(cover[..., None], kernels) for kernels, _ in parts if len(parts) > 1],
    )
    mixed = own + (1 - covering) * behind
    coded = [np.rint(np.interp(mixed[..., c], lut[:, c], np.arange(256))) for c in range(3)]
    touched = (covering.max(axis=-1) > LEAST_COVERAGE) | (cover > 0)
    result, covered = color.copy(), coverage.copy()
    result[box] = np.where(touched[..., None], np.stack(coded, axis=-1), codes).astype(np.uint8)
    covered[box] = np.where(touched, covering[..., 1], 0)
    return result, covered


def _blurred_part(
    linear: Float32[np.ndarray, "h w 3"],
    cover: Float32[np.ndarray, "h w"],
    kernels: Float64[np.ndarray, "3 k k"],
    weight: Float32[np.ndarray, "h w"],
) -> tuple[Layer, Layer, Layer]:
    """Returns how much a part of the objects covers, blurred, its light times that, and the light behind it."""
    objects, behind = (continued(linear, known, kernels.shape[1]) for known in (cover >= SOLID, cover <= 0))
    part = (cover * weight)[..., None]
    return _by_channel(part, kernels), _by_channel(part * objects, kernels), behind


def _merged(
    parts: Sequence[tuple[Layer, Layer, Layer]], wholes: Sequence[Layer]
) -> tuple[Layer, Layer, Layer]:
    """Merges parts that were blurred differently; `wholes`: the coverage of all objects in the blur of each part.

    Where parts meet, their coverages do not sum to 1, although nothing shows between them. So light is averaged with
    the coverages as weights, and so is the coverage of all objects.
    """
    if len(parts) == 1:
        return parts[0]
    total = np.maximum(sum(cover for cover, _, _ in parts), TINY_COVERAGE)
    whole = sum(cover * each for (cover, _, _), each in zip(parts, wholes, strict=True)) / total
    own = sum(own for _, own, _ in parts) * whole / total
    return whole, np.asarray(own), np.asarray(sum(cover * behind for cover, _, behind in parts) / total)


def _by_channel(picture: Float32[np.ndarray, "h w c"], kernels: Float64[np.ndarray, "3 k k"]) -> Layer:
    """Returns R G B through their kernels; of a picture of one channel, that through each."""
    channels = np.broadcast_to(picture, (*picture.shape[:2], 3))
    return np.stack([_filtered(channels[..., c], kernel) for c, kernel in enumerate(kernels)], axis=-1)


def _filtered(
    picture: Float32[np.ndarray, "h w"], kernel: Float64[np.ndarray, "k k"]
) -> Float32[np.ndarray, "h w"]:
    turned = kernel[::-1, ::-1]  # filter2D correlates
    return np.asarray(cv2.filter2D(picture, -1, turned, borderType=cv2.BORDER_REPLICATE))


def continued(
    picture: Float32[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"], width: int
) -> Float32[np.ndarray, "h w 3"]:
    """Returns a picture where `known`, and elsewhere the mean of what is known nearby; far from that, as it is."""
    weight = known.astype(np.float32)
    size = (2 * (width // 2) + 1,) * 2
    total = cv2.GaussianBlur(weight, size, 0)[..., None]
    mean = cv2.GaussianBlur(picture * weight[..., None], size, 0) / np.maximum(total, 1e-6)
    return np.where(known[..., None] | (total < 1e-4), picture, mean).astype(np.float32)
