"""Steadiness of a sequence: changes in the result that are not in truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from deltalight.benchmarks.quality.metrics import Mask, Picture


@dataclass(frozen=True)
class Deviation:
    """Root mean square of the wrong change from frame to frame, in 8-bit codes; nan for a single frame.

    `changed`: pixels that the objects change in either frame, `unchanged`: the others.
    """

    unchanged: float
    changed: float


def temporal_deviation(
    results: Sequence[Picture], references: Sequence[Picture], changed: Sequence[Mask]
) -> Deviation:
    """Compares the steps between following frames of a result with those of its reference."""
    squares: dict[bool, list[Float64[np.ndarray, " n"]]] = {False: [], True: []}
    for now in range(1, len(results)):
        step = results[now].astype(np.float64) - results[now - 1]
        wrong = step - (references[now].astype(np.float64) - references[now - 1])
        touched = changed[now] | changed[now - 1]
        for part, found in squares.items():
            found.append(np.square(wrong[touched == part]).ravel())
    return Deviation(_root_mean(squares[False]), _root_mean(squares[True]))


def _root_mean(squares: list[Float64[np.ndarray, " n"]]) -> float:
    values = np.concatenate(squares) if squares else np.empty(0)
    return float(np.sqrt(values.mean())) if values.size else np.nan
