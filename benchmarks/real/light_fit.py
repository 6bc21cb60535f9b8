"""Lights from the shadows of one cuboid on a table: distant discs and even light, found greedily.

Light k gives the fraction w_k of the irradiance that the bare table receives, even light the rest. With O_k(x) the
part of light k that the cuboid hides from x, and A(x) the part of even light, the table keeps

    E(x) / E_bare = 1 - sum_k w_k O_k(x) - (1 - sum_k w_k) A(x)

Light that the cuboid sends back is left out. Fractions are found by channel, non-negative and at most 1 in sum.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.optimize import nnls

from deltalight.benchmarks.real.cuboid import Cuboid

MOST_LIGHTS = 6
LEAST_GAIN = 0.01
"""A further light must explain this fraction of the squared error that is left."""
RADII = np.radians((4.0, 12.0))
DISC_SAMPLES, SKY_SAMPLES, CANDIDATES = 32, 512, 200
LOWEST = np.radians(10.0)
"""Lights below would throw shadows beyond any table."""
FIRST_STEP, LAST_STEP = np.radians(6.0), np.radians(0.5)
RADIUS_FACTOR = 1.3
LEAST_RADIUS, MOST_RADIUS = np.radians(1.0), np.radians(40.0)
SUM_WEIGHT = 1e3
GOLDEN = np.pi * (3 - np.sqrt(5))

Direction = Float64[np.ndarray, " 3"]
Points = Float64[np.ndarray, "n 3"]
Fractions = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class FoundLight:
    """Distant light: unit vector towards it, angular radius (rad), fraction of the bare table's irradiance, R G B."""

    towards: Direction
    radius: float
    fraction: Float64[np.ndarray, " 3"]


@dataclass(frozen=True, eq=False)
class FoundLights:
    """What lights the table; `even` is the fraction of even light, R G B. `rms` of the ratios that were fitted."""

    lights: Sequence[FoundLight]
    even: Float64[np.ndarray, " 3"]
    rms: float

    def ratios(self, points: Points, cuboid: Cuboid) -> Fractions:
        """Returns what fraction of its light each point of the table keeps beside a cuboid, R G B."""
        hidden = hidden_sky(points, cuboid)[:, None] * self.even
        for light in self.lights:
            hidden_part = hidden_light(points, cuboid, light.towards, light.radius)
            hidden = hidden + hidden_part[:, None] * light.fraction
        return np.asarray(1 - hidden)


def hidden_light(
    points: Points, cuboid: Cuboid, towards: Direction, radius: float
) -> Float64[np.ndarray, " n"]:
    """Returns the part of a distant disc's light, cosine-weighted, that a cuboid hides from points of the table."""
    return _hidden(points, cuboid, _disc(towards, radius))


def hidden_sky(points: Points, cuboid: Cuboid) -> Float64[np.ndarray, " n"]:
    """Returns the part of even light that a cuboid hides from points of the table."""
    square, turn = (np.arange(SKY_SAMPLES) + 0.5) / SKY_SAMPLES, GOLDEN * np.arange(SKY_SAMPLES)
    across = np.sqrt(square)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), np.sqrt(1 - square)], axis=1)
    return np.asarray(_blocked(points, cuboid, directions).mean(axis=1))


def _hidden(points: Points, cuboid: Cuboid, directions: Points) -> Float64[np.ndarray, " n"]:
    weights = np.maximum(directions[:, 2], 0)
    return np.asarray(_blocked(points, cuboid, directions) @ (weights / weights.sum()))


def _blocked(points: Points, cuboid: Cuboid, directions: Points) -> Float64[np.ndarray, "n m"]:
    enter, leave = cuboid.hits(points[:, None], directions[None])
    return ((enter <= leave) & (leave > 0)).astype(np.float64)


def _disc(towards: Direction, radius: float) -> Points:
    first, second = _across(towards)
    place, turn = np.arange(DISC_SAMPLES) + 0.5, GOLDEN * np.arange(DISC_SAMPLES)
    reach = np.tan(radius) * np.sqrt(place / DISC_SAMPLES)
    spread = towards + reach[:, None] * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
    return np.asarray(spread / np.linalg.norm(spread, axis=1, keepdims=True))


def _across(towards: Direction) -> tuple[Direction, Direction]:
    helper = np.array([1.0, 0, 0]) if abs(towards[0]) < 0.9 else np.array([0, 1.0, 0])
    first = np.cross(towards, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(towards, first)


@dataclass(frozen=True, eq=False)
class _Disc:
    towards: Direction
    radius: float
    hidden: Float64[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class _Problem:
    points: Points
    ratios: Fractions
    cuboid: Cuboid
    sky: Float64[np.ndarray, " n"]

    def disc(self, towards: Direction, radius: float) -> _Disc:
        return _Disc(towards, radius, hidden_light(self.points, self.cuboid, towards, radius))

    def solve(self, discs: Sequence[_Disc]) -> tuple[Fractions, float]:
        """Returns each disc's fractions, R G B, and the sum of squared errors."""
        if not discs:
            return np.zeros((0, 3)), float(((1 - self.ratios - self.sky[:, None]) ** 2).sum())
        columns = np.stack([disc.hidden - self.sky for disc in discs], axis=1)
        upper, rows = np.linalg.qr(columns)
        fractions, error = np.zeros((len(discs), 3)), 0.0
        for channel in range(3):
            wanted = 1 - self.ratios[:, channel] - self.sky
            inside = upper.T @ wanted
            fractions[:, channel], rest = _at_most_one(rows, inside)
            error += rest**2 + float(wanted @ wanted - inside @ inside)
        return fractions, error


def _at_most_one(
    matrix: Float64[np.ndarray, "n k"], wanted: Float64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, " k"], float]:
    """Returns the non-negative least-squares solution whose sum is at most 1: a last unknown takes up the rest."""
    count = matrix.shape[1]
    full = np.zeros((len(matrix) + 1, count + 1))
    full[:-1, :-1], full[-1] = matrix, SUM_WEIGHT
    found, rest = nnls(full, np.append(wanted, SUM_WEIGHT))
    return found[:-1], float(rest)


def fit_lights(points: Points, ratios: Fractions, cuboid: Cuboid) -> FoundLights:
    """Returns the lights under which a cuboid leaves the table these fractions of its light.

    `points` (n, 3) lie on the table, m; `ratios` (n, 3) are picture over empty table, linear R G B.
    """
    problem = _Problem(points, ratios, cuboid, hidden_sky(points, cuboid))
    candidates = [problem.disc(towards, radius) for towards in _directions() for radius in RADII]
    discs: list[_Disc] = []
    fractions, error = problem.solve(discs)
    while len(discs) < MOST_LIGHTS:
        more = min(([*discs, each] for each in candidates), key=lambda tried: problem.solve(tried)[1])
        more = _refined(problem, more)
        new_fractions, new_error = problem.solve(more)
        if new_error > (1 - LEAST_GAIN) * error:
            break
        discs, fractions, error = more, new_fractions, new_error
    lights = [
        FoundLight(disc.towards, disc.radius, fraction)
        for disc, fraction in zip(discs, fractions, strict=True)
        if fraction.any()
    ]
    return FoundLights(lights, np.maximum(1 - fractions.sum(axis=0), 0), float(np.sqrt(error / ratios.size)))


def _directions() -> Points:
    """Returns directions spread evenly over the sky above LOWEST."""
    height = np.linspace(np.sin(LOWEST), 1, CANDIDATES)
    turn, across = GOLDEN * np.arange(CANDIDATES), np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)


def _refined(problem: _Problem, discs: list[_Disc]) -> list[_Disc]:
    """Returns the lights moved and resized, one after the other in ever smaller steps, while the error shrinks."""
    step, error = FIRST_STEP, problem.solve(discs)[1]
    while step > LAST_STEP:
        before = error
        for index in range(len(discs)):
            for moved in _moves(problem, discs[index], step):
                tried = [*discs[:index], moved, *discs[index + 1 :]]
                found = problem.solve(tried)[1]
                if found < error:
                    discs, error = tried, found
        if error > 0.999 * before:
            step /= 2
    return discs


def _moves(problem: _Problem, disc: _Disc, step: float) -> list[_Disc]:
    moved = [disc.towards + sign * step * axis for axis in _across(disc.towards) for sign in (1, -1)]
    turned = [each / np.linalg.norm(each) for each in moved]
    factor = RADIUS_FACTOR ** (step / FIRST_STEP)
    radii = [float(np.clip(disc.radius * each, LEAST_RADIUS, MOST_RADIUS)) for each in (factor, 1 / factor)]
    return [
        *(problem.disc(each, disc.radius) for each in turned if each[2] > np.sin(LOWEST)),
        *(problem.disc(disc.towards, radius) for radius in radii),
    ]
