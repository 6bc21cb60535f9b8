"""Fits of the lens models to views of a target: plumb_bob, equidistant, ocam."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeLens
from deltalight.protocol.ocam_lens import OcamLens
from deltalight.protocol.poses import rigid_matrix
from deltalight.sensor_node.calibration.bundle import LensMaker, refine
from deltalight.sensor_node.calibration.fits import LensFit, noise_px, rms
from deltalight.sensor_node.calibration.poses import target_pose
from deltalight.sensor_node.calibration.views import View

# Powers of the radius in Scaramuzza's polynomial; slope 0 on the axis, because lenses are smooth there.
OCAM_POWERS = (0, 2, 3, 4)
# A lens has up to nine parameters, a view gives two beyond its pose.
LEAST_START = 5
# Initial focal lengths, as fractions of the width: fields of view from 115 to 360 degrees across it.
FOCAL_FRACTIONS = (0.16, 0.23, 0.32, 0.45)
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-10)


def fit_pinhole(views: Sequence[View], size: tuple[int, int], coefficients: int) -> LensFit:
    """Fits `plumb_bob` with 5 or 8 coefficients."""
    flags = cv2.CALIB_RATIONAL_MODEL if coefficients == 8 else 0
    try:
        _, matrix, distortion, turns, shifts, spread, _, _ = cv2.calibrateCameraExtended(
            [view.points.astype(np.float32) for view in views],
            [view.pixels.astype(np.float32).reshape(-1, 1, 2) for view in views],
            size,
            None,
            None,
            flags=flags,
            criteria=CRITERIA,
        )
    except cv2.error as error:
        raise _no_start(views) from error
    camera = CameraModel(*size, matrix, "plumb_bob", np.ravel(distortion)[:coefficients])
    poses = tuple(
        rigid_matrix(cv2.Rodrigues(turn)[0], shift.ravel()) for turn, shift in zip(turns, shifts, strict=True)
    )
    misses = tuple(
        view.pixels - camera.project(view.points @ pose[:3, :3].T + pose[:3, 3])
        for view, pose in zip(views, poses, strict=True)
    )
    every = np.nan_to_num(np.concatenate(misses), nan=np.inf)
    parameters = 4 + coefficients + 6 * len(views)
    raised = noise_px(every, parameters) / max(float(np.sqrt(np.sum(every**2) / every.size)), 1e-12)
    fraction = np.max(np.ravel(spread)[:2] / np.diag(matrix)[:2]) * max(raised, 1.0)
    return LensFit(camera, tuple(views), poses, misses, float(fraction))


def fit_equidistant(views: Sequence[View], size: tuple[int, int]) -> LensFit:
    """Fits Kannala & Brandt's lens, also to points beyond 90 degrees.

    `cv2.fisheye.calibrate` is not used: its initialisation fails on views that reach the rim of the picture, and the
    view that it then names is random (of sixteen views of a good set it accepted none as culprit).
    """
    maker = _equidistant_maker(size)
    numbers = min(
        (_ideal_lens(size, fraction) for fraction in FOCAL_FRACTIONS),
        key=lambda n: _start_error(views, maker, n),
    )
    # The first round may leave out views that its ideal lens does not reach.
    first = _refined(maker, numbers, (0, 1), views)
    assert isinstance(first.lens, EquidistantLens)
    return _refined(maker, _equidistant_numbers(first.lens), (0, 1), views)


def _ideal_lens(size: tuple[int, int], focal_fraction: float) -> Float64[np.ndarray, "8"]:
    """Returns the parameters of an exactly equidistant lens with its axis in the middle of the picture."""
    width, height = size
    focal = focal_fraction * width
    return np.array([focal, focal, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0, 0.0, 0.0])


def _start_error(views: Sequence[View], maker: LensMaker, numbers: Float64[np.ndarray, " k"]) -> float:
    """Returns the median over the views of the rms of an unrefined lens; infinite for views out of its reach."""
    errors = [placed.rms_px for placed in _placed(views, maker, numbers)[0]]
    return float(np.median([*errors, *[np.inf] * (len(views) - len(errors))]))


def _equidistant_numbers(lens: EquidistantLens) -> Float64[np.ndarray, "8"]:
    coefficients = lens.camera.distortion
    assert coefficients is not None  # an equidistant camera has four
    return np.concatenate([lens.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], coefficients])


def fit_ocam(views: Sequence[View], size: tuple[int, int]) -> LensFit:
    """Fits Scaramuzza's lens (polynomial of degree 4, centre, affine part) from an equidistant start."""
    equidistant = fit_equidistant(views, size)
    assert isinstance(equidistant.lens, EquidistantLens)
    numbers = _ocam_numbers(equidistant.lens)
    maker = _ocam_maker(size)
    fit = _refined(maker, numbers, (0,), equidistant.views)
    return replace(fit, refused=equidistant.refused + fit.refused)


class _Placed(NamedTuple):
    """A view with its pose by a given lens."""

    view: View
    pose: Float64[np.ndarray, "4 4"]
    rms_px: float


def _refined(
    maker: LensMaker, numbers: Float64[np.ndarray, " k"], focal: tuple[int, ...], views: Sequence[View]
) -> LensFit:
    """Refines a lens and all poses; `focal` lists the parameters that are focal lengths."""
    placed, refused = _placed(views, maker, numbers)
    if len(placed) < LEAST_START:
        raise _no_start(views)
    seen = tuple(each.view for each in placed)
    bundle = refine(maker, numbers, seen, [each.pose for each in placed])
    places = list(focal)
    fraction = np.max(np.sqrt(np.diag(bundle.covariance)[places]) / bundle.numbers[places])
    lens = maker(bundle.numbers, 0)
    assert isinstance(lens, FisheyeLens)
    return LensFit(lens, seen, bundle.poses, bundle.misses, float(fraction), tuple(refused))


def _placed(
    views: Sequence[View], maker: LensMaker, numbers: Float64[np.ndarray, " k"]
) -> tuple[list[_Placed], list[tuple[str, str]]]:
    """Returns the views with their poses by a lens, and those that it does not reach."""
    placed, refused = [], []
    for view in views:
        margin = view.gray.shape[1]
        lens = maker(numbers, margin)
        directions = lens.directions(view.pixels + margin)
        pose = target_pose(view.points, directions) if np.isfinite(directions).all() else None
        seen = np.nan if pose is None else lens.project(view.points @ pose[:3, :3].T + pose[:3, 3])
        if pose is None or not np.isfinite(seen).all():
            refused.append((view.name, "reaches where the lens of the other views ends"))
        else:
            placed.append(_Placed(view, pose, rms(view.pixels + margin - seen)))
    return placed, refused


def _no_start(views: Sequence[View]) -> DeltalightError:
    return DeltalightError(
        f"no lens fits the {len(views)} views; check --target (inner corners, edge of a square) and take views in "
        "which the target lies tilted in different directions."
    )


def _equidistant_maker(size: tuple[int, int]) -> LensMaker:
    def make(numbers: Float64[np.ndarray, " k"], margin: int) -> EquidistantLens:
        fx, fy, x, y = numbers[:4]
        matrix = np.array([[fx, 0, x + margin], [0, fy, y + margin], [0, 0, 1.0]])
        width, height = (edge + 2 * margin for edge in size)
        return EquidistantLens(CameraModel(width, height, matrix, "equidistant", numbers[4:]))

    return make


def _ocam_maker(size: tuple[int, int]) -> LensMaker:
    """Returns a maker whose parameters are the polynomial in units of half the width, the centre, and c d.

    These units make all parameters similar in size. e stays 0: the rotation about the axis that it would add is the
    same as one of all poses.
    """
    unit = size[0] / 2

    def make(numbers: Float64[np.ndarray, " k"], margin: int) -> OcamLens:
        polynomial = np.zeros(max(OCAM_POWERS) + 1)
        powers = np.array(OCAM_POWERS)
        polynomial[powers] = numbers[: len(powers)] * unit ** (1.0 - powers)
        x, y, c, d = (float(value) for value in numbers[len(powers) :])
        width, height = (edge + 2 * margin for edge in size)
        return OcamLens(width, height, tuple(polynomial.tolist()), (x + margin, y + margin), (c, d, 0.0))

    return make


def _ocam_numbers(lens: EquidistantLens) -> Float64[np.ndarray, " k"]:
    """Returns the least-squares polynomial of z over the radius of an equidistant lens within the picture."""
    fx, fy, x, y = lens.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    unit = lens.width / 2
    radii = np.linspace(0.02, min(lens.largest_radius * fx, 0.999 * (lens.width - x)) / unit, 200)
    directions = lens.directions(np.column_stack([x + radii * unit, np.full(200, y)]))
    known = np.isfinite(directions).all(axis=1) & (directions[:, 0] > 0)
    z = radii[known] * directions[known, 2] / directions[known, 0]
    powers = radii[known, None] ** np.array(OCAM_POWERS)
    # Weighted by the cosine of the ray, so that errors are those of the angle.
    weight = directions[known, 0]
    polynomial = np.linalg.lstsq(powers * weight[:, None], z * weight, rcond=None)[0]
    return np.array([*polynomial, x, y, fy / fx, 0.0])
