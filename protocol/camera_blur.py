"""A camera's blur on the virtual part of a picture ([D] 6.2): its lens's, measured at the board's edges, and motion.

The response to an edge is taken as Gaussian, a pixel's own area included, so the MTF is exp(-2 (pi sigma f)^2). One
figure holds lens, focus at the board's distance, demosaicking and sharpening. During an exposure the picture moves in
a straight line.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.frames import ViewFrame, decode_lut

PIXEL_VARIANCE = 1 / 12
"""Of a pixel's area; objects are rendered with it, so that much of the camera's blur is there already."""
SIGMAS_PX = np.geomspace(0.3, 6.0, 76)
SHIFTS_PX = np.linspace(-1.0, 1.0, 21)
BIN_PX = 0.25
"""Width of the bins of distance from an edge, in which pixels beside it are averaged."""
INSET = 0.15
"""Of an edge's length at either end, where the next edge begins."""
REACH = 0.7
"""Of the marker's border: how far beside an edge pixels are read."""
LEAST_REACH_PX, LEAST_LENGTH_PX, LEAST_BINS = 1.5, 6.0, 8
LEAST_CONTRAST = 0.1
MOST_RESIDUAL = 0.1
"""Of an edge's contrast, rms: what lies across it is something else."""
CODES = (4, 251)
"""An edge with pixels outside is clipped."""
LEAST_EDGES = 8
NO_MOTION = np.zeros(2)
SOLID, LEAST_SHARE = 0.99, 1 / 512
LEAST_MOTION_PX = 0.25

Color = UInt8[np.ndarray, "h w 3"]
Coverage = Float32[np.ndarray, "h w"]


def mtf50(sigma_px: float) -> float:
    """Return the frequency (cycles a pixel) at which a Gaussian blur halves contrast."""
    return float(np.sqrt(np.log(2) / 2) / (np.pi * sigma_px))


def measure_blur(frame: ViewFrame) -> float | None:
    """Return the standard deviation (px) of the blur across the edges of markers; None if too few of them show."""
    if frame.board is None or frame.pose is None or frame.board.type == "charuco":
        return None
    found = [sigma for edge in _edges(frame, frame.board) if (sigma := _edge_blur(frame, edge)) is not None]
    return float(np.median(found)) if len(found) >= LEAST_EDGES else None


@dataclass(frozen=True, eq=False)
class _Edge:
    """A straight edge in the picture: a point of it (px), its direction, its length and how far beside it to look."""

    start: Float64[np.ndarray, " 2"]
    along: Float64[np.ndarray, " 2"]
    length: float
    reach: float


def _edges(frame: ViewFrame, board: BoardSpec) -> Iterator[_Edge]:
    """Yield the outer edges of the markers in view that are long enough."""
    assert frame.pose is not None
    camera_from_world = np.linalg.inv(frame.pose.world_from_camera)
    cells = board.opencv_dictionary().markerSize + 2 * board.border_bits
    border = board.border_bits / cells
    size = np.array([frame.camera.width, frame.camera.height])
    for quad in board.corner_points().values():
        middle = quad.mean(axis=0)
        for corner, other in zip(quad, np.roll(quad, -1, axis=0), strict=True):
            inward = middle - (corner + other) / 2  # half of the marker
            points = np.stack([corner, other, (corner + other) / 2 + 2 * border * inward])
            seen = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
            if (seen[:, 2] <= 0).any():
                continue
            first, last, inside = frame.camera.project(seen)
            length = float(np.linalg.norm(last - first))
            if not (np.isfinite(length) and length > 0):
                continue
            along = (last - first) / length
            reach = REACH * abs(float(_across(along) @ (inside - first)))
            start = first + INSET * (last - first)
            if min(first.min(), last.min(), *(size - first), *(size - last)) < reach + 1:
                continue
            if reach >= LEAST_REACH_PX and (1 - 2 * INSET) * length >= LEAST_LENGTH_PX:
                yield _Edge(start, along, (1 - 2 * INSET) * length, reach)


def _across(along: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, " 2"]:
    return np.array([-along[1], along[0]])


def _edge_blur(frame: ViewFrame, edge: _Edge) -> float | None:
    """Return the blur's standard deviation across one edge; None if that is clipped, faint or something else."""
    ends = np.stack([edge.start, edge.start + edge.length * edge.along])
    low = np.floor(ends.min(axis=0) - edge.reach).astype(int)
    high = np.ceil(ends.max(axis=0) + edge.reach).astype(int) + 1
    codes = frame.color[low[1] : high[1], low[0] : high[0]]
    rows, columns = np.mgrid[low[1] : high[1], low[0] : high[0]]
    offset = np.stack([columns, rows], axis=-1) - edge.start
    distance, along = offset @ _across(edge.along), offset @ edge.along
    used = (np.abs(distance) <= edge.reach) & (along >= 0) & (along <= edge.length)
    if not used.any() or codes[used].min() < CODES[0] or codes[used].max() > CODES[1]:
        return None
    linear = decode_lut(frame.response)[codes[used], np.arange(3)].mean(axis=1)
    return _fitted_sigma(distance[used], linear.astype(np.float64))


def _fitted_sigma(distance: Float64[np.ndarray, " n"], value: Float64[np.ndarray, " n"]) -> float | None:
    """Fit a step blurred by a Gaussian, wherever near the edge it is: the best of all SIGMAS_PX and SHIFTS_PX."""
    from scipy.special import erf

    bins = np.round(distance / BIN_PX).astype(int)
    names, bins = np.unique(bins, return_inverse=True)
    if len(names) < LEAST_BINS:
        return None
    count = np.bincount(bins).astype(np.float64)
    value = np.bincount(bins, value) / count
    distance = np.bincount(bins, distance) / count
    weight = count / count.sum()
    steps = erf((distance - SHIFTS_PX[:, None]) / (np.sqrt(2) * SIGMAS_PX[:, None, None]))
    steps = steps - (steps @ weight)[..., None]
    centred = value - weight @ value
    power = (steps**2) @ weight
    slope = (steps * centred) @ weight / power
    residual = (centred**2) @ weight - slope**2 * power
    best, shift = np.unravel_index(residual.argmin(), residual.shape)
    contrast, rms = 2 * abs(float(slope[best, shift])), float(residual[best, shift].clip(min=0)) ** 0.5
    if contrast < LEAST_CONTRAST or rms > MOST_RESIDUAL * contrast:
        return None
    return float(np.sqrt(SIGMAS_PX[best] ** 2 - BIN_PX**2 / 12))


def blur_kernel(
    sigma_px: float | None, motion_px: Float64[np.ndarray, " 2"]
) -> Float64[np.ndarray, "k k"] | None:
    """Return what rendered objects lack of a camera's blur; None if that is nothing.

    `sigma_px` None: the lens's blur is unknown. `motion_px` is how far (columns, rows) the picture moves in an
    exposure.
    """
    lacks = 0.0 if sigma_px is None else sigma_px**2 - PIXEL_VARIANCE
    length = float(np.linalg.norm(motion_px))
    if lacks <= PIXEL_VARIANCE / 4 and length < LEAST_MOTION_PX:
        return None
    # The kernel's own texels, over which the Gaussian is integrated, have the variance of a pixel.
    sigma = np.sqrt(max(lacks - PIXEL_VARIANCE, 1e-4))
    radius = int(np.ceil(3 * sigma + length / 2 + 1))
    steps = 8 * int(np.ceil(length)) + 1
    share = (np.arange(steps) + 0.5) / steps - 0.5
    columns, rows = (
        _integrals(share * moved, sigma, radius) for moved in motion_px
    )  # a row for each moment of the exposure
    kernel = np.einsum("tr,tc->rc", rows, columns)
    return np.asarray(kernel / kernel.sum())


def _integrals(centres: Float64[np.ndarray, " t"], sigma: float, radius: int) -> Float64[np.ndarray, "t k"]:
    """Return Gaussians at `centres`, integrated over texels -radius..radius."""
    from scipy.special import erf

    edges = np.arange(-radius, radius + 2) - 0.5
    return np.asarray(np.diff(erf((edges - centres[:, None]) / (np.sqrt(2) * sigma)), axis=1) / 2)


def blurred(
    color: Color,
    coverage: Coverage,
    kernel: Float64[np.ndarray, "k k"],
    response: Float32[np.ndarray, "256 3"] | None,
) -> tuple[Color, Coverage]:
    """Return a picture whose virtual part went through `kernel`, in linear light, and how much that covers then.

    Objects and what is behind them are told apart by coverage: the picture around them is the camera's and has its
    blur. Behind an object's edges it is as near them. Pixels that the blurred objects do not reach are the same to
    the bit.
    """
    rows, columns = np.nonzero(coverage > 0)
    if not len(rows):
        return color, coverage
    radius = kernel.shape[0] // 2
    box = tuple(
        slice(max(int(each.min()) - radius, 0), int(each.max()) + radius + 1) for each in (rows, columns)
    )
    codes, cover = color[box], np.clip(coverage[box], 0, 1)
    lut = decode_lut(response)
    linear = lut[codes, np.arange(3)].astype(np.float32)
    objects, behind = (_continued(linear, known, kernel.shape[0]) for known in (cover >= SOLID, cover <= 0))
    flipped = kernel[::-1, ::-1]  # filter2D correlates
    share = _filtered(cover, flipped)
    mixed = _filtered(cover[..., None] * objects, flipped) + (1 - share[..., None]) * behind
    touched = (share > LEAST_SHARE) | (cover > 0)
    coded = np.stack([np.interp(mixed[..., c], lut[:, c], np.arange(256)) for c in range(3)], axis=-1)
    result, covered = color.copy(), coverage.copy()
    result[box] = np.where(touched[..., None], np.rint(coded), codes).astype(np.uint8)
    covered[box] = np.where(touched, share, 0)
    return result, covered


def _filtered(picture: Float32[np.ndarray, "h w *c"], kernel: Float64[np.ndarray, "k k"]) -> np.ndarray:
    return np.asarray(cv2.filter2D(picture, -1, kernel, borderType=cv2.BORDER_REPLICATE))


def _continued(
    picture: Float32[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"], width: int
) -> Float32[np.ndarray, "h w 3"]:
    """Return a picture where `known`, and elsewhere the mean of what is known nearby; far from that, as it is."""
    weight = known.astype(np.float32)
    size = (2 * (width // 2) + 1,) * 2
    share = cv2.GaussianBlur(weight, size, 0)[..., None]
    mean = cv2.GaussianBlur(picture * weight[..., None], size, 0) / np.maximum(share, 1e-6)
    return np.where(known[..., None] | (share < 1e-4), picture, mean).astype(np.float32)
