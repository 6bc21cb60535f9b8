"""How far the lights of a fish-eye picture are, from how light falls off over the board's paper.

A fish-eye picture tells directions only, and shadows of a lamp one metre away go apart by ten degrees over a table.
Paper of one albedo is a light meter with hundreds of cells: over it light of a near lamp changes by I cos / d^2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from protocol.frames import ViewFrame, decode_lut
from render_server.scene.known_surfaces import LEAST_PIXELS, known_albedo
from render_server.scene.median_cut import RegionLight
from render_server.scene.registration import unclipped

# Inverse distances tried, 1/m: from far away to 20 cm, finer than what the paper can tell.
INVERSE_DISTANCES = np.linspace(0.0, 5.0, 101)
# A near light is believed if what it leaves unexplained of the paper's light is at most this share of what far lights
# leave: then it explains three quarters of the variance, which stains and uneven ambient light do not by chance.
BELIEVED_SHARE = 0.5
OUTLIER_DEVIATIONS = 3.0


@dataclass(frozen=True, eq=False)
class PaperLight:
    """Irradiance (camera units) of points of the board's plane (world, m) where the albedo is known."""

    points: Float64[np.ndarray, "k 3"]
    irradiance: Float64[np.ndarray, "k 3"]


def paper_light(frame: ViewFrame) -> PaperLight | None:
    """Read the light off paper and grey cards; None where fewer than 30 pixels show any unclipped."""
    if frame.board is None or frame.pose is None:
        return None
    albedo = known_albedo(frame.board, frame.camera, frame.pose)
    coded = decode_lut(frame.response)[frame.color, np.arange(3)]
    usable = (albedo > 0) & unclipped(frame.color, coded)
    if np.count_nonzero(usable) < LEAST_PIXELS:
        return None
    matrix = frame.pose.world_from_camera
    rays = np.insert(frame.camera.rays()[usable].astype(np.float64), 2, 1.0, axis=1) @ matrix[:3, :3].T
    points = matrix[:3, 3] - rays * (matrix[2, 3] / rays[:, 2:])
    irradiance = np.pi * coded[usable].astype(np.float64) / (albedo[usable, None] * frame.exposure_scale)
    return PaperLight(points, irradiance)


def fit_distance(
    paper: PaperLight,
    place: Float64[np.ndarray, "3"],
    lights: Sequence[RegionLight],
    ambient: Float64[np.ndarray, "3"],
) -> float | None:
    """Find the distance of the lights from the fish-eye camera at `place`, m; None where they seem far away.

    The paper's irradiance is f (sum of E_i (D/d)^2 cos + ambient) with a factor f for each channel; the distance
    D, one for all lights, is that of least squares. `ambient` is the irradiance of all else on paper, in the
    units of the lights.
    """
    misfits = [_misfit(paper, place, lights, ambient, inverse) for inverse in INVERSE_DISTANCES]
    best = int(np.argmin(misfits))
    if best == 0 or misfits[best] > BELIEVED_SHARE * misfits[0]:
        return None
    return float(1 / INVERSE_DISTANCES[best])


def _misfit(
    paper: PaperLight,
    place: Float64[np.ndarray, "3"],
    lights: Sequence[RegionLight],
    ambient: Float64[np.ndarray, "3"],
    inverse: float,
) -> float:
    """Relative root-mean-square difference of predicted and measured irradiance."""
    predicted = np.tile(ambient, (len(paper.points), 1))
    for light in lights:
        way = light.toward - inverse * (paper.points - place)  # to the lamp, as a share of its distance
        share = np.maximum(way[:, 2], 0) / np.linalg.norm(way, axis=1) ** 3
        predicted += share[:, None] * light.irradiance
    ratio = paper.irradiance / np.maximum(predicted, 1e-12)
    deviation = np.abs(ratio - np.median(ratio, axis=0))
    kept = (deviation <= OUTLIER_DEVIATIONS * 1.4826 * np.median(deviation, axis=0) + 1e-9).all(axis=1)
    measured, predicted = paper.irradiance[kept], predicted[kept]
    factor = (measured * predicted).sum(axis=0) / np.maximum((predicted**2).sum(axis=0), 1e-12)
    return float(np.sqrt(((factor * predicted - measured) ** 2).mean() / (measured**2).mean()))
