"""How far the lights of a fish-eye camera are.

A fish-eye picture gives directions only, but shadows of a lamp one metre away diverge by ten degrees over a table.
Paper of one albedo is a light meter with hundreds of cells: across it, light of a near lamp varies by I cos / d^2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.sky_lights import TrackedLight
from deltalight.render_server.scene.albedo import MIN_PIXELS, known_albedo, unclipped

# Candidate inverse distances, 1/m: from far away to 20 cm, finer than the paper resolves.
INVERSE_DISTANCES = np.linspace(0.0, 5.0, 101)
# Near lights are accepted if they explain this fraction of all smooth differences (a plane over the paper) from far
# lights: uneven ambient light and shadows do not vary like near lamps by chance ...
MIN_EXPLAINED = 0.75
# ... and if the improvement is significant at 0.1 % (F-test with 1 and many degrees of freedom), where four
# neighbouring values of pixels and channels count as one, because lens and demosaicing mix them.
MIN_F_RATIO = 11.0
CORRELATED_VALUES = 4
OUTLIER_DEVIATIONS = 3.0


@dataclass(frozen=True, eq=False)
class PaperLight:
    """Irradiance (camera units) at points of the board (world, m) with known albedo."""

    points: Float64[np.ndarray, "k 3"]
    irradiance: Float64[np.ndarray, "k 3"]


def paper_light(frame: ViewFrame) -> PaperLight | None:
    """Measures irradiance on paper and grey cards; None for fewer than 30 unclipped pixels."""
    if frame.board is None or frame.pose is None:
        return None
    albedo = known_albedo(frame.board, frame.camera, frame.pose)
    coded = decode_lut(frame.response)[frame.color, np.arange(3)]
    usable = (albedo > 0) & unclipped(frame.color, coded)
    if np.count_nonzero(usable) < MIN_PIXELS:
        return None
    matrix = frame.pose.world_from_camera
    rays = np.insert(frame.camera.rays()[usable].astype(np.float64), 2, 1.0, axis=1) @ matrix[:3, :3].T
    points = matrix[:3, 3] - rays * (matrix[2, 3] / rays[:, 2:])
    irradiance = np.pi * coded[usable].astype(np.float64) / (albedo[usable, None] * frame.exposure_scale)
    return PaperLight(points, irradiance)


def fit_distance(
    paper: PaperLight,
    position: Float64[np.ndarray, "3"],
    lights: Sequence[TrackedLight],
    ambient: Float64[np.ndarray, "3"],
) -> float | None:
    """Estimates the distance of the lights from the fish-eye camera at `position`, m; None where they seem far away.

    The paper's irradiance is f (sum of E_i (D/d)^2 cos + ambient) with a factor f per channel; D, one distance for
    all lights, is fitted by least squares and must be significant. `ambient` is the irradiance of all other light
    on the paper, in the units of the lights.
    """
    far = _predicted(paper, position, lights, ambient, 0.0)
    misfits = [
        _misfit(paper, _predicted(paper, position, lights, ambient, inverse)) for inverse in INVERSE_DISTANCES
    ]
    best = int(np.argmin(misfits))
    gain = misfits[0] - misfits[best]
    explainable = misfits[0] - _misfit(paper, far * _plane(paper, far))
    values = paper.irradiance.size / CORRELATED_VALUES
    if gain < MIN_EXPLAINED * explainable or gain * values < MIN_F_RATIO * misfits[best] or best == 0:
        return None
    return float(1 / INVERSE_DISTANCES[best])


def _predicted(
    paper: PaperLight,
    position: Float64[np.ndarray, "3"],
    lights: Sequence[TrackedLight],
    ambient: Float64[np.ndarray, "3"],
    inverse: float,
) -> Float64[np.ndarray, "k 3"]:
    """Returns the irradiance of the paper under lights at an inverse distance."""
    predicted = np.tile(ambient, (len(paper.points), 1))
    for light in lights:
        to_lamp = light.to_light - inverse * (paper.points - position)  # in units of the lamp's distance
        attenuation = np.maximum(to_lamp[:, 2], 0) / np.linalg.norm(to_lamp, axis=1) ** 3
        predicted += attenuation[:, None] * light.irradiance
    return np.asarray(np.maximum(predicted, 1e-12))


def _plane(paper: PaperLight, predicted: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k 3"]:
    """Fits measured over predicted irradiance by a linear function of position per channel."""
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
    """Returns the relative mean squared difference to the measured irradiance, after fitting a factor per channel."""
    kept = _without_outliers(paper.irradiance / predicted)
    measured, predicted = paper.irradiance[kept], predicted[kept]
    factor = (measured * predicted).sum(axis=0) / (predicted**2).sum(axis=0)
    return float(((factor * predicted - measured) ** 2).mean() / (measured**2).mean())


def _without_outliers(ratio: Float64[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
    deviation = np.abs(ratio - np.median(ratio, axis=0))
    allowed = OUTLIER_DEVIATIONS * 1.4826 * np.median(deviation, axis=0) + 1e-9
    return np.asarray((deviation <= allowed).all(axis=1))
