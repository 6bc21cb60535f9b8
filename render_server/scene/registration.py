"""Photometric registration: the factor that ties predicted light to what the camera sees (METHOD 1)."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from protocol.board import BoardSpec
from protocol.camera_model import CameraModel
from protocol.frames import BoardPose
from render_server.scene.environment import LUMINANCE

CLIPPED_LINEAR = 0.98
CLIPPED_CODE = 255
DARK_LINEAR = 0.005
LEAST_PIXELS = 30
ENOUGH_PIXELS = 10 * LEAST_PIXELS
FARTHEST_PX = 1e5  # beyond, fixed-point outlines overflow
OUTLIER_DEVIATIONS = 3.0
LEAST_IRRADIANCE = 1e-4
LEAST_OPENING = 0.05  # share of the hemisphere that must be open: below, noise of the paper decides
GREATEST_ALBEDO = 0.95
PERCENTILE = 99.0
INSETS_PX = (
    2,
    1,
)  # from the paper's edges, where lens and sampling mix it with ink; the second if little is left
EDGE_POINTS = 8


@dataclass(frozen=True, eq=False)
class Registration:
    """Factor R G B on all lights, how it was found, and how well it fits.

    `residual` is the relative root-mean-square difference of predicted and measured radiance (0..), None
    where nothing was fitted. `warning` is a sentence for the user.
    """

    factor: Float32[np.ndarray, "3"]
    source: Literal["patch", "percentile", "given"]
    residual: float | None = None
    warning: str | None = None


def registration_from_patch(
    measured: Float[np.ndarray, "k 3"],
    light_irradiance: Float[np.ndarray, "k 3"],
    bounce_irradiance: Float[np.ndarray, "k 3"],
    albedo: float,
) -> Registration | None:
    """Fit the factor on pixels of known albedo: albedo/pi (f E_light + E_bounce) = B, each channel.

    Least squares after pixels that lie off the median by more than 3 robust deviations are left out (hands,
    stains, shadows). `measured` must be linear and without clipped pixels (`unclipped`); E_bounce, gathered
    from the picture itself, already has the camera's scale.

    Returns:
        None where fewer than 30 pixels are left, or light or the fit vanishes in a channel.
    """
    irradiance = np.pi / albedo * np.asarray(measured, np.float64) - bounce_irradiance
    light = np.asarray(light_irradiance, np.float64)
    usable = np.isfinite(irradiance).all(axis=1) & (light > LEAST_IRRADIANCE).all(axis=1)
    if np.count_nonzero(usable) < LEAST_PIXELS:
        return None
    irradiance, light = irradiance[usable], light[usable]
    kept = _without_outliers(irradiance / light)
    irradiance, light = irradiance[kept], light[kept]
    factor = (light * irradiance).sum(axis=0) / (light**2).sum(axis=0)
    if len(irradiance) < LEAST_PIXELS or not (factor > 0).all():
        return None
    misfit = (factor * light - irradiance) / np.maximum(np.abs(irradiance).mean(axis=0), 1e-9)
    return Registration(factor.astype(np.float32), "patch", float(np.sqrt((misfit**2).mean())))


def surroundings_from_patch(
    measured: Float[np.ndarray, "k 3"],
    irradiance: Float[np.ndarray, "k 3"],
    per_radiance: Float[np.ndarray, "k 3"],
    albedo: float,
) -> Float32[np.ndarray, "3"] | None:
    """Find the even radiance X >= 0 of what is out of sight: albedo/pi (E + X E_1) = B on paper, each channel.

    `irradiance` E is what lights, environment and the real surfaces in view explain; `per_radiance` E_1 is what
    radiance 1 from everywhere that they leave open would add. The median is robust against stains and shadows.

    Returns:
        None where fewer than 30 pixels see anything of the surroundings.
    """
    missing = np.pi / albedo * np.asarray(measured, np.float64) - irradiance
    open_sky = np.asarray(per_radiance, np.float64)
    usable = np.isfinite(missing).all(axis=1) & (open_sky > LEAST_OPENING * np.pi).all(axis=1)
    if np.count_nonzero(usable) < LEAST_PIXELS:
        return None
    found = np.median(missing[usable] / open_sky[usable], axis=0)
    return np.asarray(np.maximum(found, 0.0), np.float32)


def _without_outliers(ratios: Float64[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
    """Whether all channels are within 3 deviations of their medians (1.4826 times the median deviation)."""
    deviation = np.abs(ratios - np.median(ratios, axis=0))
    scale = 1.4826 * np.median(deviation, axis=0)
    return np.asarray((deviation <= OUTLIER_DEVIATIONS * scale + 1e-9).all(axis=1))


def registration_from_albedo_percentile(
    measured: Float[np.ndarray, "k 3"],
    light_irradiance: Float[np.ndarray, "k 3"],
    bounce_irradiance: Float[np.ndarray, "k 3"],
) -> Registration:
    """Find the common scale at which the 99th percentile of luminance albedo is 0.95 (METHOD 1).

    The pixels must be unshadowed, unsaturated and diffuse. Albedo pi B/(f E_light + E_bounce) falls with f,
    so the percentile of the factors that give each pixel an albedo of 0.95 is the factor sought.
    """
    light = np.asarray(light_irradiance, np.float64) @ LUMINANCE
    wanted = np.pi / GREATEST_ALBEDO * (np.asarray(measured, np.float64) @ LUMINANCE)
    rest = wanted - np.asarray(bounce_irradiance, np.float64) @ LUMINANCE
    usable = np.isfinite(rest) & (light > LEAST_IRRADIANCE)
    if np.count_nonzero(usable) < LEAST_PIXELS:
        return Registration(np.ones(3, np.float32), "given", None, _NOTHING_SEEN)
    factor = max(float(np.percentile(rest[usable] / light[usable], PERCENTILE)), LEAST_IRRADIANCE)
    return Registration(np.full(3, factor, np.float32), "percentile", None, _NO_PATCH)


_NO_PATCH = (
    "No white paper of the marker board was usable, so the lights' scale comes from the brightest real "
    "surface, taken to have albedo 0.95: show the board's paper unclipped, or set lights.registration."
)
_NOTHING_SEEN = (
    "No lit real surface was usable to scale the lights, so they are used as given: "
    "set lights.registration or the exposure."
)


def unclipped(
    color: UInt8[np.ndarray, "h w 3"], linear: Float[np.ndarray, "h w 3"]
) -> Bool[np.ndarray, "h w"]:
    """Whether a pixel carries its true radiance: no channel at the top of the scale, not all but black.

    `linear` is the picture decoded by the response alone, before division by the exposure.
    """
    bright = (linear >= CLIPPED_LINEAR) | (color == CLIPPED_CODE)
    return np.asarray(~bright.any(axis=-1) & (linear @ LUMINANCE >= DARK_LINEAR))


def paper_pixels(board: BoardSpec, camera: CameraModel, pose: BoardPose) -> Bool[np.ndarray, "h w"]:
    """Return which pixels show white paper between the board's markers, 2 pixels inside its edges (1 if few are).

    Patches that are not wholly in front of the camera are left out; what covers the board is not known here.
    """
    patches = _patch_masks(board, camera, pose)
    found = np.zeros((camera.height, camera.width), np.uint8)
    for inset in INSETS_PX:
        square = np.ones((2 * inset + 1,) * 2, np.uint8)
        for patch in patches:
            found |= cv2.erode(patch, square, borderValue=0)
        if np.count_nonzero(found) >= ENOUGH_PIXELS:
            break
    return np.asarray(found.astype(bool))


def _patch_masks(board: BoardSpec, camera: CameraModel, pose: BoardPose) -> list[UInt8[np.ndarray, "h w"]]:
    camera_from_world = np.linalg.inv(pose.world_from_camera)
    masks = []
    for patch in board.paper_patches():
        outline = _dense_outline(patch) @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        pixels = camera.project(outline)
        if not np.isfinite(pixels).all() or np.abs(pixels).max() > FARTHEST_PX:
            continue
        mask = np.zeros((camera.height, camera.width), np.uint8)
        cv2.fillPoly(mask, [np.round(pixels * 16).astype(np.int32)], 1, shift=4)
        masks.append(mask)
    return masks


def _dense_outline(patch: Float64[np.ndarray, "4 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return points along a quad's edges, because a lens bends straight lines."""
    share = np.linspace(0, 1, EDGE_POINTS, endpoint=False)[:, None]
    following = np.roll(patch, -1, axis=0)
    return np.concatenate(
        [start + share * (end - start) for start, end in zip(patch, following, strict=True)]
    )
