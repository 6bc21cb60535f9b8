"""Arrays that are compared at once agree exactly where pytest, which looks at each number, says so."""

from itertools import product
from typing import Any

import numpy as np
import pytest

ODD = [np.nan, np.inf, -np.inf, 0.0, 1.0, 1 + 1e-7, 1 + 5e-6, -1.0, 2.0**-149, 3e38]


def one_by_one(actual: Any, expected: Any, **tolerance: Any) -> bool:  # noqa: ANN401
    """What pytest says of each pair of plain numbers."""
    pairs = zip(np.ravel(actual).tolist(), np.broadcast_to(expected, np.shape(actual)).ravel(), strict=True)
    return all(number == pytest.approx(float(wanted), **tolerance) for number, wanted in pairs)


@pytest.mark.parametrize("tolerance", [{}, {"rel": 1e-5}, {"abs": 1e-6}, {"rel": 1e-5, "abs": 0.5}], ids=str)
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_arrays_agree_as_their_numbers_do(kind: type[np.floating], tolerance: dict[str, float]) -> None:
    with np.errstate(all="ignore"):
        for number, wanted in product(np.array(ODD, kind), repeat=2):
            actual, expected = np.array([1, number, 1], kind), np.array([1, wanted, 1], kind)
            agrees = one_by_one(actual, expected, **tolerance)
            assert (actual == pytest.approx(expected, **tolerance)) == agrees, (number, wanted)
            assert (expected == pytest.approx(expected, **tolerance)) != np.isnan(wanted)


@pytest.mark.parametrize("wanted", [0.25, np.float32(0.25), np.inf, np.nan])
def test_arrays_agree_with_one_number(wanted: float) -> None:
    for off in (0.0, 0.009, 0.011, -0.011, np.inf, np.nan):
        actual = np.array([0.25, 0.25 + off], np.float32)
        assert (actual == pytest.approx(wanted, abs=0.01)) == one_by_one(actual, wanted, abs=0.01), off


def test_what_cannot_be_compared_does_not_agree() -> None:
    pictures = np.array([[0, 255]], np.uint8)
    assert pictures == pytest.approx(np.array([[1, 254]], np.uint8), abs=1)
    assert pictures != pytest.approx(np.array([[2, 254]], np.uint8), abs=1)
    assert pictures != pytest.approx(pictures.T, abs=1)
    assert np.array([True]) != pytest.approx(np.array([0.5]), abs=0.1)
    assert np.array([np.nan]) == pytest.approx(np.array([np.nan]), nan_ok=True)
    with pytest.raises(ValueError, match="negative"):
        assert np.ones(2) == pytest.approx(np.zeros(2), abs=-1.0)
    with pytest.raises(AssertionError, match="Mismatched elements: 1 / 2"):
        assert np.ones(2) == pytest.approx(np.array([1.0, 2.0]))
