"""Rooms for tests: a placer of stand-ins in this process, plans, and a directory that a web process follows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import psutil
import pytest

from deltalight.benchmarks.rooms.processes import is_render_server
from deltalight.services import ports
from deltalight.services.rooms.keeper import RoomKeeper, RoomPlan
from deltalight.services.rooms.placer import Placement, PlacementEvent, RoomOrder, Slot, choose_slot
from deltalight.services.rooms.status import RoomList, RoomNode
from tests.services.render_server_samples import Recorder

WITHOUT_RAY = pytest.mark.skipif(find_spec("ray") is None, reason="the extra `cluster` is not installed")


def is_rendering(process: psutil.Process) -> bool:
    """Whether a process is a render server, or the actor of a cluster that holds one."""
    return is_render_server(process) or "RenderActor" in process.name()


def plans(folder: Path, *names: str) -> list[RoomPlan]:
    """Rooms that all show one node, at which nobody listens."""
    node = RoomNode(name="desk", endpoint=ports.endpoint(ports.private_ports(1)[0]))
    return [RoomPlan(name, f"The {name}", (node,), folder / f"{name}.json") for name in names]


@dataclass
class StandInPlacer:
    """Places nothing in slots whose names begin with their host's.

    With `answers`, control sockets answer as a render server of the epoch does.
    """

    slot_names: Sequence[str] = ("slot-1", "slot-2")
    answers: bool = False
    placed: dict[str, Placement] = field(default_factory=dict)
    released: list[Placement] = field(default_factory=list)
    events: list[PlacementEvent] = field(default_factory=list)
    devices: Mapping[str, str] = field(
        default_factory=dict
    )  # of slots, where they have other than the default
    servers: dict[int, Recorder] = field(default_factory=dict)

    def slots(self) -> list[Slot]:
        rooms = {name: placement.room for name, placement in self.placed.items()}
        return [
            Slot(name, self.devices.get(name, "default"), rooms.get(name), name.partition("/")[0])
            for name in self.slot_names
        ]

    def place(self, order: RoomOrder, slot: str | None = None) -> Placement:
        chosen = choose_slot(self.slots(), order, slot).name
        publish, control = ports.private_ports(2)
        if self.answers:
            self.servers[order.epoch] = Recorder(control, epoch=order.epoch)
        placement = Placement(
            order.room, order.epoch, chosen, ports.endpoint(publish), ports.endpoint(control)
        )
        self.placed[chosen] = placement
        return placement

    def release(self, placement: Placement) -> None:
        if self.placed.get(placement.slot) == placement:
            del self.placed[placement.slot]
            self.released.append(placement)
            self._end(placement.epoch)

    def watch(self) -> list[PlacementEvent]:
        found, self.events = self.events, []
        return found

    def close(self) -> None:
        for epoch in list(self.servers):
            self._end(epoch)

    def report(self, room: str, *, shows: bool = True, slot: str | None = None) -> None:
        """Has the render server of a room report."""
        self.events.append(PlacementEvent(self.of(room, slot).epoch, "reported", shows=shows))

    def lose(self, room: str, *, slot: str | None = None, detail: str = "It broke.", **kind: bool) -> None:
        """Has the render server of a room die."""
        placement = self.of(room, slot)
        del self.placed[placement.slot]
        self._end(placement.epoch)
        self.events.append(PlacementEvent(placement.epoch, "lost", detail, **kind))

    def of(self, room: str, slot: str | None = None) -> Placement:
        """The placement of a room, in this slot if it is in two."""
        found = (each for each in self.placed.values() if each.room == room and slot in (None, each.slot))
        return next(found)

    def report_all(self) -> None:
        """Has all render servers report; other threads may place and release meanwhile."""
        epochs = [placement.epoch for placement in list(self.placed.values())]
        self.events += [PlacementEvent(epoch, "reported", shows=True) for epoch in epochs]

    def _end(self, epoch: int) -> None:
        if epoch in self.servers:
            self.servers.pop(epoch).close()


class NoDirectory:
    """For followers that are told what to follow."""

    def rooms(self) -> RoomList:
        raise AssertionError("it was told, and need not ask")


def running(keeper: RoomKeeper, placer: StandInPlacer, *names: str) -> None:
    """Places rooms and has them report."""
    keeper.poll()
    for name in names:
        placer.report(name)
    keeper.poll()
