"""All figures of a variant on a scene, by flat names; means over frames and scenes ignore nan."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict

import numpy as np

from deltalight.benchmarks.ground_truth.truth import TruthFrame
from deltalight.benchmarks.quality.case import SceneCase
from deltalight.benchmarks.quality.energy import Change, energy_ratios
from deltalight.benchmarks.quality.metrics import Comparison, Picture
from deltalight.benchmarks.quality.penumbra import EdgeOnPicture
from deltalight.benchmarks.quality.regions import Linear, Regions
from deltalight.benchmarks.quality.temporal import temporal_deviation
from deltalight.protocol.frames import decode_lut

Figures = dict[str, float]
PARTS = ("changed", "changed_real", "changed_virtual")


def linear(picture: Picture) -> Linear:
    """Returns camera units of an 8-bit sRGB picture."""
    return np.asarray(decode_lut(None)[:, 0][picture])


def scene_figures(pictures: Sequence[Picture], case: SceneCase) -> Figures:
    """Compares a variant's pictures, one per frame, with the truth of their scene.

    Names: `<part>_<share|psnr_db|ssim|flip>` with the parts picture, changed, changed_real, changed_virtual;
    `darkening`, `brightening`, `virtual_radiance` (energy.py); `penumbra_error` (first frame); `temporal_unchanged`,
    `temporal_changed` (temporal.py).
    """
    frames = zip(pictures, case.frames, case.regions, case.changes, strict=True)
    figures = mean_figures(_frame_figures(*frame) for frame in frames)
    steadiness = temporal_deviation(pictures, case.references, [one.changed for one in case.regions])
    figures["temporal_unchanged"] = steadiness.unchanged
    figures["temporal_changed"] = steadiness.changed
    figures["penumbra_error"] = _penumbra_error(pictures[0], case)
    return figures


def _frame_figures(
    picture: Picture, truth: TruthFrame, regions: Regions, changes: Sequence[Change]
) -> Figures:
    compared = Comparison(picture, truth.sensor_with)
    parts = {"picture": compared.everywhere()}
    parts |= {part: compared.over(getattr(regions, part)) for part in PARTS}
    figures = {
        f"{part}_{name}": value
        for part, agreement in parts.items()
        for name, value in asdict(agreement).items()
    }
    camera = linear(truth.sensor_without)
    energy = energy_ratios(linear(picture), camera, changes)
    figures["darkening"], figures["brightening"] = energy.darkening, energy.brightening
    figures["virtual_radiance"] = energy.virtual
    return figures


def _penumbra_error(picture: Picture, case: SceneCase) -> float:
    """Returns the mean size of the relative errors of all shadow edges; nan if one is hidden or has no shadow."""
    frame, view = case.frames[0], case.views[0]
    pose = case.scene.world_from_camera[0]
    camera = linear(frame.sensor_without)
    errors = [
        EdgeOnPicture.seen(edge, view.camera, pose)
        .uncovered(frame.cover)
        .measure(camera, linear(picture), frame.without, frame.with_objects)
        .relative_error
        for edge in case.scene.shadow_edges
    ]
    return float(np.mean(np.abs(errors))) if errors else np.nan


def mean_figures(many: Iterable[Figures]) -> Figures:
    """Returns the mean of each figure over those that have it; nan if none has."""
    rows = list(many)
    names = dict.fromkeys(name for row in rows for name in row)
    found = {name: [row[name] for row in rows if name in row and not np.isnan(row[name])] for name in names}
    return {name: float(np.mean(values)) if values else np.nan for name, values in found.items()}
