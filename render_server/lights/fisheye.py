"""Lights and residual of successive splits as one steady light: identities kept, everything low-passed."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64
from scipy.optimize import linear_sum_assignment

from render_server.lights.environment import LUMINANCE
from render_server.lights.median_cut import RegionLight

# Two lights of successive pictures may be one if they are no further apart. A lamp held in the hand at 1 m moves
# as far within a time constant of half a second; neighbours of a split with four lights are mostly further apart.
GATE_RAD = float(np.radians(20.0))
# While nothing new is seen, light moves on in so many steps a time constant, each of which costs a rebuild.
STEPS_PER_CONSTANT = 5
SETTLED_CONSTANTS = 7.0  # after which what is left of a change is 0.1 %: taken as done
FORGOTTEN_SHARE = 1e-3  # of all lights' irradiance: a light on its way out is gone below
NS = 1e-9


@dataclass(frozen=True, eq=False)
class FollowedLight:
    """A distant light with a number: `toward` is the unit direction to it (world), `irradiance` across the beam."""

    identity: int
    toward: Float64[np.ndarray, "3"]
    irradiance: Float64[np.ndarray, "3"]
    angular_radius_rad: float


class LightTracker:
    """Follows lights and residual (octahedral, world axes) with a time constant, seconds; 0 = at once.

    Lights and residual pass the same low-pass filter: what a light that fades in still lacks is still in the
    residual, and their sum follows that of the maps. The first map is taken as it is. A new map changes nothing
    by itself; time does. A clock that was set back stops the light until it goes on.
    """

    def __init__(self, smoothing_s: float) -> None:
        self._smoothing_s = smoothing_s
        self._identities = 0
        self._clock_ns = 0
        self._to_settle_s = 0.0
        self._wanted: tuple[FollowedLight, ...] = ()
        self._wanted_residual: Float32[np.ndarray, "n n 3"] | None = None
        self.lights: tuple[FollowedLight, ...] = ()
        self.residual: Float32[np.ndarray, "n n 3"] | None = None

    def see(
        self, timestamp_ns: int, lights: tuple[RegionLight, ...], residual: Float32[np.ndarray, "n n 3"]
    ) -> None:
        """Take the split of a new map as what is to be approached from this time on."""
        self.advance(timestamp_ns, at_once=True)
        self._clock_ns = timestamp_ns
        self._wanted = self._numbered(lights)
        self._wanted_residual = residual
        known = {light.identity for light in self.lights}
        new = (light for light in self._wanted if light.identity not in known)
        self.lights += tuple(replace(light, irradiance=np.zeros(3)) for light in new)
        self._to_settle_s = SETTLED_CONSTANTS * self._smoothing_s
        if self.residual is None or self._smoothing_s == 0:
            self._settle()

    def advance(self, timestamp_ns: int, *, at_once: bool = False) -> bool:
        """Let time pass; returns whether light changed. Small steps are saved up unless wanted `at_once`."""
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
        self.lights, self.residual, self._to_settle_s = self._wanted, self._wanted_residual, 0.0

    def _approach(self, share: float) -> None:
        """Go this share of the way to what is wanted; a light that is wanted no more goes towards darkness."""
        wanted = {light.identity: light for light in self._wanted}
        assert self.residual is not None
        assert self._wanted_residual is not None
        moved = [_between(light, wanted.get(light.identity), share) for light in self.lights]
        least = FORGOTTEN_SHARE * sum(_strength(light) for light in moved)
        self.lights = tuple(light for light in moved if light.identity in wanted or _strength(light) > least)
        self.residual = self.residual + np.float32(share) * (self._wanted_residual - self.residual)

    def _numbered(self, lights: tuple[RegionLight, ...]) -> tuple[FollowedLight, ...]:
        """Give each new light the number of the one that it continues, or a new number."""
        old = self._continued(lights)
        numbered = []
        for index, light in enumerate(lights):
            if index not in old:
                self._identities += 1
            identity = old.get(index, self._identities)
            numbered.append(FollowedLight(identity, light.toward, light.irradiance, light.angular_radius_rad))
        return tuple(numbered)

    def _continued(self, lights: tuple[RegionLight, ...]) -> dict[int, int]:
        """Number by index of those new lights that continue an old one: pairs near each other and alike in energy."""
        # Lights on their way out may come back; where two are as near, the one that shines is the likelier.
        old = [*self._wanted, *(light for light in self.lights if light.identity not in self._wanted_numbers)]
        if not old or not lights:
            return {}
        cosine = np.array([light.toward for light in old]) @ np.array([light.toward for light in lights]).T
        angle = np.arccos(np.clip(cosine, -1, 1)) / GATE_RAD
        before = np.array([_strength(light) for light in old])[:, None]
        after = np.array([_strength(light) for light in lights])
        difference = np.abs(before - after) / np.maximum(before + after, 1e-12)
        far = angle > 1
        rows, columns = linear_sum_assignment(np.where(far, 1e6, angle + difference))
        pairs = zip(rows.tolist(), columns.tolist(), strict=True)
        return {column: old[row].identity for row, column in pairs if not far[row, column]}

    @property
    def _wanted_numbers(self) -> set[int]:
        return {light.identity for light in self._wanted}


def _strength(light: FollowedLight | RegionLight) -> float:
    return float(light.irradiance @ LUMINANCE)


def _between(light: FollowedLight, wanted: FollowedLight | None, share: float) -> FollowedLight:
    """The light a share of the way on."""
    if wanted is None:
        return replace(light, irradiance=(1 - share) * light.irradiance)
    toward = light.toward + share * (wanted.toward - light.toward)
    return FollowedLight(
        light.identity,
        toward / np.linalg.norm(toward),
        light.irradiance + share * (wanted.irradiance - light.irradiance),
        light.angular_radius_rad + share * (wanted.angular_radius_rad - light.angular_radius_rad),
    )
