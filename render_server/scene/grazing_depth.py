"""Surfaces too oblique for a depth camera to measure, bridged between what it did measure beside them.

Stereo gives no depth on the top of a box when the camera looks along it. Such a surface at a grazing angle shows as a
strip without depth between something near and something far, in a colour that neither has. Without it, light would
fall through it, so it is bridged from the near to the far side. A strip so wide that a measurable slope could explain
it has lost its depth for another reason (black, shiny) and stays unknown; so does a strip in the colour of a surface
beside it, the occlusion shadow of stereo.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage
from deltalight.render_server.scene.depth_surface import Map, Mask, Window, jump_threshold

# Thinner strips are edges, where colours mix.
MIN_STRIP_WIDTH_PX = 3
# Smaller strips are remains of edges: depth comes with holes up to this size filled.
MIN_STRIP_AREA_PX = 64
# Surfaces beside a strip are sampled up to this distance, in windows of this radius.
BORDER_RADIUS_PX = 4
WINDOW_MARGIN_PX = 2 * BORDER_RADIUS_PX  # around a strip
# Colours mix this far across a strip's border: lenses and demosaicing blur edges over a pixel or two.
MIXED_BORDER_PX = 2
# Least standard deviation of colour, 0..1, by light and noise.
MIN_COLOR_SPREAD = 0.05
COLOR_SIGMAS = 3.0
# Fraction of a strip that must look like a grazing surface for all of it to count as one: all but a mixed pixel at
# either side of strips 8 pixels wide. Of blurred edges of near things before far ones, a third or more is mixed.
MIN_GRAZING_FRACTION = 0.75

Colors = Float32[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class _Side:
    """The nearer or the farther surface beside a strip: each pixel's distance to it, and its nearest pixel (flat)."""

    surface: Mask
    distance_px: Map
    nearest_pixel: Int64[np.ndarray, "h w"]


def grazing_depth_fill(depth: DepthImage, color: UInt8[np.ndarray, "h w 3"], camera: CameraModel) -> Map:
    """Returns the inverse depth (1/m) of surfaces at grazing angles where `depth` has none; 0 elsewhere.

    `depth` is clean and registered to `color` (RGB) and `camera`. In inverse depth a plane is an affine function of
    the pixel, so strips are filled linearly from their near to their far side.
    """
    valid = depth.valid & (depth.depth_m > 0)
    result = np.zeros(valid.shape, np.float32)
    for part, strip in _strips(~valid):
        beside = valid[part] & _dilated(strip, BORDER_RADIUS_PX)
        around = np.divide(1, depth.depth_m[part], out=np.zeros(strip.shape, np.float32), where=beside)
        if _may_be_grazing(strip, around, ~valid[part], depth, camera):
            grazing, bridged = _bridge(strip, around, color[part], depth, camera)
            result[part][grazing] = bridged[grazing]
    return result


def _strips(unknown: Mask) -> Iterator[tuple[Window, Mask]]:
    """Yields the strips without depth that are large enough, each in a window of the picture."""
    square = np.ones((MIN_STRIP_WIDTH_PX,) * 2, np.uint8)
    thick = cv2.morphologyEx(unknown.view(np.uint8), cv2.MORPH_OPEN, square)
    for tile in _tiles(thick.view(bool)):
        count, labels, boxes, _ = cv2.connectedComponentsWithStats(thick[tile], connectivity=4)
        for label in range(1, count):
            if boxes[label, cv2.CC_STAT_AREA] >= MIN_STRIP_AREA_PX:
                part = _strip_window(boxes[label])
                strip = labels[part] == label
                down, right = (whole.start + own.start for whole, own in zip(tile, part, strict=True))
                yield (slice(down, down + strip.shape[0]), slice(right, right + strip.shape[1])), strip


def _tiles(mask: Mask) -> Iterator[Window]:
    """Yields parts of the picture that hold enough of a mask, and whole windows around all strips of it.

    Of most pictures they are few: to label strips everywhere would take longer than all else.
    """
    for rows in _runs(np.asarray(mask.any(axis=1))):
        for columns in _runs(np.asarray(mask[rows].any(axis=0))):
            if np.count_nonzero(mask[rows, columns]) >= MIN_STRIP_AREA_PX:
                yield rows, columns


def _runs(is_set: Bool[np.ndarray, " n"]) -> list[slice]:
    """Returns the runs of elements that lie within WINDOW_MARGIN_PX of set ones."""
    margin, places = WINDOW_MARGIN_PX, np.flatnonzero(is_set)
    parts = np.split(places, np.flatnonzero(np.diff(places) > 2 * margin + 1) + 1)
    return [slice(max(int(each[0]) - margin, 0), int(each[-1]) + margin + 1) for each in parts if len(each)]


def _strip_window(box: Int32[np.ndarray, "5"]) -> Window:
    """Returns rows and columns of a strip (box: left, top, width, height, area) and the surfaces beside it."""
    margin = WINDOW_MARGIN_PX
    left, top, width, height = (int(value) for value in box[:4])
    return (
        slice(max(top - margin, 0), top + height + margin),
        slice(max(left - margin, 0), left + width + margin),
    )


def _steps_at_all(around: Map, depth: DepthImage, camera: CameraModel) -> bool:
    """Whether inverse depth beside a strip (0 elsewhere) differs by more than even its border could explain."""
    known = around[around > 0]
    if not known.size:
        return False
    least = known.min(keepdims=True)
    return bool(known.max() - least > jump_threshold(depth, camera, least, 2.0))


def _may_be_grazing(strip: Mask, around: Map, unknown: Mask, depth: DepthImage, camera: CameraModel) -> bool:
    """Rules out most strips cheaply: no depth step beside them could make most of their pixels grazing.

    `around` is the inverse depth beside the strip, 0 elsewhere. A strip is at least twice as wide as a pixel of it is
    from the nearest known one, which is no farther beyond the strip than the window reaches.
    """
    if not _steps_at_all(around, depth, camera):
        return False
    known = around[around > 0]
    to_known = cv2.distanceTransform(unknown.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    least = np.full(int(strip.sum()), known.min())
    bearable = jump_threshold(depth, camera, least, 2 * to_known[strip])
    return bool((known.max() - known.min() > bearable).mean() > MIN_GRAZING_FRACTION)


def _bridge(
    strip: Mask, around: Map, color: UInt8[np.ndarray, "h w 3"], depth: DepthImage, camera: CameraModel
) -> tuple[Mask, Map]:
    """Returns which pixels of a strip are a grazing surface, and their inverse depth, bridged between its sides."""
    split = (around[around > 0].min() + around.max()) / 2
    near, far = _side(around > split), _side((around > 0) & (around <= split))
    before, behind = around.ravel()[near.nearest_pixel], around.ravel()[far.nearest_pixel]
    width = near.distance_px + far.distance_px
    bridged = (before * far.distance_px + behind * near.distance_px) / width
    grazing = strip & (before - behind > jump_threshold(depth, camera, bridged, width))
    pure = ~_dilated(strip, MIXED_BORDER_PX)
    least, own = MIN_GRAZING_FRACTION * strip.sum(), np.flatnonzero(grazing)
    for side in (near, far):
        if len(own) > least:
            own = own[_differs_in_color(side, np.float32(1 / 255) * color, pure, own)]
    return grazing & (len(own) > least), np.asarray(bridged)


def _dilated(mask: Mask, radius_px: int) -> Mask:
    return np.asarray(cv2.dilate(mask.view(np.uint8), np.ones((2 * radius_px + 1,) * 2)).view(bool))


def _side(surface: Mask) -> _Side:
    """Finds the nearest pixel of a surface from every pixel."""
    distance, labels = cv2.distanceTransformWithLabels(
        (~surface).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE, labelType=cv2.DIST_LABEL_PIXEL
    )
    places = np.flatnonzero(surface)
    nearest = np.zeros(labels.max() + 1, np.int64)
    nearest[labels.ravel()[places]] = places
    return _Side(surface, distance, nearest[labels])


def _differs_in_color(
    side: _Side, color: Colors, pure: Mask, pixels: Int64[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Whether pixels (flat indices) differ in colour from the nearest unmixed part of a surface."""
    mean, variance = _color_statistics(color, side.surface & pure)
    nearest_pixel = side.nearest_pixel.ravel()[pixels]
    difference = color.reshape(-1, 3)[pixels] - mean.reshape(-1, 3)[nearest_pixel]
    squared = np.einsum("nc,nc->n", difference, difference)
    return np.asarray(squared > COLOR_SIGMAS**2 * (variance.ravel()[nearest_pixel] + MIN_COLOR_SPREAD**2))


def _color_statistics(color: Colors, mask: Mask) -> tuple[Colors, Map]:
    """Returns mean and total variance of a mask's colours in the window around each pixel; infinite without any."""
    weight = mask.astype(np.float32)

    def summed(values: np.ndarray) -> np.ndarray:
        size = (2 * BORDER_RADIUS_PX + 1,) * 2
        border = cv2.BORDER_CONSTANT
        return np.asarray(cv2.boxFilter(values, cv2.CV_32F, size, normalize=False, borderType=border))

    count = summed(weight)
    fraction = 1 / np.maximum(count, 1)
    mean = summed(color * weight[..., None]) * fraction[..., None]
    square = summed(np.einsum("hwc,hwc->hw", color, color) * weight) * fraction
    variance = np.maximum(square - np.einsum("hwc,hwc->hw", mean, mean), 0)
    return mean, np.where(count > 0, variance, np.float32(np.inf))
