"""Photometric registration: the factor that ties predicted light to what the camera sees (METHOD 1)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from render_server.lights.environment import LUMINANCE
from render_server.scene.board_albedo import LEAST_PIXELS

OUTLIER_DEVIATIONS = 3.0
LEAST_IRRADIANCE = 1e-4
LEAST_OPENING = 0.05  # share of the hemisphere that must be open: below, noise of the paper decides
GREATEST_ALBEDO = 0.95
PERCENTILE = 99.0
# Relative misfit from which users are warned: light that varies more over the paper than the lights explain is seen
# as wrong (people notice differences of a few per cent within one surface).
POOR_RESIDUAL = 0.1
MOST_AVERAGED = (
    30  # registrations: by then noise of a single one is a fifth, and slow drift is still followed
)


@dataclass(frozen=True, eq=False)
class Registration:
    """Factor R G B on all lights, how it was found, and how well it fits.

    `residual` is the relative root-mean-square difference of predicted and measured radiance (0..), None
    where nothing was fitted. `warning` is a sentence for the user.
    """

    factor: Float32[np.ndarray, "3"]
    source: Literal["patch", "percentile", "given"]
    residual: float | None = None
    warning: str | None = None


def registration_from_patch(
    measured: Float[np.ndarray, "k 3"],
    light_irradiance: Float[np.ndarray, "k 3"],
    bounce_irradiance: Float[np.ndarray, "k 3"],
    albedo: Float[np.ndarray, " k"] | float,
) -> Registration | None:
    """Fit the factor on pixels of known albedo: albedo/pi (f E_light + E_bounce) = B, each channel.

    Least squares after pixels that lie off the median by more than 3 robust deviations are left out (hands,
    stains, shadows). `measured` must be linear and without clipped pixels (`unclipped`); E_bounce, gathered
    from the picture itself, already has the camera's scale.

    Returns:
        None where fewer than 30 pixels are left, or light or the fit vanishes in a channel.
    """
    irradiance = _paper_irradiance(measured, albedo) - bounce_irradiance
    light = np.asarray(light_irradiance, np.float64)
    usable = np.isfinite(irradiance).all(axis=1) & (light > LEAST_IRRADIANCE).all(axis=1)
    if np.count_nonzero(usable) < LEAST_PIXELS:
        return None
    irradiance, light = irradiance[usable], light[usable]
    kept = _without_outliers(irradiance / light)
    irradiance, light = irradiance[kept], light[kept]
    factor = (light * irradiance).sum(axis=0) / (light**2).sum(axis=0)
    if len(irradiance) < LEAST_PIXELS or not (factor > 0).all():
        return None
    misfit = (factor * light - irradiance) / np.maximum(np.abs(irradiance).mean(axis=0), 1e-9)
    residual = float(np.sqrt((misfit**2).mean()))
    warning = _POOR_FIT.format(100 * residual) if residual > POOR_RESIDUAL else None
    return Registration(factor.astype(np.float32), "patch", residual, warning)


def _paper_irradiance(
    measured: Float[np.ndarray, "k 3"], albedo: Float[np.ndarray, " k"] | float
) -> Float64[np.ndarray, "k 3"]:
    """Return the irradiance at which a diffuse surface of this albedo shows what was measured."""
    return np.pi * np.asarray(measured, np.float64) / np.asarray(albedo, np.float64).reshape(-1, 1)


def unseen_radiance_from_patch(
    measured: Float[np.ndarray, "k 3"],
    irradiance: Float[np.ndarray, "k 3"],
    per_radiance: Float[np.ndarray, "k 3"],
    albedo: Float[np.ndarray, " k"] | float,
) -> Float32[np.ndarray, "3"] | None:
    """Find the even radiance X >= 0 of what is out of sight: albedo/pi (E + X E_1) = B on paper, each channel.

    `irradiance` E is what lights, environment and the real surfaces in view explain; `per_radiance` E_1 is what
    radiance 1 from everywhere that they leave open would add. The median is robust against stains and shadows.

    Returns:
        None where fewer than 30 pixels see anything of the surroundings.
    """
    missing = _paper_irradiance(measured, albedo) - irradiance
    open_sky = np.asarray(per_radiance, np.float64)
    usable = np.isfinite(missing).all(axis=1) & (open_sky > LEAST_OPENING * np.pi).all(axis=1)
    if np.count_nonzero(usable) < LEAST_PIXELS:
        return None
    found = np.median(missing[usable] / open_sky[usable], axis=0)
    return np.asarray(np.maximum(found, 0.0), np.float32)


def _without_outliers(ratios: Float64[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
    """Whether all channels are within 3 deviations of their medians (1.4826 times the median deviation)."""
    deviation = np.abs(ratios - np.median(ratios, axis=0))
    scale = 1.4826 * np.median(deviation, axis=0)
    return np.asarray((deviation <= OUTLIER_DEVIATIONS * scale + 1e-9).all(axis=1))


def registration_from_albedo_percentile(
    measured: Float[np.ndarray, "k 3"],
    light_irradiance: Float[np.ndarray, "k 3"],
    bounce_irradiance: Float[np.ndarray, "k 3"],
) -> Registration:
    """Find the common scale at which the 99th percentile of luminance albedo is 0.95 (METHOD 1).

    The pixels must be unshadowed, unsaturated and diffuse. Albedo pi B/(f E_light + E_bounce) falls with f,
    so the percentile of the factors that give each pixel an albedo of 0.95 is the factor sought.
    """
    light = np.asarray(light_irradiance, np.float64) @ LUMINANCE
    wanted = np.pi / GREATEST_ALBEDO * (np.asarray(measured, np.float64) @ LUMINANCE)
    rest = wanted - np.asarray(bounce_irradiance, np.float64) @ LUMINANCE
    usable = np.isfinite(rest) & (light > LEAST_IRRADIANCE)
    if np.count_nonzero(usable) < LEAST_PIXELS:
        return Registration(np.ones(3, np.float32), "given", None, _NOTHING_SEEN)
    factor = max(float(np.percentile(rest[usable] / light[usable], PERCENTILE)), LEAST_IRRADIANCE)
    return Registration(np.full(3, factor, np.float32), "percentile", None, _NO_PATCH)


_POOR_FIT = (
    "The lights explain the board's paper only within {:.0f} %: see whether the lights' positions are right, and "
    "whether something shadows the board."
)
_NO_PATCH = (
    "No white paper of the marker board was usable, so the lights' scale comes from the brightest real "
    "surface, taken to have albedo 0.95: show the board's paper unclipped, or set lights.registration."
)
_NOTHING_SEEN = (
    "No lit real surface was usable to scale the lights, so they are used as given: "
    "set lights.registration or the exposure."
)


class RegistrationAverage:
    """The mean of the factors found over time; at most the last 30 or so count.

    A factor found on known surfaces replaces those that were guessed from the brightest albedo.
    """

    def __init__(self) -> None:
        self._mean = np.ones(3)
        self._source = ""
        self._count = 0

    def add(self, found: Registration) -> Float32[np.ndarray, "3"]:
        """Take a new registration and return the factor to use from now on."""
        ranks = ("", "given", "percentile", "patch")
        rank, known = ranks.index(found.source), ranks.index(self._source)
        if rank > known:
            self._count, self._source = 0, found.source
        if rank >= known:
            self._count = min(self._count + 1, MOST_AVERAGED)
            self._mean = self._mean + (found.factor - self._mean) / self._count
        return self._mean.astype(np.float32)
