"""What a machine cannot do is found out once, and tests that take long are given the time."""

from pathlib import Path

import pytest

from tests.patience import LIMIT_S, LOST_S, TIMES, LostTime, grant


def report(nodeid: str, outcome: str, duration_s: float) -> pytest.TestReport:
    return pytest.TestReport(
        nodeid,
        (nodeid, None, ""),
        {},
        outcome,  # type: ignore[arg-type]
        None,
        "call",
        duration=duration_s,
    )


@pytest.fixture
def item(request: pytest.FixtureRequest) -> pytest.Item:
    """A test of this file that no one has marked."""
    return pytest.Function.from_parent(
        pytest.Module.from_parent(request.session, path=Path(__file__)),
        name="test_nothing",
        callobj=lambda: None,
    )


def test_a_file_whose_tests_fail_for_long_is_given_up(item: pytest.Item) -> None:
    lost = LostTime()
    lost.note(report("tests/other.py::test_a", "failed", LOST_S))
    lost.note(report(item.nodeid, "passed", LOST_S))
    lost.note(report(item.nodeid, "failed", LOST_S - 1))
    lost.refuse(item)
    lost.note(report(item.nodeid, "failed", 1))
    with pytest.raises(pytest.fail.Exception, match=f"failed after {LOST_S:.0f} s"):
        lost.refuse(item)


def test_who_says_that_it_takes_long_gets_more_time(item: pytest.Item) -> None:
    grant([item])
    item.add_marker(pytest.mark.slow(seconds=LIMIT_S / TIMES))
    grant([item])
    assert item.get_closest_marker("timeout") is None, "it has the limit of all"
    item.add_marker(pytest.mark.slow(seconds=LIMIT_S), append=False)
    grant([item])
    mark = item.get_closest_marker("timeout")
    assert mark is not None
    assert mark.args == (LIMIT_S * TIMES,)
