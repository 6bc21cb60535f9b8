"""Lights of successive maps of radiance, tracked over time."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from deltalight.protocol.frames import LUMINANCE
from deltalight.protocol.median_cut import RegionLight
from deltalight.protocol.message_fields import MAX_LIGHTS
from deltalight.protocol.sky_lights import TrackedLight

# Lights of successive pictures within this angle may be the same. A hand-held lamp at 1 m moves as far within a time
# constant of half a second; neighbours of a split with four lights are mostly farther apart.
GATE_RAD = float(np.radians(20.0))
# Between pictures, lights move in so many steps per time constant, each of which costs a rebuild.
STEPS_PER_CONSTANT = 5
SETTLED_CONSTANTS = 7.0  # after which 0.1 % of a change is left and counts as done
FORGOTTEN_FRACTION = 1e-3  # of all lights' irradiance: fading lights are dropped below
MOST_LIGHTS = MAX_LIGHTS - 1  # composites list the environment with them
NS = 1e-9


class LightTracker:
    """Tracks lights and residual (octahedral, world axes) through a low-pass filter; time constant in s, 0 = none.

    Lights and residual pass the same filter: what a fading light still lacks is still in the residual, so that their
    sum follows that of the maps. The first map is applied immediately. A new map only sets the target; `advance`
    moves towards it. If the clock is set back, lights stay until it catches up.
    """

    def __init__(self, smoothing_s: float) -> None:
        self._smoothing_s = smoothing_s
        self._identities = 0
        self._clock_ns = 0
        self._to_settle_s = 0.0
        self._target: tuple[TrackedLight, ...] = ()
        self._target_residual: Float32[np.ndarray, "n n 3"] | None = None
        self.lights: tuple[TrackedLight, ...] = ()
        self.residual: Float32[np.ndarray, "n n 3"] | None = None

    def set_target(
        self, timestamp_ns: int, lights: tuple[RegionLight, ...], residual: Float32[np.ndarray, "n n 3"]
    ) -> None:
        """Sets the split of a new map as the target from this time on."""
        self.advance(timestamp_ns, at_once=True)
        self._clock_ns = timestamp_ns
        self._target = self._identified(lights)
        self._target_residual = residual
        known = {light.identity for light in self.lights}
        new = (light for light in self._target if light.identity not in known)
        appearing = tuple(replace(light, irradiance=np.zeros(3)) for light in new)
        self.lights = self._without_faint(self.lights + appearing)
        self._to_settle_s = SETTLED_CONSTANTS * self._smoothing_s
        if self.residual is None or self._smoothing_s == 0:
            self._settle()

    def advance(self, timestamp_ns: int, *, at_once: bool = False) -> bool:
        """Advances the filter; returns whether lights changed. Small steps are accumulated unless `at_once`."""
        self._clock_ns = min(self._clock_ns, timestamp_ns)
        passed_s = (timestamp_ns - self._clock_ns) * NS
        least_s = 0.0 if at_once else self._smoothing_s / STEPS_PER_CONSTANT
        if self._to_settle_s <= 0 or passed_s <= 0 or passed_s < least_s:
            return False
        self._clock_ns = timestamp_ns
        self._to_settle_s -= passed_s
        if self._to_settle_s <= 0:
            self._settle()
        else:
            self._approach(float(1 - np.exp(-passed_s / self._smoothing_s)))
        return True

    def _settle(self) -> None:
        self.lights, self.residual, self._to_settle_s = self._target, self._target_residual, 0.0

    def _approach(self, fraction: float) -> None:
        """Moves this fraction of the way to the target; lights without a target fade out."""
        target = {light.identity: light for light in self._target}
        assert self.residual is not None
        assert self._target_residual is not None
        self.lights = self._without_faint(
            tuple(_blended(light, target.get(light.identity), fraction) for light in self.lights)
        )
        self.residual = self.residual + np.float32(fraction) * (self._target_residual - self.residual)

    def _without_faint(self, lights: tuple[TrackedLight, ...]) -> tuple[TrackedLight, ...]:
        """Drops fading lights that are too faint to matter, and the faintest of too many."""
        target = self._target_identities
        faintest = FORGOTTEN_FRACTION * sum(_strength(light) for light in lights)
        fading = sorted((_strength(light) for light in lights if light.identity not in target), reverse=True)
        room = MOST_LIGHTS - len(target)
        if len(fading) > room:
            faintest = max(faintest, fading[room])
        return tuple(light for light in lights if light.identity in target or _strength(light) > faintest)

    def _identified(self, lights: tuple[RegionLight, ...]) -> tuple[TrackedLight, ...]:
        """Gives each new light the identity of the light that it continues, or a new one."""
        old = self._matched(lights)
        numbered = []
        for index, light in enumerate(lights):
            if index not in old:
                self._identities += 1
            identity = old.get(index, self._identities)
            numbered.append(
                TrackedLight(identity, light.to_light, light.irradiance, light.angular_radius_rad)
            )
        return tuple(numbered)

    def _matched(self, lights: tuple[RegionLight, ...]) -> dict[int, int]:
        """Matches new lights (by index) to identities of old ones: pairs close in direction and energy."""
        # Fading lights may come back; of two at the same distance, the shining one is likelier.
        old = [
            *self._target,
            *(light for light in self.lights if light.identity not in self._target_identities),
        ]
        if not old or not lights:
            return {}
        from scipy.optimize import linear_sum_assignment

        cosine = (
            np.array([light.to_light for light in old]) @ np.array([light.to_light for light in lights]).T
        )
        angle = np.arccos(np.clip(cosine, -1, 1)) / GATE_RAD
        before = np.array([_strength(light) for light in old])[:, None]
        after = np.array([_strength(light) for light in lights])
        difference = np.abs(before - after) / np.maximum(before + after, 1e-12)
        far = angle > 1
        rows, columns = linear_sum_assignment(np.where(far, 1e6, angle + difference))
        pairs = zip(rows.tolist(), columns.tolist(), strict=True)
        return {column: old[row].identity for row, column in pairs if not far[row, column]}

    @property
    def _target_identities(self) -> set[int]:
        return {light.identity for light in self._target}


def _strength(light: TrackedLight | RegionLight) -> float:
    return float(light.irradiance @ LUMINANCE)


def _blended(light: TrackedLight, target: TrackedLight | None, fraction: float) -> TrackedLight:
    """Interpolates between a light and its target."""
    if target is None:
        return replace(light, irradiance=(1 - fraction) * light.irradiance)
    to_light = light.to_light + fraction * (target.to_light - light.to_light)
    return TrackedLight(
        light.identity,
        to_light / np.linalg.norm(to_light),
        light.irradiance + fraction * (target.irradiance - light.irradiance),
        light.angular_radius_rad + fraction * (target.angular_radius_rad - light.angular_radius_rad),
    )
