"""Samples of the light that falls on real surfaces, next to what the camera measured there; when to measure again."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float16, Float32, Float64, Int64, UInt8

from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.render_server.frame import ObjectSurface, Observation
from deltalight.render_server.frame_graph import FrameGraph
from deltalight.render_server.gpu.textures import read_texels
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.scene.albedo import known_albedo, unclipped

UNSHADOWED = 0.95  # fraction of its direct light that a pixel gets, from which on it counts as unshadowed

Gathered = Float16[np.ndarray, "h w 4"]
"""Irradiance that cones gather at each texel of the reduced grid; a: 1 where they were traced."""


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """What the camera sees of the real scene, by pixel: position (world, m; w = 0 where it is unknown) and normal."""

    position: Float32[np.ndarray, "n 4"]
    normal: Float16[np.ndarray, "n 4"]

    @classmethod
    def of(cls, seen: Observation) -> "SeenSurface":
        """Reads it back."""
        return cls(
            *(read_texels(each).reshape(-1, 4) for each in (seen.surface.position, seen.surface.normal))
        )


def seen_surface(graph: FrameGraph) -> SeenSurface:
    """Returns what the camera sees, read back once while nothing moves."""
    return graph.kept(SeenSurface.of, graph.resources.observation)


def decoded(frame: ViewFrame, codes: UInt8[np.ndarray, "n m 3"]) -> Float32[np.ndarray, "n m 3"]:
    """Returns codes of a frame's camera in linear units, before division by the exposure."""
    if not codes.size:
        return np.zeros(codes.shape, np.float32)
    return np.asarray(cv2.LUT(codes, decode_lut(frame.response)[None]))


@dataclass(frozen=True, eq=False)
class LitPicture:
    """A picture and the light that falls on what it shows: `direct` by pixel, the rest by texel of the reduced grid.

    `bounce`: the part of `cones` that comes from real surfaces.
    """

    frame: ViewFrame
    surface: SeenSurface
    direct: Float16[np.ndarray, "n 4"]
    cones: Gathered
    bounce: Gathered | None
    scale: int

    @cached_property
    def usable(self) -> Bool[np.ndarray, " n"]:
        """Which pixels carry their true radiance."""
        color = self.frame.color
        return unclipped(color, decoded(self.frame, color)).ravel()

    @cached_property
    def albedo(self) -> Float32[np.ndarray, " n"]:
        """The albedo of each pixel where it is known, else 0."""
        frame = self.frame
        if frame.board is None or frame.pose is None:
            return np.zeros(len(self.direct), np.float32)
        return known_albedo(frame.board, frame.camera, frame.pose).ravel()


@dataclass(frozen=True, eq=False)
class LightSamples:
    """Samples at pixels that show real surfaces: what falls on them is looked up when it is asked for.

    `pixel` counts row by row. Positions are in world metres, the rest is linear RGB.
    """

    picture: LitPicture
    pixel: Int64[np.ndarray, " k"]

    def of(self, chosen: Bool[np.ndarray, " k"] | Int64[np.ndarray, " n"]) -> "LightSamples":
        """Returns some of the samples."""
        return LightSamples(self.picture, self.pixel[chosen])

    @property
    def usable(self) -> Bool[np.ndarray, " k"]:
        """Which samples carry their true radiance."""
        return np.asarray(self.picture.usable[self.pixel])

    @property
    def albedo(self) -> Float32[np.ndarray, " k"]:
        """Where it is known, else 0."""
        return np.asarray(self.picture.albedo[self.pixel])

    @property
    def position(self) -> Float64[np.ndarray, "k 3"]:
        """Places of the surfaces."""
        return self.picture.surface.position[self.pixel, :3].astype(np.float64)

    @property
    def normal(self) -> Float64[np.ndarray, "k 3"]:
        """Normals of the surfaces."""
        return self.picture.surface.normal[self.pixel, :3].astype(np.float64)

    @property
    def measured(self) -> Float32[np.ndarray, "k 3"]:
        """Radiance that the camera measured."""
        frame = self.picture.frame
        coded = decoded(frame, frame.color.reshape(-1, 1, 3)[self.pixel])[:, 0]
        return np.asarray(coded / frame.exposure_scale)

    @property
    def direct(self) -> Float64[np.ndarray, "k 3"]:
        """Irradiance of the lights."""
        return self.picture.direct[self.pixel, :3].astype(np.float64)

    @property
    def lit(self) -> Float64[np.ndarray, " k"]:
        """Fraction of the unshadowed direct light."""
        own = self.picture.direct[self.pixel].astype(np.float64)
        whole = own[:, 3]
        part = np.divide(own[:, :3].mean(axis=1), whole, out=np.ones(len(own)), where=whole > 0)
        return np.asarray(part)

    @property
    def unshadowed(self) -> Bool[np.ndarray, " k"]:
        """Which samples receive nearly all of their direct light."""
        return np.asarray(self.lit >= UNSHADOWED)

    @property
    def bounce(self) -> Float64[np.ndarray, "k 3"]:
        """Irradiance that comes from real surfaces; 0 where it is attributed to the lights."""
        bounce = self.picture.bounce
        return np.zeros((len(self.pixel), 3)) if bounce is None else self._of_texels(bounce)

    @property
    def light(self) -> Float64[np.ndarray, "k 3"]:
        """Irradiance of lights and environment."""
        return np.asarray(self.direct + self._of_texels(self.picture.cones) - self.bounce)

    def gather(self, graph: FrameGraph, lights: LightSet) -> Float64[np.ndarray, "k 3"]:
        """Returns the irradiance that cones gather at the samples under other lights."""
        scale = graph.layers.grid.value.scale
        pixel = np.stack(self._places, axis=1)
        low, high = pixel.min(axis=0) - 2 * scale, pixel.max(axis=0) + 2 * scale  # a filter's reach
        found = read_texels(graph.gather(lights, (*low.tolist(), *(high - low).tolist())).mu)
        return self._of_texels(found)

    @property
    def _places(self) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]]:
        """Columns and rows."""
        row, column = np.divmod(self.pixel, self.picture.frame.color.shape[1])
        return column, row

    def _of_texels(self, gathered: Gathered) -> Float64[np.ndarray, "k 3"]:
        """Looks up what was gathered; a pixel's cones are those of its texel of the grid."""
        column, row = (each // self.picture.scale for each in self._places)
        return gathered[row, column, :3].astype(np.float64)


def bounced_light(graph: FrameGraph, lights: LightSet) -> Gathered:
    """Returns the irradiance that cones gather from real surfaces alone, traced under a black environment."""
    black = replace(lights, environment=np.zeros_like(lights.environment))
    return read_texels(graph.gather(black, (0, 0, *graph.inputs.view.size)).mu)


def sample_light(graph: FrameGraph, lights: LightSet, bounce: Gathered | None) -> LightSamples:
    """Reads the fields back where the real scene is visible.

    Without `bounce`, all light that the cones gather is attributed to the lights.
    """
    fields, resources, frame = graph.evaluate(lights), graph.resources, graph.inputs.frame
    shown = graph.kept(_shown, resources.observation, resources.object_surface)
    surface, scale = seen_surface(graph), fields.grid.scale
    cones, direct = read_texels(fields.cones.mu), read_texels(fields.direct.light.mu)
    rows, columns = (np.arange(n) // scale for n in shown.shape)
    traced = (cones[..., 3] > 0)[np.ix_(rows, columns)]
    picture = LitPicture(frame, surface, direct.reshape(-1, 4), cones, bounce, scale)
    return LightSamples(picture, np.flatnonzero(shown & traced))


def _shown(seen: Observation, objects: ObjectSurface) -> Bool[np.ndarray, "h w"]:
    """Returns which pixels show real surfaces at known places, and nothing of an object."""
    known = read_texels(seen.surface.position)[..., 3] > 0
    return np.asarray(known & ~(read_texels(objects.coverage.texture)[..., 0] > 0))


FIRST_WAIT_S = 1.0
MAX_WAIT_S = 30.0


class BackoffSchedule:
    """Due immediately, then after intervals that double from 1 to 30 s of the frames' own time.

    An average over time converges soon; keeping it up to date then costs almost nothing.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._wait_s = FIRST_WAIT_S

    def is_due(self, timestamp_ns: int) -> bool:
        """Whether a measurement is due; if so, starts the next interval. Restarts if the clock is set back."""
        if self._last_ns is None:
            self._last_ns = timestamp_ns
            return True
        self._last_ns = min(self._last_ns, timestamp_ns)
        if timestamp_ns - self._last_ns < self._wait_s * 1e9:
            return False
        self._last_ns, self._wait_s = timestamp_ns, min(2 * self._wait_s, MAX_WAIT_S)
        return True
