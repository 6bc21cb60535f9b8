"""Where rooms run: the interface of all placers.

A placer starts the render server of a room in a free slot and says what becomes of it. It decides nothing: which room
is placed when, and what follows a loss, is the keeper's (`keeper.RoomKeeper`).
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

from deltalight.protocol.errors import DeltalightError

HERE = "local"  # the host of placers that know one


class NoSlotError(DeltalightError):
    """No slot is free, or the one that was asked for is not."""


@dataclass(frozen=True)
class RoomOrder:
    """What a render server needs to know: its room, whose frames it reads, and the file that keeps the scene.

    `epoch` counts the placements of all rooms: endpoints of a newer one replace those of an older one of the room.
    Its host has all `labels`, and is none of those to `avoid`, which are drained. Devices (host, device) that are
    `doubted` are taken if no other is free.
    """

    room: str
    epoch: int
    sources: tuple[str, ...]
    session_file: Path
    labels: Mapping[str, str] = field(default_factory=dict)
    avoid: frozenset[str] = frozenset()
    doubted: frozenset[tuple[str, str]] = frozenset()


@dataclass(frozen=True)
class Placement:
    """A render server that was started: its slot, and its endpoints, which no other late placement has had."""

    room: str
    epoch: int
    slot: str
    publish: str
    control: str


@dataclass(frozen=True)
class Slot:
    """Room for one render server: on which device of which host, and who is in it (the room's name, None = free)."""

    name: str
    device: str
    room: str | None
    host: str = HERE
    labels: Mapping[str, str] = field(default_factory=dict)  # of the host


@dataclass(frozen=True)
class PlacementEvent:
    """News of a placement.

    `reported`: the render server says how it is; `shows` tells whether it renders frames now. `lost`: it is gone, or
    was ended because it hung; `refused` tells that it did not take its input, so that another attempt is in vain, and
    `host_refused` that its host does not have what it claims.
    """

    epoch: int
    kind: Literal["reported", "lost"]
    detail: str = ""
    shows: bool = False
    refused: bool = False
    host_refused: bool = False


class Placer(Protocol):
    """Places render servers; called from one thread at a time."""

    def slots(self) -> Sequence[Slot]:
        """Returns all slots."""

    def place(self, order: RoomOrder, slot: str | None = None) -> Placement:
        """Starts the render server of a room, in this slot or in a free one, without waiting for it.

        Raises:
            NoSlotError: there is none.
            DeltalightError: it cannot be started.
        """

    def release(self, placement: Placement) -> None:
        """Ends a render server and frees its slot; one that is gone already is ignored."""

    def watch(self) -> Sequence[PlacementEvent]:
        """Returns what happened since the last call; the slot of what was lost is free."""

    def close(self) -> None:
        """Ends all render servers."""


def choose_slot(slots: Sequence[Slot], order: RoomOrder, wanted: str | None = None) -> Slot:
    """Returns the slot that is wanted, or a free one of the host that has most of them.

    Hosts none of whose devices is doubted come first.

    Raises:
        NoSlotError: there is none; says why.
    """
    if wanted is not None:
        return _wanted_slot(slots, order, wanted)
    fitting = [slot for slot in slots if order.labels.items() <= slot.labels.items()]
    usable = [slot for slot in fitting if slot.host not in order.avoid]
    free = [slot for slot in usable if slot.room is None]
    if not free:
        raise NoSlotError(_why_none(order, fitting, usable))
    free = [slot for slot in free if (slot.host, slot.device) not in order.doubted] or free
    of_host, doubted_hosts = Counter(slot.host for slot in free), {host for host, _ in order.doubted}
    return max(free, key=lambda slot: (slot.host not in doubted_hosts, of_host[slot.host]))


def _wanted_slot(slots: Sequence[Slot], order: RoomOrder, wanted: str) -> Slot:
    named = {slot.name: slot for slot in slots}
    if wanted not in named:
        raise NoSlotError(f"there is no slot {wanted}; the slots are {', '.join(named) or 'none'}.")
    slot = named[wanted]
    if slot.room is not None:
        raise NoSlotError(f"{wanted} is in use by {slot.room}; choose a free one.")
    if slot.host in order.avoid:
        raise NoSlotError(f"the host of {wanted} is drained; choose a slot of another.")
    if not order.labels.items() <= slot.labels.items():
        raise NoSlotError(f"the host of {wanted} lacks {_written(order.labels)}; choose a slot of another.")
    return slot


def _why_none(order: RoomOrder, fitting: Sequence[Slot], usable: Sequence[Slot]) -> str:
    where = f" with {_written(order.labels)}" if order.labels else ""
    if not fitting:
        return f"no host{where} offers a slot; start one."
    if not usable:
        return f"the hosts{where} are drained; end that for one of them, or add slots."
    in_use = f"all {len(usable)} slots{where} are" if len(usable) > 1 else f"the only usable slot{where} is"
    return f"{in_use} in use; free one or add slots."


def _written(labels: Mapping[str, str]) -> str:
    return ", ".join(f"{key}={value}" for key, value in labels.items())
