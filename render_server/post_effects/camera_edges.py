"""Edges of the board's markers in a camera's picture, each fitted with a step that a Gaussian blurs."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.frames import ViewFrame, decode_lut

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
PROFILE_REACH_PX = (2.0, 4.0)
"""How far beside an edge its profile must be seen, and how far it is kept."""
STEEP = (0.2, 0.8)
"""Between dark and bright: codes that tell where an edge is."""
LEAST_STEEP = 8


@dataclass(frozen=True, eq=False)
class EdgeProfile:
    """Green codes across an edge, from its dark side to its bright side, averaged in bins.

    `distance_px` is measured from where the code is halfway, `code` is 0 and 1 at the medians of both sides, which
    are `levels` (0..255), and `pixels` is how many a bin holds. `across` is the direction in the picture.
    """

    distance_px: Float64[np.ndarray, " n"]
    code: Float64[np.ndarray, " n"]
    pixels: Float64[np.ndarray, " n"]
    levels: tuple[float, float]
    across: Float64[np.ndarray, " 2"]


@dataclass(frozen=True)
class EdgeStep:
    """The picture of one edge.

    `sigma_px` is the blur's standard deviation in green. `across_px` is how far the edge is from the principal point,
    measured across it, `red_px` and `blue_px` how far beside it red and blue are. Its middle is at the depth
    1 / `inverse_m`, along the optical axis, and `radius_px` from the principal point. `profile` is None if too little
    is seen beside it.
    """

    sigma_px: float
    across_px: float
    red_px: float
    blue_px: float
    inverse_m: float
    radius_px: float
    profile: EdgeProfile | None


def edge_steps(frame: ViewFrame) -> list[EdgeStep]:
    """Returns the outer edges of the board's markers (grids and single markers) that are seen well; none without."""
    if frame.board is None or frame.pose is None or frame.board.type == "charuco":
        return []
    return [step for edge in _edges(frame, frame.board) if (step := _edge_step(frame, edge)) is not None]


@dataclass(frozen=True, eq=False)
class _Edge:
    """A straight edge in the picture: a point of it (px), its direction, its length and how far beside it to look.

    `inverse_m` is 1 over its middle's depth.
    """

    start: Float64[np.ndarray, " 2"]
    along: Float64[np.ndarray, " 2"]
    length: float
    reach: float
    inverse_m: float


def _edges(frame: ViewFrame, board: BoardSpec) -> Iterator[_Edge]:
    """Yields the outer edges of the markers in view that are long enough."""
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
                inverse_m = float(np.mean(1 / seen[:2, 2]))  # linear along a line in the picture
                yield _Edge(start, along, (1 - 2 * INSET) * length, reach, inverse_m)


def _across(along: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, " 2"]:
    return np.array([-along[1], along[0]])


def _edge_step(frame: ViewFrame, edge: _Edge) -> EdgeStep | None:
    """Returns what is seen of an edge; None if it is clipped, faint or something else."""
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
    steps = _fitted_steps(distance[used], linear)
    if steps is None:
        return None
    (_, red), (sigma, green), (_, blue) = steps
    from_centre = ends.mean(axis=0) - frame.camera.matrix[:2, 2]
    radius = float(np.linalg.norm(from_centre))
    profile = _profile(distance[used], along[used] / edge.length - 0.5, codes[used][:, 1], across)
    return EdgeStep(
        sigma, float(across @ from_centre), red - green, blue - green, edge.inverse_m, radius, profile
    )


def _profile(
    distance: Float64[np.ndarray, " n"],
    along: Float64[np.ndarray, " n"],
    codes: UInt8[np.ndarray, " n"],
    across: Float64[np.ndarray, " 2"],
) -> EdgeProfile | None:
    """Returns the profile of an edge, put straight: the board's pose may be off by part of a pixel.

    `along` is -0.5 at one end of the edge and 0.5 at the other.
    """
    reach = float(np.abs(distance).max())
    below, above = (float(np.median(codes[side * distance > reach / 2])) for side in (-1, 1))
    if reach < PROFILE_REACH_PX[0] or below == above:
        return None
    value = (codes - min(below, above)) / abs(above - below)
    rising = 1 if above > below else -1
    steep = (value > STEEP[0]) & (value < STEEP[1]) & (np.abs(distance) < PROFILE_REACH_PX[0])
    if steep.sum() < LEAST_STEEP:
        return None
    columns = np.stack([value - 0.5, np.ones_like(value), along], axis=1)
    _, shift, tilt = np.linalg.lstsq(columns[steep], distance[steep], rcond=None)[0]
    distance = rising * (distance - shift - tilt * along)
    kept = np.abs(distance) <= PROFILE_REACH_PX[1]
    _, bins = np.unique(np.round(distance[kept] / BIN_PX).astype(int), return_inverse=True)
    count = np.bincount(bins).astype(np.float64)
    middle, mean = (np.bincount(bins, each[kept]) / count for each in (distance, value))
    return EdgeProfile(middle, mean, count, (min(below, above), max(below, above)), rising * across)


def _fitted_steps(
    distance: Float64[np.ndarray, " n"], values: Float64[np.ndarray, "n 3"]
) -> list[tuple[float, float]] | None:
    """Fits each channel with a step blurred by a Gaussian: the best of all SIGMAS_PX and SHIFTS_PX; returns both."""
    from scipy.special import erf

    bins = np.round(distance / BIN_PX).astype(int)
    names, bins = np.unique(bins, return_inverse=True)
    if len(names) < LEAST_BINS:
        return None
    count = np.bincount(bins).astype(np.float64)
    distance = np.bincount(bins, distance) / count
    weight = count / count.sum()
    steps = erf((distance - SHIFTS_PX[:, None]) / (np.sqrt(2) * SIGMAS_PX[:, None, None]))
    steps = steps - (steps @ weight)[..., None]
    power = (steps**2) @ weight
    found = [_best_step(steps, power, weight, np.bincount(bins, value) / count) for value in values.T]
    known = [each for each in found if each is not None]
    return known if len(known) == len(found) else None


def _best_step(
    steps: Float64[np.ndarray, "s d n"],
    power: Float64[np.ndarray, "s d"],
    weight: Float64[np.ndarray, " n"],
    value: Float64[np.ndarray, " n"],
) -> tuple[float, float] | None:
    """Returns blur and shift of the step that fits best; None if it is faint, or does not fit."""
    centred = value - weight @ value
    slope = (steps * centred) @ weight / power
    residual = (centred**2) @ weight - slope**2 * power
    best, shift = np.unravel_index(residual.argmin(), residual.shape)
    contrast, rms = 2 * abs(float(slope[best, shift])), float(residual[best, shift].clip(min=0)) ** 0.5
    if contrast < LEAST_CONTRAST or rms > MOST_RESIDUAL * contrast:
        return None
    sigma = float(np.sqrt(SIGMAS_PX[best] ** 2 - BIN_PX**2 / 12))
    return sigma, float(SHIFTS_PX[shift]) + _vertex(residual[best], int(shift))


def _vertex(values: Float64[np.ndarray, " n"], least: int) -> float:
    """Returns how far beside the least of the values at SHIFTS_PX a parabola through its neighbours is lowest."""
    if not 0 < least < len(values) - 1:
        return 0.0
    before, here, after = values[least - 1 : least + 2]
    return float((before - after) / (2 * (before - 2 * here + after)) * (SHIFTS_PX[1] - SHIFTS_PX[0]))
