"""Noise of synthetic cameras is found, and put on the virtual part alone."""

import cv2
import numpy as np
import pytest

from deltalight.benchmarks.ground_truth.sensors import ColorSensor, srgb_bytes
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.render_server.post_effects.camera_noise import (
    CameraNoise,
    NoiseModel,
    add_noise,
    estimate_noise,
)

SIZE = (240, 320)
LINEAR = np.repeat(np.linspace(0.03, 0.8, SIZE[1], dtype=np.float32)[None, :, None], SIZE[0], 0).repeat(3, 2)
LINEAR = LINEAR * np.array([1, 0.9, 0.7], np.float32)
BINS = np.linspace(0.05, 0.5, 8)[:, None].repeat(3, 1)


def pair(sensor: ColorSensor) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return sensor.expose(LINEAR, rng), sensor.expose(LINEAR, rng)


@pytest.mark.parametrize(("shot", "read"), [(2e-4, 0.003), (5e-5, 0.006), (6e-4, 0.001)])
def test_noise_is_found_within_15_percent_in_every_bin(shot: float, read: float) -> None:
    found = estimate_noise(*pair(ColorSensor(shot, read)), None)
    assert found is not None
    np.testing.assert_allclose(found.variance(BINS), read**2 + shot * BINS, rtol=0.15)
    assert max(found.correlation) < 0.05


@pytest.mark.parametrize(("shot", "read"), [(2e-4, 0.003), (5e-5, 0.006)])
@pytest.mark.parametrize("levels", [[0.05, 0.5], [0.04, 0.1, 0.3, 0.31, 0.6]])
def test_areas_of_one_brightness_tell_their_noise(shot: float, read: float, levels: list[float]) -> None:
    flat = np.repeat(np.array(levels, np.float32), SIZE[1] // len(levels))
    picture = np.broadcast_to(flat[None, :, None], (SIZE[0], len(flat), 3)).astype(np.float32)
    rng, sensor = np.random.default_rng(3), ColorSensor(shot, read)
    found = estimate_noise(sensor.expose(picture, rng), sensor.expose(picture, rng), None)
    assert found is not None
    ends = np.array([levels[0], levels[-1]])[:, None].repeat(3, 1)
    np.testing.assert_allclose(found.variance(ends), read**2 + shot * ends, rtol=0.15)


def test_what_moves_is_left_out() -> None:
    """A tenth of the picture moves; the noise stays the rest's. Where all moves, nothing is found."""
    first, second = pair(ColorSensor(2e-4, 0.003))
    moved = second.copy()
    moved[:, :32] = moved[:, 32:64]
    found = estimate_noise(first, moved, None)
    assert found is not None
    np.testing.assert_allclose(found.variance(BINS), 0.003**2 + 2e-4 * BINS, rtol=0.2)
    assert estimate_noise(first, np.roll(second, 40, axis=1), None) is None


def test_equal_pictures_have_no_noise() -> None:
    first, _ = pair(ColorSensor())
    found = estimate_noise(first, first, None)
    assert found is not None
    assert not found.variance(BINS).any()


def test_added_noise_is_the_models() -> None:
    """Variance within 15 % at every intensity, and correlation, as measured in pictures with the noise."""
    model = NoiseModel(np.full(3, 2e-5), np.full(3, 3e-4), (0.4, 0.2))
    clean, cover = srgb_bytes(LINEAR), np.ones(SIZE, np.float32)
    noisy = [add_noise(clean, cover, model, number, None) for number in (1, 2)]
    found = estimate_noise(noisy[0], noisy[1], None)
    assert found is not None
    np.testing.assert_allclose(found.variance(BINS), model.variance(BINS), rtol=0.15)
    np.testing.assert_allclose(found.correlation, model.correlation, atol=0.05)
    assert np.abs(noisy[0].astype(float).mean(axis=0) - clean.mean(axis=0)).mean() < 0.3
    assert np.array_equal(noisy[0], add_noise(clean, cover, model, 1, None))
    assert not np.array_equal(noisy[0], noisy[1])


def test_noise_follows_coverage() -> None:
    """None without coverage, and at edges what the real part lacks: (1 - c) of the real noise stays there."""
    model = NoiseModel(np.full(3, 1e-4), np.zeros(3), (0.0, 0.0))
    clean = np.full((*SIZE, 3), 150, np.uint8)
    cover = np.zeros(SIZE, np.float32)
    cover[:, 100:200], cover[:, 200:] = 0.5, 1.0
    lut = decode_lut(None)
    noise = lut[add_noise(clean, cover, model, 5, None), np.arange(3)] - lut[150]
    assert not noise[:, :100].any()
    assert noise[:, 100:200].var() == pytest.approx(0.75e-4, rel=0.15)
    assert noise[:, 200:].var() == pytest.approx(1e-4, rel=0.15)


def test_a_camera_is_learnt_from_its_frames() -> None:
    rng, sensor, noise = np.random.default_rng(4), ColorSensor(2e-4, 0.003), CameraNoise()
    camera = CameraModel(SIZE[1], SIZE[0], np.array([[300, 0, 160], [0, 300, 120], [0, 0, 1.0]]))
    frames = [ViewFrame(number, number, sensor.expose(LINEAR, rng), camera) for number in range(4)]
    noise.observe(frames[0])
    assert noise.model is None
    for frame in frames:
        noise.observe(frame)
    model = noise.model
    assert model is not None
    np.testing.assert_allclose(model.variance(BINS), 0.003**2 + 2e-4 * BINS, rtol=0.1)
    noise.forget()
    assert noise.model is None


def test_correlated_noise_of_a_camera_is_found() -> None:
    rng, kernel = np.random.default_rng(6), np.array([0.3, 1, 0.3]) / np.sqrt(1.18)
    white = [rng.standard_normal((*SIZE, 3)) for _ in range(2)]
    pictures = [
        srgb_bytes((LINEAR + 0.01 * cv2.sepFilter2D(each, -1, kernel, np.ones(1))).astype(np.float32))
        for each in white
    ]
    found = estimate_noise(*pictures, None)
    assert found is not None
    assert found.correlation[0] == pytest.approx(0.6 / 1.18, abs=0.05)
    assert found.correlation[1] < 0.05
