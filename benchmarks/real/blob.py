"""One soft blob as shadow, as simple renderers have it: a Gaussian that lies on the table beside the thing's foot."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize

from deltalight.benchmarks.real.cuboid import Cuboid
from deltalight.benchmarks.real.light_fit import Fractions, Points

FIRST_STEPS = np.array([0.3, 0.3, 0.5, 0.3])
START = np.array([0.0, 0.0, 1.0, 0.3])


@dataclass(frozen=True, eq=False)
class Blob:
    """Offset of its centre from the foot's in world axes and widening of its axes, per height of the thing.

    Its axes' standard deviations are `widths` times half the foot's edges plus `spread` heights; `darkness` R G B is
    what it takes at its centre.
    """

    offset: tuple[float, float]
    widths: float
    spread: float
    darkness: Float64[np.ndarray, " 3"]

    def ratios(self, points: Points, cuboid: Cuboid) -> Fractions:
        """Returns what fraction of its light each point of the table keeps, R G B."""
        shape = _shape(np.array([*self.offset, self.widths, self.spread]), points, cuboid)
        return np.asarray(1 - shape[:, None] * self.darkness)


def fit_blob(points: Points, ratios: Fractions, cuboid: Cuboid) -> Blob:
    """Returns the blob that comes nearest to a picture's ratios; arguments as for `fit_lights`."""

    def cost(parameters: Float64[np.ndarray, " 4"]) -> float:
        shape = _shape(parameters, points, cuboid)
        return float(((1 - shape[:, None] * _darkness(shape, ratios) - ratios) ** 2).sum())

    simplex = np.vstack([START, START + np.diag(FIRST_STEPS)])
    found = minimize(cost, START, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 600}).x
    darkness = _darkness(_shape(found, points, cuboid), ratios)
    return Blob((float(found[0]), float(found[1])), float(found[2]), float(found[3]), darkness)


def _shape(
    parameters: Float64[np.ndarray, " 4"], points: Points, cuboid: Cuboid
) -> Float64[np.ndarray, " n"]:
    x, y, widths, spread = parameters
    width, depth, height = cuboid.size_m
    along = points[:, :2] - (cuboid.x_m + x * height, cuboid.y_m + y * height)
    cosine, sine = np.cos(cuboid.turn), np.sin(cuboid.turn)
    own = along @ np.array([[cosine, -sine], [sine, cosine]])
    sigma = np.maximum(abs(widths) * np.array([width, depth]) / 2 + abs(spread) * height, 1e-3)
    return np.asarray(np.exp(-0.5 * ((own / sigma) ** 2).sum(axis=1)))


def _darkness(shape: Float64[np.ndarray, " n"], ratios: Fractions) -> Float64[np.ndarray, " 3"]:
    return np.asarray(np.clip(shape @ (1 - ratios) / max(float(shape @ shape), 1e-12), 0, 1))
