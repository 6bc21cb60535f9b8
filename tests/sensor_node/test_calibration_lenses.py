"""Lens calibration: known lenses come back, bad views go, misleading sets are refused, real sets agree."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Float64

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.ocam_lens import OcamLens
from deltalight.protocol.radial_lens import RadialLens
from deltalight.sensor_node.calibration.coverage import image_circle, measure_coverage
from deltalight.sensor_node.calibration.fits import rms
from deltalight.sensor_node.calibration.lens_calibration import (
    LensKind,
    LensResult,
    calibrate_lens,
    require_good,
)
from deltalight.sensor_node.calibration.lens_fits import fit_equidistant
from deltalight.sensor_node.calibration.picture_sources import open_series
from deltalight.sensor_node.calibration.poses import target_pose
from deltalight.sensor_node.calibration.targets import MarkerBoard, parse_target
from deltalight.sensor_node.calibration.views import View, ViewCollector
from tests.sensor_node.calibration_samples import BOARD, facing, poses, views

SIZE = (640, 480)
PINHOLE = CameraModel(
    640,
    480,
    np.array([[520.0, 0, 325.0], [0, 523.0, 236.0], [0, 0, 1]]),
    "plumb_bob",
    np.array([-0.25, 0.08, 0.001, -0.0008, 0.0]),
)
FISHEYE = CameraModel(
    640,
    480,
    np.array([[190.0, 0, 322.0], [0, 191.0, 243.0], [0, 0, 1]]),
    "equidistant",
    np.array([-0.02, 0.004, -0.002, 0.0003]),
)
OCAM = OcamLens(640, 480, (190.0, 0.0, -1.9e-3, 3e-6, -1.6e-8), (322.0, 243.0), (1.002, 0.0005, 0.0))
NEAR = (0.42, 0.3)
WIDE = (1.55, 1.15)


def calibrated(found: list[View], kind: LensKind) -> LensResult:
    collected = ViewCollector(BOARD, moving=False)
    collected.views, collected.seen = found, len(found)
    collected.brightest = np.full(SIZE[::-1], 200, np.uint8)
    return calibrate_lens(collected, BOARD, kind)


def directions_apart_px(lens: RadialLens, truth: RadialLens, focal: float, largest: float) -> float:
    """Largest difference of two lenses' directions within an angle of the axis, in pixels."""
    grid = (
        np.stack(np.meshgrid(np.arange(0, 640, 16), np.arange(0, 480, 16)), -1).reshape(-1, 2).astype(float)
    )
    ours, theirs = lens.directions(grid), truth.directions(grid)
    known = np.isfinite(ours).all(axis=1) & (theirs[:, 2] > np.cos(largest))
    assert known.sum() > 0.5 * len(grid)
    return float(focal * np.linalg.norm(ours[known] - theirs[known], axis=1).max())


@pytest.mark.parametrize("kind", ["plumb_bob_5", "plumb_bob_8"])
def test_a_known_pinhole_lens_comes_back(kind: LensKind) -> None:
    found = views(PINHOLE.project, SIZE, poses(20, NEAR, 0.55))
    result = calibrated(found, kind)
    require_good(result)
    assert isinstance(result.fit.lens, CameraModel)
    # Noise of 0.1 px a coordinate is 0.14 px a point.
    assert result.fit.rms_px == pytest.approx(0.14, abs=0.02)
    assert result.fit.focal_fraction < 0.002
    np.testing.assert_allclose(np.diag(result.fit.lens.matrix)[:2], [520, 523], rtol=0.003)
    np.testing.assert_allclose(result.fit.lens.matrix[:2, 2], [325, 236], atol=1.0)
    apart = np.abs(result.fit.lens.rays() - PINHOLE.rays()).max(axis=-1) * 520
    assert np.median(apart) < 1
    assert apart.max() < 3  # in the corners, where few points were


@pytest.mark.slow
def test_the_stated_uncertainty_of_the_focal_length_is_true() -> None:
    """Over sets that differ in their noise only, the focal length scatters as each fit says."""
    found = views(FISHEYE.project, SIZE, poses(10, (0.6, 0.5), 0.4), noise_px=0.0)
    random = np.random.default_rng(8)
    fits = [
        fit_equidistant(
            [replace(view, pixels=view.pixels + random.normal(0, 0.3, view.pixels.shape)) for view in found],
            SIZE,
        )
        for _ in range(6)
    ]
    focals = [fit.lens.camera.matrix[0, 0] for fit in fits if isinstance(fit.lens, EquidistantLens)]
    stated = np.mean([fit.focal_fraction for fit in fits]) * 190
    assert np.std(focals) == pytest.approx(stated, rel=0.6)


@pytest.mark.parametrize("kind", ["equidistant", "ocam"])
def test_a_known_fisheye_comes_back_also_beyond_90_degrees(kind: LensKind) -> None:
    truth: RadialLens = EquidistantLens(FISHEYE) if kind == "equidistant" else OCAM
    found = views(truth.project, SIZE, poses(24, WIDE, 0.35))
    reach = max(float(np.degrees(np.arccos(truth.directions(view.pixels)[:, 2].min()))) for view in found)
    assert reach > 91
    result = calibrated(found, kind)
    require_good(result)
    lens = result.fit.lens
    assert isinstance(lens, RadialLens)
    assert result.fit.refused == ()
    assert result.fit.rms_px == pytest.approx(0.14, abs=0.02)
    # Only the centre is known to within a tenth of a pixel, far out the angle is.
    np.testing.assert_allclose(lens.centre, truth.centre, atol=0.2)
    assert directions_apart_px(lens, truth, 190, np.radians(88)) < 0.4


def test_a_bad_view_and_a_wrong_point_are_left_out_and_named() -> None:
    found = views(PINHOLE.project, SIZE, poses(16, NEAR, 0.55))
    blurred = np.random.default_rng(1).normal(0, 2.0, found[4].pixels.shape)
    found[4] = replace(found[4], pixels=found[4].pixels + blurred)
    shifted = found[7].pixels.copy()
    shifted[5] += 15
    found[7] = replace(found[7], pixels=shifted)
    fit = calibrated(found, "plumb_bob_5").fit
    assert [name for name, _ in fit.refused] == ["view 4"]
    assert fit.refused_points == 1
    assert fit.rms_px < 0.17
    assert len(fit.views) == 15


def test_a_view_that_reaches_where_no_lens_does_is_named() -> None:
    """A view whose points were mixed up has no pose at all."""
    truth = EquidistantLens(FISHEYE)
    found = views(truth.project, SIZE, poses(16, WIDE, 0.35))
    random = np.random.default_rng(5)
    found[3] = replace(found[3], pixels=random.permutation(found[3].pixels))
    fit = calibrated(found, "equidistant").fit
    assert "view 3" in [name for name, _ in fit.refused]
    assert fit.rms_px < 0.17


def frontal(count: int) -> list[Float64[np.ndarray, "4 4"]]:
    middle = BOARD.points.mean(axis=0)
    return [facing(middle, (0.0, 0.0), (0.0, 0.0), 0.5 + 0.03 * k, 0.2 * k) for k in range(count)]


def leaning(count: int) -> list[Float64[np.ndarray, "4 4"]]:
    middle = BOARD.points.mean(axis=0)
    return [facing(middle, (0.0, 0.0), (0.26, 0.0), 0.5 + 0.03 * k, 0.0) for k in range(count)]


def small(count: int) -> list[Float64[np.ndarray, "4 4"]]:
    middle = BOARD.points.mean(axis=0)
    tilts = [(0.6 * np.cos(k), 0.6 * np.sin(k)) for k in range(count)]
    return [facing(middle, (0.0, 0.0), tilt, 1.4, 0.2 * k) for k, tilt in enumerate(tilts)]


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (views(PINHOLE.project, SIZE, poses(7, NEAR, 0.55)), "only 7 of 7 pictures"),
        (views(PINHOLE.project, SIZE, frontal(12)), "one tilt in all views"),
        (views(PINHOLE.project, SIZE, leaning(12)), "one tilt in all views"),
        (views(PINHOLE.project, SIZE, poses(8, NEAR, 2.5), noise_px=0.6), "focal length uncertain"),
        (views(PINHOLE.project, SIZE, small(12)), r"% of the picture's cells"),
        (views(PINHOLE.project, SIZE, poses(16, NEAR, 0.55), noise_px=1.2), "misses the corners by"),
    ],
    ids=["few", "frontal", "one tilt", "far", "only the middle", "blurred"],
)
def test_misleading_sets_are_refused_with_a_reason(found: list[View], sentence: str) -> None:
    with pytest.raises(DeltalightError, match=sentence):
        require_good(calibrated(found, "plumb_bob_5"))


def test_too_many_bad_views_are_refused() -> None:
    found = views(PINHOLE.project, SIZE, poses(10, NEAR, 0.55))
    random = np.random.default_rng(2)
    for number in (0, 3, 6):
        found[number] = replace(
            found[number], pixels=found[number].pixels + random.normal(0, 6, found[number].pixels.shape)
        )
    with pytest.raises(DeltalightError, match="7 views are left after 3 bad ones"):
        require_good(calibrated(found, "plumb_bob_5"))


def test_no_lens_at_all_is_a_sentence() -> None:
    random = np.random.default_rng(0)
    found = [
        replace(view, pixels=random.uniform((0, 0), SIZE, view.pixels.shape))
        for view in views(PINHOLE.project, SIZE, poses(10, NEAR, 0.55))
    ]
    with pytest.raises(DeltalightError):
        require_good(calibrated(found, "equidistant"))


def test_coverage_counts_cells_inside_the_image_circle() -> None:
    found = views(PINHOLE.project, SIZE, small(3))
    everywhere = measure_coverage(found, SIZE)
    inside = measure_coverage(found, SIZE, (np.array([320.0, 240.0]), 150.0))
    assert everywhere.points.shape == (6, 8)
    assert everywhere.points.sum() == sum(len(view.points) for view in found)
    assert inside.fraction > everywhere.fraction
    assert inside.text().splitlines()[0].strip() == ""


def test_the_image_circle_is_where_light_ends() -> None:
    rows, columns = np.mgrid[:480, :640]
    bright = np.where(np.hypot(columns - 310, rows - 245) < 200, 180, 4).astype(np.uint8)
    bright[200:260, 300:420] = 3  # a dark thing inside
    assert image_circle(bright, np.array([310.0, 245.0])) == pytest.approx(200, abs=2)
    assert image_circle(np.full((480, 640), 99, np.uint8), np.array([310.0, 245.0])) is None


@pytest.fixture(scope="module")
def fisheye_sets(shared_data: Path) -> Path:
    return shared_data / "fisheye" / "chessboard_set_fish2"


def collected(source: str, target: str) -> ViewCollector:
    collector = ViewCollector(parse_target(target, None, ()), moving=False)
    for each in open_series(source, "fisheye").pictures:
        collector.add(each)
    return collector


@pytest.mark.data
@pytest.mark.parametrize("kind", ["equidistant", "ocam"])
def test_real_fisheye_set_of_large_squares(fisheye_sets: Path, kind: LensKind) -> None:
    target = parse_target("chessboard:8x6:0.117", None, ())
    views_found = collected(f"{fisheye_sets}/Fisheye2_*.jpg", "chessboard:8x6:0.117")
    # OpenCV 5 and 4.14 find the board in all 16 pictures, 4.10 in fewer.
    assert len(views_found.views) >= 13
    result = calibrate_lens(views_found, target, kind)
    require_good(result)
    assert len(result.fit.views) == len(views_found.views)
    assert result.fit.rms_px < 0.15
    assert not isinstance(result.fit.lens, CameraModel)
    assert result.fit.lens.image_circle == pytest.approx(298, abs=6)


@pytest.mark.data
def test_real_fisheye_set_agrees_with_a_finished_calibration(fisheye_sets: Path) -> None:
    """The other calibration has its own corners and drops a view: they agree within half a pixel to 80 degrees."""
    target = parse_target("chessboard:8x6:0.0325", None, ())
    result = calibrate_lens(
        collected(f"{fisheye_sets}/Fisheye1_*.jpg", "chessboard:8x6:0.0325"), target, "ocam"
    )
    require_good(result)
    assert result.fit.rms_px < 0.45
    finished = json.loads((fisheye_sets / "calibration_fisheye_1_18052022_154907.json").read_text())
    assert isinstance(result.fit.lens, OcamLens)
    np.testing.assert_allclose(result.fit.lens.centre, finished["distortion_center"], atol=0.6)
    (c, d), (e, _) = finished["stretch_matrix"]
    other = OcamLens(1032, 778, tuple(finished["taylor_coefficient"]), tuple(finished["distortion_center"]))
    assert abs(c - 1) < 0.005
    assert abs(d) + abs(e) < 0.001
    for angle in np.radians([10, 30, 50, 70, 80]):
        ray = np.array([[np.sin(angle), 0, np.cos(angle)]])
        ours = result.fit.lens.project(ray)[0, 0] - result.fit.lens.centre[0]
        theirs = other.project(ray)[0, 0] - other.centre[0]
        assert ours == pytest.approx(theirs, abs=2.0)


@pytest.mark.data
def test_real_chessboard_series_agrees_with_the_published_result(shared_data: Path) -> None:
    target = parse_target("chessboard:9x6:0.025", None, ())
    found = collected(str(shared_data / "aruco_photos" / "chessboard_opencv"), "chessboard:9x6:0.025")
    result = calibrate_lens(found, target, "plumb_bob_5")
    require_good(result)
    assert len(result.fit.views) == 13
    assert result.fit.rms_px < 0.2  # published: 0.39
    assert isinstance(result.fit.lens, CameraModel)
    np.testing.assert_allclose(np.diag(result.fit.lens.matrix)[:2], 535.9, rtol=0.006)
    np.testing.assert_allclose(result.fit.lens.matrix[:2, 2], [342.28, 235.57], atol=2)
    eight = calibrate_lens(found, target, "plumb_bob_8")
    with pytest.raises(DeltalightError, match="fewer coefficients"):
        require_good(eight)


@pytest.mark.data
def test_real_charuco_photograph_fits_its_published_lens_but_calibrates_none(shared_data: Path) -> None:
    target = MarkerBoard(
        BoardSpec(
            type="charuco",
            dictionary="DICT_6X6_250",
            marker_length_m=0.02,
            separation_m=0.02,
            rows=7,
            columns=5,
        )
    )
    photographs = shared_data / "aruco_photos" / "opencv"
    collector = ViewCollector(target, moving=False)
    for each in open_series(f"{photographs}/choriginal.*", "rgb").pictures:
        collector.add(each)
    assert [len(view.points) for view in collector.views] == [24]
    file = cv2.FileStorage(str(photographs / "tutorial_camera_charuco.yml"), cv2.FILE_STORAGE_READ)
    matrix, distortion = (file.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients"))
    camera = CameraModel(640, 480, matrix, "plumb_bob", distortion.ravel())
    view = collector.views[0]
    rays = np.column_stack([camera.unproject(view.pixels), np.ones(24)])
    pose = target_pose(view.points, rays / np.linalg.norm(rays, axis=1)[:, None])
    assert pose is not None
    assert rms(view.pixels - camera.project(view.points @ pose[:3, :3].T + pose[:3, 3])) < 0.2
    with pytest.raises(DeltalightError, match="only 1 of 1 pictures"):
        calibrate_lens(collector, target, "plumb_bob_5")
