"""The fish-eye's map as the objects see it: near things move to where they are, nothing else changes."""

import numpy as np
import pytest

from deltalight.protocol.octahedral import octahedral_grid, sample_octahedral
from deltalight.render_server.estimation.parallax import EnvironmentParallax

SIZE = 64
FISHEYE, OBJECTS = np.array([0.0, 0.0, 0.1]), np.array([0.4, 0.0, 0.1])
BOOK = np.array([0.0, 0.4, 0.3])  # its middle
GREY, RED = np.full(3, 0.3, np.float32), np.array([0.8, 0.1, 0.1], np.float32)


def sheet(middle: np.ndarray, half: float) -> np.ndarray:
    """Points of a square whose normal is y."""
    across, up = np.meshgrid(*[np.linspace(-half, half, 200)] * 2)
    return middle + np.stack([across, 0 * across, up], axis=-1).reshape(-1, 3)


def room_with(middle: np.ndarray, half: float) -> np.ndarray:
    """What the fish-eye sees: a grey room, and a red sheet."""
    ways = octahedral_grid(SIZE)
    with np.errstate(divide="ignore", invalid="ignore"):
        met = FISHEYE + ways * ((middle - FISHEYE)[1] / ways[..., 1:2])
    is_sheet = (ways[..., 1] > 0) & (np.abs(met - middle).max(axis=-1) <= half)
    return np.where(is_sheet[..., None], RED, GREY)


def towards(place: np.ndarray, origin: np.ndarray) -> np.ndarray:
    return (place - origin)[None, None] / np.linalg.norm(place - origin)


def test_a_near_thing_lies_where_the_objects_see_it_and_the_room_beside_it_where_it_was() -> None:
    seen = room_with(BOOK, 0.1)
    moved = EnvironmentParallax.between(FISHEYE, OBJECTS, sheet(BOOK, 0.1), SIZE).applied(seen)
    assert sample_octahedral(seen, towards(BOOK, FISHEYE))[0, 0] == pytest.approx(RED)
    assert sample_octahedral(moved, towards(BOOK, OBJECTS))[0, 0] == pytest.approx(RED, abs=0.02)
    assert sample_octahedral(moved, towards(BOOK, FISHEYE))[0, 0] == pytest.approx(GREY, abs=0.1)
    away = octahedral_grid(SIZE)[..., 1] < 0
    np.testing.assert_array_equal(moved[away], seen[away])


def test_without_parallax_the_map_stays_as_it_is() -> None:
    seen, points = room_with(BOOK, 0.1), sheet(BOOK, 0.1)
    for objects, near in (
        (FISHEYE, points),
        (OBJECTS, FISHEYE + 1e4 * (points - FISHEYE)),
        (OBJECTS, points[:0]),
    ):
        same = EnvironmentParallax.between(FISHEYE, objects, near, SIZE)
        assert same.is_shown.all()
        np.testing.assert_allclose(same.applied(seen), seen, atol=0.03)


def test_it_holds_while_the_fisheye_trembles_and_not_once_it_has_moved() -> None:
    parallax = EnvironmentParallax.between(FISHEYE, OBJECTS, sheet(BOOK, 0.1), SIZE)
    assert parallax.holds_for(FISHEYE + np.array([0.002, 0.0, -0.002]))
    assert not parallax.holds_for(FISHEYE + np.array([0.0, 0.02, 0.0]))


def test_what_a_nearer_thing_hides_from_the_fisheye_does_not_get_its_colour() -> None:
    """The wall behind the book, which the objects see beside it, is as the wall around it."""
    wall = sheet(np.array([-0.4, 0.8, 0.5]), 0.6)
    points = np.vstack([sheet(BOOK, 0.1), wall])
    parallax = EnvironmentParallax.between(FISHEYE, OBJECTS, points, SIZE)
    behind = FISHEYE + 2 * (BOOK - FISHEYE)
    assert np.abs(behind[[0, 2]] - [-0.4, 0.5]).max() < 0.6
    found = sample_octahedral(parallax.applied(room_with(BOOK, 0.1)), towards(behind, OBJECTS))[0, 0]
    assert found == pytest.approx(GREY, abs=0.1)
