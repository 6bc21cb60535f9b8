"""How far the lights of a fish-eye camera are, by the shading and the shadows that the colour camera sees.

Divided by the irradiance of lights in their right places, a picture is albedo, which has fewer steps than shading:
shadows and falloff are gone (intrinsic images, Barrow & Tenenbaum 1978).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage, ViewFrame, decode_lut
from deltalight.protocol.occlusion import are_occluded
from deltalight.protocol.octahedral import sample_octahedral
from deltalight.protocol.sky_lights import SkyLights, TrackedLight
from deltalight.render_server.lights.light_distance import (
    CANDIDATES,
    DistanceCue,
    is_significant,
    sum_by_tile,
    tiles_of,
)
from deltalight.render_server.lights.octahedral import irradiance_map
from deltalight.render_server.scene.albedo import unclipped
from deltalight.render_server.scene.depth_surface import depth_surface, noise_sigma

# Depth is read at this width, shading at every second of its pixels: a few thousand points see soft shadows well.
WIDTH = 160
STRIDE = 2
# Points are compared over 5 and 10 % of the picture's width: closer ones differ by noise, others by material.
SPANS = (4, 8)
SAME_CHROMA = 0.1  # largest difference of log colour between points that may be of one material
LARGEST_STEP = 0.2  # of log albedo: beyond it, materials differ, whatever the light
MIN_PAIRS = 500
ROUNDS = 2  # over all lamps: where one is depends on the others
SHADOW_STEPS = 32
OFFSET_SIGMAS = 4.0  # from a surface to where its shadow rays start, in noise of its depth


@dataclass(frozen=True, eq=False)
class Shading:
    """What shading and shadows of a picture say about the distances of lamps from the fish-eye camera.

    The nearer places are to that camera the more they count. `lit` is the irradiance of the points by each lamp at
    each of CANDIDATES, `smooth` that by all other light.
    """

    sky: SkyLights
    seen: "_SeenPoints"
    lamps: list[list[TrackedLight]]
    lit: list[list[Float32[np.ndarray, "k 3"]]]
    smooth: Float32[np.ndarray, "k 3"]

    @classmethod
    def of(cls, frame: ViewFrame, sky: SkyLights) -> "Shading | None":
        """Returns what a frame says; None without depth or pose, and where it shows too little."""
        seen = _seen_points(frame, sky.world_from_fisheye[:3, 3])
        if seen is None:
            return None
        lamps = _lamps(sky.lights)
        lit = [[seen.lit_by(lamp, sky, inverse) for inverse in CANDIDATES] for lamp in lamps]
        smooth = sample_octahedral(irradiance_map(sky.residual), seen.normals[None])[0]
        return cls(sky, seen, lamps, lit, smooth)

    @cached_property
    def cue(self) -> DistanceCue | None:
        """How many steps the picture's albedo has if all lamps are at one distance."""
        return self._cue([sum(lit, self.smooth) for lit in zip(*self.lit, strict=True)])

    def own_inverses(self) -> dict[int, float]:
        """Returns inverse distances, 1/m, of the lights (by identity) that are not as far as the others.

        One of its own must leave significantly fewer steps than the distance common to all.
        """
        if self.cue is None or len(self.lamps) == 1:
            return {}
        common, _ = self.cue.estimate
        pairs, found = self.seen.pairs, dict[int, float]()
        now = [self.seen.lit_by(lamp, self.sky, common) for lamp in self.lamps]
        for index in ROUNDS * sorted(range(len(now)), key=lambda index: -float(now[index].sum())):
            others = sum(now[:index] + now[index + 1 :], self.smooth)
            own = self._cue([others + lit for lit in self.lit[index]])
            (before,) = sum_by_tile([pairs.steps(others + now[index])], pairs.tile)
            if own is not None and is_significant(before - own.losses[own.best], len(now)):
                inverse, _ = own.estimate
                found |= {light.identity: inverse for light in self.lamps[index]}
                now[index] = self.seen.lit_by(self.lamps[index], self.sky, inverse)
        return found

    def _cue(self, lights: Sequence[Float32[np.ndarray, "k 3"]]) -> DistanceCue | None:
        """Returns the steps under each of some irradiances."""
        pairs = self.seen.pairs
        return DistanceCue.of(CANDIDATES, [pairs.steps(light) for light in lights], pairs.tile)


def _lamps(lights: Sequence[TrackedLight]) -> list[list[TrackedLight]]:
    """Returns the lights of each lamp: large ones are cut into several, whose discs touch."""
    from scipy.sparse.csgraph import connected_components

    toward = np.array([light.to_light for light in lights])
    radius = np.array([light.angular_radius_rad for light in lights])
    touch = np.arccos(np.clip(toward @ toward.T, -1, 1)) <= radius + radius[:, None]
    count, lamp = connected_components(touch, directed=False)
    return [[light for light, own in zip(lights, lamp, strict=True) if own == one] for one in range(count)]


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of points that may be of one material: indices, weight (sum 1), difference of log radiance, tile."""

    first: Int64[np.ndarray, " p"]
    second: Int64[np.ndarray, " p"]
    weight: Float32[np.ndarray, " p"]
    difference: Float32[np.ndarray, " p"]
    tile: Int64[np.ndarray, " p"]

    def steps(self, light: Float32[np.ndarray, "k 3"]) -> Float32[np.ndarray, " p"]:
        """Returns each pair's weighted step of log albedo under an irradiance of the points."""
        log = np.log(np.maximum(light, 1e-6)).mean(axis=1)
        step = np.abs(self.difference - (log[self.first] - log[self.second]))
        return np.asarray(self.weight * np.minimum(step, LARGEST_STEP))


@dataclass(frozen=True, eq=False)
class _SeenPoints:
    """Points on real surfaces, world metres, and their normals; `depth`, of that median, hides light from them."""

    depth: DepthImage
    median_m: float
    world_from_camera: Float64[np.ndarray, "4 4"]
    points: Float32[np.ndarray, "k 3"]
    normals: Float32[np.ndarray, "k 3"]
    pairs: _Pairs

    def lit_by(
        self, lamp: Sequence[TrackedLight], sky: SkyLights, inverse: float
    ) -> Float32[np.ndarray, "k 3"]:
        """Returns the irradiance from a lamp's lights at an inverse distance from the fish-eye camera."""
        return sum((self._lit_by(light, sky, inverse) for light in lamp), np.zeros_like(self.points))

    def _lit_by(self, light: TrackedLight, sky: SkyLights, inverse: float) -> Float32[np.ndarray, "k 3"]:
        offset = self.points - sky.world_from_fisheye[:3, 3].astype(np.float32)
        to_lamp = light.to_light.astype(np.float32) - np.float32(inverse) * offset  # in units of its distance
        distance = np.linalg.norm(to_lamp, axis=1)
        cosine = np.einsum("ki,ki->k", to_lamp, self.normals) / distance
        lit = np.maximum(cosine, 0) / distance**2 * self._sees(to_lamp, light.angular_radius_rad, cosine > 0)
        return np.asarray(lit[:, None] * light.irradiance.astype(np.float32))

    def _sees(
        self, to_lamp: Float32[np.ndarray, "k 3"], radius_rad: float, faces: Bool[np.ndarray, " k"]
    ) -> Bool[np.ndarray, " k"]:
        """Whether each point sees a place of the lamp, each one another: differences average over soft edges."""
        places = to_lamp[faces] + np.float32(np.sin(radius_rad)) * _on_discs(to_lamp[faces])
        ways = places / np.linalg.norm(places, axis=1, keepdims=True)
        offset = np.float32(OFFSET_SIGMAS * noise_sigma(self.depth) * self.median_m**2)
        starts = self.points[faces] + offset * self.normals[faces]
        # Densest at the start, where shadows meet what casts them, and as far as the camera sees things.
        along = self.median_m * np.linspace(0, 1, SHADOW_STEPS + 1, dtype=np.float32)[1:] ** 1.5
        sees = faces.copy()
        sees[faces] = ~are_occluded(self.depth, self.world_from_camera, starts, ways, along)
        return sees


def _on_discs(axes: Float32[np.ndarray, "k 3"]) -> Float32[np.ndarray, "k 3"]:
    """Returns a point of the unit disc across each axis, together evenly spread (R2 sequence, Roberts 2018)."""
    count = np.arange(len(axes))
    turn, radius = 2 * np.pi * (0.7548776662 * count % 1), np.sqrt(0.5698402910 * count % 1)
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    across = np.cross(axes, np.where(np.abs(axes[:, 2:]) < 0.9, [0.0, 0, 1], [1.0, 0, 0]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(axes, across)
    return np.asarray((np.cos(turn) * across.T + np.sin(turn) * up.T).T * radius[:, None], np.float32)


def _seen_points(frame: ViewFrame, centre: Float64[np.ndarray, "3"]) -> _SeenPoints | None:
    """Returns what a frame shows, most of all around `centre` (world, m)."""
    if frame.depth is None or frame.pose is None:
        return None
    camera = _small_pinhole(frame.depth.camera)
    rays = np.insert(camera.rays(), 2, 1.0, axis=2)
    places = frame.depth.camera.project(rays.reshape(-1, 3).astype(np.float64)).astype(np.float32)
    places = places.reshape(camera.height, camera.width, 2)
    known = np.where(frame.depth.valid, frame.depth.depth_m, 0).astype(np.float32)
    depth_m = cv2.remap(known, places, None, cv2.INTER_NEAREST)
    depth = DepthImage(depth_m, depth_m > 0, camera, frame.depth.noise_sigma_m)
    if not depth.valid.any():
        return None
    world_from_camera, shown = frame.pose.world_from_camera, np.s_[::STRIDE, ::STRIDE]
    points = ((rays * depth_m[..., None]) @ world_from_camera[:3, :3].T + world_from_camera[:3, 3])[shown]
    normals = depth_surface(depth, camera).normals[shown]
    is_surface = normals.any(axis=-1)
    normals[~is_surface] = (0, 0, -1)  # any direction: no pair holds these points
    color, measured = _measured_color(frame, places)
    median_m = float(np.median(depth_m[depth.valid]))
    near = np.linalg.norm(points - centre, axis=-1) / (median_m / 2)
    pairs = _pairs(color[shown], measured[shown] & is_surface, 1 / (1 + near**2) ** 2)
    if len(pairs.weight) < MIN_PAIRS:
        return None
    return _SeenPoints(
        depth,
        median_m,
        world_from_camera,
        points.reshape(-1, 3).astype(np.float32),
        (normals @ world_from_camera[:3, :3].T).reshape(-1, 3).astype(np.float32),
        pairs,
    )


def _small_pinhole(camera: CameraModel) -> CameraModel:
    """Returns a camera of WIDTH pixels without distortion that sees all that `camera` does."""
    rays = camera.rays().reshape(-1, 2).astype(np.float64)
    low, high = rays.min(axis=0), rays.max(axis=0)
    height = max(round(WIDTH * camera.height / camera.width), 2)
    focal = (np.array([WIDTH, height]) - 1) / np.maximum(high - low, 1e-9)
    matrix = np.diag([*focal, 1.0])
    matrix[:2, 2] = -low * focal
    return CameraModel(WIDTH, height, matrix)


def _measured_color(
    frame: ViewFrame, places: Float32[np.ndarray, "h w 2"]
) -> tuple[Float32[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Returns the mean linear colour around places of the picture, and where nothing is clipped or black."""
    linear = decode_lut(frame.response)[frame.color, np.arange(3)]
    measured = unclipped(frame.color, linear).astype(np.uint8)
    edge = max(1, round(frame.camera.width / WIDTH))
    color = cv2.remap(cv2.blur(linear, (edge, edge)), places, None, cv2.INTER_LINEAR)
    return color, cv2.remap(measured, places, None, cv2.INTER_NEAREST) > 0


def _pairs(
    color: Float32[np.ndarray, "h w 3"], usable: Bool[np.ndarray, "h w"], weight: Float[np.ndarray, "h w"]
) -> _Pairs:
    """Pairs usable points of similar chroma along rows and columns."""
    log = np.log(np.maximum(color, 1e-6))
    mean = log.mean(axis=-1)
    chroma = log - mean[..., None]
    index = np.arange(usable.size).reshape(usable.shape)
    tile = tiles_of(index, usable.shape[1])
    parts = []
    for span in SPANS:
        for one, other in ((np.s_[:, :-span], np.s_[:, span:]), (np.s_[:-span], np.s_[span:])):
            alike = np.abs(chroma[one] - chroma[other]).max(axis=-1) < SAME_CHROMA
            both = usable[one] & usable[other] & alike
            values = index[one], index[other], weight[one] + weight[other], mean[one] - mean[other], tile[one]
            parts.append([value[both] for value in values])
    first, second, weights, difference, tiles = (np.concatenate(part) for part in zip(*parts, strict=True))
    weights = weights / max(float(weights.sum()), 1e-12)
    return _Pairs(first, second, weights.astype(np.float32), difference.astype(np.float32), tiles)
