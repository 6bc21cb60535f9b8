"""Deals tests to workers: the longest start first, and the tests of a file stay together."""

from collections.abc import Sequence
from itertools import chain, groupby

import pytest

SLOW_MARKERS = ("slow", "data")
SECONDS = 3.0  # of a slow test that does not say how long it takes


def is_slow(item: pytest.Item) -> bool:
    """Whether a test is left out of the quick tier."""
    return any(item.get_closest_marker(name) for name in SLOW_MARKERS)


def dealt(items: Sequence[pytest.Item], workers: int) -> list[pytest.Item]:
    """Order tests for `--dist worksteal`, which first gives each worker equally many in a row.

    Each worker begins with whole files that have slow tests, the longest first, and ends with quick tests: these are
    what is stolen, so hardly any fixture of a slow file is made twice, and nobody waits long for the last test.
    """
    files = [list(tests) for _, tests in groupby(items, key=lambda item: item.path)]
    lanes: list[list[pytest.Item]] = [[] for _ in range(workers)]
    loads_s = [0.0] * workers
    for tests in sorted(filter(_seconds, files), key=_seconds, reverse=True):
        lightest = loads_s.index(min(loads_s))
        lanes[lightest] += tests
        loads_s[lightest] += _seconds(tests)
    quick = list(chain.from_iterable(tests for tests in files if not _seconds(tests)))
    left = len(items)
    for number, lane in enumerate(lanes):
        size = left // (workers - number)
        missing = max(size - len(lane), 0)
        lane.extend(quick[:missing])
        del quick[:missing]
        left -= size
    return [*chain.from_iterable(lanes), *quick]


def _seconds(tests: Sequence[pytest.Item]) -> float:
    """How long the slow ones take together, as their marks say."""
    marks = (item.get_closest_marker("slow") for item in tests if is_slow(item))
    return sum(SECONDS if mark is None else mark.kwargs.get("seconds", SECONDS) for mark in marks)
