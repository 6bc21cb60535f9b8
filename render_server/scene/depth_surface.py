"""Surface normals and discontinuities of a depth image, from inverse depth, and surfaces too oblique to measure.

In inverse depth w = 1/z a plane is an affine function of the ray (x/z, y/z), and the noise of stereo and
structured light, sigma z^2, is the same everywhere (sigma). Both make w the quantity to fit and to compare.

Stereo gives no depth on the top of a box when the camera looks along it. Such a surface at a grazing angle shows as a
strip without depth between something near and something far, in a colour that neither has. Without it, light would
fall through it, so it is bridged from the near to the far side. A strip so wide that a measurable slope could explain
it has lost its depth for another reason (black, shiny) and stays unknown; so does a strip in the colour of a surface
beside it, the occlusion shadow of stereo.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage
from deltalight.render_server.scene.threads import by_bands
from deltalight.render_server.view import LENSES_KEPT

ASSUMED_NOISE_SIGMA_M = 0.002
MAX_SLOPE_DEG = 80.0
NOISE_SIGMAS = 3.0
MAX_TILT_ERROR_RAD = 0.05
MAX_RADIUS = 5
SAMPLE_STEP = 4  # rows and columns between the pixels that give the mean depth
SHIFTS = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
# Least spread of a window's valid pixels relative to a full window (determinant of their covariance).
MIN_SUPPORT = 0.01
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

Map = Float32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
Colors = Float32[np.ndarray, "h w 3"]
Pixels = slice | Int64[np.ndarray, "k w"]  # flat indices
Window = tuple[slice, slice]  # rows and columns
Jumps = tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]


@dataclass(frozen=True, eq=False)
class DepthSurface:
    """The surface at every pixel of `camera`.

    `inverse_depth` is as measured, 0 where invalid and where a pixel stands alone. `gradient` is its change
    by ray coordinate (x/z, y/z), fitted to the surroundings (NaN where unknown), and `fitted_depth` is
    `inverse_depth` where it is known, 0 elsewhere.
    """

    inverse_depth: Float32[np.ndarray, "h w"]
    gradient: Float32[np.ndarray, "2 h w"]
    fitted_depth: Float32[np.ndarray, "h w"]
    camera: CameraModel

    @cached_property
    def normals(self) -> Float32[np.ndarray, "h w 3"]:
        """Unit vectors in the optical frame towards the camera, zero where they are unknown."""
        return surface_normals(self.inverse_depth, self.gradient, self.camera)


def noise_sigma(depth: DepthImage) -> float:
    """Returns the depth noise at 1 m, metres (if unknown 2 mm, between structured light and stereo)."""
    return ASSUMED_NOISE_SIGMA_M if depth.noise_sigma_m is None else depth.noise_sigma_m


def depth_surface(depth: DepthImage, camera: CameraModel) -> DepthSurface:
    """Fits a plane to the surroundings of every valid pixel by least squares, without crossing edges.

    The window grows with the noise until normals are good to about 3 degrees at the mean distance. Where it
    would hold a discontinuity, the window is moved aside to one that holds the pixel but no discontinuity
    (if there is one).
    """
    shape, radius, terms = depth.depth_m.shape, window_radius(depth, camera), jump_terms(depth, camera)
    inverse, fitted, crossed = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, bool)
    by_pixel, gradient = (np.empty((2, *shape), np.float32) for _ in range(2))

    def fit(rows: slice) -> None:
        around, own = _with_margin(rows, radius + 1)
        near, valid, jumps = _clean_inverse(depth.depth_m[around], depth.valid[around], terms)
        inverse[rows] = near[own]
        _fit_windows(near, valid.astype(np.float32), radius, own, by_pixel[:, rows])
        crossed[rows] = valid[own] & _crosses_edge(jumps, valid, radius)[own]

    def move(rows: slice) -> None:
        moved = by_pixel[:, rows].copy()
        _move_windows(by_pixel, crossed, radius, rows, moved)
        gradient[:, rows] = by_ray(moved, camera, slice(rows.start * shape[1], rows.stop * shape[1]))
        np.multiply(inverse[rows], np.isfinite(moved[0]), out=fitted[rows])

    if camera.has_distortion:
        _pixel_from_ray(camera)  # once, before threads ask for it
    by_bands(fit, shape[0])
    by_bands(move, shape[0])
    return DepthSurface(inverse, gradient, fitted, camera)


def _with_margin(rows: slice, margin: int) -> tuple[slice, slice]:
    """Returns rows with those around them, and where they are among these."""
    around = slice(max(rows.start - margin, 0), rows.stop + margin)
    return around, slice(rows.start - around.start, rows.stop - around.start)


def _clean_inverse(
    depth_m: Float32[np.ndarray, "h w"], is_valid: Mask, terms: tuple[float, float]
) -> tuple[Map, Mask, Jumps]:
    """Returns inverse depth (0 where unknown) without pixels that stand alone, where it is known, and its jumps.

    The jumps are those with all valid pixels. `terms`: those of `jump_threshold`.
    """
    valid = is_valid & (depth_m > 0)
    inverse = np.empty(depth_m.shape, np.float32)
    with np.errstate(divide="ignore"):
        np.divide(1, depth_m, out=inverse)
    inverse[~valid] = 0
    jumps = _jumps(inverse, _threshold(inverse, terms), valid)
    valid &= ~_lonely(jumps)
    inverse *= valid
    return inverse, valid, jumps


def jump_threshold(
    depth: DepthImage,
    camera: CameraModel,
    inverse_depth: Float32[np.ndarray, "h w"],
    step_px: float | Float32[np.ndarray, "h w"] = 1.0,
) -> Float32[np.ndarray, "h w"]:
    """Returns the change of w over `step_px` pixels beyond which two points are not on one surface.

    Three sigma of a difference, and the change on a surface that is 80 degrees from facing the camera:
    |dw| = w tan(slope) / f.
    """
    return _threshold(inverse_depth, jump_terms(depth, camera), step_px)


def _threshold(
    inverse_depth: Float32[np.ndarray, "*s"],
    terms: tuple[float, float],
    step_px: float | Float32[np.ndarray, "*s"] = 1.0,
) -> Float32[np.ndarray, "*s"]:
    slope, least = terms
    return inverse_depth * (step_px * np.float32(slope)) + np.float32(least)


def jump_terms(depth: DepthImage, camera: CameraModel) -> tuple[float, float]:
    """Returns the terms of `jump_threshold`: by w and pixel, and the constant one (1/m)."""
    return jump_terms_of(noise_sigma(depth), camera)


def jump_terms_of(sigma: float, camera: CameraModel) -> tuple[float, float]:
    """Returns the terms of `jump_threshold` for depth with noise of `sigma` m at 1 m."""
    focal = float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
    slope = float(np.tan(np.radians(MAX_SLOPE_DEG))) / focal
    return slope, float(NOISE_SIGMAS * np.sqrt(2) * sigma)


def window_radius(depth: DepthImage, camera: CameraModel) -> int:
    """Returns the least radius whose slope error, sigma f z / sqrt(sum of squared offsets), is acceptable, pixels."""
    sampled = depth.depth_m[::SAMPLE_STEP, ::SAMPLE_STEP]
    known = sampled[depth.valid[::SAMPLE_STEP, ::SAMPLE_STEP] & (sampled > 0)]
    mean = float(np.mean(1 / known, dtype=np.float64)) if known.size else 0.0
    error = noise_sigma(depth) * float(camera.matrix[0, 0]) / max(mean, 1e-6)
    for radius in range(1, MAX_RADIUS):
        if error <= MAX_TILT_ERROR_RAD * np.sqrt((2 * radius + 1) ** 2 * radius * (radius + 1) / 3):
            return radius
    return MAX_RADIUS


def _fit_windows(
    inverse: Float32[np.ndarray, "h w"],
    mask: Float32[np.ndarray, "h w"],
    radius: int,
    rows: slice,
    gradient: Float32[np.ndarray, "2 k w"],
) -> None:
    """Fills the slopes of w by pixel of some rows: least squares over a square window, valid pixels only.

    The rows around them that their windows hold are given too. Where pixels are too few or in a line, the slope is
    NaN. Offsets count from the pixel itself, so that no large numbers cancel.
    """
    one = np.ones(2 * radius + 1)
    ramp = np.arange(-radius, radius + 1.0)

    def summed(values: Map, across: np.ndarray, down: np.ndarray) -> Map:
        return _filtered(values, across, down)[rows]

    per_pixel = 1 / np.maximum(summed(mask, one, one), 1)
    w = summed(inverse, one, one)
    mu, mv = summed(mask, ramp, one), summed(mask, one, ramp)
    wu, wv = summed(inverse, ramp, one), summed(inverse, one, ramp)
    uu, vv = summed(mask, ramp**2, one), summed(mask, one, ramp**2)
    uv = summed(mask, ramp, ramp)
    mean_u, mean_v = mu * per_pixel, mv * per_pixel
    uu -= mean_u * mu
    vv -= mean_v * mv
    uv -= mean_u * mv
    wu -= w * mean_u
    wv -= w * mean_v
    determinant = uu * vv - uv * uv
    full = (2 * radius + 1) ** 2 * radius * (radius + 1) / 3
    known = (determinant > MIN_SUPPORT * full**2) & (mask[rows] > 0)
    inverted = np.divide(1, determinant, out=np.full_like(determinant, np.nan), where=known)
    np.multiply(wu * vv - wv * uv, inverted, out=gradient[0])
    np.multiply(wv * uu - wu * uv, inverted, out=gradient[1])


def _filtered(
    values: Float32[np.ndarray, "h w"], across: np.ndarray, down: np.ndarray
) -> Float32[np.ndarray, "h w"]:
    return np.asarray(cv2.sepFilter2D(values, cv2.CV_32F, across, down, borderType=cv2.BORDER_CONSTANT))


def _jumps(inverse: Map, threshold: Map, valid: Mask) -> Jumps:
    """Returns where a pixel and the next one down, and right, are valid but on different surfaces (1)."""
    down, right = np.zeros((2, *valid.shape), np.uint8)
    down[:-1] = (np.abs(inverse[1:] - inverse[:-1]) > threshold[:-1]) & valid[1:] & valid[:-1]
    right[:, :-1] = (
        (np.abs(inverse[:, 1:] - inverse[:, :-1]) > threshold[:, :-1]) & valid[:, 1:] & valid[:, :-1]
    )
    return down, right


def _lonely(jumps: Jumps) -> Mask:
    """Whether a pixel jumps to at least three of its neighbours: a spike, or a flying pixel between surfaces."""
    down, right = jumps
    count = down + right
    count[1:] += down[:-1]
    count[:, 1:] += right[:, :-1]
    return np.asarray(count >= 3)


def _crosses_edge(jumps: Jumps, valid: Mask, radius: int) -> Mask:
    """Whether the window around a pixel holds a jump between two valid neighbours."""
    down, right = jumps
    down[:-1] &= valid[1:] & valid[:-1]
    right[:, :-1] &= valid[:, 1:] & valid[:, :-1]
    crossed = np.zeros(valid.shape, np.uint8)
    for axis, jump in enumerate(jumps):
        # The jump between i and i + 1 lies in the windows of the pixels i + 1 - radius to i + radius.
        size = [2 * radius + 1, 2 * radius + 1]
        size[axis] = 2 * radius
        crossed |= cv2.dilate(jump, np.ones(size, np.uint8), anchor=(radius, radius))
    return crossed > 0


def _move_windows(
    gradient: Float32[np.ndarray, "2 h w"],
    crossed: Mask,
    radius: int,
    rows: slice,
    moved: Float32[np.ndarray, "2 k w"],
) -> None:
    """Gives pixels of some rows whose window crosses an edge the slope of a shifted one that does not, in `moved`."""
    width, first = crossed.shape[1], rows.start * crossed.shape[1]
    slopes, own = gradient.reshape(2, -1), moved.reshape(2, -1)
    pending = np.flatnonzero(crossed[rows]) + first
    columns = pending % width
    for down, right in SHIFTS:
        column = columns + radius * right
        source = np.clip(pending + radius * (down * width + right), 0, crossed.size - 1)
        is_clean = ~crossed.ravel().take(source) & np.isfinite(slopes[0].take(source))
        hit = is_clean & (column >= 0) & (column < width)
        own[:, pending[hit] - first] = slopes.take(source[hit], axis=1)
        pending, columns = pending[~hit], columns[~hit]


def by_ray(
    by_pixel: Float32[np.ndarray, "2 k w"], camera: CameraModel, pixels: Pixels
) -> Float32[np.ndarray, "2 k w"]:
    """Turns a change by pixel, at these pixels (flat indices), into a change by ray coordinate."""
    if not camera.has_distortion:
        return by_pixel * camera.matrix[[0, 1], [0, 1]].astype(np.float32)[:, None, None]
    inverse = _pixel_from_ray(camera)[:, :, pixels].reshape(2, *by_pixel.shape)
    return np.stack([(by_pixel * inverse[:, ray]).sum(axis=0) for ray in (0, 1)])


@lru_cache(maxsize=LENSES_KEPT)
def _pixel_from_ray(camera: CameraModel) -> Float32[np.ndarray, "2 2 n"]:
    """Returns the change of pixel coordinates (first axis) by ray coordinates (second) at every pixel."""
    rays = camera.rays().astype(np.float64)
    jacobian = np.stack([np.gradient(rays, axis=1), np.gradient(rays, axis=0)], axis=-1)
    return np.ascontiguousarray(np.linalg.inv(jacobian).transpose(2, 3, 0, 1), np.float32).reshape(2, 2, -1)


def surface_normals(
    inverse: Float32[np.ndarray, "h w"],
    gradient: Float32[np.ndarray, "2 h w"],
    camera: CameraModel,
) -> Float32[np.ndarray, "h w 3"]:
    """Returns unit normals of inverse depth and its change by ray at every pixel; zero where unknown."""
    normals = np.empty((*inverse.shape, 3), np.float32)
    rays = ray_planes(camera)

    def fill(rows: slice) -> None:
        cv2.merge(normals_along(inverse[rows], gradient[:, rows], rays[:, rows]), normals[rows])

    by_bands(fill, len(inverse))
    return normals


def normals_along(
    inverse: Float32[np.ndarray, "h w"],
    gradient: Float32[np.ndarray, "2 h w"],
    rays: Float32[np.ndarray, "2 h w"],
) -> list[Float32[np.ndarray, "h w"]]:
    """Returns x, y and z of the unit normals of inverse depth and its change by ray, along these rays.

    They are in the optical frame, towards the camera; zero where unknown. A plane n.P = d has
    w = (n/d).(x/z, y/z, 1), so n is along (gradient, w - gradient.ray).
    """
    x, y = gradient
    z = inverse - x * rays[0] - y * rays[1]
    scale = x * x + y * y + z * z
    scale = -1 / np.sqrt(scale, out=scale)
    unknown = ~(scale > -np.inf)
    parts = [part * scale for part in (x, y, z)]
    for part in parts:
        part[unknown] = 0
    return parts


@lru_cache(maxsize=LENSES_KEPT)
def ray_planes(camera: CameraModel) -> Float32[np.ndarray, "2 h w"]:
    """Returns x/z and y/z of the ray through every pixel."""
    return np.ascontiguousarray(camera.rays().transpose(2, 0, 1))


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
