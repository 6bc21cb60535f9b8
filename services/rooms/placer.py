"""Where rooms run: the interface of all placers.

A placer starts the render server of a room in a free slot and says what becomes of it. It decides nothing: which room
is placed when, and what follows a loss, is the keeper's (`keeper.RoomKeeper`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from deltalight.protocol.errors import DeltalightError


class NoSlotError(DeltalightError):
    """No slot is free, or the one that was asked for is not."""


@dataclass(frozen=True)
class RoomOrder:
    """What a render server needs to know: its room, whose frames it reads, and the file that keeps the scene.

    `epoch` counts the placements of all rooms: endpoints of a newer one replace those of an older one of the room.
    """

    room: str
    epoch: int
    sources: tuple[str, ...]
    session_file: Path


@dataclass(frozen=True)
class Placement:
    """A render server that was started: its slot, and its endpoints, which no other placement has had."""

    room: str
    epoch: int
    slot: str
    publish: str
    control: str


@dataclass(frozen=True)
class Slot:
    """Room for one render server: on which device, and who is in it (the room's name, None = free)."""

    name: str
    device: str
    room: str | None


@dataclass(frozen=True)
class PlacementEvent:
    """News of a placement.

    `reported`: the render server says how it is; `shows` tells whether it renders frames now. `lost`: it is gone, or
    was ended because it hung; `refused` tells that it did not take its input, so that another attempt is in vain.
    """

    epoch: int
    kind: Literal["reported", "lost"]
    detail: str = ""
    shows: bool = False
    refused: bool = False


class Placer(Protocol):
    """Places render servers; called from one thread at a time."""

    def slots(self) -> Sequence[Slot]:
        """Return all slots."""

    def place(self, order: RoomOrder, slot: str | None = None) -> Placement:
        """Start the render server of a room, in this slot or in a free one, without waiting for it.

        Raises:
            NoSlotError: there is none.
            DeltalightError: it cannot be started.
        """

    def release(self, placement: Placement) -> None:
        """End a render server and free its slot; one that is gone already is ignored."""

    def watch(self) -> Sequence[PlacementEvent]:
        """Return what happened since the last call; the slot of what was lost is free."""

    def close(self) -> None:
        """End all render servers."""
