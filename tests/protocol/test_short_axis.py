"""Reductions by columns give what NumPy gives, to the bit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from deltalight.protocol import short_axis

FLOATS = st.sampled_from([np.float32, np.float64])
SHAPES = st.tuples(st.integers(1, 40), st.integers(1, 5))


def _values(seed: int, kind: type, shape: tuple[int, ...]) -> np.ndarray:
    dice = np.random.default_rng(seed)
    values = dice.normal(size=shape) * 10.0 ** dice.integers(-6, 6, shape)
    values[dice.random(shape) < 0.02] = np.nan
    return values.astype(kind)


VALUES = st.builds(_values, st.integers(0, 2**32 - 1), FLOATS, SHAPES)


def _same(found: np.ndarray, wanted: np.ndarray) -> None:
    assert found.dtype == wanted.dtype
    np.testing.assert_array_equal(found, wanted)


@given(VALUES)
def test_bounds_greatest_and_lengths_are_those_of_numpy(values: np.ndarray) -> None:
    low, high = short_axis.bounds(values)
    _same(low, values.min(axis=0))
    _same(high, values.max(axis=0))
    _same(short_axis.greatest(values), values.max(axis=1))
    _same(short_axis.lengths(values[:, :3]), np.linalg.norm(values[:, :3], axis=-1))


@given(st.integers(0, 2**32 - 1), SHAPES)
def test_mean_and_length_are_those_of_numpy(seed: int, shape: tuple[int, int]) -> None:
    values = _values(seed, np.float64, shape)
    _same(short_axis.mean(values), values.mean(axis=0))
    np.testing.assert_array_equal(short_axis.length(values[0]), np.linalg.norm(values[0]))


@given(arrays.arrays(bool, st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(1, 5))))
def test_masks_of_any_shape_are_reduced_along_their_last_axis(mask: np.ndarray) -> None:
    _same(short_axis.all_of(mask), np.all(mask, axis=-1))
    _same(short_axis.any_of(mask), np.any(mask, axis=-1))


@given(st.integers(0, 2**32 - 1), FLOATS, st.integers(0, 40))
def test_boxes_enclose_the_corners_of_each_triangle(seed: int, kind: type, count: int) -> None:
    corners = _values(seed, kind, (count, 3, 3))
    low, high = short_axis.boxes(corners)
    _same(low, corners.min(axis=1))
    _same(high, corners.max(axis=1))


def test_no_points_have_no_bounds() -> None:
    with pytest.raises(ValueError, match="zero-size"):
        short_axis.bounds(np.zeros((0, 3)))
