"""The best picture that relighting could make from the camera's picture."""

import numpy as np

from deltalight.benchmarks.ground_truth.sensors import srgb_bytes
from deltalight.benchmarks.ground_truth.truth import TruthFrame
from deltalight.benchmarks.quality.figures import linear
from deltalight.benchmarks.quality.metrics import Picture

REGULARIZER = 1e-3
"""Keeps the ratio finite in black; the same fraction of white as in composition (docs/method.md 3)."""


def ideal_composite(truth: TruthFrame) -> Picture:
    """Returns the camera picture times the true change of light, with the true objects over it, coded.

    What then differs from the reference is the sensor's noise: it is scaled with the light here, and absent on the
    objects.
    """
    ratio = (truth.with_objects + REGULARIZER) / (truth.without + REGULARIZER)
    cover = truth.cover[..., None]
    relit = (1 - cover) * linear(truth.sensor_without) * ratio + cover * truth.with_objects
    return srgb_bytes(np.asarray(relit, np.float32))
