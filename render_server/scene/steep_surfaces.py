"""Surfaces that the camera sees too obliquely to measure, bridged from what lies before to what lies behind them.

Stereo gives no depth on the top of a box when the camera looks along it. Such a surface shows as a strip without
depth between something near and something far, in a colour that neither has. Without it, light would fall through it.
A strip so wide that a measurable slope could explain it has lost its depth for another reason (black, shiny) and
stays unknown; so does a strip in the colour of a surface beside it, the shadow that stereo leaves.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt8

from protocol.camera_model import CameraModel
from protocol.frames import DepthImage
from render_server.scene.depth_surface import jump_threshold

# A thinner strip is an edge, where colours mix.
LEAST_WIDTH_PX = 3
# Smaller ones are crumbs of edges: depth comes with holes up to this size filled.
LEAST_AREA_PX = 64
# As far beside a strip its surfaces are looked at, in windows of as much to each side.
BESIDE_RADIUS_PX = 4
# Colours of a strip and of what is beside it mix so far out: lenses and demosaicing blur edges over a pixel or two.
MIXED_PX = 2
# Spread of colour, 0..1, that light and noise cause where a window shows none.
LEAST_SPREAD = 0.05
COLOR_SIGMAS = 3.0
# Share of a strip that must look like a steep surface for all of it to count as one: all but a mixed pixel at either
# side of strips 8 pixels wide. Blurred edges of near things before far ones have a third or more of such pixels.
MOST_OF_IT = 0.75

Map = Float32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
Colors = Float32[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class _Side:
    """The nearer or the farther surface beside a strip, as each pixel has it nearest."""

    surface: Mask
    distance_px: Map
    place: Int64[np.ndarray, "h w"]
    """Flat index of that nearest pixel."""


def steep_surfaces(depth: DepthImage, color: UInt8[np.ndarray, "h w 3"], camera: CameraModel) -> Map:
    """Return the inverse depth (1/m) of steep surfaces where `depth` knows none; 0 elsewhere.

    `depth` is clean and registered to `color` (RGB) and `camera`. In inverse depth a plane is an affine function of
    the pixel (depth_surface.py), so strips are filled linearly from their near to their far side.
    """
    valid = depth.valid & (depth.depth_m > 0)
    inverse = np.divide(1, depth.depth_m, out=np.zeros_like(depth.depth_m), where=valid)
    result = np.zeros_like(inverse)
    unknown = (~valid).view(np.uint8)
    to_known = cv2.distanceTransform(unknown, cv2.DIST_L2, cv2.DIST_MASK_5)
    thick = cv2.morphologyEx(unknown, cv2.MORPH_OPEN, np.ones((LEAST_WIDTH_PX,) * 2, np.uint8))
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(thick, connectivity=4)
    for label in range(1, count):
        if boxes[label, cv2.CC_STAT_AREA] < LEAST_AREA_PX:
            continue
        part = _surroundings(boxes[label])
        strip = labels[part] == label
        around = inverse[part] * _grown(strip, BESIDE_RADIUS_PX)
        if _may_be_steep(strip, around, to_known[part], depth, camera):
            steep, bridged = _bridge(strip, around, color[part], depth, camera)
            result[part][steep] = bridged[steep]
    return np.asarray(result)


def _surroundings(box: Int32[np.ndarray, "5"]) -> tuple[slice, slice]:
    """Rows and columns of a strip (OpenCV's statistics: left, top, width, height) and the surfaces beside it."""
    margin = 2 * BESIDE_RADIUS_PX
    left, top, width, height = (int(value) for value in box[:4])
    return (
        slice(max(top - margin, 0), top + height + margin),
        slice(max(left - margin, 0), left + width + margin),
    )


def _may_be_steep(strip: Mask, around: Map, to_known: Map, depth: DepthImage, camera: CameraModel) -> bool:
    """Rule most strips out at little cost: no step beside them could make most of their pixels steep.

    `around` is the inverse depth beside the strip, 0 elsewhere, `to_known` how far pixels are from known ones: there,
    a strip is at least twice as wide.
    """
    known = around[around > 0]
    if not known.size:
        return False
    least = np.full(int(strip.sum()), known.min())
    bearable = jump_threshold(depth, camera, least, 2 * to_known[strip])
    return bool((known.max() - known.min() > bearable).mean() > MOST_OF_IT)


def _bridge(
    strip: Mask, around: Map, color: UInt8[np.ndarray, "h w 3"], depth: DepthImage, camera: CameraModel
) -> tuple[Mask, Map]:
    """Which pixels of a strip are a steep surface, and inverse depth there; `around` has it on either side."""
    split = (around[around > 0].min() + around.max()) / 2
    near, far = _side(around > split), _side((around > 0) & (around <= split))
    before, behind = around.ravel()[near.place], around.ravel()[far.place]
    width = near.distance_px + far.distance_px
    bridged = (before * far.distance_px + behind * near.distance_px) / width
    steep = strip & (before - behind > jump_threshold(depth, camera, bridged, width))
    pure = ~_grown(strip, MIXED_PX)
    least, own = MOST_OF_IT * strip.sum(), np.flatnonzero(steep)
    for side in (near, far):
        if len(own) > least:
            own = own[_is_strange(side, np.float32(1 / 255) * color, pure, own)]
    return steep & (len(own) > least), np.asarray(bridged)


def _grown(mask: Mask, radius_px: int) -> Mask:
    return np.asarray(cv2.dilate(mask.view(np.uint8), np.ones((2 * radius_px + 1,) * 2)).view(bool))


def _side(surface: Mask) -> _Side:
    """Look from every pixel at the nearest pixel of a surface."""
    distance, labels = cv2.distanceTransformWithLabels(
        (~surface).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE, labelType=cv2.DIST_LABEL_PIXEL
    )
    places = np.flatnonzero(surface)
    nearest = np.zeros(labels.max() + 1, np.int64)
    nearest[labels.ravel()[places]] = places
    return _Side(surface, distance, nearest[labels])


def _is_strange(
    side: _Side, color: Colors, pure: Mask, pixels: Int64[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Whether pixels (flat indices) differ in colour from the surface, where it is pure, nearest to them."""
    mean, variance = _spread(color, side.surface & pure)
    place = side.place.ravel()[pixels]
    difference = color.reshape(-1, 3)[pixels] - mean.reshape(-1, 3)[place]
    squared = np.einsum("nc,nc->n", difference, difference)
    return np.asarray(squared > COLOR_SIGMAS**2 * (variance.ravel()[place] + LEAST_SPREAD**2))


def _spread(color: Colors, mask: Mask) -> tuple[Colors, Map]:
    """Mean and variance (over all channels; infinite of none) of a mask's colours in the window around each pixel."""
    weight = mask.astype(np.float32)

    def summed(values: np.ndarray) -> np.ndarray:
        size = (2 * BESIDE_RADIUS_PX + 1,) * 2
        border = cv2.BORDER_CONSTANT
        return np.asarray(cv2.boxFilter(values, cv2.CV_32F, size, normalize=False, borderType=border))

    count = summed(weight)
    share = 1 / np.maximum(count, 1)
    mean = summed(color * weight[..., None]) * share[..., None]
    square = summed(np.einsum("hwc,hwc->hw", color, color) * weight) * share
    variance = np.maximum(square - np.einsum("hwc,hwc->hw", mean, mean), 0)
    return mean, np.where(count > 0, variance, np.float32(np.inf))
