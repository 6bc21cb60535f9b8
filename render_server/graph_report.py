"""Reports on the sources and stages of a frame graph, for people and programs."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

Clock = Literal["scene", "lights", "world", "objects", "view"]
CLOCKS: Final[tuple[Clock, ...]] = get_args(Clock)


@dataclass(frozen=True)
class SourceReport:
    """A source after a frame; `changed`: in this frame."""

    name: str
    clock: Clock
    size_bytes: int
    changed: bool


@dataclass(frozen=True)
class StageReport:
    """A stage after a frame.

    Attributes:
        size_bytes: GPU memory of its outputs, without what counts as another stage's or source's.
        time_ms: how long its last run took.
        ran: in this frame.
        section: part of the frame that it belongs to.
        is_value: it only combines values.
        summary: first sentence of its function's docstring.
        file: where that function is.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    clocks: tuple[Clock, ...]
    size_bytes: int
    time_ms: float | None
    ran: bool
    section: str
    is_value: bool
    summary: str
    file: str


def summary(function: Callable[..., Any]) -> str:
    """Returns the first sentence of a function's documentation, without its full stop."""
    text = " ".join((inspect.getdoc(function) or "").split("\n\n")[0].split())
    return text.split(". ")[0].rstrip(".")
