"""How far the lights of a fish-eye camera are, by the falloff of light over the board's paper.

Paper of one albedo is a light meter with hundreds of cells: across it, light of a near lamp varies by I cos / d^2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.octahedral import octahedral_grid, texel_solid_angles
from deltalight.protocol.sky_lights import SkyLights
from deltalight.render_server.lights.light_distance import CANDIDATES, DistanceCue, tiles_of
from deltalight.render_server.scene.albedo import MIN_PIXELS, known_albedo, unclipped

MOST_POINTS = 1000  # of the paper: noise of more is far less than what they have in common
FINE_STEPS = 8  # between the neighbours of the best of CANDIDATES: paper tells more than shading
MOST_PATCHES = 16  # per edge of the map of all other light: patches of 13 degrees
# Near lights are accepted if they explain this fraction of all smooth differences (a plane over the paper) from far
# lights: shadows do not vary like near lamps by chance.
MIN_EXPLAINED = 0.75
OUTLIER_DEVIATIONS = 3.0


@dataclass(frozen=True, eq=False)
class PaperLight:
    """Irradiance (camera units) at points of the board (world, m) with known albedo; `tile`: of the picture."""

    points: Float64[np.ndarray, "k 3"]
    irradiance: Float64[np.ndarray, "k 3"]
    tile: Int64[np.ndarray, " k"]

    def errors(self, predicted: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, " k"]:
        """Returns log measured over predicted irradiance, mean of the channels, each up to a factor."""
        ratio = np.log(np.maximum(self.irradiance, 1e-12)) - np.log(np.maximum(predicted, 1e-12))
        mean = ratio.mean(axis=1)
        return np.asarray(mean - np.median(mean))


def paper_light(frame: ViewFrame) -> PaperLight | None:
    """Measures irradiance on paper and grey cards; None for fewer than 30 unclipped pixels."""
    if frame.board is None or frame.pose is None:
        return None
    albedo = known_albedo(frame.board, frame.camera, frame.pose)
    coded = decode_lut(frame.response)[frame.color, np.arange(3)]
    pixels = np.flatnonzero((albedo > 0) & unclipped(frame.color, coded))
    if len(pixels) < MIN_PIXELS:
        return None
    pixels = pixels[:: 1 + len(pixels) // MOST_POINTS]
    matrix = frame.pose.world_from_camera
    rays = np.insert(frame.camera.rays().reshape(-1, 2)[pixels].astype(np.float64), 2, 1.0, axis=1)
    rays = rays @ matrix[:3, :3].T
    points = matrix[:3, 3] - rays * (matrix[2, 3] / rays[:, 2:])
    measured = coded.reshape(-1, 3)[pixels].astype(np.float64)
    irradiance = np.pi * measured / (albedo.ravel()[pixels, None] * frame.exposure_scale)
    return PaperLight(points, irradiance, tiles_of(pixels, frame.camera.width))


def paper_cue(paper: PaperLight, sky: SkyLights) -> DistanceCue | None:
    """Returns how badly lights at each distance explain the paper; None where none does.

    The paper's irradiance is, up to a factor per channel, that of the lights, E (D/d)^2 cos, and of all other light
    that the fish-eye camera saw, on a diffuse sphere of radius D about it: a room's walls are about as far as its
    lamps, and brightest beside them, so that they seem to be nearer lamps if they are taken to be far.
    """
    rough = _cue(paper, sky, CANDIDATES)
    if rough is None:
        return None
    low, high = CANDIDATES[rough.around][0], CANDIDATES[rough.around][-1]
    return _cue(paper, sky, sorted({0.0, *np.linspace(low, high, FINE_STEPS + 1).tolist()}))


def _cue(paper: PaperLight, sky: SkyLights, inverses: Sequence[float]) -> DistanceCue | None:
    errors = np.stack([paper.errors(_predicted(paper, sky, inverse)) for inverse in inverses])
    spread = 1.4826 * np.median(np.abs(errors), axis=1).min()
    plane = _plane(paper, errors[0], spread)
    losses, smooth = (np.minimum(each**2, (OUTLIER_DEVIATIONS * spread) ** 2) for each in (errors, plane))
    found = DistanceCue.of(inverses, losses, paper.tile)
    if found is None:
        return None
    explained = losses[0].sum() - losses[found.best].sum()
    return found if explained >= MIN_EXPLAINED * (losses[0] - smooth).sum() else None


def _predicted(paper: PaperLight, sky: SkyLights, inverse: float) -> Float64[np.ndarray, "k 3"]:
    """Returns the irradiance of the paper under lights and other light at an inverse distance."""
    offset = inverse * (paper.points - sky.world_from_fisheye[:3, 3])  # all lengths in units of the distance
    predicted = np.zeros((len(paper.points), 3))
    for light in sky.lights:
        to_lamp = light.to_light - offset
        attenuation = np.maximum(to_lamp[:, 2], 0) / np.linalg.norm(to_lamp, axis=1) ** 3
        predicted += attenuation[:, None] * light.irradiance
    toward, flux = _patches(sky)
    to_patch = toward - offset[:, None]
    squared = (to_patch**2).sum(axis=2)
    facing = np.maximum(to_patch[..., 2], 0) * np.einsum("kti,ti->kt", to_patch, toward)
    return np.asarray(predicted + facing / squared**2 @ flux)


def _patches(sky: SkyLights) -> tuple[Float64[np.ndarray, "t 3"], Float64[np.ndarray, "t 3"]]:
    """Returns the directions of patches of all other light, and radiance times solid angle of what is there."""
    size = len(sky.residual)
    edge = min(MOST_PATCHES, size)
    flux = sky.residual * texel_solid_angles(size)[..., None].astype(np.float64)
    flux = flux.reshape(edge, size // edge, edge, size // edge, 3).sum(axis=(1, 3))
    return octahedral_grid(edge).reshape(-1, 3), flux.reshape(-1, 3)


def _plane(paper: PaperLight, errors: Float64[np.ndarray, " k"], spread: float) -> Float64[np.ndarray, " k"]:
    """Returns what a linear function of position leaves of the errors."""
    places = np.column_stack([np.ones(len(errors)), paper.points[:, :2]])
    kept = np.abs(errors) <= OUTLIER_DEVIATIONS * max(spread, 1.4826 * float(np.median(np.abs(errors))))
    return np.asarray(errors - places @ np.linalg.lstsq(places[kept], errors[kept])[0])
