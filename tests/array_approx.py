"""`pytest.approx` of arrays, all numbers at once: pytest takes microseconds for each, most of some tests' time."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import numpy as np
import pytest

REL, ABS = 1e-6, 1e-12  # of pytest, where a test gives none


def compare_arrays_at_once() -> None:
    """What agrees is told at once; pytest looks at all else, and says what is wrong."""
    for example, agrees in ((np.zeros(1), _agrees_with_array), (1.0, _agrees_with_number)):
        kind = type(pytest.approx(example))
        if kind.__eq__.__module__ != __name__:
            kind.__eq__ = _quick(kind.__eq__, agrees)


def _quick(
    compare: Callable[[Any, object], bool], agrees: Callable[[Any, object], bool]
) -> Callable[[Any, object], bool]:
    @wraps(compare, assigned=())
    def is_close(approx: Any, actual: object) -> bool:  # noqa: ANN401 (pytest's own class)
        return agrees(approx, actual) or compare(approx, actual)

    return is_close


def _agrees_with_array(approx: Any, actual: object) -> bool:  # noqa: ANN401
    """Whether each pair agrees, in the precision of Python's floats, as pytest compares them."""
    expected = approx.expected
    if not isinstance(actual, np.ndarray) or actual.shape != expected.shape:
        return False
    if expected.dtype.kind not in "fiu" or actual.dtype.kind not in "fiu" or not np.isfinite(expected).all():
        return False
    wanted = expected.astype(float)
    if approx.rel is None and approx.abs is not None:
        tolerance = approx.abs
    else:
        rel, least = (REL if approx.rel is None else approx.rel), (ABS if approx.abs is None else approx.abs)
        tolerance = np.maximum(rel * np.abs(wanted), least)
    with np.errstate(invalid="ignore"):
        return bool((np.abs(wanted - actual.astype(float)) <= tolerance).all())


def _agrees_with_number(approx: Any, actual: object) -> bool:  # noqa: ANN401
    """Whether each float of an array agrees with one number, in the array's precision, as pytest compares them."""
    expected = approx.expected
    if not isinstance(actual, np.ndarray) or actual.dtype.kind != "f":
        return False
    if not isinstance(expected, float | int | np.floating) or isinstance(expected, bool):
        return False
    if not np.isfinite(expected):
        return False
    with np.errstate(all="ignore"):
        return bool((np.abs(expected - actual) <= approx.tolerance).all())
