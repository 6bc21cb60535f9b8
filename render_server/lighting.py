"""The lights of one scene document from frame to frame: followed, then completed from what the picture shows."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float32, UInt8

from protocol import scene_lights as documents
from protocol.frames import ViewFrame
from render_server.debug_view import draw_lights
from render_server.estimation.backoff_schedule import BackoffSchedule
from render_server.estimation.plane_extrapolation import ExtrapolatedPlanes
from render_server.estimation.registration_fit import RegistrationAverage
from render_server.light_registration import register_lights
from render_server.light_samples import Relight, bounced_light
from render_server.lights.lights import LightSet
from render_server.lights.sources import open_light_source
from render_server.relight.frame import RelightInput
from render_server.surroundings import (
    find_continued_planes,
    find_surroundings,
    ground_radiance,
    surroundings_shape,
)

Rgb = Float32[np.ndarray, "3"]
VERSION_STEP = 8
"""Versions between two light sets; while something is found from the picture, those between number trial sets."""


class Lighting:
    """Lights in camera units, and a number that changes with them.

    Factor, ground and surroundings are found from the first frame that can tell, and hold for all lights that the
    source brings from then on; the factor is the mean of what later frames tell, after growing intervals.
    `versions` counts in steps of VERSION_STEP; `say` takes sentences for the user.

    Raises:
        DeltalightError: an environment map that cannot be read.
    """

    def __init__(self, wished: documents.Lights, versions: Iterator[int], say: Callable[[str], None]) -> None:
        self._source = open_light_source(wished)
        self._versions, self._say = versions, say
        self._follows_lamps = wished.mode == "tracked"
        self._wants_registration = wished.resolved_registration == "auto"
        given = wished.mode in ("manual", "tracked") and not self._wants_registration
        self._wants_surroundings = given and wished.surroundings == "auto"
        self._wants_ground = self._wants_surroundings or wished.mode == "fisheye"
        self._raw: LightSet | None = None
        self._forget()
        self.lights: LightSet | None = None
        self.version = 0

    def _forget(self) -> None:
        """Find everything anew."""
        self._is_complete = False
        self._average, self._interval = RegistrationAverage(), BackoffSchedule()
        self._factor: Rgb | None = None
        self._ground: Rgb | None = None
        self._walls: ExtrapolatedPlanes | None = None
        self._sky: tuple[Rgb, Float32[np.ndarray, "n n 1"]] | None = None

    def follow(self, frame: ViewFrame) -> bool:
        """Take over a frame's lights; returns whether there are any lights yet."""
        raw = self._source.update(frame)
        for sentence in self._source.remarks:
            self._say(sentence)
        if raw is not None:
            if self._follows_lamps and self._raw is not None and raw.identities != self._raw.identities:
                self._forget()  # another lamp explains more of what is seen
            self._raw = raw
            self._finish()
        return self.lights is not None

    def _finish(self) -> None:
        """Apply to the source's lights what was found."""
        assert self._raw is not None
        lights = self._raw.registered(self._factor)
        if self._ground is not None:
            lights = lights.with_ground(self._ground)
        if self._walls is not None:
            lights = lights.with_surfaces(self._walls.radiance, self._walls.probability)
        if self._sky is not None:
            lights = lights.with_sky(*self._sky)
        self.lights, self.version = lights, next(self._versions)

    def complete(
        self, frame: ViewFrame, scene: RelightInput, relight: Relight, *, moved: bool
    ) -> RelightInput:
        """Return the input with lights in camera units, all found that a picture can tell.

        Frames are measured again only where the real scene or the camera has `moved`, so that still pictures stay.
        """
        assert self._raw is not None
        shines = bool(self._raw.lights) or bool(self._raw.environment.any())
        if self._follows_lamps and not shines:
            return scene
        if self._is_complete:
            return self._measured_again(frame, scene, relight) if moved else scene
        self._is_complete = True
        if self._wants_registration and self._interval.is_due(frame.timestamp_ns):
            self._register(frame, replace(scene, lights=self._raw), relight)
        if self._wants_ground:
            self._ground = ground_radiance(frame, scene)
        if self._wants_surroundings:
            self._find_surroundings(frame, scene, relight)
        return self._finished(scene)

    def _measured_again(self, frame: ViewFrame, scene: RelightInput, relight: Relight) -> RelightInput:
        """Average the factor over one more frame, if it is time."""
        assert self._raw is not None
        if not self._wants_registration or not self._interval.is_due(frame.timestamp_ns):
            return scene
        trial = self.version + VERSION_STEP // 2
        self._register(frame, replace(scene, lights=self._raw, lights_version=trial), relight)
        return self._finished(scene)

    def _finished(self, scene: RelightInput) -> RelightInput:
        self._finish()
        assert self.lights is not None
        return replace(scene, lights=self.lights, lights_version=self.version)

    def renewed(self, scene: RelightInput) -> RelightInput:
        """Return the input under a new number: what the lights fall on is not what it was."""
        self.version = next(self._versions)
        return replace(scene, lights_version=self.version)

    def picture(self, frame: ViewFrame) -> UInt8[np.ndarray, "h w 3"]:
        """Draw the lights (view `lights`), once there are any."""
        assert self.lights is not None
        return draw_lights(frame, self.lights, self._source.split)

    def _register(self, frame: ViewFrame, scene: RelightInput, relight: Relight) -> None:
        """Find the lights' factor from this frame and average it with those before."""
        found = register_lights(frame, scene, relight)
        if self._factor is None:
            factor = ", ".join(f"{value:.3g}" for value in found.factor)
            fit = "" if found.residual is None else f", residual {100 * found.residual:.1f} %"
            self._say(f"lights registered by {found.source}: factor ({factor}){fit}")
        if found.warning is not None:
            self._say(found.warning)
        self._factor = self._average.add(found)

    def _find_surroundings(self, frame: ViewFrame, scene: RelightInput, relight: Relight) -> None:
        """Find the light of what is out of sight, as this frame shows it."""
        trial = self.version + VERSION_STEP // 2
        lights = scene.lights if self._ground is None else scene.lights.with_ground(self._ground)
        scene = replace(scene, lights=lights, lights_version=trial)
        bounce = bounced_light(scene, relight)
        walls = self._walls = find_continued_planes(frame, scene, bounce, relight)
        shape = surroundings_shape(frame, scene) * (1 - walls.probability)
        lights = lights.with_surfaces(walls.radiance, walls.probability)
        scene = replace(scene, lights=lights, lights_version=trial + 2)
        found = find_surroundings(frame, scene, shape, bounce, relight)
        if found is not None:
            self._sky = (found, shape)
            radiance = ", ".join(f"{value:.3g}" for value in found)
            self._say(f"surroundings out of sight: radiance up to ({radiance}), found on the board's paper")
