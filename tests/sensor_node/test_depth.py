"""Depth clean-up: noise goes, steps stay, small holes close, unknown stays unknown."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import Bool, Float32, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.sensor_node.depth import DepthSettings, clean_depth, estimate_noise_sigma

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
SIGMA = 0.002
CAMERA = CameraModel(WIDTH, HEIGHT, np.array([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1]]))
GREY = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
COLUMNS, ROWS = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))


def slanted_plane(near_inverse: float = 1.0) -> Float32[np.ndarray, "h w"]:
    """Depth of a plane that recedes to one side and upwards."""
    inverse = near_inverse + 0.5 * (COLUMNS - 160) / FOCAL + 0.8 * (ROWS - 120) / FOCAL
    return (1 / inverse).astype(np.float32)


def disc() -> Bool[np.ndarray, "h w"]:
    return np.asarray((COLUMNS - 150) ** 2 + (ROWS - 110) ** 2 < 50**2)


def image(depth_m: Float32[np.ndarray, "h w"], sigma: float | None = SIGMA) -> DepthImage:
    return DepthImage(depth_m, depth_m > 0, CAMERA, sigma)


def noisy(depth_m: Float32[np.ndarray, "h w"], sigma: float = SIGMA) -> Float32[np.ndarray, "h w"]:
    noise = np.random.default_rng(1).normal(0, sigma, depth_m.shape)
    return (depth_m + noise * depth_m**2).astype(np.float32)


def checked(period: int = 16) -> UInt8[np.ndarray, "h w 3"]:
    """A texture that has nothing to do with depth."""
    tiles = ((COLUMNS // period + ROWS // period) % 2).astype(bool)
    return np.where(tiles[..., None], np.uint8(220), np.uint8(30)).repeat(3, axis=2)


@pytest.mark.parametrize("color", [GREY, checked()], ids=["grey", "textured"])
def test_noise_on_a_slanted_plane_is_reduced_and_texture_is_not_copied(
    color: UInt8[np.ndarray, "h w 3"],
) -> None:
    truth = slanted_plane()
    cleaned = clean_depth(image(noisy(truth)), color)
    error = (cleaned.depth_m - truth) / truth**2
    assert cleaned.valid.all()
    assert error.std() < 0.25 * SIGMA
    assert abs(error.mean()) < 0.02 * SIGMA


@pytest.mark.parametrize("step_m", [0.03, 0.3])
def test_a_step_that_colour_does_not_show_stays_sharp(step_m: float) -> None:
    truth = slanted_plane()
    truth[disc()] -= step_m
    raw = noisy(truth)
    cleaned = clean_depth(image(raw), GREY)
    error = np.abs(cleaned.depth_m - truth) / truth**2
    edge = cv2.morphologyEx(disc().astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    # Beside the step a reading moves by three standard deviations (of noise and floor together) at most.
    moved = np.abs(cleaned.depth_m - raw) / truth**2
    assert moved[edge].max() < 3.2 * np.hypot(SIGMA, 0.001)
    assert np.median(error[edge]) < 0.7 * SIGMA
    assert (error[edge] > step_m / 3).mean() < 0.01


def test_small_holes_are_filled_exactly_and_large_ones_stay() -> None:
    truth = slanted_plane()
    holed = noisy(truth)
    holed[50:56, 60:67] = 0
    holed[100:140, 200:250] = 0
    cleaned = clean_depth(image(holed), GREY)
    small, large = np.s_[50:56, 60:67], np.s_[100:140, 200:250]
    assert cleaned.valid[small].all()
    assert np.abs(cleaned.depth_m - truth)[small].max() < 1.5 * SIGMA * truth[small].max() ** 2
    assert not cleaned.valid[large].any()
    assert (cleaned.depth_m[large] == 0).all()


def test_the_fill_area_is_a_setting() -> None:
    holed = slanted_plane()
    holed[50:54, 60:64] = 0
    assert clean_depth(image(holed), GREY, DepthSettings(fill_area_px=16)).valid.all()
    assert not clean_depth(image(holed), GREY, DepthSettings(fill_area_px=15)).valid[50:54, 60:64].any()
    assert not clean_depth(image(holed), GREY, DepthSettings(fill_area_px=0)).valid[50:54, 60:64].any()


def test_a_hole_between_two_surfaces_is_not_bridged() -> None:
    left = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    left[:, 160:] = 1.6
    left[100:106, 157:163] = 0
    cleaned = clean_depth(image(left), GREY)
    hole = cleaned.depth_m[100:106, 157:163]
    near_surface = np.minimum(np.abs(hole - 1.0), np.abs(hole - 1.6)) < 0.02
    assert (near_surface | (hole == 0)).all()


def test_unknown_depth_never_becomes_near_nor_spoils_its_neighbours() -> None:
    truth = np.full((HEIGHT, WIDTH), 1.5, np.float32)
    speckled = truth.copy()
    speckled[np.random.default_rng(2).random(truth.shape) < 0.3] = 0
    cleaned = clean_depth(image(speckled), checked())
    assert np.abs(cleaned.depth_m[cleaned.valid] - 1.5).max() < 1e-3
    assert cleaned.valid.mean() > 0.99
    infinite = replace(image(truth), depth_m=np.where(COLUMNS < 100, np.float32(np.inf), truth))
    assert not clean_depth(infinite, GREY).valid[:, :100].any()


def test_all_unknown_stays_all_unknown() -> None:
    cleaned = clean_depth(image(np.zeros((HEIGHT, WIDTH), np.float32), None), GREY)
    assert not cleaned.valid.any()
    assert (cleaned.depth_m == 0).all()


def test_a_masked_reading_does_not_count_even_if_it_has_a_value() -> None:
    depth_m = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    depth_m[50:90, 50:90] = 0.2
    valid = np.ones(depth_m.shape, bool)
    valid[50:90, 50:90] = False
    cleaned = clean_depth(DepthImage(depth_m, valid, CAMERA, SIGMA), GREY)
    assert not cleaned.valid[50:90, 50:90].any()
    assert np.abs(cleaned.depth_m[cleaned.valid] - 1).max() < 1e-3


def test_odd_sizes_keep_their_size() -> None:
    depth = image(noisy(slanted_plane())[:-1, :-1])
    cleaned = clean_depth(depth, GREY[:-1, :-1])
    assert cleaned.depth_m.shape == cleaned.valid.shape == (HEIGHT - 1, WIDTH - 1)
    assert (np.abs(cleaned.depth_m - slanted_plane()[:-1, :-1]) < 6 * SIGMA).all()


def test_no_filter_and_no_filling_is_the_raw_depth() -> None:
    raw = noisy(slanted_plane())
    raw[10:12, 10:12] = 0
    cleaned = clean_depth(image(raw), GREY, DepthSettings(filter_radius_px=0, fill_area_px=0))
    np.testing.assert_array_equal(cleaned.depth_m, raw)
    np.testing.assert_array_equal(cleaned.valid, raw > 0)
    only_filled = clean_depth(image(raw), GREY, DepthSettings(filter_radius_px=0))
    np.testing.assert_allclose(only_filled.depth_m[raw > 0], raw[raw > 0], rtol=1e-6)
    assert only_filled.valid.all()


@pytest.mark.parametrize("sigma", [0.001, 0.004])
def test_noise_is_measured_despite_steps_and_holes(sigma: float) -> None:
    truth = slanted_plane()
    truth[disc()] -= 0.3
    measured = noisy(truth, sigma)
    measured[150:200, 20:80] = 0
    assert estimate_noise_sigma(image(measured, None)) == pytest.approx(sigma, rel=0.1)


def test_given_noise_wins_over_measured() -> None:
    depth = image(noisy(slanted_plane()), None)
    assert clean_depth(depth, GREY).noise_sigma_m == pytest.approx(SIGMA, rel=0.15)
    assert clean_depth(replace(depth, noise_sigma_m=0.005), GREY).noise_sigma_m == 0.005
    fixed = DepthSettings(noise_sigma_m=0.01)
    assert clean_depth(replace(depth, noise_sigma_m=0.005), GREY, fixed).noise_sigma_m == 0.01


def test_depth_of_another_size_is_refused_with_a_sentence() -> None:
    with pytest.raises(DeltalightError, match=r"320x240 pixels .* 100x100 pixels"):
        clean_depth(image(slanted_plane()), np.zeros((100, 100, 3), np.uint8))


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="filter_radius_px"):
        DepthSettings(filter_radius_px=-1)
