"""What a frame graph tells of its sources and stages, for who reads it."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

if TYPE_CHECKING:
    from deltalight.render_server.stages import Stage

Clock = Literal["scene", "lights", "world", "objects", "view"]
CLOCKS: Final[tuple[Clock, ...]] = get_args(Clock)


@dataclass(frozen=True)
class SourceReport:
    """One source as the frame left it. `changed`: whether it did in this frame."""

    name: str
    clock: Clock
    size_bytes: int
    changed: bool


@dataclass(frozen=True)
class StageReport:
    """One stage as the frame left it.

    `size_bytes` is the GPU memory of what it writes, as far as no other stage or source has it by itself; `time_ms`
    what it took when it last ran. `is_value`: it only puts values together. `summary` and `file` tell what its
    function does, and where it stands.
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


def links(circle: "Sequence[Stage]") -> str:
    """Returns what each stage of a circle reads of the next."""
    links = []
    for stage, writer in zip(circle, [*circle[1:], circle[0]], strict=True):
        item = next(item for item in stage.inputs if item.stage is writer)
        links.append(f"`{stage.name}` reads `{item.name}` of `{writer.name}`")
    return ", ".join(links)
