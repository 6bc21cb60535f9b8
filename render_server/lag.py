"""Stages of a frame graph that may lag some frames behind what moves."""

from collections.abc import Container, Sequence
from dataclasses import dataclass, field


@dataclass(eq=False)
class Lag:
    """Lets stages follow changes of the inputs `behind` only in one of `turns` frames, while these keep changing.

    The stages run at once on the first change, when any other input changes, and in the first frame without a change.
    """

    behind: Container[object]
    turns: int
    has_run: bool = False  # in this frame, because of `behind` alone
    is_waiting: bool = False  # in this frame
    _waited: int = 0  # frames in a row
    _may_wait: bool = False
    # Versions of the inputs, by inputs, of stages that were asked in this frame, and in the one before.
    _held: dict[tuple[object, ...], Sequence[int]] = field(default_factory=dict)
    _held_before: dict[tuple[object, ...], Sequence[int]] = field(default_factory=dict)

    def begin_frame(self) -> None:
        """Lets the stages wait if they ran or waited in the last frame, `turns` - 1 times in a row at most."""
        self._waited = self._waited + 1 if self.is_waiting else 0
        self._may_wait = (self.has_run or self.is_waiting) and self._waited < self.turns - 1
        self.has_run = self.is_waiting = False
        self._held_before, self._held = self._held, {}

    def holds(self, inputs: Sequence[object], seen: Sequence[int] | None, versions: Sequence[int]) -> bool:
        """Decides whether a stage waits; its inputs had the versions `seen` when it last ran (None: never)."""
        if seen is None:
            return False
        changed = (item for item, old, new in zip(inputs, seen, versions, strict=True) if old != new)
        if any(item not in self.behind for item in changed):
            return False
        waits = self._may_wait and self._held_before.get(tuple(inputs)) != versions
        self._held[tuple(inputs)] = versions
        self.is_waiting |= waits
        self.has_run |= not waits
        return waits
