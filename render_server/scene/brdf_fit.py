"""Fits a sum of Gaussians to a measured BRDF (docs/method.md 6.7)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float64

from deltalight.render_server.scene.brdf_measurements import BrdfMeasurements
from deltalight.render_server.scene.gaussian_brdf import RISE_TERMS, GaussianBrdf, lobe_density, rise_basis

BROAD_LOBES = 3
MIRROR_RANGE_DEG = 3.0  # of the half-vector from the normal: `FitError.off_mirror` leaves these samples out
_HALVES = 3
# Widths that are tried first, rad of the half-vector. Of narrow lobes a gonioreflectometer meets a few samples, too
# few to tell how the weight rises with the angle, so a narrow one is a dielectric coat of F0 = 0.04.
_COATS = np.geomspace(0.01, 0.06, 10)  # a gonioreflectometer's aperture hides what is narrower
_BROAD = np.geomspace(0.06, 0.7, 12)
_COAT_RISE = np.array([0.04] * 5 + [1.0])  # Schlick's term
_DARK = 0.03  # 1/sr: below it errors count in absolute terms, above more and more relative
_COMPRESSION = 0.5
_RIDGE = 1e-2  # of the weights of columns of length 1
_ROUNDS = 3


@dataclass(frozen=True)
class FitError:
    """Errors of a fit at samples that it did not use, r.m.s. over that of the values.

    `whole` over all of them, `off_mirror` without those near the mirror direction.
    """

    whole: float
    off_mirror: float


class _Fit:
    """Least squares with weights at least 0, for some samples."""

    def __init__(self, samples: BrdfMeasurements) -> None:
        self._samples = samples
        self._grey = samples.values.mean(axis=1)
        seen = np.sqrt(samples.light[:, 2] * samples.view[:, 2])
        self._trust = seen / (self._grey + _DARK) ** _COMPRESSION
        self._base = np.full((len(samples), 1), 1 / np.pi)

    def solve(
        self, values: Float64[np.ndarray, " n"], columns: Sequence[np.ndarray]
    ) -> tuple[Float64[np.ndarray, " m"], float]:
        """Returns the coefficients of diffuse base and columns, and the residual."""
        design = np.hstack([self._base, *columns]) * self._trust[:, None]
        lengths = np.linalg.norm(design, axis=0) + 1e-9
        size = design.shape[1]
        matrix = np.vstack([design / lengths, _RIDGE * np.eye(size)])
        from scipy.optimize import nnls

        found, residual = nnls(matrix, np.append(values * self._trust, np.zeros(size)), maxiter=100 * size)
        return found / lengths, float(residual)

    def coat(self, sigma: float) -> Float64[np.ndarray, "n 1"]:
        """Returns the column of a coat."""
        return np.asarray(self.broad(sigma) @ _COAT_RISE[:, None])

    def broad(self, sigma: float) -> Float64[np.ndarray, "n 6"]:
        """Returns the columns of a lobe whose weight rises as it likes."""
        density, v_dot_h = lobe_density(self._samples.light, self._samples.view, sigma)
        return np.asarray(density[:, None] * rise_basis(v_dot_h))

    def residual(self, coat: float | None, broad: Sequence[float]) -> float:
        """Returns how badly lobes of these widths fit the mean of the colours."""
        return self.solve(self._grey, self._columns(coat, broad))[1]

    def _columns(self, coat: float | None, broad: Sequence[float]) -> list[np.ndarray]:
        return [*([] if coat is None else [self.coat(coat)]), *(self.broad(sigma) for sigma in broad)]

    def made(self, coat: float, broad: Sequence[float]) -> GaussianBrdf:
        """Returns the sum with lobes of these widths, narrowest first."""
        columns = self._columns(coat, broad)
        found = np.stack([self.solve(values, columns)[0] for values in self._samples.values.T], axis=1)
        lobes = found[2:].reshape(-1, RISE_TERMS, 3)
        weights = np.concatenate([(_COAT_RISE[:, None] * found[1])[None], lobes])
        sigmas = np.array([coat, *broad])
        order = np.argsort(sigmas)
        return GaussianBrdf(found[0], sigmas[order], weights[order])

    def widths(self) -> tuple[float, list[float]]:
        """Searches for the widths of a coat and the broad lobes: tried in turn, then refined."""
        broad: list[float] = []
        for _ in range(BROAD_LOBES):
            broad.append(min(_BROAD, key=lambda sigma: self.residual(None, [*broad, sigma])))
        coat = float(_COATS[0])
        for search in (_best, _refined):
            for _ in range(_ROUNDS):
                coat = search(partial(self.residual, broad=broad), coat, _COATS)
                for k in range(BROAD_LOBES):
                    broad[k] = search(partial(self._residual_with, coat, broad, k), broad[k], _BROAD)
        return coat, broad

    def _residual_with(self, coat: float, broad: Sequence[float], k: int, sigma: float) -> float:
        """Returns the residual with another width of lobe `k`."""
        return self.residual(coat, [*broad[:k], sigma, *broad[k + 1 :]])


Residual = Callable[[float], float]


def _best(residual: Residual, _sigma: float, tried: Float64[np.ndarray, " n"]) -> float:
    return float(min(tried, key=residual))


def _refined(residual: Residual, sigma: float, tried: Float64[np.ndarray, " n"]) -> float:
    """Returns the best width within a step of what was tried."""
    step = np.log(tried[1] / tried[0])
    low, high = (np.clip(np.log(sigma) + sign * step, *np.log(tried[[0, -1]])) for sign in (-1, 1))
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda log: residual(float(np.exp(log))),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-3},
    )
    return float(np.exp(found.x))


def fit_brdf(samples: BrdfMeasurements) -> GaussianBrdf:
    """Fits a coat, three broad lobes and a diffuse base; the sum reflects no more light than arrives."""
    fit = _Fit(samples)
    return fit.made(*fit.widths()).scaled_to_conserve()


def held_out_error(samples: BrdfMeasurements) -> FitError:
    """Fits halves of the samples, chosen by chance; returns the errors at the other halves, the median of three."""
    errors = [_error_at_other_half(samples, seed) for seed in range(_HALVES)]
    return FitError(*(float(each) for each in np.median(errors, axis=0)))


def _error_at_other_half(samples: BrdfMeasurements, seed: int) -> tuple[float, float]:
    taken = np.zeros(len(samples), bool)
    taken[np.random.default_rng(seed).permutation(len(samples))[::2]] = True
    fitted, kept = fit_brdf(samples.subset(taken)), samples.subset(~taken)
    half = kept.light + kept.view
    cosine = half[:, 2] / np.linalg.norm(half, axis=1)
    off_mirror = cosine < np.cos(np.radians(MIRROR_RANGE_DEG))
    return _error(fitted, kept), _error(fitted, kept.subset(off_mirror))


def _error(fitted: GaussianBrdf, samples: BrdfMeasurements) -> float:
    difference = fitted.evaluate(samples.light, samples.view) - samples.values
    return float(np.sqrt((difference**2).sum() / (samples.values**2).sum()))
