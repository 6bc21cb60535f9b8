"""A tone curve as part of a response: it turns a picture's codes back into linear light, where post effects work."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.scene_output import Tone


def with_tone_curve(frame: ViewFrame, tone: Tone) -> ViewFrame:
    """Returns the frame with the response that relit pictures of it have, which may reach beyond sensor white."""
    if tone == "camera":
        return frame
    return replace(frame, response=inverse_aces(decode_lut(frame.response)))


def inverse_aces(toned: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Returns what composite.comp.glsl's `aces` turns into these values, 0..1 (Narkowicz 2015); 7.2 into 1."""
    y = np.asarray(toned, np.float64)
    a, b = 2.51 - 2.43 * y, 0.03 - 0.59 * y
    return np.asarray((np.sqrt(b * b + 4 * a * 0.14 * y) - b) / (2 * a), np.float32)
