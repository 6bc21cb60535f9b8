"""Joint refinement of a radial lens and all poses of a target (bundle adjustment with a free lens)."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.poses import rigid_matrix
from deltalight.protocol.radial_lens import RadialLens
from deltalight.sensor_node.calibration.fits import noise_px
from deltalight.sensor_node.calibration.views import View

Pixels = Float64[np.ndarray, "n 2"]
Poses = Float64[np.ndarray, "v 6"]
_Values = tuple[Float64[np.ndarray, " k"], Poses]
# Creates a lens from its parameters, with its picture enlarged by a margin on every side, so that predictions of
# corners near the border never fall outside.
LensMaker = Callable[[Float64[np.ndarray, " k"], int], RadialLens]
# Step of the difference quotients, as a fraction of a parameter (at least of 1): about the cube root of 1e-16.
STEP = 1e-5
MAX_ROUNDS = 100
# Relative gain of an iteration below which differences of squares cannot tell results apart.
DONE = 1e-9
# Beyond this the step is below a hundred-millionth of the parameters.
MOST_DAMPING = 1e8
# Keeps the equations solvable if a parameter has no effect.
LEAST_DAMPING = 1e-9


class Bundle(NamedTuple):
    """The refined parameters of the lens with their covariance, the poses and the remaining residuals."""

    numbers: Float64[np.ndarray, " k"]
    covariance: Float64[np.ndarray, "k k"]
    poses: tuple[Float64[np.ndarray, "4 4"], ...]
    misses: tuple[Pixels, ...]


def refine(
    make_lens: LensMaker,
    start: Float64[np.ndarray, " k"],
    views: Sequence[View],
    poses: Sequence[Float64[np.ndarray, "4 4"]],
) -> Bundle:
    """Minimises the squared distances in pixels over the lens and the poses.

    Args:
        make_lens: creates the lens of a list of parameters.
        start: initial parameters.
        views: views of the target.
        poses: initial camera_from_target of each view.
    """
    problem = _Problem(make_lens, views, len(start))
    vectors = [np.concatenate([cv2.Rodrigues(pose[:3, :3])[0].ravel(), pose[:3, 3]]) for pose in poses]
    values, slopes = _least_squares(problem, np.concatenate([start, *vectors]))
    numbers, placed = problem.split(values)
    misses = problem.misses(values).reshape(-1, 2)
    covariance = cv2.invert(slopes.T @ slopes, flags=cv2.DECOMP_EIG)[1] * noise_px(misses, values.size) ** 2
    ends = np.cumsum([len(view.points) for view in views])[:-1]
    return Bundle(
        numbers,
        covariance[: len(start), : len(start)],
        tuple(rigid_matrix(cv2.Rodrigues(pose[:3])[0], pose[3:]) for pose in placed),
        tuple(-each for each in np.split(misses, ends)),
    )


def _least_squares(
    problem: "_Problem", values: Float64[np.ndarray, " m"]
) -> tuple[Float64[np.ndarray, " m"], Float64[np.ndarray, "r m"]]:
    """Levenberg-Marquardt (Marquardt 1963) by normal equations; return the values and the Jacobian there.

    scipy's solvers decompose the whole Jacobian in each iteration, or converge slowly without; this takes a twentieth
    of their time.
    """
    misses, damping = problem.misses(values), 1e-3
    for _ in range(MAX_ROUNDS):
        slopes = problem.jacobian(values)
        normal, gradient, cost = slopes.T @ slopes, slopes.T @ misses, misses @ misses
        gain = 0.0
        while gain <= 0 and damping < MOST_DAMPING:
            damped = normal + np.diag(damping * np.maximum(np.diag(normal), 1e-12))
            step = cv2.solve(damped, gradient[:, None], flags=cv2.DECOMP_CHOLESKY)[1].ravel()
            after = problem.misses(values - step)
            # If the lens does not reach a point, the cost is NaN and the step is refused.
            gain = float(cost - np.nan_to_num(after @ after, nan=np.inf))
            damping = max(damping * (0.1 if gain > 0 else 10.0), LEAST_DAMPING)
        if gain <= 0:
            break
        values, misses = values - step, after
        if gain < DONE * cost:
            break
    return values, problem.jacobian(values)


class _Problem:
    """Residuals (predicted minus found) and their block-sparse Jacobian by difference quotients."""

    def __init__(self, make_lens: LensMaker, views: Sequence[View], numbers: int) -> None:
        self._make_lens, self._views, self._count = make_lens, views, numbers
        self._margin = int(max(view.gray.shape[1] for view in views))
        self._found = np.concatenate([view.pixels for view in views])

    def split(self, values: Float64[np.ndarray, " m"]) -> _Values:
        return values[: self._count], values[self._count :].reshape(-1, 6)

    def misses(self, values: Float64[np.ndarray, " m"]) -> Float64[np.ndarray, " r"]:
        return np.asarray((self._predicted(*self.split(values)) - self._found).ravel())

    def jacobian(self, values: Float64[np.ndarray, " m"]) -> Float64[np.ndarray, "r m"]:
        numbers, poses = self.split(values)
        result = np.zeros((self._found.size, values.size))
        for column in range(self._count):
            step = _step(numbers, column)
            result[:, column] = self._slope((numbers + step, poses), (numbers - step, poses), step[column])
        ends = np.cumsum([0, *(2 * len(view.points) for view in self._views)])
        for column in range(6):
            # A view depends on its own pose only, so all views' poses are moved at once.
            steps = np.zeros_like(poses)
            steps[:, column] = STEP
            slope = self._slope((numbers, poses + steps), (numbers, poses - steps), STEP)
            for view, (first, end) in enumerate(pairwise(ends)):
                result[first:end, self._count + 6 * view + column] = slope[first:end]
        return result

    def _slope(self, after: _Values, before: _Values, step: float) -> Float64[np.ndarray, " r"]:
        difference = self._predicted(*after) - self._predicted(*before)
        # Across the end of the lens there is no slope; the point itself is within reach.
        return np.asarray(np.nan_to_num(difference.ravel() / (2 * step)))

    def _predicted(self, numbers: Float64[np.ndarray, " k"], poses: Poses) -> Pixels:
        points = [
            view.points @ cv2.Rodrigues(pose[:3])[0].T + pose[3:]
            for view, pose in zip(self._views, poses, strict=True)
        ]
        try:
            lens = self._make_lens(numbers, self._margin)
        except DeltalightError:  # impossible parameters; the solver takes a shorter step
            return np.full_like(self._found, np.nan)
        return np.asarray(lens.project(np.concatenate(points)) - self._margin)


def _step(numbers: Float64[np.ndarray, " k"], column: int) -> Float64[np.ndarray, " k"]:
    step = np.zeros_like(numbers)
    step[column] = STEP * max(abs(float(numbers[column])), 1.0)
    return step
