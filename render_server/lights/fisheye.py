"""Lights in a fish-eye picture: its radiance map, lights tracked over time, their distance, occlusion tests.

A fish-eye picture gives directions only, but shadows of a lamp one metre away diverge by ten degrees over a table.
Paper of one albedo is a light meter with hundreds of cells: across it, light of a near lamp varies by I cos / d^2.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import Self

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from deltalight.protocol.frames import DepthImage, RadianceMap, ViewFrame, decode_lut
from deltalight.protocol.hemisphere import hemisphere_uv, texel_directions, texel_solid_angles
from deltalight.render_server.lights.environment import LUMINANCE, SkyGrid
from deltalight.render_server.lights.median_cut import RegionLight
from deltalight.render_server.lights.octahedral import octahedral_grid, sample_octahedral, texel_weights
from deltalight.render_server.lights.octahedral import texel_solid_angles as octahedral_solid_angles
from deltalight.render_server.scene.albedo import MIN_PIXELS, known_albedo, unclipped

COARSE_SIZE = 32
# Power of the cosine that weights visible directions for an unseen one: half at 24 degrees, about the size of parts
# of a room (a wall, a window, the ceiling).
LOBE_POWER = 8
# Weight of all visible directions: decides only where none is close.
MIN_LOBE_WEIGHT = 1e-4
# Lights of successive pictures within this angle may be the same. A hand-held lamp at 1 m moves as far within a time
# constant of half a second; neighbours of a split with four lights are mostly farther apart.
GATE_RAD = float(np.radians(20.0))
# Between pictures, lights move in so many steps per time constant, each of which costs a rebuild.
STEPS_PER_CONSTANT = 5
SETTLED_CONSTANTS = 7.0  # after which 0.1 % of a change is left and counts as done
FORGOTTEN_FRACTION = 1e-3  # of all lights' irradiance: fading lights are dropped below
NS = 1e-9
# Candidate inverse distances, 1/m: from far away to 20 cm, finer than the paper resolves.
INVERSE_DISTANCES = np.linspace(0.0, 5.0, 101)
# Near lights are accepted if they explain this fraction of all smooth differences (a plane over the paper) from far
# lights: uneven ambient light and shadows do not vary like near lamps by chance ...
MIN_EXPLAINED = 0.75
# ... and if the improvement is significant at 0.1 % (F-test with 1 and many degrees of freedom), where four
# neighbouring values of pixels and channels count as one, because lens and demosaicing mix them.
MIN_F_RATIO = 11.0
CORRELATED_VALUES = 4
OUTLIER_DEVIATIONS = 3.0
RAY_STEP_M = 0.01  # as fine as things on a table that can occlude a light
MAX_RAY_M = 10.0  # range of depth cameras
DEPTH_TOLERANCE = 0.02  # of depth: beyond the noise of any depth camera in its range
# Greatest depth of the first point behind a surface: more than a step, even where the camera looks along the surface,
# and less than things on a table are apart.
THICKNESS_M = 0.05


@dataclass(frozen=True, eq=False)
class HemisphereMap:
    """Radiance on the grid of `deltalight.protocol.hemisphere`, 0 where not `seen`.

    `world_from_map` is a rotation.
    """

    radiance: Float32[np.ndarray, "n n 3"]
    seen: Bool[np.ndarray, "n n"]
    world_from_map: Float64[np.ndarray, "3 3"]

    @classmethod
    def of(cls, radiance_map: RadianceMap) -> Self:
        """Builds from a fish-eye camera's radiance map."""
        radiance = radiance_map.radiance * radiance_map.seen[..., None]
        return cls(radiance, radiance_map.seen, np.asarray(radiance_map.world_from_fisheye[:3, :3]))

    @property
    def grid(self) -> SkyGrid:
        """Directions and solid angles of the pixels."""
        return _grid(len(self.radiance))

    @cached_property
    def known_solid_angle(self) -> float:
        """Solid angle of what was seen, sr."""
        return float(self.grid.solid_angles[self.seen].sum(dtype=np.float64))

    def with_radiance(self, radiance: Float32[np.ndarray, "n n 3"]) -> Self:
        """Returns the map with other radiance."""
        return replace(self, radiance=radiance)


@cache
def _grid(size: int) -> SkyGrid:
    return SkyGrid(texel_directions(size), texel_solid_angles(size))


@dataclass(frozen=True, eq=False)
class WorldSky:
    """A map on an octahedral grid in world axes: radiance times the fraction of each texel that is `seen`."""

    radiance: Float32[np.ndarray, "m m 3"]
    seen: Float32[np.ndarray, "m m 1"]

    def filled(self) -> Float32[np.ndarray, "m m 3"]:
        """Returns radiance in all directions; unseen ones get the weighted mean of nearby seen ones."""
        return np.asarray(self.radiance + (1 - self.seen) * _nearby_mean(self.radiance, self.seen))


def to_world(sky: HemisphereMap, size: int) -> WorldSky:
    """Averages a map over the texels of an octahedral grid in world axes."""
    place, weight = _sampling(sky.world_from_map.astype(np.float64).tobytes(), len(sky.radiance), size)
    rgbs = np.dstack([sky.radiance, sky.seen.astype(np.float32)])
    samples = cv2.remap(rgbs, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    samples *= weight[..., None]
    mean = cv2.resize(samples, (size, size), interpolation=cv2.INTER_AREA)
    return WorldSky(np.ascontiguousarray(mean[..., :3]), mean[..., 3:])


@lru_cache(maxsize=4)
def _sampling(
    rotation: bytes, map_size: int, size: int
) -> tuple[Float32[np.ndarray, "k k 2"], Float32[np.ndarray, "k k"]]:
    """Returns where to read a map for each sample of the octahedral grid, and the sample's weight (0 behind).

    Samples are half as far apart as the map's texels, with at least 2x2 per texel of the grid.
    """
    fine = size * max(2, 2 * map_size // size)
    world_from_map = np.frombuffer(rotation).reshape(3, 3)
    directions = octahedral_grid(fine) @ world_from_map
    in_front = directions[..., 2] >= 0
    directions[..., 2] = np.maximum(directions[..., 2], 0)
    place = (hemisphere_uv(directions) * map_size - 0.5).astype(np.float32)
    return place, np.asarray(texel_weights(size, fine // size) * in_front.astype(np.float32))


def _nearby_mean(
    radiance: Float32[np.ndarray, "m m 3"], seen: Float32[np.ndarray, "m m 1"]
) -> Float32[np.ndarray, "m m 3"]:
    """Returns the mean seen radiance around each direction, weighted by a power of the cosine."""
    size = len(radiance)
    coarse = min(size, COARSE_SIZE)
    both = np.dstack([radiance, seen]) * texel_weights(coarse, size // coarse)[..., None]
    small = cv2.resize(both, (coarse, coarse), interpolation=cv2.INTER_AREA)
    sums = _lobe_weights(coarse) @ (small * octahedral_solid_angles(coarse)[..., None]).reshape(-1, 4)
    mean = sums[:, :3] / np.maximum(sums[:, 3:], 1e-12)
    return sample_octahedral(mean.reshape(coarse, coarse, 3), octahedral_grid(size))


@cache
def _lobe_weights(size: int) -> Float32[np.ndarray, "k k"]:
    directions = octahedral_grid(size).reshape(-1, 3)
    lobe = np.maximum(directions @ directions.T, 0) ** LOBE_POWER
    return np.asarray(lobe + MIN_LOBE_WEIGHT, np.float32)


@dataclass(frozen=True, eq=False)
class TrackedLight:
    """A distant light with an identity: unit direction to it (world), irradiance across the beam."""

    identity: int
    to_light: Float64[np.ndarray, "3"]
    irradiance: Float64[np.ndarray, "3"]
    angular_radius_rad: float


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
        self.lights += tuple(replace(light, irradiance=np.zeros(3)) for light in new)
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
        moved = [_blended(light, target.get(light.identity), fraction) for light in self.lights]
        faintest = FORGOTTEN_FRACTION * sum(_strength(light) for light in moved)
        self.lights = tuple(
            light for light in moved if light.identity in target or _strength(light) > faintest
        )
        self.residual = self.residual + np.float32(fraction) * (self._target_residual - self.residual)

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


@dataclass(frozen=True, eq=False)
class PaperLight:
    """Irradiance (camera units) at points of the board (world, m) with known albedo."""

    points: Float64[np.ndarray, "k 3"]
    irradiance: Float64[np.ndarray, "k 3"]


def paper_light(frame: ViewFrame) -> PaperLight | None:
    """Measures irradiance on paper and grey cards; None for fewer than 30 unclipped pixels."""
    if frame.board is None or frame.pose is None:
        return None
    albedo = known_albedo(frame.board, frame.camera, frame.pose)
    coded = decode_lut(frame.response)[frame.color, np.arange(3)]
    usable = (albedo > 0) & unclipped(frame.color, coded)
    if np.count_nonzero(usable) < MIN_PIXELS:
        return None
    matrix = frame.pose.world_from_camera
    rays = np.insert(frame.camera.rays()[usable].astype(np.float64), 2, 1.0, axis=1) @ matrix[:3, :3].T
    points = matrix[:3, 3] - rays * (matrix[2, 3] / rays[:, 2:])
    irradiance = np.pi * coded[usable].astype(np.float64) / (albedo[usable, None] * frame.exposure_scale)
    return PaperLight(points, irradiance)


def fit_distance(
    paper: PaperLight,
    position: Float64[np.ndarray, "3"],
    lights: Sequence[RegionLight],
    ambient: Float64[np.ndarray, "3"],
) -> float | None:
    """Estimates the distance of the lights from the fish-eye camera at `position`, m; None where they seem far away.

    The paper's irradiance is f (sum of E_i (D/d)^2 cos + ambient) with a factor f per channel; D, one distance for
    all lights, is fitted by least squares and must be significant. `ambient` is the irradiance of all other light
    on the paper, in the units of the lights.
    """
    far = _predicted(paper, position, lights, ambient, 0.0)
    misfits = [
        _misfit(paper, _predicted(paper, position, lights, ambient, inverse)) for inverse in INVERSE_DISTANCES
    ]
    best = int(np.argmin(misfits))
    gain = misfits[0] - misfits[best]
    explainable = misfits[0] - _misfit(paper, far * _plane(paper, far))
    values = paper.irradiance.size / CORRELATED_VALUES
    if gain < MIN_EXPLAINED * explainable or gain * values < MIN_F_RATIO * misfits[best] or best == 0:
        return None
    return float(1 / INVERSE_DISTANCES[best])


def _predicted(
    paper: PaperLight,
    position: Float64[np.ndarray, "3"],
    lights: Sequence[RegionLight],
    ambient: Float64[np.ndarray, "3"],
    inverse: float,
) -> Float64[np.ndarray, "k 3"]:
    """Returns the irradiance of the paper under lights at an inverse distance."""
    predicted = np.tile(ambient, (len(paper.points), 1))
    for light in lights:
        to_lamp = light.to_light - inverse * (paper.points - position)  # in units of the lamp's distance
        attenuation = np.maximum(to_lamp[:, 2], 0) / np.linalg.norm(to_lamp, axis=1) ** 3
        predicted += attenuation[:, None] * light.irradiance
    return np.asarray(np.maximum(predicted, 1e-12))


def _plane(paper: PaperLight, predicted: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k 3"]:
    """Fits measured over predicted irradiance by a linear function of position per channel."""
    places = np.column_stack([np.ones(len(paper.points)), paper.points[:, :2]])
    kept = _without_outliers(paper.irradiance / predicted)
    return np.stack(
        [
            places @ np.linalg.lstsq(places[kept] * one[kept, None], measured[kept])[0]
            for one, measured in zip(predicted.T, paper.irradiance.T, strict=True)
        ],
        axis=1,
    )


def _misfit(paper: PaperLight, predicted: Float64[np.ndarray, "k 3"]) -> float:
    """Returns the relative mean squared difference to the measured irradiance, after fitting a factor per channel."""
    kept = _without_outliers(paper.irradiance / predicted)
    measured, predicted = paper.irradiance[kept], predicted[kept]
    factor = (measured * predicted).sum(axis=0) / (predicted**2).sum(axis=0)
    return float(((factor * predicted - measured) ** 2).mean() / (measured**2).mean())


def _without_outliers(ratio: Float64[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
    deviation = np.abs(ratio - np.median(ratio, axis=0))
    allowed = OUTLIER_DEVIATIONS * 1.4826 * np.median(deviation, axis=0) + 1e-9
    return np.asarray((deviation <= allowed).all(axis=1))


def is_occluded(
    depth: DepthImage,
    world_from_camera: Float64[np.ndarray, "4 4"],
    origin: Float64[np.ndarray, "3"],
    direction: Float64[np.ndarray, "3"],
) -> bool:
    """Whether the ray from `origin` (world, m) in a unit direction passes through a surface of the depth image.

    The ray is marched while the camera sees it; beyond, nothing is known to occlude it. Passing behind something near
    the camera is no hit: the ray must enter a surface from the front and lie close behind it.
    """
    known = depth.valid & (depth.depth_m > 0)
    if not known.any():
        return False
    camera_from_world = np.linalg.inv(world_from_camera)
    reach = min(MAX_RAY_M, 2 * float(depth.depth_m[known].max()))
    along = np.arange(RAY_STEP_M, reach, RAY_STEP_M)[:, None]
    points = (origin + along * direction) @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    pixels = np.rint(np.nan_to_num(depth.camera.project(points), nan=-1.0))
    height, width = depth.depth_m.shape
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    column, row = np.where(inside[:, None], pixels, 0).astype(int).T
    behind = points[:, 2] - depth.depth_m[row, column]
    slack = DEPTH_TOLERANCE * np.abs(points[:, 2])
    shown = inside & known[row, column]
    before = shown & (behind <= slack)
    through = shown & (behind > slack) & (behind <= slack + THICKNESS_M)
    return bool((before[:-1] & through[1:]).any())
