"""How far the lights of a fish-eye camera are: what cues in the colour camera's picture say together.

A fish-eye picture gives directions only, but shadows of a lamp one metre away diverge by ten degrees over a table.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float64, Int64

# Inverse distances to try, 1/m, from far away to 20 cm: neighbours differ by about what shading can tell apart.
CANDIDATES: Sequence[float] = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 1.1, 1.3, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0)
# Tiles of the picture are squares of this fraction of its width: what a cue leaves out, such as light that things
# reflect or the grain of wood, is alike within one and not in others.
TILE = 1 / 8
MIN_TILES = 2
SIGNIFICANCE = 0.05  # of what is found, else lights are far, or all at one distance


@dataclass(frozen=True, eq=False)
class DistanceCue:
    """How badly lights at each inverse distance (1/m, rising from 0) explain what each tile of the picture shows.

    `losses` are in any unit.
    """

    inverses: Sequence[float]
    losses: Float64[np.ndarray, "c t"]

    @classmethod
    def of(
        cls,
        inverses: Sequence[float],
        losses: Sequence[Float[np.ndarray, " k"]],
        tile: Int64[np.ndarray, " k"],
    ) -> "DistanceCue | None":
        """Adds up the losses of observations in each tile; None where too few tiles show any."""
        by_tile = sum_by_tile(losses, tile)
        return cls(inverses, by_tile) if by_tile.shape[1] >= MIN_TILES else None

    @property
    def best(self) -> int:
        """Index of the inverse distance with the least loss."""
        return int(np.argmin(self.losses.sum(axis=1)))

    @property
    def around(self) -> slice:
        """The best of the inverse distances and its neighbours."""
        best = min(max(self.best, 1), len(self.inverses) - 2)
        return slice(best - 1, best + 2)

    @property
    def tells_near(self) -> bool:
        """Whether lights near by explain the cue significantly better than lights far away."""
        return is_significant(self.losses[0] - self.losses[self.best])

    @cached_property
    def estimate(self) -> tuple[float, float]:
        """The inverse distance of the least loss, 1/m, and its standard error.

        A parabola through the best one and its neighbours has its vertex there. The error is the sandwich
        estimate (Huber 1967): the scatter of the tiles' slopes over the curvature.
        """
        tried = self.inverses[self.around]
        bend, slope, _ = np.polyfit(tried, self.losses[self.around], 2)
        curvature = max(2 * float(bend.sum()), 1e-12)
        inverse = float(np.clip(-slope.sum() / curvature, tried[0], tried[-1]))
        scatter = np.std(2 * bend * inverse + slope, ddof=1) * np.sqrt(len(bend))
        return inverse, float(scatter) / curvature


def tiles_of(pixel: Int64[np.ndarray, "*shape"], width: int) -> Int64[np.ndarray, "*shape"]:
    """Returns the tile of each pixel; pixels count row by row."""
    edge = max(round(TILE * width), 1)
    return np.asarray(pixel // width // edge * width + pixel % width // edge)


def sum_by_tile(
    losses: Sequence[Float[np.ndarray, " k"]], tile: Int64[np.ndarray, " k"]
) -> Float64[np.ndarray, "c t"]:
    """Adds up each of the losses in every tile that shows any observation."""
    used = np.bincount(tile) > 0
    return np.stack([np.bincount(tile, one)[used] for one in losses])


def is_significant(gain: Float64[np.ndarray, " t"], tests: int = 1) -> bool:
    """Whether tiles gain on average: a one-sided t-test, one of several `tests` (Bonferroni)."""
    from scipy.special import stdtrit

    least_t = float(stdtrit(len(gain) - 1, 1 - SIGNIFICANCE / tests))
    return bool(gain.sum() > least_t * np.std(gain, ddof=1) * np.sqrt(len(gain)))


def common_inverse(cues: Sequence[DistanceCue]) -> float:
    """Returns the inverse distance, 1/m, that cues which tell near lights say together: a mean by 1 / variance."""
    inverse, error = np.array([cue.estimate for cue in cues]).T
    return float(np.average(inverse, weights=np.maximum(error, 1e-6) ** -2.0))
