"""Amount of light that a method adds and removes, relative to truth."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from deltalight.benchmarks.quality.metrics import Mask
from deltalight.benchmarks.quality.regions import Linear, Regions

NEAR_PIXELS = (5, 5)  # enough to average the noise of single pixels, within the edge of a soft shadow


@dataclass(frozen=True)
class Energy:
    """Ratios ours / truth; 1 is right, nan where truth has no such light.

    `darkening` and `brightening`: summed linear change of changed real pixels, over the channels that truth darkens
    or brightens around them; 0 = no change, negative = the opposite change. `virtual`: mean radiance of the objects.
    """

    darkening: float
    brightening: float
    virtual: float


def energy_ratios(result: Linear, camera: Linear, without: Linear, truth: Linear, regions: Regions) -> Energy:
    """Compare what `result` changes in the `camera` picture with what `truth` changes in `without`.

    All are linear camera units; a camera shows nothing above 1, so truth is clipped there. Whether truth darkens or
    brightens a channel is decided by the pixels around it: decided by its own value, the path tracer's noise would
    count as light, always in its own direction (an unbiased result came out at 0.6 where truth adds 1 % of what it
    takes).
    """
    ours = result - camera
    theirs = np.minimum(truth, 1) - np.minimum(without, 1)
    around = _mean_around(theirs, regions.changed_real)
    return Energy(
        _ratio(ours, theirs, around < 0),
        _ratio(ours, theirs, around > 0),
        _ratio(result, np.minimum(truth, 1), _channels(regions.virtual)),
    )


def _mean_around(values: Float32[np.ndarray, "h w 3"], mask: Mask) -> Float32[np.ndarray, "h w 3"]:
    """Return the mean of the masked pixels near each masked one without itself; 0 elsewhere and for isolated ones."""
    kept = mask.astype(np.float64)
    weighted = values * kept[..., None]
    total, count = (
        cv2.boxFilter(part, -1, NEAR_PIXELS, normalize=False, borderType=cv2.BORDER_CONSTANT) - part
        for part in (weighted, kept)
    )
    known = mask & (count > 0.5)
    return np.where(known[..., None], total / np.maximum(count, 1)[..., None], 0).astype(np.float32)


def _channels(mask: Mask) -> Bool[np.ndarray, "h w 3"]:
    return np.repeat(mask[..., None], 3, axis=2)


def _ratio(
    ours: Float32[np.ndarray, "h w 3"], theirs: Float32[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w 3"]
) -> float:
    total = float(theirs[mask].sum(dtype=np.float64))
    return float(ours[mask].sum(dtype=np.float64)) / total if total != 0 else np.nan
