"""Completion of unknown depth along depth edges: a surface beside each pixel, selected by colour.

Stereo leaves a rim without depth around near things: its matching windows straddle the edge, and the second camera
does not see all that the first one does. The colour picture still shows which surface a pixel of the rim belongs to.
For each such pixel, known samples around it are split into a nearer and a farther surface, a plane of each is
extended to the pixel, and the one whose colours match clearly better wins. The vote is shared with neighbours of
similar colour, so that the rim becomes smooth. Pixels that see only one surface, or match both or neither, stay
unknown. So do those that resemble other unknown pixels much more than either surface: they show a third one, too
steep to be measured, such as the top of a box seen along it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from deltalight.sensor_node.depth_filter import NoiseModel

Samples = Float32[np.ndarray, "samples n"]
PerPixel = Float32[np.ndarray, " n"]

# Directions and distances of the samples: on a spiral, equally many per doubling of the distance, so that near ones
# dominate and far ones are still found. The golden angle spreads them over all directions.
SAMPLE_COUNT = 64
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
# A rim pixel beside one surface is farther from the other, which lies beyond the occlusion's shadow.
SIGHT_PER_REACH = 4.0
# Samples of either surface that determine a plane.
LEAST_SAMPLES = 3
# After these iterations the mean of both means hardly moves if there are two surfaces.
SPLIT_ROUNDS = 2
# Keeps a plane through collinear samples solvable; square pixels.
SLOPE_RIDGE_PX2 = 1.0
# Fraction of the step between two planes within which their samples must lie; otherwise there are not two.
STRAY_FRACTION = 0.25
# A surface must match this much better than the other: odds of 4 to 1.
CLEAR_LOG_ODDS = float(np.log(4.0))
# Limits the vote of a pixel's own colour, so that one stray pixel does not decide it.
MOST_LOG_ODDS = 3 * CLEAR_LOG_ODDS
# Match of a colour that no surface around has (ten times the contrast away): it favours neither.
ALIEN_MATCH = 1e-4
# Unknown pixels are nearest to an unknown one, so they resemble it most in any case: a third surface requires twice
# the evidence (logarithms add) that decides between two.
OWN_ODDS = 4.0**2
# Thinner lines are edges, where colours mix to one of their own.
OWN_WIDTH_PX = 3
VOTE_RADIUS_PX = 2
# Pixels processed at a time, so that their data stays in the processor's cache.
CHUNK = 2048
EMPTY = 1e-9


class _Offsets(NamedTuple):
    """Positions of a pixel's samples relative to it, in pixels, and their weights."""

    x: Float32[np.ndarray, " samples"]
    y: Float32[np.ndarray, " samples"]
    weight: Float32[np.ndarray, " samples"]


class _Padded(NamedTuple):
    """Inverse depth (0 = unknown) and colour, flat, padded so that no look-up leaves them."""

    inverse_depth: Float32[np.ndarray, " padded"]
    color: Float32[np.ndarray, "padded 4"]
    stride: int


class _Surfaces(NamedTuple):
    """Pixels that see two surfaces: flat positions in the padded picture, both surfaces extended there (1/m)."""

    places: Int64[np.ndarray, " n"]
    near: PerPixel
    far: PerPixel
    log_odds: PerPixel
    """For the nearer surface, by colour."""
    own: Bool[np.ndarray, " n"]
    """Whether the colour is that of unknown pixels around, and of neither surface."""


def assign_edges(
    inverse_depth: Float32[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    color: UInt8[np.ndarray, "h w 3"],
    *,
    noise: NoiseModel,
    sigmas: float,
    contrast: float,
    reach_px: int,
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Returns inverse depth and mask with the clear pixels along depth edges added; known ones stay unchanged.

    Args:
        inverse_depth: 1/m; anything where not known.
        known: which pixels are known.
        color: RGB picture as coded, 0..255.
        noise: of the depth.
        sigmas: surfaces that differ by less than this many standard deviations of the noise are one.
        contrast: difference of colour, 0..1, that distinguishes surfaces.
        reach_px: pixels farther than this from known ones of their surface stay unknown; at least 1.
    """
    offsets = _spiral(reach_px)
    margin = int(np.ceil(SIGHT_PER_REACH * reach_px)) + VOTE_RADIUS_PX
    picture = _pad(cv2.copyTo(inverse_depth, known.view(np.uint8)), color, margin, contrast)
    rows, columns = np.divmod(_rim(known, reach_px), known.shape[1])
    places = (rows + margin) * picture.stride + columns + margin
    parts = [_seen(picture, part, offsets, noise, sigmas) for part in _chunks(places)]
    if parts:
        seen = _Surfaces(*(np.concatenate(values) for values in zip(*parts, strict=True)))
        _assign(picture, _without_own(picture, seen), reach_px)
    inside = slice(margin, -margin)
    result = np.ascontiguousarray(picture.inverse_depth.reshape(-1, picture.stride)[inside, inside])
    assigned = known | (result > 0)
    return np.asarray(cv2.copyTo(inverse_depth, known.view(np.uint8), result)), assigned


def _without_own(picture: _Padded, seen: _Surfaces) -> _Surfaces:
    """Drops the pixels of areas in a colour of their own, unless such pixels form only a thin line."""
    own = np.zeros(len(picture.inverse_depth), np.uint8)
    own[seen.places] = seen.own
    window = np.ones((OWN_WIDTH_PX,) * 2, np.uint8)
    areas = cv2.morphologyEx(own.reshape(-1, picture.stride), cv2.MORPH_OPEN, window).ravel()
    kept = areas[seen.places] == 0
    return _Surfaces(*(values[kept] for values in seen))


def _assign(picture: _Padded, seen: _Surfaces, reach_px: int) -> None:
    """Writes the decided pixels into the picture: the clear ones, then those between both surfaces.

    A pixel with both surfaces beside it is on the edge itself, where colours mix: the likelier surface is good enough
    there, as at most that pixel is wrong.
    """
    log_odds = _voted(picture, seen)
    value = np.where(log_odds > 0, seen.near, seen.far)
    middle = (seen.near + seen.far) / 2
    clear = (np.abs(log_odds) >= CLEAR_LOG_ODDS) & (value > 0)
    _grow(picture, seen.places[clear], value[clear], np.abs(value - middle)[clear], reach_px)
    beside = picture.inverse_depth[seen.places + _square(picture.stride, 1)]
    nearer, farther = beside > middle, (beside > 0) & (beside <= middle)
    between = nearer.any(axis=0) & farther.any(axis=0) & ~clear & (value > 0)
    picture.inverse_depth[seen.places[between]] = value[between]


def _grow(
    picture: _Padded, places: Int64[np.ndarray, " n"], value: PerPixel, near_by: PerPixel, reach_px: int
) -> None:
    """Writes pixels that touch their own surface (depth within `near_by`), then those that touch these.

    Spots with the colour of a surface but no connection to it stay unknown, and no pixel is farther than the reach
    from known ones of its surface.
    """
    for _ in range(reach_px):
        beside = picture.inverse_depth[places + _square(picture.stride, 1)]
        touches = ((beside > 0) & (np.abs(beside - value) < near_by)).any(axis=0)
        if not touches.any():
            return
        picture.inverse_depth[places[touches]] = value[touches]
        places, value, near_by = places[~touches], value[~touches], near_by[~touches]


def _rim(known: Bool[np.ndarray, "h w"], reach_px: int) -> Int64[np.ndarray, " n"]:
    """Returns flat positions of the unknown pixels within reach of known ones."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach_px + 1,) * 2)
    return np.flatnonzero(cv2.dilate(known.view(np.uint8), disc).view(bool) & ~known)


def _spiral(reach_px: int) -> _Offsets:
    """Returns samples from one pixel away to the end of sight, weighted by inverse distance."""
    step = np.arange(SAMPLE_COUNT)
    radius = (SIGHT_PER_REACH * reach_px) ** (step / (SAMPLE_COUNT - 1))
    x, y = (np.rint(radius * f(GOLDEN_ANGLE * step)) for f in (np.cos, np.sin))
    weight = 1 / np.hypot(x, y)
    return _Offsets(*(values.astype(np.float32) for values in (x, y, weight)))


def _pad(
    inverse_depth: Float32[np.ndarray, "h w"], color: UInt8[np.ndarray, "h w 3"], margin: int, contrast: float
) -> _Padded:
    """Pads the picture; colour is in units of the contrast, so that a distance of 1 is one contrast."""
    padded = cv2.copyMakeBorder(inverse_depth, *(margin,) * 4, cv2.BORDER_CONSTANT)
    four = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2RGBA)
    colors = cv2.copyMakeBorder(four, *(margin,) * 4, cv2.BORDER_REPLICATE).astype(np.float32)
    colors *= np.float32(1 / (255 * contrast))
    return _Padded(padded.ravel(), colors.reshape(-1, 4), padded.shape[1])


def _chunks(places: Int64[np.ndarray, " n"]) -> Iterator[Int64[np.ndarray, " m"]]:
    for first in range(0, len(places), CHUNK):
        yield places[first : first + CHUNK]


def _seen(
    picture: _Padded, places: Int64[np.ndarray, " n"], offsets: _Offsets, noise: NoiseModel, sigmas: float
) -> _Surfaces:
    """Splits the samples around pixels into two surfaces and compares colours; drops pixels without two."""
    shifts = (offsets.y * picture.stride + offsets.x).astype(np.int64)[:, None]
    samples = picture.inverse_depth.take(places + shifts)
    unknown = (samples == 0).astype(np.float32)
    known = 1 - unknown
    split = _split(samples, known, offsets.weight)
    nearer = (samples > split).astype(np.float32)
    farther = known - nearer
    from_split = samples - split
    near, near_stray = _continued(from_split, nearer, offsets)
    far, far_stray = _continued(from_split, farther, offsets)
    step = near - far
    two = (step > sigmas * noise.of_inverse_depth(split)) & (near_stray + far_stray < STRAY_FRACTION * step)
    two &= np.minimum(nearer.sum(axis=0), farther.sum(axis=0)) >= LEAST_SAMPLES
    chosen = np.flatnonzero(two)
    places = places[chosen]
    match = _match(picture.color, places + shifts, places)
    near_match, far_match, own_match = (
        _mean(match, part.take(chosen, axis=1), offsets.weight) + ALIEN_MATCH
        for part in (nearer, farther, unknown)
    )
    own = own_match > OWN_ODDS * np.maximum(near_match, far_match)
    return _Surfaces(places, (near + split)[two], (far + split)[two], np.log(near_match / far_match), own)


def _split(samples: Samples, known: Samples, weight: Float32[np.ndarray, " samples"]) -> PerPixel:
    """Returns the inverse depth between nearer and farther samples: the mean of both means, starting half-way."""
    least = (samples + (1 - known) * np.finfo(np.float32).max).min(axis=0)
    most = samples.max(axis=0)
    split = np.asarray((np.minimum(least, most) + most) / 2)
    for _ in range(SPLIT_ROUNDS):
        nearer = (samples > split).astype(np.float32)
        split = (_mean(samples, nearer, weight) + _mean(samples, known - nearer, weight)) / 2
    return split


def _mean(values: Samples, taken: Samples, weight: Float32[np.ndarray, " samples"]) -> PerPixel:
    """Returns the weighted mean of the values taken (0..1 each); 0 of none."""
    return np.asarray((weight @ (values * taken)) / np.maximum(weight @ taken, EMPTY))


def _continued(values: Samples, taken: Samples, offsets: _Offsets) -> tuple[PerPixel, PerPixel]:
    """Returns the value at the pixel of the plane through the samples taken, and their rms distance from it."""
    x, y, weight = offsets
    linear = np.stack([np.ones_like(x), x, y])
    total, sum_x, sum_y, sum_xx, sum_xy, sum_yy = (
        np.concatenate([linear, np.stack([x * x, x * y, y * y])]) * weight @ taken
    )
    norm = 1 / np.maximum(total, EMPTY)
    of_taken = values * taken
    mean, xv, yv = linear * weight @ of_taken * norm
    mean_x, mean_y = sum_x * norm, sum_y * norm
    xx = sum_xx * norm - mean_x * mean_x + SLOPE_RIDGE_PX2
    yy = sum_yy * norm - mean_y * mean_y + SLOPE_RIDGE_PX2
    xy, xv, yv = sum_xy * norm - mean_x * mean_y, xv - mean_x * mean, yv - mean_y * mean
    determinant = xx * yy - xy * xy
    slope_x, slope_y = (xv * yy - yv * xy) / determinant, (yv * xx - xv * xy) / determinant
    variance = weight @ (of_taken * values) * norm - mean * mean
    unexplained = np.maximum(variance - slope_x * xv - slope_y * yv, 0)
    return mean - slope_x * mean_x - slope_y * mean_y, np.sqrt(unexplained)


def _match(
    color: Float32[np.ndarray, "padded 4"],
    around: Int64[np.ndarray, "samples n"],
    places: Int64[np.ndarray, " n"],
) -> Samples:
    """Returns the similarity of colours: 1 the same, 1/4 one contrast apart.

    The long tail still tells which of two colours a mixture of them, far from both, is closer to.
    """
    squares = color.take(around, axis=0)
    squares -= color[places]
    squares *= squares
    alike = squares[..., 0] + squares[..., 1]  # faster than a sum along an axis of four
    alike += squares[..., 2]
    alike += 1
    alike *= alike
    return np.asarray(np.divide(1, alike, out=alike))


def _voted(picture: _Padded, seen: _Surfaces) -> PerPixel:
    """Returns the mean log odds of a pixel and its unknown neighbours of similar colour."""
    log_odds, votes = np.zeros((2, len(picture.inverse_depth)), np.float32)
    log_odds[seen.places] = np.clip(seen.log_odds, -MOST_LOG_ODDS, MOST_LOG_ODDS)
    votes[seen.places] = 1
    shifts = _square(picture.stride, VOTE_RADIUS_PX)
    alike = np.ones(len(shifts), np.float32)
    means = []
    for places in _chunks(seen.places):
        around = places + shifts
        means.append(_mean(log_odds[around], votes[around] * _match(picture.color, around, places), alike))
    return np.concatenate(means) if means else seen.log_odds


def _square(stride: int, radius_px: int) -> Int64[np.ndarray, "pixels 1"]:
    """Returns the shifts to the pixels of a square around one in the flat picture."""
    y, x = np.mgrid[-radius_px : radius_px + 1, -radius_px : radius_px + 1]
    return np.asarray((y * stride + x).reshape(-1, 1), np.int64)
