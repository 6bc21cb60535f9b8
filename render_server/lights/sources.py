"""Sources of a scene document's lights over time: fixed, lamps with markers, or a fish-eye (docs/method.md 2)."""

from functools import partial
from typing import Protocol

import numpy as np
from jaxtyping import Float64

from deltalight.protocol import scene_lights as documents
from deltalight.protocol.frames import RadianceMap, ViewFrame
from deltalight.protocol.hemisphere_map import HemisphereMap, WorldSky, to_world
from deltalight.protocol.light_tracker import LightTracker
from deltalight.protocol.median_cut import Split, split_map
from deltalight.protocol.occlusion import is_occluded
from deltalight.protocol.sky_lights import TrackedLight
from deltalight.render_server.lights.light_distance import fit_distance, paper_light
from deltalight.render_server.lights.lights import (
    AMBIENT_SIZE,
    DirectionalLight,
    Light,
    LightSet,
    SphereLight,
    build_lights,
    light_set,
)
from deltalight.render_server.lights.octahedral import above_horizon, irradiance

# Fraction of a lamp's radius that it must move to count as moved. Soft edges of its shadows are then off by a
# twentieth of their width, whereas noise of the marker's pose would make them tremble and cost a rebuild per frame.
STILL_FRACTION = 0.1
# Texels of 1.6 degrees, finer than glossy surfaces resolve; lights are not in it. Filtering it takes a third of the
# time of a map of mode `environment`, which never changes.
RESIDUAL_SIZE = 128
UP = np.array([[0.0, 0.0, 1.0]])


class LightSource(Protocol):
    """Lights that may change from frame to frame."""

    def update(self, frame: ViewFrame) -> LightSet | None:
        """Returns the unregistered lights of a frame; None where they did not change."""
        ...

    @property
    def split(self) -> Split[HemisphereMap] | None:
        """The latest split of a fish-eye picture, for the debug view."""
        ...

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user on what is missing or was found."""
        ...


class FixedLights:
    """Lights of modes `manual` and `environment`, which never change."""

    split: Split[HemisphereMap] | None = None
    remarks: tuple[str, ...] = ()

    def __init__(self, lights: documents.Lights) -> None:
        self._lights: LightSet | None = build_lights(lights)

    def update(self, frame: ViewFrame) -> LightSet | None:  # noqa: ARG002
        """Returns the lights for the first frame."""
        lights, self._lights = self._lights, None
        return lights


class TrackedSource:
    """Lights of mode `tracked`: lamps with a marker; a lamp out of sight keeps its last position."""

    def __init__(self, lights: documents.Lights) -> None:
        self._document = lights
        self._positions: dict[int, Float64[np.ndarray, " 3"]] = {}
        self._visible: set[int] = set()
        self._started = False
        self.split: Split[HemisphereMap] | None = None

    def update(self, frame: ViewFrame) -> LightSet | None:
        """Returns the unregistered lights of a frame; None where they did not change."""
        poses = {lamp.marker: lamp.world_from_marker for lamp in frame.lamps}
        self._visible = set(poses)
        changed = not self._started
        self._started = True
        for lamp in self._document.tracked:
            if lamp.marker in poses:
                position = (poses[lamp.marker] @ (*lamp.offset_m, 1.0))[:3]
                changed |= self._move(lamp, position)
        return self._lights() if changed else None

    def _move(self, lamp: documents.TrackedLamp, position: Float64[np.ndarray, "3"]) -> bool:
        last = self._positions.get(lamp.marker)
        if last is not None and np.linalg.norm(position - last) <= STILL_FRACTION * lamp.radius_m:
            return False
        self._positions[lamp.marker] = position
        return True

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user on lamps that are out of sight."""
        never_seen = [lamp.marker for lamp in self._document.tracked if lamp.marker not in self._positions]
        lost = [marker for marker in self._positions if marker not in self._visible]
        sentences = []
        if never_seen:
            sentences.append(
                f"No picture has shown the marker of {_lamps(never_seen)} yet, so no light comes from there: turn it "
                "to the camera, and see that board.yaml has it in lamp_markers."
            )
        if lost:
            sentences.append(
                f"The marker of {_lamps(lost)} is out of sight in some frames; there the light stays where it was."
            )
        return tuple(sentences)

    def _lights(self) -> LightSet:
        shown = [lamp for lamp in self._document.tracked if lamp.marker in self._positions]
        return light_set(
            self._document,
            tuple(_lamp_light(lamp, self._positions[lamp.marker]) for lamp in shown),
            np.zeros((AMBIENT_SIZE, AMBIENT_SIZE, 3), np.float32),
            1 - above_horizon(AMBIENT_SIZE),
            tuple(lamp.marker for lamp in shown),
        )


def _lamp_light(lamp: documents.TrackedLamp, position: Float64[np.ndarray, "3"]) -> SphereLight:
    color = np.array(lamp.color_linear, np.float32)
    return SphereLight(position.astype(np.float32), lamp.intensity * color, lamp.radius_m)


def _lamps(markers: list[int]) -> str:
    return f"lamp {markers[0]}" if len(markers) == 1 else f"lamps {', '.join(map(str, markers))}"


class FisheyeSource:
    """Lights of mode `fisheye`: a camera's radiance maps, split into lights and tracked over time."""

    def __init__(self, lights: documents.Lights) -> None:
        self._document = lights
        self._tracker = LightTracker(lights.fisheye.smoothing_s)
        self._map: RadianceMap | None = None
        self._sky: WorldSky | None = None
        self._distance_m: float | None = None
        self._wants_distance = lights.fisheye.distance_m == "auto"
        if isinstance(lights.fisheye.distance_m, float):
            self._distance_m = lights.fisheye.distance_m
        self.split: Split[HemisphereMap] | None = None

    def update(self, frame: ViewFrame) -> LightSet | None:
        """Returns the unregistered lights of a frame; None where they did not change.

        There are none until a frame brings the first map.
        """
        if frame.radiance_map is not None and frame.radiance_map is not self._map:
            self._map = frame.radiance_map
            self._split_map(frame, frame.radiance_map)
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
        if self._distance_m is None or self._document.fisheye.distance_m != "auto":
            return ()
        return (f"lights of the fish-eye picture: {self._distance_m:.2g} m away, as the board's paper tells",)

    def _split_map(self, frame: ViewFrame, seen: RadianceMap) -> None:
        settings = self._document.fisheye
        occlusion_test = None
        if frame.depth is not None and frame.pose is not None:
            position = seen.world_from_fisheye[:3, 3]
            occlusion_test = partial(is_occluded, frame.depth, frame.pose.world_from_camera, position)
        self.split = split_map(
            HemisphereMap.of(seen),
            settings.count,
            threshold=settings.threshold,
            whole_map=settings.split == "all",
            is_occluded=occlusion_test,
        )
        self._sky = to_world(self.split.residual, RESIDUAL_SIZE)
        self._tracker.set_target(frame.timestamp_ns, self.split.lights, self._sky.filled())
        self._find_distance(frame, seen)

    def _find_distance(self, frame: ViewFrame, seen: RadianceMap) -> bool:
        """Estimates the lights' distance on the first frame with enough paper; returns whether that succeeded."""
        assert self.split is not None
        assert self._tracker.residual is not None
        paper = paper_light(frame) if self._wants_distance and self.split.lights else None
        if paper is None:
            return False
        self._wants_distance = False
        ambient = irradiance(self._tracker.residual, UP)[0]
        position = seen.world_from_fisheye[:3, 3]
        self._distance_m = fit_distance(paper, position, self.split.lights, ambient)
        return self._distance_m is not None

    def _lights(self) -> LightSet:
        assert self._map is not None
        assert self._sky is not None
        assert self._tracker.residual is not None
        position, distance_m = self._map.world_from_fisheye[:3, 3], self._distance_m
        tracked = self._tracker.lights
        return light_set(
            self._document,
            tuple(
                _distant(light) if distance_m is None else _near(light, position, distance_m)
                for light in tracked
            ),
            self._tracker.residual,
            (1 - self._sky.seen) * (1 - above_horizon(RESIDUAL_SIZE)),
            tuple(light.identity for light in tracked),
        )


def _distant(light: TrackedLight) -> Light:
    return DirectionalLight(
        (-light.to_light).astype(np.float32), light.irradiance.astype(np.float32), light.angular_radius_rad
    )


def _near(light: TrackedLight, position: Float64[np.ndarray, "3"], distance_m: float) -> Light:
    """Returns a sphere with the same irradiance (E = I / d^2) and angular size at `position` as the distant light."""
    return SphereLight(
        (position + distance_m * light.to_light).astype(np.float32),
        (light.irradiance * distance_m**2).astype(np.float32),
        float(distance_m * np.sin(light.angular_radius_rad)),
    )


_NO_PICTURE = (
    "No fish-eye picture has come yet, so frames are passed through as the camera saw them: give the source one, "
    "or set lights.mode to manual."
)


def open_light_source(lights: documents.Lights) -> LightSource:
    """Returns the source of a scene document's lights.

    Raises:
        DeltalightError: an environment map that cannot be read.
    """
    match lights.mode:
        case "fisheye":
            return FisheyeSource(lights)
        case "tracked":
            return TrackedSource(lights)
        case _:
            return FixedLights(lights)
