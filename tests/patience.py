"""How long tests may take: who says that it takes long gets more time, and who loses too much of it is given up."""

from collections import defaultdict
from collections.abc import Iterable

import pytest

TIMES = 10  # a machine may be this much slower than the one whose seconds the marks tell
LIMIT_S = 300.0  # of pytest-timeout, for those that do not say
LOST_S = 120.0  # that the failed tests of a file may take together: two waits of a minute each


def grant(items: Iterable[pytest.Item]) -> None:
    """Gives tests that say how long they take that time, TIMES over; the others have pytest-timeout's."""
    for item in items:
        mark = item.get_closest_marker("slow")
        limit_s = TIMES * mark.kwargs.get("seconds", 0.0) if mark is not None else 0.0
        if limit_s > LIMIT_S:
            item.add_marker(pytest.mark.timeout(limit_s))


class LostTime:
    """What a machine cannot do is found out once: where failed tests of a file took long, the others fail at once.

    Each of them would wait for what does not come, until its own limit.
    """

    def __init__(self) -> None:
        self._lost_s = defaultdict[str, float](float)  # by file

    def note(self, report: pytest.TestReport) -> None:
        """Counts the time of a test that failed."""
        if report.failed:
            self._lost_s[_file(report.nodeid)] += report.duration

    def refuse(self, item: pytest.Item) -> None:
        """Fail a test whose file is given up.

        Raises:
            pytest.fail.Exception: it is.
        """
        lost_s = self._lost_s[_file(item.nodeid)]
        if lost_s >= LOST_S:
            pytest.fail(f"not tried: tests of this file failed after {lost_s:.0f} s already", pytrace=False)


def _file(nodeid: str) -> str:
    return nodeid.partition("::")[0]
