"""The lights of one scene document across frames: tracked, and completed by estimates from the picture."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float32, UInt8

from deltalight.protocol import scene_lights as documents
from deltalight.protocol.frames import ViewFrame
from deltalight.render_server.debug_view import draw_lights
from deltalight.render_server.estimation.parallax import EnvironmentParallax, find_parallax
from deltalight.render_server.estimation.plane_extrapolation import ExtrapolatedPlanes
from deltalight.render_server.estimation.registration import RegistrationAverage, register_lights
from deltalight.render_server.estimation.samples import (
    BackoffSchedule,
    LightSamples,
    bounced_light,
    sample_light,
)
from deltalight.render_server.estimation.unseen_environment import (
    find_extrapolated_planes,
    find_unseen_light,
    ground_radiance,
    unseen_light_shape,
)
from deltalight.render_server.frame_graph import FrameGraph
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.lights.sources import open_light_source

Rgb = Float32[np.ndarray, "3"]


class LightEstimator:
    """Lights in camera units: `lights`, a new object whenever any of them changes.

    Registration, ground and unseen environment are estimated from the first usable frame, and apply to all lights
    that the source delivers afterwards. The registration is a running mean over later frames, measured with
    exponential back-off. `notify` receives sentences for the user. `before`: the estimator of other lights, whose
    unseen environment is assumed until the scene rests, where pictures must be quick. `waits`: the first picture
    waits for the search for light out of sight, which takes longer than the picture; otherwise the second has it.

    Raises:
        DeltalightError: an environment map cannot be read.
    """

    def __init__(
        self,
        settings: documents.Lights,
        notify: Callable[[str], None],
        before: "LightEstimator | None" = None,
        *,
        waits: bool = True,
    ) -> None:
        self._source = open_light_source(settings)
        self._notify = notify
        self._has_tracked_lamps = settings.mode == "tracked"
        self._wants_registration = settings.resolved_registration == "auto"
        self._guesses_balance = settings.mode in ("fisheye", "environment")
        given = settings.mode in ("manual", "tracked") and not self._wants_registration
        self._wants_unseen = given and settings.surroundings == "auto"
        self._wants_ground = self._wants_unseen or settings.mode == "fisheye"
        self._postpones = self._wants_ground and not waits
        self.is_provisional = False  # of the newest lights: the search was postponed
        self._raw: LightSet | None = None
        self._reset()
        if before is not None and self._wants_unseen and before.has_unseen:
            self._assume(before)
        self.lights: LightSet | None = None

    @property
    def has_unseen(self) -> bool:
        """Whether it has estimated the unseen environment, or assumes another's estimate."""
        return self._wants_unseen and (self._is_complete or self._is_assumed)

    def _reset(self) -> None:
        """Resets all estimates."""
        self._is_complete = self._is_assumed = False
        self._average, self._schedule = RegistrationAverage(), BackoffSchedule()
        self._factor: Rgb | None = None
        self._ground: Rgb | None = None
        self._parallax: EnvironmentParallax | None = None
        self._walls: ExtrapolatedPlanes | None = None
        self._sky: tuple[Rgb, Float32[np.ndarray, "n n 1"]] | None = None

    def _assume(self, before: "LightEstimator") -> None:
        self._ground, self._walls, self._sky = before._ground, before._walls, before._sky
        self._is_assumed = True

    def update(self, frame: ViewFrame) -> bool:
        """Updates the lights from a frame; returns whether there are any yet."""
        raw = self._source.update(frame)
        for sentence in self._source.remarks:
            self._notify(sentence)
        if raw is not None:
            if self._has_tracked_lamps and self._raw is not None and raw.identities != self._raw.identities:
                self._reset()  # another set of lamps explains other light
            self._raw = raw
            self._apply()
        return self.lights is not None

    def _apply(self) -> LightSet:
        """Applies the estimates to the source's lights."""
        assert self._raw is not None
        lights = self._raw.registered(self._factor)
        if self._parallax is not None:
            lights = replace(lights, environment=self._parallax.applied(lights.environment))
        if self._ground is not None:
            lights = lights.with_ground(self._ground)
        if self._walls is not None:
            # Where a wall ends, the fish-eye camera shows; of what is below its horizon it shows nothing.
            hidden = 1 if self._wants_unseen else lights.ground_fraction
            lights = lights.with_surfaces(self._walls.radiance, hidden * self._walls.probability)
        if self._sky is not None:
            lights = lights.with_sky(*self._sky)
        self.lights = lights
        return lights

    def estimate(self, graph: FrameGraph, *, moved: bool, is_at_rest: bool) -> LightSet:
        """Returns the lights in camera units, with all estimates that the picture allows.

        Evaluates the graph under trial lights. It measures again only if the real scene or the camera has `moved`, so
        that pictures of a scene at rest do not change. What is assumed is measured once all `is_at_rest`.
        """
        assert self._raw is not None
        assert self.lights is not None
        if self._is_assumed:
            if not is_at_rest:
                return self.lights
            self._reset()
            self._apply()
        shines = bool(self._raw.lights) or bool(self._raw.environment.any())
        if self._has_tracked_lamps and not shines:
            return self.lights
        due = self._wants_registration and (moved or self._factor is None)
        if due and self._schedule.is_due(graph.inputs.frame.timestamp_ns):
            self._register(graph, self._raw)
        elif self._is_complete and not self._fisheye_moved():
            return self.lights
        if not self._is_complete:
            self.is_provisional, self._postpones = self._postpones, False
            self._is_complete = not self.is_provisional
            if self._wants_ground and self._ground is None:
                self._ground = ground_radiance(graph)
            if self._wants_ground and self._is_complete:
                self._find_unseen(graph, self._raw.registered(self._factor))
        if self._raw.environment_origin is not None:
            size = len(self._raw.environment)
            self._parallax = find_parallax(graph, self._raw.environment_origin, size)
        return self._apply()

    def _fisheye_moved(self) -> bool:
        """Whether the environment was measured elsewhere than the parallax was found for."""
        assert self._raw is not None
        origin = self._raw.environment_origin
        return origin is not None and not (self._parallax is not None and self._parallax.holds_for(origin))

    def picture(self, frame: ViewFrame) -> UInt8[np.ndarray, "h w 3"]:
        """Draws the lights (view `lights`), once there are any."""
        assert self.lights is not None
        return draw_lights(frame, self.lights, self._source.regions)

    def _register(self, graph: FrameGraph, raw: LightSet) -> None:
        """Registers the lights on this frame and averages the result with earlier ones."""
        found = register_lights(graph, raw, self._factor, guesses_balance=self._guesses_balance)
        if self._factor is None:
            factor = ", ".join(f"{value:.3g}" for value in found.factor)
            fit = "" if found.residual is None else f", residual {100 * found.residual:.1f} %"
            self._notify(f"lights registered by {found.source}: factor ({factor}){fit}")
        if found.warning is not None:
            self._notify(found.warning)
        self._factor = self._average.add(found)

    def _find_unseen(self, graph: FrameGraph, lights: LightSet) -> None:
        """Estimates the light from out of view, as this frame shows it."""
        if self._ground is not None:
            lights = lights.with_ground(self._ground)
        known = sample_light(graph, lights, bounced_light(graph, lights))
        self._walls = find_extrapolated_planes(graph, lights, known)
        if self._wants_unseen:
            self._find_sky(graph, lights, known, self._walls)

    def _find_sky(
        self, graph: FrameGraph, lights: LightSet, known: LightSamples, walls: ExtrapolatedPlanes
    ) -> None:
        """Estimates the light that comes past the walls. `known` are samples under `lights`."""
        shape = unseen_light_shape(graph, len(lights.environment)) * (1 - walls.probability)
        lights = lights.with_surfaces(walls.radiance, walls.probability)
        found = find_unseen_light(graph, lights, shape, known)
        if found is not None:
            self._sky = (found, shape)
            radiance = ", ".join(f"{value:.3g}" for value in found)
            self._notify(
                f"surroundings out of sight: radiance up to ({radiance}), found on the board's paper"
            )
