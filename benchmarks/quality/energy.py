"""How much light a method adds and takes away, against truth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from benchmarks.quality.metrics import Mask
from benchmarks.quality.regions import Linear, Regions


@dataclass(frozen=True)
class Energy:
    """Ratios ours / truth, 1 is right, nan where truth has nothing of the kind.

    `darkening` and `brightening`: summed linear change of changed real pixels, over the channels that truth
    darkens or brightens; 0 = no change, negative = the wrong way. `virtual`: mean radiance of the objects.
    """

    darkening: float
    brightening: float
    virtual: float


def energy_ratios(result: Linear, camera: Linear, without: Linear, truth: Linear, regions: Regions) -> Energy:
    """Compare what `result` changes in the `camera` picture with what `truth` changes in `without`.

    All are linear camera units; a camera shows nothing above 1, so truth is clipped there.
    """
    ours = result - camera
    theirs = np.minimum(truth, 1) - np.minimum(without, 1)
    changed = regions.changed_real[..., None]
    return Energy(
        _ratio(ours, theirs, changed & (theirs < 0)),
        _ratio(ours, theirs, changed & (theirs > 0)),
        _ratio(result, np.minimum(truth, 1), _channels(regions.virtual)),
    )


def _channels(mask: Mask) -> Bool[np.ndarray, "h w 3"]:
    return np.repeat(mask[..., None], 3, axis=2)


def _ratio(
    ours: Float32[np.ndarray, "h w 3"], theirs: Float32[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w 3"]
) -> float:
    total = float(theirs[mask].sum(dtype=np.float64))
    return float(ours[mask].sum(dtype=np.float64)) / total if total != 0 else np.nan
