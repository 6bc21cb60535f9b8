"""The factor on all lights, found from the picture (docs/method.md 1.4)."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from deltalight.protocol.frames import LUMINANCE
from deltalight.render_server.estimation.samples import LightSamples, bounced_light, sample_light
from deltalight.render_server.frame_graph import FrameGraph
from deltalight.render_server.lights.light_models import DirectionalLight
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.lights.octahedral import solid_angle_mean
from deltalight.render_server.scene.albedo import ALBEDO_RANGE, MIN_PIXELS

OUTLIER_DEVIATIONS = 3.0
MIN_IRRADIANCE = 1e-4
MIN_OPEN_FRACTION = 0.05  # of the hemisphere that must be open: below, noise of the paper dominates
PERCENTILE = 99.0
# Relative misfit from which users are warned: people notice unexplained differences of a few per cent within one
# surface.
POOR_RESIDUAL = 0.1
GREATEST_TRIAL = 1000.0  # irradiance, in the unit of the lights: those of more are tried darker first
MAX_TRIALS = 4
TRIALS_AGREE = 0.01  # relative change of the factor
MAX_AVERAGED = 30  # registrations: reduces noise to a fifth, and still keeps up with slow drift


@dataclass(frozen=True, eq=False)
class Registration:
    """Factor R G B on all lights, how it was estimated, and how well it fits.

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
    """Fits the factor on pixels of known albedo: albedo/pi (f E_light + E_bounce) = B, each channel.

    Least squares without pixels that are off the median by more than 3 robust deviations (hands, stains, shadows).
    `measured` must be linear and without clipped pixels (`unclipped`); E_bounce, gathered from the picture itself,
    already has the camera's scale.

    Returns:
        None where fewer than 30 pixels are left, or light or the fit vanishes in a channel.
    """
    irradiance = _paper_irradiance(measured, albedo) - bounce_irradiance
    light = np.asarray(light_irradiance, np.float64)
    usable = np.isfinite(irradiance).all(axis=1) & (light > MIN_IRRADIANCE).all(axis=1)
    if np.count_nonzero(usable) < MIN_PIXELS:
        return None
    irradiance, light = irradiance[usable], light[usable]
    kept = _without_outliers(irradiance / light)
    irradiance, light = irradiance[kept], light[kept]
    factor = (light * irradiance).sum(axis=0) / (light**2).sum(axis=0)
    if len(irradiance) < MIN_PIXELS or not (factor > 0).all():
        return None
    misfit = (factor * light - irradiance) / np.maximum(np.abs(irradiance).mean(axis=0), 1e-9)
    residual = float(np.sqrt((misfit**2).mean()))
    warning = _POOR_FIT.format(100 * residual) if residual > POOR_RESIDUAL else None
    return Registration(factor.astype(np.float32), "patch", residual, warning)


def _paper_irradiance(
    measured: Float[np.ndarray, "k 3"], albedo: Float[np.ndarray, " k"] | float
) -> Float64[np.ndarray, "k 3"]:
    """Returns the irradiance under which a diffuse surface of this albedo has the measured radiance."""
    return np.pi * np.asarray(measured, np.float64) / np.asarray(albedo, np.float64).reshape(-1, 1)


def unseen_radiance_from_patch(
    measured: Float[np.ndarray, "k 3"],
    irradiance: Float[np.ndarray, "k 3"],
    per_radiance: Float[np.ndarray, "k 3"],
    albedo: Float[np.ndarray, " k"] | float,
) -> Float32[np.ndarray, "3"] | None:
    """Estimates the uniform radiance X >= 0 of unseen surroundings: albedo/pi (E + X E_1) = B on paper, per channel.

    `irradiance` E is explained by lights, environment and the real surfaces in view; `per_radiance` E_1 is what
    radiance 1 from all other directions would add. The median is robust against stains and shadows.

    Returns:
        None where fewer than 30 pixels see any of the surroundings.
    """
    missing = _paper_irradiance(measured, albedo) - irradiance
    open_sky = np.asarray(per_radiance, np.float64)
    usable = np.isfinite(missing).all(axis=1) & (open_sky > MIN_OPEN_FRACTION * np.pi).all(axis=1)
    if np.count_nonzero(usable) < MIN_PIXELS:
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
    """Estimates the common scale at which the 99th percentile of luminance albedo is 0.95 (docs/method.md 1).

    The pixels must be unshadowed, unsaturated and diffuse. Albedo pi B/(f E_light + E_bounce) falls with f,
    so the percentile of the factors that give each pixel an albedo of 0.95 is the factor sought.
    """
    light = np.asarray(light_irradiance, np.float64) @ LUMINANCE
    wanted = np.pi / ALBEDO_RANGE[1] * (np.asarray(measured, np.float64) @ LUMINANCE)
    rest = wanted - np.asarray(bounce_irradiance, np.float64) @ LUMINANCE
    usable = np.isfinite(rest) & (light > MIN_IRRADIANCE)
    if np.count_nonzero(usable) < MIN_PIXELS:
        return Registration(np.ones(3, np.float32), "given", None, _NOTHING_SEEN)
    factor = max(float(np.percentile(rest[usable] / light[usable], PERCENTILE)), MIN_IRRADIANCE)
    return Registration(
        np.full(3, factor, np.float32),
        "percentile",
        None,
        _NO_PATCH.format("colour is not matched to the picture"),
    )


def guessed_balance(
    measured: Float[np.ndarray, "k 3"],
    light_irradiance: Float[np.ndarray, "k 3"],
    bounce_irradiance: Float[np.ndarray, "k 3"],
    own: Float[np.ndarray, "3"],
) -> Float64[np.ndarray, "3"]:
    """Estimates the lights' white balance: factors R G B, with G = 1 (docs/method.md 1.4).

    Each ratio is the median of three guesses: `own`, which leaves the lights as they were given; the balance under
    which their light is white, as if the camera had balanced its picture; and that under which the 99th percentile
    of albedo is the same in all channels, as if the brightest surfaces were white. The pixels must be as for
    `registration_from_albedo_percentile`; where they tell nothing, it is `own`.
    """
    light = np.asarray(light_irradiance, np.float64)
    rest = np.pi / ALBEDO_RANGE[1] * np.asarray(measured, np.float64) - np.asarray(
        bounce_irradiance, np.float64
    )
    usable = np.isfinite(rest).all(axis=1) & (light > MIN_IRRADIANCE).all(axis=1)
    guesses = [np.asarray(own, np.float64)]
    if np.count_nonzero(usable) >= MIN_PIXELS:
        light, rest = light[usable], rest[usable]
        brightest = np.percentile(rest / light, PERCENTILE, axis=0)
        guesses += [1 / light.mean(axis=0), np.maximum(brightest, MIN_IRRADIANCE)]
    return np.asarray(np.median([each / each[1] for each in guesses], axis=0))


_POOR_FIT = (
    "The lights explain the board's paper only to within {:.0f} %: check the lights' positions, and that nothing "
    "shadows the board."
)
_NO_PATCH = (
    "No white paper of the marker board was usable, so the lights' scale comes from the brightest real "
    "surface, taken to have albedo 0.95, and their {}: if objects are too bright, "
    "too dark or tinted, show the board's paper unclipped, or set lights.registration."
)
_NOTHING_SEEN = (
    "No lit real surface was usable to scale the lights, so they are used as given: "
    "set lights.registration or the exposure."
)


class RegistrationAverage:
    """Running mean of the registrations over time, over about the last 30.

    A factor from surfaces of known albedo replaces those estimated from the brightest albedo.
    """

    def __init__(self) -> None:
        self._mean = np.ones(3)
        self._source = ""
        self._count = 0

    def add(self, found: Registration) -> Float32[np.ndarray, "3"]:
        """Adds a registration; returns the factor to use from now on."""
        ranks = ("", "given", "percentile", "patch")
        rank, known = ranks.index(found.source), ranks.index(self._source)
        if rank > known:
            self._count, self._source = 0, found.source
        if rank >= known:
            self._count = min(self._count + 1, MAX_AVERAGED)
            self._mean = self._mean + (found.factor - self._mean) / self._count
        return self._mean.astype(np.float32)


def register_lights(
    graph: FrameGraph,
    lights: LightSet,
    estimate: Float32[np.ndarray, "3"] | None = None,
    *,
    guesses_balance: bool,
) -> Registration:
    """Estimates a factor R G B on all lights: from white paper and grey cards, else from the brightest albedo.

    `lights` are not registered yet. Light that visible real surfaces reflect is measured, so it is in camera units
    already; what the others reflect is in those of the lights. So a factor is tried before another is found, until
    they agree; an `estimate` from earlier frames is tried once. `guesses_balance`: the lights' white balance is
    another camera's, so it is estimated too where there is no paper.
    """
    if estimate is not None:
        return _registered_with(graph, lights, estimate, guesses_balance)
    found = _registered_with(graph, lights, np.full(3, _trial_scale(lights), np.float32), guesses_balance)
    for _ in range(MAX_TRIALS - 1):
        tried = found.factor
        found = _registered_with(graph, lights, tried, guesses_balance)
        if np.allclose(found.factor, tried, rtol=TRIALS_AGREE, atol=0):
            break
    return found


def _registered_with(
    graph: FrameGraph, lights: LightSet, tried: Float32[np.ndarray, "3"], guesses_balance: bool
) -> Registration:
    """Returns the registration that the picture shows while this factor is tried.

    The cones are traced twice, with and without the environment.
    """
    trial = lights.registered(tried)
    samples = sample_light(graph, trial, bounced_light(graph, trial))
    known = samples.of(samples.usable & (samples.albedo > 0))
    found = registration_from_patch(known.measured, known.light, known.bounce, known.albedo)
    if found is None:
        lit = samples.of(samples.usable & samples.unshadowed)
        found = _guessed_registration(lit, 1 / tried if guesses_balance else None)
    return replace(found, factor=found.factor * tried)


def _guessed_registration(lit: LightSamples, own_balance: Float32[np.ndarray, "3"] | None) -> Registration:
    """Returns the registration by the brightest albedo; it keeps the lights' balance if there is no `own_balance`."""
    measured, light, bounce = lit.measured, lit.light, lit.bounce
    if own_balance is None:
        return registration_from_albedo_percentile(measured, light, bounce)
    balance = guessed_balance(measured, light, bounce, own_balance)
    found = registration_from_albedo_percentile(measured, balance * light, bounce)
    warning = _NO_PATCH.format("white balance is a guess") if found.source == "percentile" else found.warning
    return replace(found, factor=(balance * found.factor).astype(np.float32), warning=warning)


def _trial_scale(lights: LightSet) -> float:
    """Returns a power of two that brings light in units such as cd/m^2 to where half floats hold it."""
    whole = 4 * np.pi * float(solid_angle_mean(lights.environment).max())
    whole += sum(
        float(light.irradiance.max()) for light in lights.lights if isinstance(light, DirectionalLight)
    )
    return 1.0 if whole <= GREATEST_TRIAL else float(2.0 ** -np.ceil(np.log2(whole)))
