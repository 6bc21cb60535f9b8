"""Calibration of a lens from views of a target, with checks that refuse misleading results."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.ocam_lens import OcamLens
from deltalight.sensor_node.calibration.coverage import Coverage, image_circle, measure_coverage
from deltalight.sensor_node.calibration.fits import LensFit
from deltalight.sensor_node.calibration.lens_fits import fit_equidistant, fit_ocam, fit_pinhole
from deltalight.sensor_node.calibration.targets import Target
from deltalight.sensor_node.calibration.views import View, ViewCollector

LensKind = Literal["plumb_bob_5", "plumb_bob_8", "equidistant", "ocam"]
Fitter = Callable[[Sequence[View], tuple[int, int]], LensFit]
# A view whose residual is this many times the median is blurred, or its target was misidentified.
BAD_MEDIANS = 3.0
# A point whose residual exceeds this and six times its view's median (noise reaches four) is another corner; if a
# tenth of the points are such, the whole view is judged.
OUTLIER_PX, OUTLIER_MEDIANS, MOST_OUTLIERS = 1.0, 6.0, 0.1
# Below this, a view is as good as corner detection, whatever the others are.
GOOD_PX = 0.3
# A view gives two equations beyond its pose, a lens has up to twelve parameters; with 8 views none depends on a
# single view.
LEAST_VIEWS = 8
LEAST_COVERAGE = 0.4
# 1.5 px at 1000 px of width is five times the error of found corners: blur, a bent sheet or the wrong model.
MOST_RMS_FRACTION = 1.5e-3
# Depth and size scale with the focal length: 2 % are 2 cm at one metre.
MOST_FOCAL_FRACTION = 0.02
# If normals vary less, a fit takes noise for tilts, and its own uncertainty is wrong too: twelve views at one tilt of
# 15 degrees gave a focal length 23 % off that claimed 1 %; from 5 degrees on the claims are true.
LEAST_TILT_SPREAD_DEG = 5.0


@dataclass(frozen=True, eq=False)
class LensResult:
    """A fitted lens with its coverage; `fit.refused` names the views left out, with the reason."""

    fit: LensFit
    coverage: Coverage
    brightest: UInt8[np.ndarray, "h w"]
    pictures: int


def calibrate_lens(collected: ViewCollector, target: Target, kind: LensKind) -> LensResult:
    """Fits a lens: first to the points as found, then to points refined with it, without the bad views.

    Raises:
        DeltalightError: there are too few views, or no lens fits them.
    """
    views, size = collected.views, collected.size
    if not collected.seen:
        raise DeltalightError(
            "the source holds no pictures of this camera; give a folder or a recording that does."
        )
    if collected.brightest is None or len(views) < LEAST_VIEWS:
        raise DeltalightError(
            f"only {len(views)} of {collected.seen} pictures can be used as views of the target and {LEAST_VIEWS} "
            "are needed; take more, from different sides, and check --target (inner corners of a chessboard)."
        )
    fitter = _fitter(kind)
    fit = fit_without_bad(fit_equidistant if kind == "ocam" else fitter, views, size)
    camera = fit.lens.camera if isinstance(fit.lens, EquidistantLens) else fit.lens
    assert isinstance(camera, CameraModel)
    better = [view.refined(target, camera) for view in views]
    if kind == "ocam" or any(new.pixels is not old.pixels for new, old in zip(better, views, strict=True)):
        fit = fit_without_bad(fitter, better, size)
    circle = None
    if not isinstance(fit.lens, CameraModel):
        centre = np.array(fit.lens.centre)
        radius = image_circle(collected.brightest, centre)
        fit = replace(fit, lens=_with_circle(fit.lens, radius))
        circle = None if radius is None else (centre, radius)
    return LensResult(fit, measure_coverage(fit.views, size, circle), collected.brightest, collected.seen)


def _fitter(kind: LensKind) -> Fitter:
    match kind:
        case "equidistant":
            return fit_equidistant
        case "ocam":
            return fit_ocam
        case _:
            return lambda views, size: fit_pinhole(views, size, int(kind[-1]))


def _with_circle(lens: EquidistantLens | OcamLens, radius: float | None) -> EquidistantLens | OcamLens:
    if isinstance(lens, EquidistantLens):
        return EquidistantLens(lens.camera, radius)
    return replace(lens, image_circle=radius)


def fit_without_bad(fitter: Fitter, views: Sequence[View], size: tuple[int, int]) -> LensFit:
    """Fits a lens, discarding misidentified points and then bad views until all are good.

    Raises:
        DeltalightError: no lens fits.
    """
    kept, points = list(views), 0
    refused: list[tuple[str, str]] = []
    while True:
        fit = fitter(kept, size)
        by_name = {view.name: misses for view, misses in zip(fit.views, fit.misses, strict=True)}
        cleaned = [_without_outliers(view, by_name.get(view.name)) for view in kept]
        lost = sum(
            len(before.points) - len(after.points) for before, after in zip(kept, cleaned, strict=True)
        )
        bad = {} if lost else _bad_views(fit)
        if not lost and not bad:
            return replace(fit, refused=(*refused, *fit.refused), refused_points=points)
        points += lost
        refused += list(bad.items())
        kept = [view for view in cleaned if view.name not in bad]


def _without_outliers(view: View, misses: Float64[np.ndarray, "n 2"] | None) -> View:
    """Returns the view without points whose residuals are far larger than the others; unchanged if these are many."""
    if misses is None:
        return view
    distances = np.linalg.norm(misses, axis=1)
    good = distances <= max(OUTLIER_PX, OUTLIER_MEDIANS * float(np.median(distances)))
    return view if good.mean() < 1 - MOST_OUTLIERS else view.only(good)


def _bad_views(fit: LensFit) -> dict[str, str]:
    """Returns views whose residuals are far larger than the others, with the reason."""
    errors = fit.view_rms_px
    median = float(np.median(errors))
    limit = max(GOOD_PX, BAD_MEDIANS * median)
    return {
        view.name: f"misses by {error:.2f} px, the median is {median:.2f}"
        for view, error in zip(fit.views, errors, strict=True)
        if not error <= limit
    }


def require_good(result: LensResult) -> None:
    """Refuses a calibration that would mislead.

    Raises:
        DeltalightError: the first reason, and what to do.
    """
    fit, width = result.fit, result.brightest.shape[1]
    if len(fit.views) < LEAST_VIEWS:
        raise DeltalightError(
            f"only {len(fit.views)} views are left after {len(fit.refused)} bad ones and {LEAST_VIEWS} are needed; "
            "take sharp pictures of the whole target at rest."
        )
    if fit.tilt_spread_deg < LEAST_TILT_SPREAD_DEG:
        raise DeltalightError(
            f"the target has one tilt in all views (it varies by {fit.tilt_spread_deg:.1f} degrees in one direction),"
            " which leaves the focal length undetermined; take views with it tilted by 20 to 45 degrees to the"
            " left, right, front and back."
        )
    if not fit.focal_fraction <= MOST_FOCAL_FRACTION:
        raise DeltalightError(
            f"the views leave the focal length uncertain by {100 * fit.focal_fraction:.1f} % (at most "
            f"{100 * MOST_FOCAL_FRACTION:.0f} % is acceptable); take more views, with the target larger in the"
            " picture and tilted by 20 to 45 degrees to the left, right, front and back."
        )
    if not fit.rms_px <= MOST_RMS_FRACTION * width:
        raise DeltalightError(
            f"the lens misses the corners by {fit.rms_px:.2f} px rms "
            f"(at most {MOST_RMS_FRACTION * width:.2f} will do); "
            "check that the target is flat, the pictures sharp and the model right (fisheye for wide lenses)."
        )
    if result.coverage.fraction < LEAST_COVERAGE:
        raise DeltalightError(
            f"the target was seen in {100 * result.coverage.fraction:.0f} % of the picture's cells and "
            f"{100 * LEAST_COVERAGE:.0f} % are needed; take views with it at the borders and in the corners."
        )
    if isinstance(fit.lens, CameraModel):
        fit.lens.rays()
