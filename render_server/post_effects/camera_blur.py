"""A camera's blur on the virtual part of a picture ([D] 6.2): its lens's, measured at the board's edges, and motion.

The response to an edge is taken as Gaussian, a pixel's own area included, so the MTF is exp(-2 (pi sigma f)^2). One
figure holds lens, focus at the board's distance, demosaicking and sharpening. By lateral chromatic aberration the
picture in red and in blue is a little larger or smaller than in green. During an exposure the picture moves in a
straight line.
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
LEAST_MOTION_PX, LEAST_SHIFT_PX = 0.25, 0.05
SIGNIFICANT = 3.0
"""Standard errors by which red or blue must differ in size from green."""

Color = UInt8[np.ndarray, "h w 3"]
Coverage = Float32[np.ndarray, "h w"]


def mtf50(sigma_px: float) -> float:
    """Return the frequency (cycles a pixel) at which a Gaussian blur halves contrast."""
    return float(np.sqrt(np.log(2) / 2) / (np.pi * sigma_px))


@dataclass(frozen=True)
class LensBlur:
    """A lens's blur, standard deviation in px, and by how much red and blue are larger than green, as a fraction."""

    sigma_px: float
    red: float = 0.0
    blue: float = 0.0

    def shifts_px(self, from_centre_px: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, "3 2"]:
        """Return how far R, G and B lie from green at a place, from the principal point."""
        return np.outer([self.red, 0.0, self.blue], from_centre_px)


def measure_blur(frame: ViewFrame) -> LensBlur | None:
    """Return the blur across the edges of the board's markers, and how colours differ in size; None if few show."""
    if frame.board is None or frame.pose is None or frame.board.type == "charuco":
        return None
    found = [step for edge in _edges(frame, frame.board) if (step := _edge_step(frame, edge)) is not None]
    if len(found) < LEAST_EDGES:
        return None
    sigmas, radii, red, blue = np.array(found).T
    return LensBlur(float(np.median(sigmas)), _magnification(radii, red), _magnification(radii, blue))


def _magnification(radius: Float64[np.ndarray, " n"], shift: Float64[np.ndarray, " n"]) -> float:
    """Return the slope of shifts over the distance from the principal point; 0 if it is within its own error."""
    power = float(radius @ radius)
    slope = float(radius @ shift) / power
    error = np.sqrt(np.mean((shift - slope * radius) ** 2) / power)
    return slope if abs(slope) > SIGNIFICANT * error else 0.0


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


def _edge_step(frame: ViewFrame, edge: _Edge) -> tuple[float, float, float, float] | None:
    """Return the blur's standard deviation, and distances across the edge: from the principal point, of red and blue.

    Those of red and blue are from green. None if the edge is clipped, faint or something else.
    """
    ends = np.stack([edge.start, edge.start + edge.length * edge.along])
    low = np.floor(ends.min(axis=0) - edge.reach).astype(int)
    high = np.ceil(ends.max(axis=0) + edge.reach).astype(int) + 1
    codes = frame.color[low[1] : high[1], low[0] : high[0]]
    rows, columns = np.mgrid[low[1] : high[1], low[0] : high[0]]
    offset = np.stack([columns, rows], axis=-1) - edge.start
    across = _across(edge.along)
    distance, along = offset @ across, offset @ edge.along
    used = (np.abs(distance) <= edge.reach) & (along >= 0) & (along <= edge.length)
    if not used.any() or codes[used].min() < CODES[0] or codes[used].max() > CODES[1]:
        return None
    linear = decode_lut(frame.response)[codes[used], np.arange(3)].astype(np.float64)
    steps = [_fitted_step(distance[used], linear[:, channel]) for channel in range(3)]
    if steps[0] is None or steps[1] is None or steps[2] is None:
        return None
    (_, red), (sigma, green), (_, blue) = steps[0], steps[1], steps[2]
    radius = float(across @ (ends.mean(axis=0) - frame.camera.matrix[:2, 2]))
    return sigma, radius, red - green, blue - green


def _fitted_step(
    distance: Float64[np.ndarray, " n"], value: Float64[np.ndarray, " n"]
) -> tuple[float, float] | None:
    """Fit a step blurred by a Gaussian: the best of all SIGMAS_PX and SHIFTS_PX; returns both."""
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
    sigma = float(np.sqrt(SIGMAS_PX[best] ** 2 - BIN_PX**2 / 12))
    return sigma, float(SHIFTS_PX[shift]) + _vertex(residual[best], int(shift))


def _vertex(values: Float64[np.ndarray, " n"], least: int) -> float:
    """Return how far beside the least of the values at SHIFTS_PX a parabola through its neighbours is lowest."""
    if not 0 < least < len(values) - 1:
        return 0.0
    before, here, after = values[least - 1 : least + 2]
    return float((before - after) / (2 * (before - 2 * here + after)) * (SHIFTS_PX[1] - SHIFTS_PX[0]))


def blur_kernels(
    lens: LensBlur | None, motion_px: Float64[np.ndarray, " 2"], from_centre_px: Float64[np.ndarray, " 2"]
) -> Float64[np.ndarray, "3 k k"] | None:
    """Return what rendered objects lack of a camera's blur, R G B; None if that is nothing.

    `lens` None: unknown. `motion_px` is how far (columns, rows) the picture moves in an exposure, `from_centre_px`
    where the objects are from the principal point.
    """
    lacks = 0.0 if lens is None else lens.sigma_px**2 - PIXEL_VARIANCE
    shifts = (lens or LensBlur(0.0)).shifts_px(from_centre_px)
    length, apart = float(np.linalg.norm(motion_px)), float(np.abs(shifts).max())
    if lacks <= PIXEL_VARIANCE / 4 and length < LEAST_MOTION_PX and apart < LEAST_SHIFT_PX:
        return None
    # The kernel's own texels, over which the Gaussian is integrated, have the variance of a pixel.
    sigma = np.sqrt(max(lacks - PIXEL_VARIANCE, 1e-4))
    radius = int(np.ceil(3 * sigma + length / 2 + apart + 1))
    steps = 8 * int(np.ceil(length)) + 1
    share = (np.arange(steps) + 0.5) / steps - 0.5
    kernels = []
    for shift in shifts:
        columns, rows = (
            _integrals(share * moved + at, sigma, radius) for moved, at in zip(motion_px, shift, strict=True)
        )  # a row for each moment of the exposure
        kernels.append(np.einsum("tr,tc->rc", rows, columns))
    return np.asarray([kernel / kernel.sum() for kernel in kernels])


def _integrals(centres: Float64[np.ndarray, " t"], sigma: float, radius: int) -> Float64[np.ndarray, "t k"]:
    """Return Gaussians at `centres`, integrated over texels -radius..radius."""
    from scipy.special import erf

    edges = np.arange(-radius, radius + 2) - 0.5
    return np.asarray(np.diff(erf((edges - centres[:, None]) / (np.sqrt(2) * sigma)), axis=1) / 2)


def blurred(
    color: Color,
    coverage: Coverage,
    kernels: Float64[np.ndarray, "3 k k"],
    response: Float32[np.ndarray, "256 3"] | None,
) -> tuple[Color, Coverage]:
    """Return a picture whose virtual part went through `kernels`, in linear light, and how much that covers then.

    Objects and what is behind them are told apart by coverage: the picture around them is the camera's and has its
    blur. Behind an object's edges it is as near them. Pixels that the blurred objects do not reach are the same to
    the bit.
    """
    rows, columns = np.nonzero(coverage > 0)
    if not len(rows):
        return color, coverage
    width = kernels.shape[1]
    box = tuple(
        slice(max(int(each.min()) - width // 2, 0), int(each.max()) + width // 2 + 1)
        for each in (rows, columns)
    )
    codes, cover = color[box], np.clip(coverage[box], 0, 1)
    lut = decode_lut(response)
    linear = lut[codes, np.arange(3)].astype(np.float32)
    objects, behind = (_continued(linear, known, width) for known in (cover >= SOLID, cover <= 0))
    shares, coded = [], []
    for channel, kernel in enumerate(kernels):
        shares.append(_filtered(cover, kernel))
        own = _filtered(cover * objects[..., channel], kernel)
        mixed = own + (1 - shares[channel]) * behind[..., channel]
        coded.append(np.rint(np.interp(mixed, lut[:, channel], np.arange(256))))
    share = np.stack(shares, axis=-1)
    touched = (share.max(axis=-1) > LEAST_SHARE) | (cover > 0)
    result, covered = color.copy(), coverage.copy()
    result[box] = np.where(touched[..., None], np.stack(coded, axis=-1), codes).astype(np.uint8)
    covered[box] = np.where(touched, share[..., 1], 0)
    return result, covered


def _filtered(
    picture: Float32[np.ndarray, "h w"], kernel: Float64[np.ndarray, "k k"]
) -> Float32[np.ndarray, "h w"]:
    turned = kernel[::-1, ::-1]  # filter2D correlates
    return np.asarray(cv2.filter2D(picture, -1, turned, borderType=cv2.BORDER_REPLICATE))


def _continued(
    picture: Float32[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"], width: int
) -> Float32[np.ndarray, "h w 3"]:
    """Return a picture where `known`, and elsewhere the mean of what is known nearby; far from that, as it is."""
    weight = known.astype(np.float32)
    size = (2 * (width // 2) + 1,) * 2
    share = cv2.GaussianBlur(weight, size, 0)[..., None]
    mean = cv2.GaussianBlur(picture * weight[..., None], size, 0) / np.maximum(share, 1e-6)
    return np.where(known[..., None] | (share < 1e-4), picture, mean).astype(np.float32)
