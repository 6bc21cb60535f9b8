"""Calls that bind a program's resources: made once for each set of them, while it exists."""

from collections.abc import Callable
from functools import partial

from deltalight.render_server.gpu.program_slots import SETS_KEPT, BindingCalls

Bound = list[tuple[str, object]]


class Resource:
    """Something that can be bound, until it is released."""

    def __init__(self) -> None:
        self.mglo = object()

    def release(self) -> None:
        """Lets go of what was bound, as moderngl's objects do."""
        self.mglo = object()


def recording(bound: Bound, made: list[str]) -> BindingCalls:
    """Calls of two slots that note what they bind; `made` tells for which slots calls were made."""

    def binder(name: str, item: object) -> Callable[[], None]:
        made.append(name)
        return partial(bound.append, (name, id(item)))

    return BindingCalls([partial(binder, name) for name in ("first", "second")])


def test_calls_of_the_same_resources_are_made_once() -> None:
    bound: Bound = []
    made: list[str] = []
    calls, one = recording(bound, made), Resource()
    for _ in range(2):
        for call in calls.of((one, None)):
            call()
    assert made == ["first", "second"]
    assert bound == [("first", id(one)), ("second", id(None))] * 2
    calls.of((None, one))
    assert len(made) == 4


def test_calls_of_what_was_released_are_not_found() -> None:
    made: list[str] = []
    calls, item = recording([], made), Resource()
    calls.of((item, None))
    item.release()
    calls.of((item, None))
    assert len(made) == 4


def test_no_calls_of_what_ended_are_found() -> None:
    """Python gives the ids of what ended to what comes next: calls for that are made anew."""
    made: list[str] = []
    calls = recording([], made)
    for _ in range(100):
        calls.of((Resource(), None))
    assert len(made) == 200


def test_no_more_sets_are_kept_than_a_room_needs() -> None:
    made: list[str] = []
    calls, held = recording([], made), [Resource() for _ in range(SETS_KEPT + 1)]
    for item in (*held, held[-1], held[0]):
        calls.of((item, None))
    assert len(made) == 2 * (len(held) + 1)  # the newest is kept, the first was given up
