"""How far the lights of a fish-eye picture are, from how light falls off over the board's paper.

A fish-eye picture tells directions only, and shadows of a lamp one metre away go apart by ten degrees over a table.
Paper of one albedo is a light meter with hundreds of cells: over it light of a near lamp changes by I cos / d^2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from protocol.frames import ViewFrame, decode_lut
from render_server.estimation.registration_fit import unclipped
from render_server.lights.median_cut import RegionLight
from render_server.scene.board_albedo import LEAST_PIXELS, known_albedo

# Inverse distances tried, 1/m: from far away to 20 cm, finer than what the paper can tell.
INVERSE_DISTANCES = np.linspace(0.0, 5.0, 101)
# Near lights are believed if they explain this share of all smooth differences (a plane over the paper) between its
# light and that of far lights: uneven ambient light and shadows do not go the way of the lamps by chance ...
BELIEVED_SHARE = 0.75
# ... and if that is more than noise would do once in a thousand times (F-test with 1 and many degrees of freedom),
# where four neighbouring values of pixels and channels count as one, because lens and demosaicing mix them.
LEAST_F = 11.0
MIXED_VALUES = 4
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
    D, one for all lights, is that of least squares if it is believed. `ambient` is the irradiance of all else on
    paper, in the units of the lights.
    """
    far = _predicted(paper, place, lights, ambient, 0.0)
    misfits = [
        _misfit(paper, _predicted(paper, place, lights, ambient, inverse)) for inverse in INVERSE_DISTANCES
    ]
    best = int(np.argmin(misfits))
    gain = misfits[0] - misfits[best]
    explainable = misfits[0] - _misfit(paper, far * _plane(paper, far))
    values = paper.irradiance.size / MIXED_VALUES
    if gain < BELIEVED_SHARE * explainable or gain * values < LEAST_F * misfits[best] or best == 0:
        return None
    return float(1 / INVERSE_DISTANCES[best])


def _predicted(
    paper: PaperLight,
    place: Float64[np.ndarray, "3"],
    lights: Sequence[RegionLight],
    ambient: Float64[np.ndarray, "3"],
    inverse: float,
) -> Float64[np.ndarray, "k 3"]:
    """Irradiance of the paper under lights at an inverse distance."""
    predicted = np.tile(ambient, (len(paper.points), 1))
    for light in lights:
        way = light.toward - inverse * (paper.points - place)  # to the lamp, as a share of its distance
        share = np.maximum(way[:, 2], 0) / np.linalg.norm(way, axis=1) ** 3
        predicted += share[:, None] * light.irradiance
    return np.asarray(np.maximum(predicted, 1e-12))


def _plane(paper: PaperLight, predicted: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k 3"]:
    """Measured over predicted irradiance as a linear function of the place, each channel, by least squares."""
    places = np.column_stack([np.ones(len(paper.points)), paper.points[:, :2]])
    kept = _without_outliers(paper.irradiance / predicted)
    return np.stack(
        [
            places @ np.linalg.lstsq(places[kept] * one[kept, None], measured[kept])[0]
            for one, measured in zip(predicted.T, paper.irradiance.T, strict=True)
        ],
        axis=1,
    )


def _misfit(paper: PaperLight, predicted: Float64[np.ndarray, "k 3"]) -> float:
    """Mean squared difference of predicted and measured irradiance, relative; a factor a channel is fitted."""
    kept = _without_outliers(paper.irradiance / predicted)
    measured, predicted = paper.irradiance[kept], predicted[kept]
    factor = (measured * predicted).sum(axis=0) / (predicted**2).sum(axis=0)
    return float(((factor * predicted - measured) ** 2).mean() / (measured**2).mean())


def _without_outliers(ratio: Float64[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
    deviation = np.abs(ratio - np.median(ratio, axis=0))
    allowed = OUTLIER_DEVIATIONS * 1.4826 * np.median(deviation, axis=0) + 1e-9
    return np.asarray((deviation <= allowed).all(axis=1))
