"""Depth clean-up (docs/method.md 2).

Validity, smoothing guided by colour, filling of small holes, and assignment of the rims at depth edges to a surface
by colour; large holes stay.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8
from pydantic import Field

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.sensor_node.depth_edges import assign_edges
from deltalight.sensor_node.depth_filter import NoiseModel, SmoothedDepth, smooth_inverse_depth

# A normal variable's standard deviation is this multiple of its median absolute deviation.
SIGMA_PER_MAD = 1.4826
NOISE_FIT_RADIUS_PX = 5
# Sensors that store depth in steps cannot be more exact; keeps noise-free depth filterable.
LEAST_NOISE_SIGMA_M = 1e-4
UNKNOWN_NOISE_SIGMA_M = 0.0025
LEAST_NOISE_SAMPLES = 500
# Weight of the windows around a pixel above which the surface counts as smooth there.
SMOOTH_CONFIDENCE = 0.3
# Window weight below which nothing is known about a hole.
LEAST_CONFIDENCE = 1e-3


class DepthSettings(StrictModel):
    """Strength of the depth clean-up; lengths in the picture are in pixels of the colour image."""

    filter_radius_px: int = Field(
        default=4, ge=0, le=16, description="Half the edge of the filter window; 0 = no filter."
    )
    edge_sigmas: float = Field(
        default=3.0,
        ge=1,
        le=10,
        description="Depth steps above this many standard deviations stay as measured.",
    )
    guide_contrast: float = Field(
        default=0.05,
        ge=0.005,
        le=1,
        description="Colour contrast (0..1) below which colour does not guide depth.",
    )
    fill_area_px: int = Field(
        default=64, ge=0, le=10000, description="Largest area of holes to fill; 0 = fill none."
    )
    edge_reach_px: int = Field(
        default=8,
        ge=0,
        le=32,
        description="Greatest distance, from known depth, of unknown pixels at depth edges that colour assigns to "
        "a neighbouring surface; 0 = none (as without filter and filling).",
    )
    noise_sigma_m: float | None = Field(
        default=None,
        ge=1e-5,
        le=0.1,
        description="Noise at 1 m, growing with distance squared; null = the sensor's, else measured.",
    )
    noise_floor_m: float = Field(
        default=0.001,
        ge=0,
        le=0.05,
        description="Noise that does not grow with distance (storage steps, near-range errors), in metres.",
    )


def clean_depth(
    depth: DepthImage, color: UInt8[np.ndarray, "h w 3"], settings: DepthSettings | None = None
) -> DepthImage:
    """Returns smoothed depth with small holes filled and depth edges completed, guided by `color` (RGB).

    Known pixels move only if a smooth surface explains them: at depth steps larger than `edge_sigmas` standard
    deviations they stay as measured. Depth 0 is unknown, never near.

    Raises:
        DeltalightError: depth and colour differ in size (register depth first).
    """
    settings = settings or DepthSettings()
    valid = known_pixels(depth)
    if depth.depth_m.shape != color.shape[:2]:
        raise DeltalightError(
            f"depth of {_size(depth.depth_m)} does not lie on the colour picture of {_size(color)}; "
            "give calibration/depth.yaml and extrinsics.yaml so that it can be registered."
        )
    sigma_m = settings.noise_sigma_m or depth.noise_sigma_m or estimate_noise_sigma(depth)
    if settings.filter_radius_px == 0 and settings.fill_area_px == 0:
        return DepthImage(np.where(valid, depth.depth_m, 0), valid, depth.camera, sigma_m)
    inverse = _inverse(depth.depth_m, valid)
    noise = NoiseModel(max(sigma_m, LEAST_NOISE_SIGMA_M), settings.noise_floor_m)
    smoothed = smooth_inverse_depth(
        inverse,
        valid,
        cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY).astype(np.float32) / 255,
        noise=noise,
        radius_px=settings.filter_radius_px or NOISE_FIT_RADIUS_PX,
        guide_contrast=settings.guide_contrast,
    )
    filled = _fillable(valid, smoothed, noise, settings)
    cleaned, known = _replaced(inverse, smoothed, filled, settings), valid | filled
    if settings.edge_reach_px:
        cleaned, known = assign_edges(
            cleaned,
            known,
            color,
            noise=noise,
            sigmas=settings.edge_sigmas,
            contrast=settings.guide_contrast,
            reach_px=settings.edge_reach_px,
        )
    return DepthImage(_inverse(cleaned, known), known, depth.camera, sigma_m)


def _replaced(
    inverse: Float32[np.ndarray, "h w"],
    smoothed: SmoothedDepth,
    filled: Bool[np.ndarray, "h w"],
    settings: DepthSettings,
) -> Float32[np.ndarray, "h w"]:
    """Returns inverse depth, smoothed in `filled` holes and where a smooth surface explains what was measured."""
    taken = filled
    if settings.filter_radius_px:
        smooth = smoothed.explains(inverse, SMOOTH_CONFIDENCE, settings.edge_sigmas)
        taken = filled | (smooth & (smoothed.inverse_depth > 0))
    return np.asarray(cv2.copyTo(smoothed.inverse_depth, taken.view(np.uint8), inverse))


def estimate_noise_sigma(depth: DepthImage) -> float:
    """Estimates the depth noise at 1 m, in metres: scaled MAD of the residuals of local plane fits.

    Fits run on inverse depth, where noise that grows with z^2 is constant. Only windows without holes or edges count;
    if too few are left, a typical sensor's value is returned.
    """
    valid = known_pixels(depth)
    inverse = _inverse(depth.depth_m, valid)
    planes = smooth_inverse_depth(
        inverse,
        valid,
        np.zeros_like(inverse),
        noise=NoiseModel(1.0, 0.0),
        radius_px=NOISE_FIT_RADIUS_PX,
        guide_contrast=1.0,
    ).inverse_depth
    inside = cv2.erode(valid.view(np.uint8), np.ones((2 * NOISE_FIT_RADIUS_PX + 1,) * 2, np.uint8)) > 0
    residuals = (inverse - planes)[inside]
    if len(residuals) < LEAST_NOISE_SAMPLES:
        return UNKNOWN_NOISE_SIGMA_M
    mad = float(np.median(np.abs(residuals - np.median(residuals))))
    return max(SIGMA_PER_MAD * mad, LEAST_NOISE_SIGMA_M)


def known_pixels(depth: DepthImage) -> Bool[np.ndarray, "h w"]:
    """Returns the mask of pixels whose depth is known: valid and positive (0 and infinity are unknown)."""
    return depth.valid & (depth.depth_m > 0) & (depth.depth_m < np.inf)


def _inverse(
    values: Float32[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Returns 1/values, 0 where unknown."""
    beyond = np.full(values.shape, np.inf, np.float32)
    return np.asarray(np.reciprocal(cv2.copyTo(values, known.view(np.uint8), beyond)))


def _fillable(
    valid: Bool[np.ndarray, "h w"], smoothed: SmoothedDepth, noise: NoiseModel, settings: DepthSettings
) -> Bool[np.ndarray, "h w"]:
    """Returns the pixels of small holes about which the windows agree.

    If surfaces of different depth reach a hole it stays open rather than being bridged in mid-air.
    """
    filled = np.zeros(valid.shape, bool)
    rows, columns = _small_holes(valid, settings.fill_area_px)
    value = smoothed.inverse_depth[rows, columns]
    agreed = smoothed.spread(rows, columns) <= settings.edge_sigmas * noise.of_inverse_depth(value)
    confident = smoothed.confidence[rows // 2, columns // 2] > LEAST_CONFIDENCE
    filled[rows, columns] = agreed & confident & (value > 0)
    return filled


def _small_holes(
    valid: Bool[np.ndarray, "h w"], area_px: int
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """Returns rows and columns of the unknown pixels whose connected area is at most `area_px`."""
    unknown = ~valid
    _, labels = cv2.connectedComponents(unknown.view(np.uint8), connectivity=4)
    places = np.flatnonzero(unknown)
    holes = labels.ravel()[places]
    small = np.bincount(holes) <= area_px
    rows, columns = np.divmod(places[small[holes]], valid.shape[1])
    return rows, columns


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]}x{image.shape[0]} pixels"
