"""Defocus by distance: found in edges at several depths, and put on objects by their own depth."""

import cv2
import numpy as np
import pytest
from jaxtyping import Float32, Float64

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.render_server.post_effects.camera_blur import NO_MOTION, LensBlur, blur_kernels, blurred
from deltalight.render_server.post_effects.camera_defocus import (
    BoardDefocus,
    Defocus,
    DistanceBlur,
    fit_defocus,
)
from deltalight.render_server.post_effects.camera_edges import edge_steps
from tests.render_server.test_camera_blur import (
    FINE,
    FOCAL_PX,
    HEIGHT,
    PIXEL_VARIANCE,
    WIDTH,
    camera,
    coded,
    edge_picture,
    linear,
    sharp,
    spread_px,
)

BOARD = BoardSpec(
    type="aruco_grid",
    dictionary="DICT_4X4_50",
    marker_length_m=0.04,
    separation_m=0.01,
    rows=6,
    columns=4,
    first_id=0,
    white_albedo=0.8,
)
APERTURE_M, FOCUS_M, SHARPEST_PX = 0.01, 0.3, 0.6


def oblique(
    tilt_deg: float = 50.0, distance_m: float = 0.3, turn_deg: float = 9.0
) -> Float64[np.ndarray, "4 4"]:
    """Looks at the board's middle, tilted about its rows and turned about the axis."""
    tilt, turn = np.radians([tilt_deg, turn_deg])
    tilted = np.array(
        [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    ) @ np.diag([1.0, -1.0, -1.0])
    turned = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3] = tilted @ turned
    matrix[:3, 3] = np.array([0.095, -0.145, 0.0]) - distance_m * matrix[:3, 2]
    return matrix


def inverse_depth(world_from_camera: Float64[np.ndarray, "4 4"], scale: int) -> Float64[np.ndarray, "h w"]:
    """Of the board's plane at each pixel, 1/m."""
    model = camera(scale)
    columns, rows = np.meshgrid(np.arange(model.width), np.arange(model.height))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(model.matrix).T
    return -(rays @ world_from_camera[2, :3]) / world_from_camera[2, 3]


def disc(diameter: float) -> Float32[np.ndarray, "k k"]:
    """Where rays of a pupil meet the picture; a pixel at the rim counts by the share that is inside."""
    radius = int(np.ceil(diameter / 2)) + 1
    at = np.abs(np.mgrid[-radius : radius + 1, -radius : radius + 1])
    kernel = np.clip(diameter / 2 + 0.5 - np.hypot(*at), 0, 1)
    return (kernel / kernel.sum()).astype(np.float32)


def shot(
    world_from_camera: Float64[np.ndarray, "4 4"],
    aperture_m: float = APERTURE_M,
    *,
    corner_px: float = 0.0,
    noise: float = 0.004,
    number: int = 0,
) -> ViewFrame:
    """The board through a thin lens; with `corner_px` blur that grows to that in the picture's corners."""
    picture = sharp(BOARD, world_from_camera)
    picture = cv2.GaussianBlur(picture, (0, 0), FINE * np.sqrt(SHARPEST_PX**2 - PIXEL_VARIANCE))
    diameter = FINE * FOCAL_PX * aperture_m * np.abs(inverse_depth(world_from_camera, FINE) - 1 / FOCUS_M)
    rows, columns = np.mgrid[: FINE * HEIGHT, : FINE * WIDTH]
    outwards = np.hypot(columns - columns.mean(), rows - rows.mean()) / np.hypot(
        FINE * WIDTH, FINE * HEIGHT
    ).astype(np.float32)
    diameter = np.hypot(diameter, 4 * FINE * corner_px * 2 * outwards)
    levels = np.linspace(0, diameter.max() + 1e-3, 12)
    soft = np.zeros_like(picture)
    for level, hat in zip(levels, np.eye(len(levels)), strict=True):
        weight = np.interp(diameter, levels, hat)
        if weight.any():
            soft += cv2.filter2D(picture, -1, disc(level)) * weight.astype(np.float32)
    small = cv2.resize(soft, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)[..., None]
    seen = small + np.random.default_rng(number).normal(0, noise, (HEIGHT, WIDTH, 3))
    pose = BoardPose(world_from_camera)
    return ViewFrame(number, number, coded(seen), camera(), pose=pose, board=BOARD)


@pytest.mark.parametrize("aperture_m", [0.006, 0.01])
@pytest.mark.parametrize("corner_px", [0.0, 0.8])
def test_aperture_and_focus_are_those_of_the_lens(aperture_m: float, corner_px: float) -> None:
    """From one frame that sees the board obliquely, also through a lens that is softer in the corners."""
    found = fit_defocus(edge_steps(shot(oblique(), aperture_m, corner_px=corner_px)))
    assert found is not None
    assert 4 * found.growth / FOCAL_PX == pytest.approx(aperture_m, rel=0.1)
    assert 1 / found.focus == pytest.approx(FOCUS_M, rel=0.1)
    assert 0.9 * SHARPEST_PX < np.sqrt(found.sharpest) < 1.1 * np.hypot(SHARPEST_PX, corner_px)


def test_a_camera_that_comes_nearer_shows_it_too() -> None:
    """From the third place on; the same place again says nothing new, as its errors are the same."""
    learned, sure = BoardDefocus(), []
    for distance_m in (0.22, 0.3, 0.42):
        seen = shot(oblique(0.0, distance_m))
        assert learned.wants(seen)
        learned.observe(seen, edge_steps(seen))
        assert not learned.wants(seen)
        sure.append(learned.model is not None)
    assert sure == [False, False, True]
    assert learned.model is not None
    assert 4 * learned.model.growth / FOCAL_PX == pytest.approx(APERTURE_M, rel=0.1)
    assert 1 / learned.model.focus == pytest.approx(FOCUS_M, rel=0.1)


@pytest.mark.parametrize("corner_px", [0.0, 1.0])
@pytest.mark.parametrize("turn_deg", [9.0, 21.0])
def test_a_camera_that_is_sharp_at_all_depths_has_none(turn_deg: float, corner_px: float) -> None:
    """Nor has one that is soft in the corners, or one that sees all of the board at one depth."""
    seen = shot(oblique(turn_deg=turn_deg), 0.0, corner_px=corner_px)
    edges = edge_steps(seen)
    assert len(edges) > 50
    assert fit_defocus(edges) is None
    assert fit_defocus(edge_steps(shot(oblique(tilt_deg=0.0, turn_deg=turn_deg)))) is None


DEFOCUS = Defocus(SHARPEST_PX**2, 1 / FOCUS_M, APERTURE_M * FOCAL_PX / 4)


def put_on(picture: np.ndarray, coverage: np.ndarray, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    blur = DistanceBlur(DEFOCUS, LensBlur(SHARPEST_PX), NO_MOTION, NO_MOTION)
    return blur.applied(picture, coverage, depth_m.astype(np.float32), None)


@pytest.mark.parametrize("depth_m", [0.2, 0.3, 0.45, 2.0])
def test_an_objects_edge_is_as_soft_as_its_depth_tells(depth_m: float) -> None:
    """A disc of the diameter A f |1/z - 1/z_focus| has a sixteenth of its square as variance."""
    picture, coverage = edge_picture()
    soft, covered = put_on(picture, coverage, np.where(coverage > 0.5, depth_m, 0.0))
    diameter = APERTURE_M * FOCAL_PX * abs(1 / depth_m - 1 / FOCUS_M)
    assert spread_px(soft) == pytest.approx(np.sqrt(SHARPEST_PX**2 + diameter**2 / 16), rel=0.1)
    untouched = covered == 0
    assert untouched.sum() > 1000
    assert np.array_equal(soft[untouched], picture[untouched])


def test_each_pixel_is_as_soft_as_its_own_depth_tells() -> None:
    """Each row of a tilted edge is within 5 % of its contrast as if all were there; nothing shows through."""
    picture, coverage = edge_picture(slope=0.0)
    inverse = np.repeat(np.linspace(3.4, 6.0, 64)[:, None], 96, axis=1)
    soft, _ = put_on(picture, coverage, 1 / inverse)
    for row in (14, 32, 50):
        alone, _ = put_on(picture, coverage, np.full_like(inverse, 1 / inverse[row, 0]))
        np.testing.assert_allclose(linear(soft)[row], linear(alone)[row], atol=0.05 * 0.6)
    assert soft[:, 70:].min() == soft[:, 70:].max() == picture[0, 95, 0]


def test_objects_at_two_depths_hide_what_is_behind_where_they_meet() -> None:
    picture, coverage = np.full((64, 96, 3), 60, np.uint8), np.zeros((64, 96), np.float32)
    picture[16:48, 16:80], coverage[16:48, 16:80] = 200, 1.0
    depth_m = np.where(np.arange(96) < 48, 0.2, 0.3) * np.ones((64, 1))
    soft, _ = put_on(picture, coverage, depth_m)
    assert (soft[26:38, 30:66] >= 199).all()


def test_one_depth_is_one_blur() -> None:
    picture, coverage = edge_picture()
    sigma = float(np.sqrt(DEFOCUS.variance(np.array(4.0))))
    kernels = blur_kernels(LensBlur(sigma), NO_MOTION, NO_MOTION)
    assert kernels is not None
    expected = blurred(picture, coverage, kernels, None)
    for found, wanted in zip(put_on(picture, coverage, np.full_like(coverage, 0.25)), expected, strict=True):
        assert np.array_equal(found, wanted)
