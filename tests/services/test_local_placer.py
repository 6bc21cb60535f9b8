"""What every placer promises, kept by `LocalPlacer` with real processes: slots, losses, endpoints, no orphans."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from deltalight.services.child import ChildSpec
from deltalight.services.rooms.local_placer import LocalPlacer
from deltalight.services.rooms.placer import NoSlotError, Placement, PlacementEvent, RoomOrder

# Reports as a render server does, until it is ended.
REPORTING = """
import sys, time
from deltalight.protocol.envelope import encode
from deltalight.protocol.messages import StatsMessage
from deltalight.protocol.publisher import Publisher
publisher = Publisher(sys.argv[1])
while True:
    publisher.send(encode(StatsMessage(node="room", capture_ns=time.time_ns(), state="running", detail="fine")))
    time.sleep(0.05)
"""
REFUSING = "import sys; print('deltalight: The scene is wrong; mend it.', file=sys.stderr); sys.exit(2)"
PATIENCE_S = 20.0


def reporting(order: RoomOrder, placement: Placement, device: int | None) -> ChildSpec:
    del device
    return ChildSpec(f"room {order.room}", ("-c", REPORTING, placement.publish))


@pytest.fixture
def placer() -> Iterator[LocalPlacer]:
    placer = LocalPlacer((None, 3), reporting, forward=lambda _line: None)
    yield placer
    placer.close()


def order(room: str, epoch: int) -> RoomOrder:
    return RoomOrder(room, epoch, (), Path("unused.json"))


def until(placer: LocalPlacer, wanted: Callable[[PlacementEvent], bool]) -> PlacementEvent:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        for event in placer.watch():
            if wanted(event):
                return event
        time.sleep(0.02)
    pytest.fail("it never came")


def rooms_in(placer: LocalPlacer) -> list[str | None]:
    return [slot.room for slot in placer.slots()]


def test_rooms_take_slots_report_and_are_lost_by_name(placer: LocalPlacer) -> None:
    first, second = placer.place(order("hall", 1)), placer.place(order("door", 2))
    assert rooms_in(placer) == ["hall", "door"]
    assert [slot.device for slot in placer.slots()] == ["default", "EGL 3"]
    with pytest.raises(NoSlotError, match="all 2 slots are in use"):
        placer.place(order("attic", 3))
    assert until(placer, lambda event: event.epoch == 2).shows
    os.kill(placer.process_ids()["slot-1"], signal.SIGKILL)
    lost = until(placer, lambda event: event.kind == "lost")
    assert (lost.epoch, lost.refused) == (first.epoch, False)
    assert "exit code -9" in lost.detail
    assert rooms_in(placer) == [None, "door"]
    again = placer.place(order("hall", 4), "slot-1")
    endpoints = {each for place in (first, second, again) for each in (place.publish, place.control)}
    assert len(endpoints) == 6


def test_a_released_slot_is_free_once_the_process_is_gone_and_that_is_no_loss(placer: LocalPlacer) -> None:
    placement = placer.place(order("hall", 1))
    until(placer, lambda event: event.kind == "reported")
    process = psutil.Process(placer.process_ids()["slot-1"])
    placer.release(placement)
    deadline_s = time.monotonic() + PATIENCE_S
    events: list[PlacementEvent] = []
    while rooms_in(placer) != [None, None] and time.monotonic() < deadline_s:
        events += placer.watch()
        time.sleep(0.02)
    assert not process.is_running()
    assert events == []
    placer.release(placement)  # it is gone already
    with pytest.raises(NoSlotError, match="there is no slot slot-9; the slots are slot-1, slot-2"):
        placer.place(order("hall", 2), "slot-9")


def test_a_server_that_refuses_its_input_says_why() -> None:
    placer = LocalPlacer((None,), lambda *_: ChildSpec("room", ("-c", REFUSING)), forward=lambda _line: None)
    placer.place(order("hall", 1))
    lost = until(placer, lambda event: event.kind == "lost")
    assert (lost.refused, lost.detail) == (True, "The scene is wrong; mend it.")
    placer.close()


def test_closing_leaves_no_process(placer: LocalPlacer) -> None:
    placer.place(order("hall", 1))
    placer.place(order("door", 2))
    processes = [psutil.Process(each) for each in placer.process_ids().values()]
    placer.close()
    assert not any(process.is_running() for process in processes)
