"""Amount of light that a method adds and removes, relative to truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from deltalight.benchmarks.quality.metrics import Mask
from deltalight.benchmarks.quality.regions import Linear, Regions

NEAR_PIXELS = (5, 5)  # enough to average the noise of single pixels, within the edge of a soft shadow


@dataclass(frozen=True, eq=False)
class Change:
    """A picture of the truth without and with objects, linear camera units, and where it says that they change it."""

    without: Linear
    with_objects: Linear
    regions: Regions

    @property
    def visible(self) -> Linear:
        """The change that a camera shows: nothing above 1."""
        return np.asarray(np.minimum(self.with_objects, 1) - np.minimum(self.without, 1))


@dataclass(frozen=True)
class Energy:
    """Ratios ours / truth; 1 is right, nan where truth has no such light.

    `darkening` and `brightening`: summed linear change of changed real pixels, over the channels that truth darkens
    or brightens around them; 0 = no change, negative = the opposite change. `virtual`: mean radiance of the objects.
    """

    darkening: float
    brightening: float
    virtual: float


def energy_ratios(result: Linear, camera: Linear, truth: Sequence[Change]) -> Energy:
    """Compares what `result` changes in the `camera` picture (linear camera units) with what truth changes.

    `truth` are two pictures with noise of their own. Each says where light is taken or added, the other how much: a
    picture that said both would count its own noise as light, always in its own direction. Where there is only one (a
    photograph), its pixels are judged by those around them, which helps where their noise is independent.
    """
    around = np.stack([_mean_around(each.visible, each.regions.changed_real) for each in truth])
    theirs = np.stack([each.visible for each in reversed(truth)])
    ours, shown = (np.broadcast_to(picture, theirs.shape) for picture in (result - camera, result))
    objects = np.stack([_channels(each.regions.virtual) for each in truth])
    return Energy(
        _ratio(ours, theirs, around < 0),
        _ratio(ours, theirs, around > 0),
        _ratio(shown, np.stack([np.minimum(each.with_objects, 1) for each in truth]), objects),
    )


def _mean_around(values: Float32[np.ndarray, "h w 3"], mask: Mask) -> Float32[np.ndarray, "h w 3"]:
    """Returns the mean of the masked pixels near each masked one, without itself; 0 elsewhere and if isolated."""
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
    ours: Float32[np.ndarray, "k h w 3"],
    theirs: Float32[np.ndarray, "k h w 3"],
    mask: Bool[np.ndarray, "k h w 3"],
) -> float:
    total = float(theirs[mask].sum(dtype=np.float64))
    return float(ours[mask].sum(dtype=np.float64)) / total if total != 0 else np.nan
