"""Lights of mode `fisheye`: what a fish-eye camera sees, split, followed over time, as a light set (METHOD 2)."""

from functools import partial

import numpy as np
from jaxtyping import Float64

from protocol import scene_lights as documents
from protocol.frames import RadianceMap, ViewFrame
from render_server.lights.fisheye import FollowedLight, LightTracker
from render_server.lights.lights import DirectionalLight, Light, LightSet, SphereLight, complete_set
from render_server.lights.median_cut import Split, split_map
from render_server.lights.octahedral import above_horizon, irradiance
from render_server.scene.hemisphere_map import HemisphereMap, WorldSky, to_world
from render_server.scene.light_distance import fit_distance, paper_light
from render_server.scene.line_of_sight import is_hidden

# Texels of 1.6 degrees, finer than what glossy surfaces tell apart; lights are not in it. Filtering it takes a
# third of the time that a map of mode `environment` takes, which changes never.
RESIDUAL_SIZE = 128
UP = np.array([[0.0, 0.0, 1.0]])


class FisheyeSource:
    """Turns the radiance maps of frames into light sets."""

    def __init__(self, lights: documents.Lights) -> None:
        self._wished = lights
        self._tracker = LightTracker(lights.fisheye.smoothing_s)
        self._map: RadianceMap | None = None
        self._sky: WorldSky | None = None
        self._distance_m: float | None = None
        self._wants_distance = lights.fisheye.distance_m == "auto"
        if isinstance(lights.fisheye.distance_m, float):
            self._distance_m = lights.fisheye.distance_m
        self.split: Split[HemisphereMap] | None = None

    def follow(self, frame: ViewFrame) -> LightSet | None:
        """Return the lights of a frame, not registered yet; None where they are those of the frame before.

        Until a frame brings the first map there are none.
        """
        if frame.radiance_map is not None and frame.radiance_map is not self._map:
            self._map = frame.radiance_map
            self._see(frame, frame.radiance_map)
        elif self._map is None or not (
            self._tracker.advance(frame.timestamp_ns) | self._find_distance(frame, self._map)
        ):
            return None
        return self._lights()

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user."""
        if self._map is None:
            return (_NO_PICTURE,)
        if self._distance_m is None or self._wished.fisheye.distance_m != "auto":
            return ()
        return (f"lights of the fish-eye picture: {self._distance_m:.2g} m away, as the board's paper tells",)

    def _see(self, frame: ViewFrame, seen: RadianceMap) -> None:
        settings = self._wished.fisheye
        hidden = None
        if frame.depth is not None and frame.pose is not None:
            place = seen.world_from_fisheye[:3, 3]
            hidden = partial(is_hidden, frame.depth, frame.pose.world_from_camera, place)
        self.split = split_map(
            HemisphereMap.of(seen),
            settings.count,
            threshold=settings.threshold,
            whole_map=settings.split == "all",
            is_hidden=hidden,
        )
        self._sky = to_world(self.split.residual, RESIDUAL_SIZE)
        self._tracker.see(frame.timestamp_ns, self.split.lights, self._sky.filled())
        self._find_distance(frame, seen)

    def _find_distance(self, frame: ViewFrame, seen: RadianceMap) -> bool:
        """Find how far the lights are from the first frame that shows enough paper; returns whether it did."""
        assert self.split is not None
        assert self._tracker.residual is not None
        paper = paper_light(frame) if self._wants_distance and self.split.lights else None
        if paper is None:
            return False
        self._wants_distance = False
        ambient = irradiance(self._tracker.residual, UP)[0]
        place = seen.world_from_fisheye[:3, 3]
        self._distance_m = fit_distance(paper, place, self.split.lights, ambient)
        return self._distance_m is not None

    def _lights(self) -> LightSet:
        assert self._map is not None
        assert self._sky is not None
        assert self._tracker.residual is not None
        place, distance_m = self._map.world_from_fisheye[:3, 3], self._distance_m
        followed = self._tracker.lights
        return complete_set(
            self._wished,
            tuple(
                _distant(light) if distance_m is None else _near(light, place, distance_m)
                for light in followed
            ),
            self._tracker.residual,
            (1 - self._sky.seen) * (1 - above_horizon(RESIDUAL_SIZE)),
            tuple(light.identity for light in followed),
        )


def _distant(light: FollowedLight) -> Light:
    return DirectionalLight(
        (-light.toward).astype(np.float32), light.irradiance.astype(np.float32), light.angular_radius_rad
    )


def _near(light: FollowedLight, place: Float64[np.ndarray, "3"], distance_m: float) -> Light:
    """A sphere that lights `place` as the distant light does: E = I / d^2, and looks as large from there."""
    return SphereLight(
        (place + distance_m * light.toward).astype(np.float32),
        (light.irradiance * distance_m**2).astype(np.float32),
        float(distance_m * np.sin(light.angular_radius_rad)),
    )


_NO_PICTURE = (
    "No fish-eye picture has come yet, so frames are passed through as the camera saw them: give the source one, "
    "or set lights.mode to manual."
)
