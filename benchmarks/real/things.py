"""What stands on the table: found where depth rises above it, and outlined by colour."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64

from deltalight.benchmarks.quality.metrics import Mask, Picture
from deltalight.benchmarks.quality.regions import Linear
from deltalight.benchmarks.real.cuboid import Observed
from deltalight.benchmarks.real.ranges import Values
from deltalight.protocol.errors import DeltalightError

FLAT_M = 0.012
"""Height up to which depth shows the table itself: several times its noise."""
HIGHEST_M = 0.5
LEAST_PX = 300
BORDER_PX = 4
REACH_PX = 20
"""How far colour may extend a thing beyond its depth, whose edges are some pixels off."""
DARKER = 0.75
"""Fraction of the empty table's light, in the darkest channel, below which a pixel near a thing may belong to it."""
CUTS = 5


@dataclass(frozen=True, eq=False)
class Thing:
    """Something on the table: what is seen of it, and the table around it."""

    observed: Observed
    table: Mask


def table_mask(heights_m: Values) -> Mask:
    """Returns the pixels of the table: the largest even area, without its border.

    Raises:
        DeltalightError: nothing is even.
    """
    even = (np.abs(heights_m) < FLAT_M).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(even)
    if len(stats) < 2:
        raise DeltalightError("depth shows no table; give the folder of real pairs as it was downloaded.")
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    inner = cv2.erode((labels == largest).astype(np.uint8), np.ones((2 * BORDER_PX + 1,) * 2))
    return np.asarray(inner > 0)


def standing(heights_m: Values) -> list[Mask]:
    """Returns what rises above the table, the largest first, without what the picture's border cuts."""
    high = ((heights_m > FLAT_M) & (heights_m < HIGHEST_M)).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(high)
    rows, columns = heights_m.shape
    left, top, width, height, area = stats[1:].T
    inside = (left > 0) & (top > 0) & (left + width < columns) & (top + height < rows) & (area >= LEAST_PX)
    order = np.argsort(-area, kind="stable")
    return [np.asarray(labels == 1 + index) for index in order if inside[index]]


def find_thing(color: Picture, empty_ratio: Linear, points: Float64[np.ndarray, "h w 3"]) -> Thing:
    """Returns the largest thing on the table.

    `empty_ratio`: linear picture over that of the empty table; `points`: of depth, in the world of the table, m.

    Raises:
        DeltalightError: nothing stands there.
    """
    found = standing(points[..., 2])
    if not found:
        raise DeltalightError(
            "nothing stands on the table of a picture; give pictures in which something does."
        )
    mask = _cut_by_color(color, empty_ratio, found[0])
    return Thing(Observed(mask, points[found[0]]), table_mask(points[..., 2]))


def _cut_by_color(color: Picture, empty_ratio: Linear, rising: Mask) -> Mask:
    """Returns the thing's pixels by GrabCut (Rother et al. 2004), begun with what depth says."""
    seed = rising.astype(np.uint8)
    near = cv2.dilate(seed, np.ones((2 * REACH_PX + 1,) * 2)) > 0
    darkest = cv2.GaussianBlur(empty_ratio.min(axis=2), (0, 0), 1.0)
    labels = np.full(rising.shape, cv2.GC_BGD, np.uint8)
    labels[near & (darkest < DARKER)] = cv2.GC_PR_BGD
    labels[rising] = cv2.GC_PR_FGD
    labels[cv2.erode(seed, np.ones((2 * BORDER_PX + 1,) * 2)) > 0] = cv2.GC_FGD
    cv2.setRNGSeed(0)  # its mixtures begin with random clusters
    cv2.grabCut(color, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), CUTS, cv2.GC_INIT_WITH_MASK)
    return np.asarray((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD))
