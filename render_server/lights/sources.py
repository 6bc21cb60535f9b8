"""Sources of a scene document's lights over time: fixed, lamps with markers, or a fish-eye (docs/method.md 2)."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from jaxtyping import Float64

from deltalight.protocol import scene_lights as documents
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.light_cutter import LightCutter
from deltalight.protocol.scene_lights import LightCut
from deltalight.protocol.sky_lights import Region, SkyLights, TrackedLight
from deltalight.render_server.lights.light_distance import common_inverse
from deltalight.render_server.lights.light_models import DirectionalLight, Light, SphereLight
from deltalight.render_server.lights.lights import AMBIENT_SIZE, LightSet, build_lights, light_set
from deltalight.render_server.lights.octahedral import above_horizon
from deltalight.render_server.lights.paper_distance import paper_cue, paper_light
from deltalight.render_server.lights.shading_distance import Shading

# Fraction of a lamp's radius that it must move to count as moved. Soft edges of its shadows are then off by a
# twentieth of their width, whereas noise of the marker's pose would make them tremble and cost a rebuild per frame.
STILL_FRACTION = 0.1
PAPER = "the board's paper"


class LightSource(Protocol):
    """Lights that may change from frame to frame."""

    def update(self, frame: ViewFrame) -> LightSet | None:
        """Returns the unregistered lights of a frame; None where they did not change."""
        ...

    @property
    def regions(self) -> Sequence[Region]:
        """Regions into which the latest fish-eye picture was cut, for the debug view."""
        ...

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user on what is missing or was found."""
        ...


class FixedLights:
    """Lights of modes `manual` and `environment`, which never change."""

    regions: Sequence[Region] = ()
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
        self.regions: Sequence[Region] = ()

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
                f"No picture has shown the marker of {_lamps(never_seen)} yet, so it gives no light: turn it to "
                "the camera, and check that board.yaml lists it in lamp_markers."
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
    """Lights of mode `fisheye`: those that the sensor node sends, if it cuts its maps as the scene document asks.

    Else the maps are cut here, in the same way.
    """

    def __init__(self, lights: documents.Lights) -> None:
        self._document = lights
        self._cut = lights.fisheye.cut
        self._cutter = LightCutter(self._cut)
        self._sky: SkyLights | None = None
        self._remark: str | None = None
        self._found: tuple[str, ...] = ()  # sentence on the distances
        self._wants_distance = lights.fisheye.distance_m == "auto"
        given = lights.fisheye.distance_m
        self._inverse = 1 / given if isinstance(given, float) else 0.0  # of the lights' distance, 1/m
        self._own_inverses: dict[int, float] = {}  # by identity of the light, where they differ

    def update(self, frame: ViewFrame) -> LightSet | None:
        """Returns the unregistered lights of a frame; None where they did not change.

        There are none until a frame brings the first map.
        """
        changed = self._changed(frame)
        self._sky = changed or self._sky
        if self._sky is None:
            return None
        found = self._find_distance(frame, self._sky)
        return self._lights(self._sky) if changed is not None or found else None

    def _changed(self, frame: ViewFrame) -> SkyLights | None:
        """Returns the lights of a frame, None where they are those of the last one."""
        sent = frame.sky_lights
        if sent is None or sent.cut != self._cut:
            self._remark = None if sent is None else _cut_here(sent.cut, self._cut)
            return self._cutter.update(frame)
        self._remark = None
        return None if sent is self._sky else sent

    @property
    def regions(self) -> Sequence[Region]:
        """Regions into which the latest fish-eye picture was cut, for the debug view."""
        return () if self._sky is None else self._sky.regions

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user."""
        if self._sky is None:
            return (_NO_PICTURE,)
        remarks = () if self._remark is None else (self._remark,)
        return remarks + self._found

    def _find_distance(self, frame: ViewFrame, sky: SkyLights) -> bool:
        """Estimates the lights' distance on the first frame that can tell; returns whether that succeeded.

        All cues that say significantly that the lights are near are taken together: the falloff of light over the
        board's paper, and shading and shadows of all surfaces. A board may still come into view.
        """
        if not (self._wants_distance and sky.lights):
            return False
        paper = paper_light(frame)
        if paper is None and (frame.board is not None or frame.depth is None or frame.pose is None):
            return False
        self._wants_distance = False
        shading = Shading.of(frame, sky)
        cues = {
            PAPER: None if paper is None else paper_cue(paper, sky),
            "shading and shadows": None if shading is None else shading.cue,
        }
        near = {name: cue for name, cue in cues.items() if cue is not None and cue.tells_near}
        if not near:
            return False
        self._inverse = common_inverse([*near.values()])
        if shading is not None:
            self._own_inverses = shading.own_inverses()
        inverses = sorted({self._inverse_of(light) for light in sky.lights}, reverse=True)
        distances = ", ".join(f"{1 / inverse:.2g} m" if inverse else "far" for inverse in inverses)
        verb = "tells" if [*near] == [PAPER] else "tell"
        self._found = (f"lights of the fish-eye picture: {distances} away, as {', '.join(near)} {verb}",)
        return True

    def _inverse_of(self, light: TrackedLight) -> float:
        return self._own_inverses.get(light.identity, self._inverse)

    def _lights(self, sky: SkyLights) -> LightSet:
        position = sky.world_from_fisheye[:3, 3]
        found = light_set(
            self._document,
            tuple(_placed(light, position, self._inverse_of(light)) for light in sky.lights),
            sky.residual,
            (1 - sky.seen) * (1 - above_horizon(len(sky.residual))),
            tuple(light.identity for light in sky.lights),
        )
        return replace(found, environment_origin=position)


def _cut_here(sent: LightCut, wanted: LightCut) -> str:
    """Returns the sentence on lights that a node cut in another way than the scene asks for."""
    asked = ", ".join(
        f"{name} = {json.dumps(value)}" for name, value in wanted if value != getattr(sent, name)
    )
    return (
        f"The scene asks for other lights than the sensor node cuts, so they are cut here; set {asked} in "
        "[node.lights] of its configuration to share them."
    )


def _placed(light: TrackedLight, position: Float64[np.ndarray, "3"], inverse: float) -> Light:
    """Returns a sphere with the same irradiance (E = I / d^2) and angular size at `position` as the distant light.

    At an inverse distance of 0 it is a distant light.
    """
    irradiance = light.irradiance.astype(np.float32)
    if inverse == 0:
        return DirectionalLight((-light.to_light).astype(np.float32), irradiance, light.angular_radius_rad)
    return SphereLight(
        (position + light.to_light / inverse).astype(np.float32),
        irradiance / np.float32(inverse**2),
        float(np.sin(light.angular_radius_rad) / inverse),
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
