"""Bloom: light that the lens scatters around bright things ([P1] 4.2), of what relighting changes alone.

The camera's picture already has the bloom of the real room, so only the change of radiance is scattered: a fraction
of it leaves its pixel and arrives around it, negative where an object hides a lamp. The sum stays the same. What an
object hides is assumed to be like its surroundings: the object gets the bloom of the room, and no trace of what is
behind it.
"""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from deltalight.protocol.frames import ViewFrame, decode_lut, linear_color
from deltalight.protocol.scene_output import Tone
from deltalight.render_server.post_effects.tone import with_tone_curve

WIDTHS = (0.01, 0.03, 0.09)
"""Of the picture's width: standard deviations of the three parts of equal light that scattered light spreads to."""
PASSES = 3
"""Boxes that follow each other: nearly a Gaussian, of finite reach, in a time that does not grow with its width."""

ROUNDING = 1e-3
"""Of radiance in 16 bits, at most: what differs by less from the camera's is not changed."""


def scattered(change: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Returns light spread around where it was; what leaves the picture is lost."""
    parts = [_spread(change, width * change.shape[1]) for width in WIDTHS]
    return np.asarray(sum(parts) / np.float32(len(parts)), np.float32)


def _spread(change: Float32[np.ndarray, "h w 3"], sigma_px: float) -> Float32[np.ndarray, "h w 3"]:
    width = 2 * round((np.sqrt(12 * sigma_px**2 / PASSES + 1) - 1) / 2) + 1
    for _ in range(PASSES):
        change = np.asarray(cv2.blur(change, (width, width), borderType=cv2.BORDER_CONSTANT))
    return change


def with_bloom(
    color: UInt8[np.ndarray, "h w 3"],
    linear: Float32[np.ndarray, "h w 3"],
    coverage: Float32[np.ndarray, "h w"],
    frame: ViewFrame,
    fraction: float,
    *,
    tone: Tone = "camera",
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns a relit picture with bloom of its change; where none arrives it is the same to the bit.

    `linear` is the picture in camera units, beyond white where objects are, `coverage` what they cover; `fraction`
    (0..1) of the light is scattered. `tone` is the curve that `color` was made with.
    """
    camera = linear_color(frame, frame.color)
    differs = color != frame.color if tone == "camera" else np.abs(linear - camera) > ROUNDING * camera
    changed = differs.any(axis=2, keepdims=True) | (coverage[..., None] > 0)
    if not changed.any():
        return color
    lut, scale = decode_lut(with_tone_curve(frame, tone).response), np.float32(frame.exposure_scale)
    hidden = np.clip(coverage, 0, 1)[..., None]
    around = scattered(camera) / scattered(np.ones_like(camera))
    change = np.where(changed, linear - camera + hidden * (camera - around), 0).astype(np.float32)
    before = np.where(changed, linear * scale, lut[color, np.arange(3)])
    after = before + fraction * scale * (scattered(change) - change)
    codes = [np.interp(after[..., c], lut[:, c], np.arange(256)) for c in range(3)]
    return np.asarray(np.rint(np.stack(codes, axis=-1)), np.uint8)
