"""Samples of the light that falls on real surfaces, next to what the camera measured there; when to measure again."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from deltalight.protocol.frames import decode_lut
from deltalight.render_server.frame_graph import FrameGraph
from deltalight.render_server.gpu.textures import read_texture
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.scene.albedo import known_albedo, unclipped

UNSHADOWED = 0.95  # fraction of its direct light that a pixel gets, from which on it counts as unshadowed

Gathered = Float64[np.ndarray, "h w 3"]
"""Irradiance that cones gather at each texel of the reduced grid."""


@dataclass(frozen=True, eq=False)
class LightSamples:
    """Samples at pixels that show real surfaces; positions in world metres, the rest linear RGB."""

    position: Float64[np.ndarray, "k 3"]
    measured: Float64[np.ndarray, "k 3"]
    direct: Float64[np.ndarray, "k 3"]
    light: Float64[np.ndarray, "k 3"]
    bounce: Float64[np.ndarray, "k 3"]
    usable: Bool[np.ndarray, " k"]
    albedo: Float32[np.ndarray, " k"]  # where it is known, else 0
    lit: Float64[np.ndarray, " k"]  # fraction of the unshadowed direct light
    pixel: Int64[np.ndarray, "k 2"]  # column, row

    @property
    def unshadowed(self) -> Bool[np.ndarray, " k"]:
        """Which samples receive nearly all of their direct light."""
        return np.asarray(self.lit >= UNSHADOWED)

    def of(self, chosen: Bool[np.ndarray, " k"]) -> "LightSamples":
        """Returns some of the samples."""
        return LightSamples(**{name: values[chosen] for name, values in vars(self).items()})

    def gather(self, graph: FrameGraph, lights: LightSet) -> Float64[np.ndarray, "k 3"]:
        """Returns the irradiance that cones gather at the samples under other lights."""
        scale = graph.layers.grid.value.scale
        low, high = self.pixel.min(axis=0) - 2 * scale, self.pixel.max(axis=0) + 2 * scale  # a filter's reach
        found = read_texture(graph.gather(lights, (*low.tolist(), *(high - low).tolist())).mu)
        column, row = (self.pixel // scale).T
        return found[row, column, :3]


def bounced_light(graph: FrameGraph, lights: LightSet) -> Gathered:
    """Returns the irradiance that cones gather from real surfaces alone, traced under a black environment."""
    black = replace(lights, environment=np.zeros_like(lights.environment))
    return read_texture(graph.gather(black, (0, 0, *graph.inputs.view.size)).mu)[..., :3]


def sample_light(graph: FrameGraph, lights: LightSet, bounce: Gathered | None) -> LightSamples:
    """Reads the fields back where the real scene is visible; a pixel's cones are those of its texel of the grid.

    Without `bounce`, all light that the cones gather is attributed to the lights.
    """
    fields, shown, frame = graph.evaluate(lights), graph.shown(), graph.inputs.frame
    cones, direct = read_texture(fields.cones.mu), read_texture(fields.direct.light.mu)
    rows, columns = (np.arange(n) // fields.grid.scale for n in direct.shape[:2])
    position = read_texture(shown.real_surface.position)
    known = position[..., 3] > 0
    covered = read_texture(shown.object_coverage)[..., 0] > 0
    y, x = np.nonzero(known & ~covered & (cones[np.ix_(rows, columns)][..., 3] > 0))
    coded = decode_lut(frame.response)[frame.color, np.arange(3)]
    own = direct[y, x]
    lit = np.divide(own[:, :3].mean(axis=1), own[:, 3], out=np.ones(len(own)), where=own[:, 3] > 0)
    reflected = np.zeros((len(y), 3)) if bounce is None else bounce[rows[y], columns[x]]
    albedo = np.zeros(known.shape, np.float32)
    if frame.board is not None and frame.pose is not None:
        albedo = known_albedo(frame.board, frame.camera, frame.pose)
    return LightSamples(
        position[y, x, :3],
        (coded / frame.exposure_scale)[y, x],
        own[:, :3],
        own[:, :3] + cones[rows[y], columns[x]][:, :3] - reflected,
        reflected,
        unclipped(frame.color, coded)[y, x],
        albedo[y, x],
        lit,
        np.stack([x, y], axis=1),
    )


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
