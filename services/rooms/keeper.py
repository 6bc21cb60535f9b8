"""Keeps rooms running: gives each a slot, places it again when its render server is lost, moves and drains it.

A room that waits is placed as soon as a slot is free: those that lost their render server first, then by the time
that they have waited.
"""

import itertools
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from deltalight.protocol.documents import nearest
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.message_fields import as_sentence
from deltalight.services.rooms.placer import NoSlotError, Placement, PlacementEvent, Placer, RoomOrder, Slot
from deltalight.services.rooms.status import (
    Reason,
    RoomEndpoints,
    RoomList,
    RoomNode,
    RoomState,
    RoomStatus,
    SlotStatus,
)
from deltalight.services.storage.drained import Drained

MAXIMUM_FAILED_STARTS = 3  # in a row
DOUBT_S = 60.0  # how long a device is taken last after no render server started on it
RETRY_S = 10.0  # between attempts on such devices alone, of a room that ran before


@dataclass(frozen=True)
class RoomPlan:
    """A room to keep; `session_file` holds its scene document, which survives a change of its render server.

    Its host has all `labels`.
    """

    name: str
    title: str
    nodes: tuple[RoomNode, ...]
    session_file: Path
    labels: Mapping[str, str] = field(default_factory=dict)


class Memory(Protocol):
    """Keeps what is drained over a restart (`storage.drained.DrainedStore`)."""

    def load(self) -> Drained:
        """Returns what was kept last."""

    def keep(self, drained: Drained) -> None:
        """Stores it; raises DeltalightError where it cannot be."""


@dataclass(eq=False)
class _Room:
    plan: RoomPlan
    queued: int  # place in the order of those that wait; lost rooms come first
    state: RoomState = "waiting"
    why: str = "It has not been started yet."
    placement: Placement | None = None
    successor: Placement | None = None  # in the slot that it moves to
    shows: bool = False
    drained: bool = False
    failed_starts: int = 0
    restarts: int = 0
    has_run: bool = False
    again_s: float = 0.0  # until then only on devices that are not doubted

    def wait(self, why: str) -> None:
        self.state, self.why, self.placement, self.shows = "waiting", why, None, False

    @property
    def waits_for(self) -> Reason | None:
        if self.state == "waiting":
            return "drained" if self.drained else "slot"
        return "failed" if self.state == "failed" else None

    def drain(self) -> None:
        self.drained = True
        self.wait(f"It was drained; `deltalight rooms start {self.plan.name}` starts it again.")

    def run_as(self, placement: Placement) -> None:
        self.state, self.why, self.placement, self.shows = "starting", "", placement, False


class RoomKeeper:
    """Decides where rooms run; `notice` gets a line for each change. Any thread may call it.

    What is drained stays so in the next keeper with this `memory`; what that refuses to keep is not drained. Epochs
    begin with the milliseconds of the clock, so that those of the next keeper are newer: web processes of other hosts
    go on following, and refuse what is older.
    """

    def __init__(
        self,
        plans: Sequence[RoomPlan],
        placer: Placer,
        notice: Callable[[str], None] = lambda _line: None,
        memory: Memory | None = None,
    ) -> None:
        self._placer, self._notice, self._memory = placer, notice, memory
        self._queue = itertools.count()
        self._epoch = time.time_ns() // 1_000_000  # the newest
        self._rooms = {plan.name: _Room(plan, next(self._queue)) for plan in plans}
        self._faults: Mapping[str, str] = {}  # of nodes
        self._doubted: dict[tuple[str, str], float] = {}  # until when, by host and device
        drained = Drained() if memory is None else memory.load()
        self._drained_hosts = set(drained.hosts)
        for name in drained.rooms & self._rooms.keys():
            self._rooms[name].drain()
        self._lock = threading.Lock()
        # A lock of its own, held while the database answers, so that rooms are looked after meanwhile.
        self._drains = threading.Lock()

    def poll(self) -> None:
        """Learns what happened, then places the rooms that wait."""
        with self._lock:
            for event in self._placer.watch():
                self._note(event)
            self._empty_drained_hosts()
            self._place_waiting()

    def note_nodes(self, faults: Mapping[str, str]) -> None:
        """Notes which nodes do not run, and why."""
        self._faults = faults

    def status(self) -> RoomList:
        """Returns all rooms, in their order, and slots."""
        with self._lock:
            rooms = tuple(self._described(room) for room in self._rooms.values())
            slots = tuple(self._described_slot(slot) for slot in self._placer.slots())
        return RoomList(rooms=rooms, slots=slots)

    def drain(self, name: str) -> None:
        """Ends a room's render server until `start`.

        Raises:
            DeltalightError: there is no such room.
        """
        room = self._room(name)
        with self._drains:
            drained = self._drained()
            self._keep(replace(drained, rooms=drained.rooms | {name}))
            with self._lock:
                self._release(room)
                room.drain()
        self._notice(f"room {name}: drained.")

    def start(self, name: str) -> None:
        """Starts a room that was drained or has failed.

        Raises:
            DeltalightError: there is no such room.
        """
        room = self._room(name)
        with self._drains:
            if room.drained:
                drained = self._drained()
                self._keep(replace(drained, rooms=drained.rooms - {name}))
            with self._lock:
                if room.placement is not None:
                    return
                room.drained, room.failed_starts, room.queued = False, 0, next(self._queue)
                room.wait("It is about to start.")

    def move(self, name: str, slot: str | None = None) -> None:
        """Starts a room's next render server in this slot, or a free one; once that shows frames, the old one ends.

        Raises:
            DeltalightError: there is no such room, it does not run or moves already, or the slot is not free.
        """
        with self._lock:
            room = self._room(name)
            if room.state != "running" or room.placement is None:
                raise DeltalightError(f"the room {name} is {room.state}; move it when it runs.")
            if room.successor is not None:
                raise DeltalightError(f"the room {name} moves to {room.successor.slot} already; wait for it.")
            room.successor = self._place(room, slot)
            self._notice(f"room {name}: moves from {room.placement.slot} to {room.successor.slot}.")

    def drain_host(self, host: str) -> None:
        """Moves the rooms of a host elsewhere, one after another, and places none there until `undrain_host`.

        A room for which there is no other slot ends and waits.

        Raises:
            DeltalightError: there is no such host.
        """
        with self._lock:
            hosts = dict.fromkeys(slot.host for slot in self._placer.slots())
        if host not in hosts:
            hint = nearest(host, hosts) or ", ".join(hosts) or "none"
            raise DeltalightError(f"there is no host {host[:80]} with a slot; did you mean {hint}?")
        with self._drains:
            drained = self._drained()
            self._keep(replace(drained, hosts=drained.hosts | {host}))
            with self._lock:
                self._drained_hosts.add(host)
        self._notice(f"host {host}: drained.")

    def undrain_host(self, host: str) -> None:
        """Lets rooms start on a host again.

        Raises:
            DeltalightError: it is not drained.
        """
        with self._drains:
            drained = self._drained()
            if host not in drained.hosts:
                known = ", ".join(sorted(drained.hosts)) or "none is"
                raise DeltalightError(f"the host {host[:80]} is not drained ({known}).")
            self._keep(replace(drained, hosts=drained.hosts - {host}))
            with self._lock:
                self._drained_hosts.remove(host)
        self._notice(f"host {host}: takes rooms again.")

    def _drained(self) -> Drained:
        rooms = frozenset(name for name, room in self._rooms.items() if room.drained)
        return Drained(rooms, frozenset(self._drained_hosts))

    def _keep(self, drained: Drained) -> None:
        if self._memory is not None:
            self._memory.keep(drained)

    def _room(self, name: str) -> _Room:
        if name not in self._rooms:
            hint = nearest(name, self._rooms) or ", ".join(self._rooms)
            raise DeltalightError(f"there is no room {name[:80]}; did you mean {hint}?")
        return self._rooms[name]

    def _place(self, room: _Room, slot: str | None = None) -> Placement:
        """Starts a room's next render server, with an epoch of its own."""
        sources = tuple(node.endpoint for node in room.plan.nodes)
        plan, avoid = room.plan, frozenset(self._drained_hosts)
        self._epoch += 1
        doubted = frozenset(self._doubted)
        order = RoomOrder(plan.name, self._epoch, sources, plan.session_file, plan.labels, avoid, doubted)
        try:
            return self._placer.place(order, slot)
        except NoSlotError:
            self._epoch -= 1  # nothing was started with it; who waits asks ten times a second
            raise
        except OSError as fault:  # open files, processes, memory
            raise DeltalightError(f"this host has no more of what it needs ({fault.strerror}).") from fault

    def _release(self, room: _Room) -> None:
        for placement in (room.placement, room.successor):
            if placement is not None:
                self._placer.release(placement)
        room.successor = None

    def _note(self, event: PlacementEvent) -> None:
        for room in self._rooms.values():
            if room.placement is not None and room.placement.epoch == event.epoch:
                if event.kind == "lost":
                    self._lose(room, event)
                else:
                    self._hear(room, event)
            elif room.successor is not None and room.successor.epoch == event.epoch:
                self._note_successor(room, event)

    def _hear(self, room: _Room, event: PlacementEvent) -> None:
        if room.state == "starting":
            self._notice(f"room {room.plan.name}: runs.")
        room.state, room.shows, room.failed_starts, room.has_run = "running", event.shows, 0, True
        names = ", ".join(node.name for node in room.plan.nodes)
        room.why = "" if event.shows else f"No frames come from {names}."

    def _lose(self, room: _Room, event: PlacementEvent) -> None:
        """Notes a loss. What a room that ran before does not take any more is its device, which may be gone."""
        is_of_device = event.refused and room.has_run
        if room.state == "starting" and room.placement is not None:
            self._doubt(room.placement.slot)
            room.again_s = time.monotonic() + RETRY_S if is_of_device else 0.0
        has_failed = room.state == "starting" and not (event.host_refused or is_of_device)
        room.failed_starts = room.failed_starts + 1 if has_failed else 0
        room.restarts += 1
        self._notice(f"room {room.plan.name}: {event.detail}")
        if room.successor is not None:
            successor, room.successor = room.successor, None
            room.run_as(successor)
        elif (event.refused and not is_of_device) or room.failed_starts >= MAXIMUM_FAILED_STARTS:
            room.wait(event.detail)
            room.state = "failed"
        else:
            room.wait(event.detail)
            room.queued = min(each.queued for each in self._rooms.values()) - 1

    def _doubt(self, name: str) -> None:
        """Takes the device of a slot last for a while."""
        for slot in self._placer.slots():
            if slot.name == name:
                self._doubted[slot.host, slot.device] = time.monotonic() + DOUBT_S

    def _has_sound_slot(self) -> bool:
        slots = self._placer.slots()
        return any(slot.room is None and (slot.host, slot.device) not in self._doubted for slot in slots)

    def _note_successor(self, room: _Room, event: PlacementEvent) -> None:
        successor, before = room.successor, room.placement
        assert successor is not None
        assert before is not None
        if event.kind == "lost":
            room.successor = None
            self._notice(f"room {room.plan.name}: it stays in {before.slot}: {event.detail}")
        elif event.shows or not room.shows:
            room.successor = None
            room.run_as(successor)
            self._hear(room, event)
            self._placer.release(before)

    def _empty_drained_hosts(self) -> None:
        """Moves the rooms of drained hosts, a single one at a time."""
        if not self._drained_hosts:
            return
        of_slot = {slot.name: slot.host for slot in self._placer.slots()}
        for room in self._rooms.values():
            if room.successor is not None and of_slot.get(room.successor.slot) in self._drained_hosts:
                self._placer.release(room.successor)
                room.successor = None
        if any(room.successor is not None for room in self._rooms.values()):
            return
        for room in self._rooms.values():
            host = None if room.placement is None else of_slot.get(room.placement.slot)
            if host is not None and host in self._drained_hosts:
                self._leave(room, host)
                return

    def _leave(self, room: _Room, host: str) -> None:
        """Starts a room's next render server on another host; without a slot there, it ends and waits."""
        assert room.placement is not None
        try:
            room.successor = self._place(room)
        except DeltalightError as fault:
            self._release(room)
            room.wait(f"Its host {host} is drained: {fault}")
            room.queued = min(each.queued for each in self._rooms.values()) - 1
        where = "waits" if room.successor is None else f"moves to {room.successor.slot}"
        self._notice(f"room {room.plan.name}: leaves {host} and {where}.")

    def _place_waiting(self) -> None:
        now_s = time.monotonic()
        self._doubted = {device: until_s for device, until_s in self._doubted.items() if until_s > now_s}
        waiting = [room for room in self._rooms.values() if room.state == "waiting" and not room.drained]
        for room in sorted(waiting, key=lambda each: each.queued):
            if room.again_s > now_s and not self._has_sound_slot():
                continue
            try:
                placement = self._place(room)
            except NoSlotError as fault:
                room.why = f"It starts when a slot is free: {fault}"
            except DeltalightError as fault:
                room.why = f"It cannot be started now, and is tried again: {fault}"
            else:
                room.run_as(placement)
                self._notice(f"room {room.plan.name}: starts in {placement.slot}.")

    def _described_slot(self, slot: Slot) -> SlotStatus:
        return SlotStatus(
            name=slot.name,
            device=slot.device,
            room=slot.room,
            host=slot.host,
            drained=slot.host in self._drained_hosts,
        )

    def _described(self, room: _Room) -> RoomStatus:
        placement = room.placement
        endpoints = None
        if placement is not None:
            endpoints = RoomEndpoints(
                epoch=placement.epoch, publish=placement.publish, control=placement.control
            )
        faults = [
            f"{node.name}: {self._faults[node.name]}" for node in room.plan.nodes if node.name in self._faults
        ]
        return RoomStatus(
            name=room.plan.name,
            title=room.plan.title or room.plan.name,
            nodes=room.plan.nodes,
            state=room.state,
            why=as_sentence(" ".join(filter(None, (room.why, *faults)))),
            waits_for=room.waits_for,
            slot=None if placement is None else placement.slot,
            endpoints=endpoints,
            moving_to=None if room.successor is None else room.successor.slot,
            restarts=room.restarts,
        )
