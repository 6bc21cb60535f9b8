"""Albedo averaged by place and time."""

import numpy as np
import pytest

from deltalight.render_server.scene.albedo import CELLS, MEAN_ALBEDO, AlbedoVolume

BOUNDS = (np.zeros(3), np.ones(3))


def at(memory: AlbedoVolume, *point: float) -> np.ndarray:
    x, y, z = np.floor((np.array(point) - memory.origin) / memory.edge * CELLS).astype(int)
    return memory.filled()[z, y, x]


def show(memory: AlbedoVolume, point: tuple[float, float, float], albedo: float, noise: float = 0.0) -> None:
    rng = np.random.default_rng(memory.version)
    irradiance = rng.uniform(0.5, 2, (20, 3))
    measured = albedo / np.pi * irradiance * rng.normal(1, noise, (20, 3))
    memory.observe(BOUNDS, np.tile(point, (20, 1)), measured, irradiance)


def test_nothing_seen_is_the_mean_of_rooms() -> None:
    memory = AlbedoVolume()
    memory.observe(BOUNDS, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
    assert np.unique(memory.filled()).tolist() == [MEAN_ALBEDO]


def test_noise_is_averaged_over_time() -> None:
    memory = AlbedoVolume()
    for _ in range(40):
        show(memory, (0.5, 0.5, 0.5), 0.3, noise=0.2)
    assert at(memory, 0.5, 0.5, 0.5) == pytest.approx([0.3] * 3, rel=0.05)


def test_holes_take_the_albedo_of_the_nearest_surroundings() -> None:
    memory = AlbedoVolume()
    show(memory, (0.1, 0.1, 0.1), 0.1)
    show(memory, (0.9, 0.9, 0.9), 0.8)
    assert at(memory, 0.15, 0.12, 0.1) == pytest.approx([0.1] * 3, rel=1e-4)
    assert at(memory, 0.95, 0.9, 0.99) == pytest.approx([0.8] * 3, rel=1e-4)
    assert 0.1 < at(memory, 0.1, 0.9, 0.1)[0] < 0.8


def test_a_surface_that_was_painted_is_learnt_anew() -> None:
    memory = AlbedoVolume()
    for _ in range(50):
        show(memory, (0.5, 0.5, 0.5), 0.7)
    for _ in range(50):
        show(memory, (0.5, 0.5, 0.5), 0.2)
    assert at(memory, 0.5, 0.5, 0.5) == pytest.approx([0.2] * 3, rel=0.05)


def test_unusable_samples_change_nothing() -> None:
    memory = AlbedoVolume()
    show(memory, (0.5, 0.5, 0.5), 0.3)
    before = memory.filled()
    outside, dark = np.full((3, 3), 7.0), np.full((3, 3), 0.5)
    memory.observe(BOUNDS, outside, np.ones((3, 3)), np.ones((3, 3)))
    memory.observe(BOUNDS, dark, np.full((3, 3), np.nan), np.ones((3, 3)))
    memory.observe(BOUNDS, dark, np.ones((3, 3)), np.zeros((3, 3)))
    assert np.array_equal(memory.filled(), before)


def test_a_scene_that_outgrows_the_cube_gets_a_new_one() -> None:
    memory = AlbedoVolume()
    show(memory, (0.5, 0.5, 0.5), 0.3)
    far = np.full((1, 3), 3.9)
    memory.observe((np.zeros(3), np.full(3, 4.0)), far, np.full((1, 3), 0.6 / np.pi), np.ones((1, 3)))
    assert memory.edge > 4
    assert at(memory, 0.5, 0.5, 0.5) == pytest.approx([0.6] * 3, rel=1e-4)
