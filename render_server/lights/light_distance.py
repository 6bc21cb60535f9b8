"""How far the lights of a fish-eye camera are: what cues in the colour camera's picture say together.

A fish-eye picture gives directions only, but shadows of a lamp one metre away diverge by ten degrees over a table.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float64, Int64

# Inverse distances to try, 1/m, from far away to 20 cm: neighbours differ by about what shading can tell apart.
CANDIDATES = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 1.1, 1.3, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0)
# Tiles of the picture are squares of this fraction of its width: what a cue leaves out, such as light that things
# reflect or the grain of wood, is alike within one and not in others.
TILE = 1 / 8
MIN_TILES = 2
SIGNIFICANCE = 0.05


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
        used = np.bincount(tile) > 0
        if np.count_nonzero(used) < MIN_TILES:
            return None
        return cls(inverses, np.stack([np.bincount(tile, one)[used] for one in losses]))

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
        """Whether lights near by explain the cue significantly better than lights far away: a paired t-test."""
        from scipy.special import stdtrit

        gain = self.losses[0] - self.losses[self.best]
        least_t = float(stdtrit(len(gain) - 1, 1 - SIGNIFICANCE))
        return bool(gain.sum() > least_t * np.std(gain, ddof=1) * np.sqrt(len(gain)))

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


def common_distance(cues: Sequence[DistanceCue]) -> float | None:
    """Returns the distance that cues say together, m: the mean of their inverse distances, weighted by 1 / variance.

    Only cues should be given that tell that the lights are near; None where there are none.
    """
    if not cues:
        return None
    inverse, error = np.array([cue.estimate for cue in cues]).T
    return float(1 / np.average(inverse, weights=np.maximum(error, 1e-6) ** -2.0))


def tiles_of(pixel: Int64[np.ndarray, "*shape"], width: int) -> Int64[np.ndarray, "*shape"]:
    """Returns the tile of each pixel; pixels count row by row."""
    edge = max(round(TILE * width), 1)
    return np.asarray(pixel // width // edge * width + pixel % width // edge)
