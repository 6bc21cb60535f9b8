"""The camera's blur: measured at the board's edges, and put on the virtual part of a picture."""

from typing import Any

import cv2
import numpy as np
import pytest
from jaxtyping import Float32, Float64

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, ViewFrame, decode_lut
from deltalight.render_server.post_effects.camera_artifacts import CameraArtifacts
from deltalight.render_server.post_effects.camera_blur import (
    NO_MOTION,
    LensBlur,
    blur_kernels,
    blurred,
    measure_blur,
    mtf50,
)
from deltalight.render_server.post_effects.camera_edges import edge_steps

WIDTH, HEIGHT, FINE = 320, 240, 5
BOARD = BoardSpec(
    type="aruco_grid",
    dictionary="DICT_4X4_50",
    marker_length_m=0.04,
    separation_m=0.01,
    rows=2,
    columns=3,
    first_id=0,
    white_albedo=0.8,
)
FOCAL_PX = 320.0
PIXEL_VARIANCE = 1 / 12


def camera(scale: int = 1) -> CameraModel:
    width, height, focal = scale * WIDTH, scale * HEIGHT, scale * FOCAL_PX
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return CameraModel(width, height, matrix, "plumb_bob", np.zeros(5))


def pose(turn_deg: float = 9.0) -> Float64[np.ndarray, "4 4"]:
    """0.25 m above the board, turned about the axis so that no edge lies along the pixels."""
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    matrix[:2, :2] = np.array([[cosine, -sine], [sine, cosine]]) @ matrix[:2, :2]
    matrix[:3, 3] = 0.07, 0.045, 0.25
    return matrix


def _larger(picture: Float32[np.ndarray, "h w"], by: float) -> Float32[np.ndarray, "h w"]:
    """The picture, larger by a fraction about its centre."""
    height, width = picture.shape
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    turn = np.column_stack([np.eye(2) * (1 + by), -by * centre])
    return np.asarray(cv2.warpAffine(picture, turn, (width, height), borderMode=cv2.BORDER_REPLICATE))


def sharp(board: BoardSpec, world_from_camera: Float64[np.ndarray, "4 4"]) -> Float32[np.ndarray, "h w"]:
    """The board as a pinhole shows it, in linear light, each pixel by FINE x FINE."""
    seen, from_world = camera(FINE), np.linalg.inv(world_from_camera)
    picture = np.full((FINE * HEIGHT, FINE * WIDTH), 0.6, np.float32)
    cells = board.opencv_dictionary().markerSize + 2 * board.border_bits
    for name, quad in board.corner_points().items():
        pixels = seen.project(quad @ from_world[:3, :3].T + from_world[:3, 3])
        marker = cv2.aruco.generateImageMarker(board.opencv_dictionary(), name, 40 * cells)
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * 40 * cells - 0.5
        warp = cv2.getPerspectiveTransform(corners, pixels.astype(np.float32))
        ink = cv2.warpPerspective(255 - marker, warp, picture.shape[::-1], flags=cv2.INTER_LINEAR)
        picture -= 0.55 * ink.astype(np.float32) / 255
    return picture


def shot(
    sigma_px: float, noise: float = 0.0, red: float = 0.0, blue: float = 0.0, **more: object
) -> ViewFrame:
    """The board through a lens of that blur, a pixel's own area included; red and blue are larger by that."""
    soft = cv2.GaussianBlur(sharp(BOARD, pose()), (0, 0), FINE * np.sqrt(sigma_px**2 - PIXEL_VARIANCE))
    colors = np.stack([_larger(soft, each) for each in (red, 0.0, blue)], axis=-1)
    linear = cv2.resize(colors, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) + np.random.default_rng(
        1
    ).normal(0, noise, (HEIGHT, WIDTH, 3))
    values: dict[str, Any] = {
        "frame_id": 0,
        "timestamp_ns": 0,
        "pose": BoardPose(pose()),
        "board": BOARD,
        **more,
    }
    return ViewFrame(color=coded(linear), camera=camera(), **values)


def coded(linear: Float64[np.ndarray, "h w 3"]) -> np.ndarray:
    return np.rint(np.interp(linear, decode_lut(None)[:, 0], np.arange(256))).astype(np.uint8)


def linear(color: np.ndarray) -> Float32[np.ndarray, "h w 3"]:
    return decode_lut(None)[color, np.arange(3)]


@pytest.mark.parametrize(("sigma_px", "noise"), [(0.5, 0.01), (0.8, 0.0), (1.2, 0.01), (1.6, 0.0)])
def test_mtf50_is_that_of_the_lens(sigma_px: float, noise: float) -> None:
    found = measure_blur(edge_steps(shot(sigma_px, noise)))
    assert found is not None
    assert mtf50(found.sigma_px) == pytest.approx(mtf50(sigma_px), rel=0.1)
    assert (found.red, found.blue) == pytest.approx((0.0, 0.0), abs=3e-4)


def test_colours_of_other_sizes_are_found_and_put_on() -> None:
    """Red 0.4 % larger, blue 0.3 % smaller than green: at 100 px from the centre, 0.4 and -0.3 px apart."""
    found = measure_blur(edge_steps(shot(0.8, noise=0.005, red=0.004, blue=-0.003)))
    assert found is not None
    assert (found.red, found.blue) == pytest.approx((0.004, -0.003), rel=0.15)
    kernels = blur_kernels(LensBlur(0.8, 0.004, -0.003), NO_MOTION, np.array([100.0, 0.0]))
    assert kernels is not None
    at = np.arange(kernels.shape[1]) - kernels.shape[1] // 2
    np.testing.assert_allclose((kernels.sum(axis=1) * at).sum(axis=1), [0.4, 0.0, -0.3], atol=1e-3)


def test_a_board_out_of_sight_says_nothing() -> None:
    away = np.eye(4)
    assert measure_blur(edge_steps(shot(1.0, pose=BoardPose(away)))) is None
    assert measure_blur(edge_steps(shot(1.0, board=None))) is None


def edge_picture(slope: float = 0.2) -> tuple[np.ndarray, Float32[np.ndarray, "h w"]]:
    """A bright object right of a slanting edge, as it is rendered: pixels are means of their area."""
    columns, rows = np.meshgrid(np.arange(FINE * 96), np.arange(FINE * 64))
    fine = (columns - 48 * FINE > slope * (rows - 32 * FINE)).astype(np.float32)
    coverage = cv2.resize(fine, (96, 64), interpolation=cv2.INTER_AREA)
    return coded(np.repeat((0.1 + 0.6 * coverage)[..., None], 3, axis=2)), coverage


def spread_px(picture: np.ndarray, slope: float = 0.2) -> float:
    """Standard deviation of the line-spread function across the edge, less the pixel over which steps are taken."""
    rows = np.arange(64)[8:-8]
    profile = linear(picture)[8:-8, :, 0]
    steps = np.diff(profile, axis=1)
    where = np.arange(95) + 0.5 - 48 + 0.5 - slope * (rows[:, None] + 0.5 - 32)
    mean = (steps * where).sum() / steps.sum()
    across = float((steps * (where - mean) ** 2).sum() / steps.sum())
    return float(np.sqrt((across - PIXEL_VARIANCE) / (1 + slope**2)))


@pytest.mark.parametrize("sigma_px", [0.45, 0.6, 1.0, 1.7])
def test_an_objects_edge_is_as_soft_as_the_lens(sigma_px: float) -> None:
    picture, coverage = edge_picture()
    kernels = blur_kernels(LensBlur(sigma_px), NO_MOTION, NO_MOTION)
    assert kernels is not None
    soft, covered = blurred(picture, coverage, kernels, None)
    assert mtf50(spread_px(soft)) == pytest.approx(mtf50(sigma_px), rel=0.1)
    untouched = covered == 0
    assert untouched.sum() > 1000
    assert np.array_equal(soft[untouched], picture[untouched])
    assert soft[:, 80:].min() == soft[:, 80:].max() == picture[0, 95, 0]
    assert covered.sum() == pytest.approx(coverage.sum(), rel=0.01)


@pytest.mark.parametrize("sigma_px", [0.35, 0.45, 0.6, 0.8, 1.0, 1.7])
def test_kernels_halve_contrast_where_the_lens_does(sigma_px: float) -> None:
    """Together with the pixels of a rendered object, whose transform is a sinc; at Nyquist if that is before."""
    kernels = blur_kernels(LensBlur(sigma_px), NO_MOTION, NO_MOTION)
    assert kernels is not None
    frequency = min(mtf50(sigma_px), 0.5)
    at = np.arange(kernels.shape[1]) - kernels.shape[1] // 2
    kept = np.sinc(frequency) * float(kernels[1].sum(axis=0) @ np.cos(2 * np.pi * frequency * at))
    assert kept == pytest.approx(np.exp(-2 * (np.pi * sigma_px * frequency) ** 2), rel=0.02)


def test_what_is_behind_an_edge_is_not_blurred() -> None:
    """The camera's part of the picture has its blur already: stripes beside an object keep their contrast."""
    picture, coverage = edge_picture(slope=0.0)
    picture[::2, :48] = 150
    kernels = blur_kernels(LensBlur(1.5), NO_MOTION, NO_MOTION)
    assert kernels is not None
    soft, covered = blurred(picture, coverage, kernels, None)
    beside = (covered > 0.01) & (covered < 0.05)
    assert beside[::2].any()
    light, before = linear(soft), linear(picture)
    stripes, ground = light[::2][beside[::2]].mean(), light[1::2][beside[1::2]].mean()
    assert stripes - ground == pytest.approx(
        (before[0, 0, 0] - before[1, 0, 0]) * (1 - covered[beside].mean()), rel=0.02
    )


@pytest.mark.parametrize("motion_px", [(5.0, 0.0), (9.0, 4.0)])
def test_motion_smears_along_its_way(motion_px: tuple[float, float]) -> None:
    """A box of the motion's length has the variance length^2 / 12, and none across."""
    kernels = blur_kernels(LensBlur(0.8), np.array(motion_px), NO_MOTION)
    assert kernels is not None
    kernel = kernels[1]
    at = np.arange(len(kernel)) - len(kernel) // 2
    columns, rows = np.meshgrid(at, at)
    length = np.linalg.norm(motion_px)
    along = (columns * motion_px[0] + rows * motion_px[1]) / length
    across = (rows * motion_px[0] - columns * motion_px[1]) / length
    lens = 0.8**2 - PIXEL_VARIANCE
    assert (kernel * along**2).sum() - lens == pytest.approx(length**2 / 12, rel=0.03)
    assert (kernel * across**2).sum() == pytest.approx(lens, rel=0.03)


def test_motion_is_the_poses_velocity_times_the_exposure() -> None:
    """0.01 m to the side in 40 ms at a distance of 0.25 m moves the place by 12.8 px; in 10 ms a quarter of that."""
    place, moved = np.array([0.07, 0.045, 0.0]), pose()
    moved[:3, 3] += 0.01 * moved[:3, 0]
    artifacts = CameraArtifacts()
    plain = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    frames = [
        ViewFrame(number, number * 40_000_000, plain, camera(), exposure_s=0.01, pose=BoardPose(at))
        for number, at in enumerate((pose(), moved))
    ]
    first, second = (
        artifacts.observe(each, each.pose.world_from_camera, place) for each in frames if each.pose
    )
    assert first.kernels is None
    assert second.kernels is not None
    at = np.arange(second.kernels.shape[1]) - second.kernels.shape[1] // 2
    variance = (second.kernels[1].sum(axis=0) * at**2).sum()
    assert np.sqrt(12 * variance) == pytest.approx(0.25 * 0.01 / 0.25 * FOCAL_PX, rel=0.05)
    again = artifacts.observe(frames[1], moved, place)
    assert again.kernels is not None
    assert np.array_equal(again.kernels, second.kernels)
