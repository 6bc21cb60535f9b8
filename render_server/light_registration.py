"""Light that has to be found from the picture: the lights' factor (METHOD 1), and what is out of sight."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import moderngl
import numpy as np
from jaxtyping import Bool, Float32, Float64

from protocol.frames import ViewFrame, decode_lut
from render_server.passes.composite import RelitLayers
from render_server.relight.frame import RelightInput
from render_server.scene.albedo_memory import AlbedoMemory
from render_server.scene.environment import LUMINANCE
from render_server.scene.known_surfaces import known_albedo
from render_server.scene.octahedral import irradiance, octahedral_uv, resample_to_octahedral
from render_server.scene.registration import (
    Registration,
    registration_from_albedo_percentile,
    registration_from_patch,
    surroundings_from_patch,
    unclipped,
)

UNSHADOWED = 0.95  # share of its direct light that a pixel gets, from which on it counts as unshadowed

GROUND_SIZES = 2.0
FACES_UP = 0.7  # cosine to the vertical

Relight = Callable[[RelightInput], RelitLayers]


@dataclass(frozen=True, eq=False)
class _Samples:
    """What is known at pixels that show real surfaces; positions in world metres, the rest linear RGB."""

    position: Float64[np.ndarray, "k 3"]
    measured: Float64[np.ndarray, "k 3"]
    direct: Float64[np.ndarray, "k 3"]
    light: Float64[np.ndarray, "k 3"]
    bounce: Float64[np.ndarray, "k 3"]
    usable: Bool[np.ndarray, " k"]
    unshadowed: Bool[np.ndarray, " k"]
    albedo: Float32[np.ndarray, " k"]  # where it is known, else 0


def register_lights(frame: ViewFrame, scene: RelightInput, relight: Relight) -> Registration:
    """Factor R G B on all lights: from white paper and grey cards, else from the brightest albedo.

    `scene.lights` are not registered yet. The light that other real surfaces throw is in camera units already (it
    is measured), so the cones are traced twice: with the environment and without.
    """
    samples = _samples(frame, scene, _bounce(scene, relight), relight)
    known = samples.usable & (samples.albedo > 0)
    found = registration_from_patch(
        samples.measured[known], samples.light[known], samples.bounce[known], samples.albedo[known]
    )
    if found is not None:
        return found
    lit = samples.usable & samples.unshadowed
    return registration_from_albedo_percentile(samples.measured[lit], samples.light[lit], samples.bounce[lit])


def find_surroundings(
    frame: ViewFrame, scene: RelightInput, shape: Float32[np.ndarray, "n n 1"], relight: Relight
) -> Float32[np.ndarray, "3"] | None:
    """Radiance, times `shape`, of what neither the camera nor the lights show; None if the paper cannot tell.

    Walls beside and behind the camera reflect light too. On paper of known albedo the irradiance is known from the
    picture; what the lights and the visible scene leave unexplained comes from there.
    """
    board = frame.board
    if board is None or (board.white_albedo is None and not board.grey_cards):
        return None
    black = replace(scene.lights, environment=np.zeros_like(scene.lights.environment))
    one = black.with_sky(np.ones(3, np.float32), shape)
    bounce = _bounce(scene, relight)
    known = _samples(frame, scene, bounce, relight)
    even = _samples(
        frame, replace(scene, lights=one, lights_version=scene.lights_version + 2), bounce, relight
    )
    paper = known.usable & (known.albedo > 0)
    total, per_radiance = known.light + known.bounce, even.light - known.direct
    return surroundings_from_patch(
        known.measured[paper], total[paper], per_radiance[paper], known.albedo[paper]
    )


def observe_albedo(frame: ViewFrame, scene: RelightInput, memory: AlbedoMemory, relight: Relight) -> None:
    """Add what this frame shows of the real surfaces' albedo; `scene.lights` are registered."""
    samples = _samples(frame, scene, None, relight)
    lit = samples.usable & samples.unshadowed
    memory.observe(scene.real.bounds, samples.position[lit], samples.measured[lit], samples.light[lit])


def ground_radiance(frame: ViewFrame, scene: RelightInput) -> Float32[np.ndarray, "3"] | None:
    """Mean radiance of the ground around the objects: of what faces up within two object sizes (METHOD 2)."""
    position = _read(scene.real_surface.position)
    normal = _read(scene.real_surface.normal)
    low, high = scene.virtual.bounds
    away = np.linalg.norm(position[..., :3] - (low + high) / 2, axis=-1)
    near = (position[..., 3] > 0) & (away <= GROUND_SIZES * float(np.max(high - low)))
    ground = near & (normal[..., 2] > FACES_UP)
    if not ground.any():
        return None
    coded = decode_lut(frame.response)[frame.color[ground], np.arange(3)]
    return np.asarray(coded.mean(axis=0) / frame.exposure_scale, np.float32)


def surroundings_shape(frame: ViewFrame, scene: RelightInput) -> Float32[np.ndarray, "n n 1"]:
    """How the light of what is out of sight is spread over an octahedral map: 1 in its strongest direction.

    Unseen walls adjoin seen ones, so it is the light that the seen surfaces above the horizon, as the objects see
    them, would throw on a surface facing each direction: as smooth as irradiance. Even where none is seen.
    """
    size = len(scene.lights.environment)
    position = _read(scene.real_surface.position)
    low, high = scene.virtual.bounds
    way = position[..., :3] - (low + high) / 2
    seen = (position[..., 3] > 0) & (way[..., 2] > 0)
    luminance = decode_lut(frame.response)[frame.color[seen], np.arange(3)] @ LUMINANCE
    texel = np.minimum((octahedral_uv(way[seen]) * size).astype(int), size - 1)
    flat = texel[:, 1] * size + texel[:, 0]
    count = np.bincount(flat, minlength=size * size)
    mean = np.bincount(flat, luminance, size * size) / np.maximum(count, 1)
    seen_radiance = np.repeat(mean.reshape(size, size, 1), 3, axis=2).astype(np.float32)

    def thrown(direction: Float32[np.ndarray, "n m 3"]) -> Float32[np.ndarray, "n m 1"]:
        light = irradiance(seen_radiance, direction.reshape(-1, 3))[:, 0]
        return np.asarray(light.reshape(*direction.shape[:2], 1), np.float32)

    shape = resample_to_octahedral(thrown, size, supersampling=1)
    return shape / shape.max() if shape.max() > 0 else np.ones_like(shape)


def _bounce(scene: RelightInput, relight: Relight) -> Float64[np.ndarray, "h w 3"]:
    """What the cones gather from real surfaces alone: traced under a black environment."""
    black = replace(scene.lights, environment=np.zeros_like(scene.lights.environment))
    layers = relight(replace(scene, lights=black, lights_version=scene.lights_version + 1, everywhere=True))
    return _read(layers.cones.mu)[..., :3]


def _samples(
    frame: ViewFrame, scene: RelightInput, bounce: Float64[np.ndarray, "h w 3"] | None, relight: Relight
) -> _Samples:
    """Read the fields back where the real scene is in view; cones are those of the pixel's texel of the grid.

    Without `bounce` all light that the cones gather counts as the lights'.
    """
    layers = relight(replace(scene, everywhere=True))
    cones, direct = _read(layers.cones.mu), _read(layers.direct.mu)
    rows, columns = (np.arange(n) // layers.grid.scale for n in direct.shape[:2])
    position = _read(scene.real_surface.position)
    known = position[..., 3] > 0
    shown = known & (_read(scene.matte)[..., 0] == 0) & (cones[np.ix_(rows, columns)][..., 3] > 0)
    y, x = np.nonzero(shown)
    coded = decode_lut(frame.response)[frame.color, np.arange(3)]
    own = direct[y, x]
    reflected = np.zeros((len(y), 3)) if bounce is None else bounce[rows[y], columns[x]]
    albedo = np.zeros(known.shape, np.float32)
    if frame.board is not None and frame.pose is not None:
        albedo = known_albedo(frame.board, frame.camera, frame.pose)
    return _Samples(
        position[y, x, :3],
        (coded / frame.exposure_scale)[y, x],
        own[:, :3],
        own[:, :3] + cones[rows[y], columns[x]][:, :3] - reflected,
        reflected,
        unclipped(frame.color, coded)[y, x],
        own[:, :3].mean(axis=1) >= UNSHADOWED * own[:, 3],
        albedo[y, x],
    )


def _read(texture: moderngl.Texture) -> Float64[np.ndarray, "h w c"]:
    """Contents of a half-float or float texture."""
    width, height = texture.size
    dtype = np.float16 if texture.dtype == "f2" else np.float32
    return np.frombuffer(texture.read(), dtype).reshape(height, width, -1).astype(np.float64)
