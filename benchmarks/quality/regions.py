"""Parts of a picture that a virtual object changes, by the noise-free truth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from deltalight.benchmarks.ground_truth.sensors import srgb_coded
from deltalight.benchmarks.quality.metrics import Mask

CHANGE_CODES = 2
"""A pixel is changed if a channel changes by more, in 8-bit codes: rounding can move either picture's code by one."""
REAL_COVER, VIRTUAL_COVER = 0.01, 0.99
"""Pixels that virtual objects cover less than the first are real, more than the second virtual."""

Linear = Float32[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class Regions:
    """Masks (h, w): where truth changes, and what is visible there. Edges of objects are neither real nor virtual."""

    changed: Mask
    real: Mask
    virtual: Mask

    @property
    def changed_real(self) -> Mask:
        """Real surfaces under changed light: shadow, bounce, reflection."""
        return np.asarray(self.changed & self.real)

    @property
    def changed_virtual(self) -> Mask:
        """Pixels of the objects themselves."""
        return np.asarray(self.changed & self.virtual)


def find_regions(without: Linear, with_objects: Linear, cover: Float32[np.ndarray, "h w"]) -> Regions:
    """Returns the regions of one frame from noise-free pictures in camera units and the objects' coverage."""
    difference = srgb_coded(with_objects) - srgb_coded(without)
    changed = np.abs(difference).max(axis=2) > CHANGE_CODES
    return Regions(changed, cover < REAL_COVER, cover > VIRTUAL_COVER)
