"""The papers' picture of errors: squared, enhanced, red-yellow where too dark, blue-white where too bright.

[P1] fig. 3 and [D] fig. 5.19. With E the signed difference result - reference of the channel that differs most,
as a fraction of the 8-bit range, the strength is s = min(1, n E^2), and the colours (8-bit R G B / 255) are

    E < 0: (min(1, 2 s), max(0, 2 s - 1), 0)                    black, red, yellow
    E > 0: (max(0, 2 s - 1), max(0, 2 s - 1), min(1, 2 s))      black, blue, white

so black is no error.
"""

import numpy as np
from jaxtyping import UInt8

from deltalight.benchmarks.quality.metrics import CODE_RANGE, Picture

ENHANCEMENT = 64.0
"""n: the brightest colour is an error of 1/8 of the range. ([P1] has n = 16, [D] 4, for larger errors.)"""


def error_view(result: Picture, reference: Picture) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the signed error of a result as a picture."""
    difference = (result.astype(np.float64) - reference) / CODE_RANGE
    most = np.abs(difference).argmax(axis=2)[..., None]
    error = np.take_along_axis(difference, most, axis=2)
    strength = np.minimum(1, ENHANCEMENT * error**2)
    first, second = np.minimum(1, 2 * strength), np.maximum(0, 2 * strength - 1)
    too_dark = np.concatenate([first, second, np.zeros_like(first)], axis=2)
    too_bright = np.concatenate([second, second, first], axis=2)
    return np.rint(CODE_RANGE * np.where(error < 0, too_dark, too_bright)).astype(np.uint8)
