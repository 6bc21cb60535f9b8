"""What every placer promises, kept with real processes, by Ray's too: slots, losses, endpoints, no orphans."""

import errno
import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import psutil
import pytest

from deltalight.services import ports
from deltalight.services.child import ChildSpec
from deltalight.services.host import HostCommands
from deltalight.services.rooms import keeper, local_placer
from deltalight.services.rooms.keeper import RoomKeeper
from deltalight.services.rooms.local_placer import Command, LocalPlacer
from deltalight.services.rooms.placer import (
    NoSlotError,
    Placement,
    PlacementEvent,
    RoomOrder,
    Slot,
    choose_slot,
)
from deltalight.services.rooms.ray_cluster import RayCluster
from deltalight.services.rooms.ray_placer import RayPlacer
from deltalight.services.rooms.status import RoomStatus
from tests.services.room_samples import WITHOUT_RAY, plans

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
# A spare that writes down what it is to rehearse.
TOLD = """
import sys
from pathlib import Path
line = sys.stdin.readline()
Path(sys.argv[1]).with_suffix(".part").write_text(line[1:])
Path(sys.argv[1]).with_suffix(".part").rename(sys.argv[1])
"""
REFUSING = "import sys; print('deltalight: The scene is wrong; mend it.', file=sys.stderr); sys.exit(2)"
# Finds no device while this file is there.
OF_DEVICE = """
import sys
from pathlib import Path
if Path(sys.argv.pop()).exists():
    print("deltalight: There is no device; plug it in.", file=sys.stderr)
    sys.exit(2)
"""
PATIENCE_S = 90.0


KINDS = (
    "local",
    pytest.param(
        "ray",
        marks=[
            pytest.mark.slow,
            WITHOUT_RAY,
        ],
    ),
)
AnyPlacer = LocalPlacer | RayPlacer
Make = Callable[[Command], AnyPlacer]


def reporting(order: RoomOrder, placement: Placement, device: int | None) -> ChildSpec:
    del device
    return ChildSpec(f"room {order.room}", ("-c", REPORTING, placement.publish))


@pytest.fixture(scope="module", params=KINDS)
def cluster(request: pytest.FixtureRequest) -> Iterator[RayCluster | None]:
    """Ray with two slots, for the tests of its placer."""
    found = RayCluster(None, 2) if request.param == "ray" else None
    yield found
    if found is not None:
        found.close()


@pytest.fixture
def make(cluster: RayCluster | None) -> Iterator[Make]:
    made: list[AnyPlacer] = []

    def make_placer(command: Command) -> AnyPlacer:
        placer: AnyPlacer
        if cluster is None:
            placer = LocalPlacer((None, 3), command, forward=lambda _line: None)
        else:
            placer = RayPlacer(cluster, command, HostCommands(), forward=lambda _line: None)
        made.append(placer)
        return placer

    yield make_placer
    for placer in made:
        placer.close()


@pytest.fixture
def placer(make: Make) -> AnyPlacer:
    return make(reporting)


def order(room: str, epoch: int) -> RoomOrder:
    return RoomOrder(room, epoch, (), Path("unused.json"))


def until(placer: AnyPlacer, wanted: Callable[[PlacementEvent], bool]) -> PlacementEvent:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        for event in placer.watch():
            if wanted(event):
                return event
        time.sleep(0.02)
    pytest.fail("it never came")


def first_slot(placer: AnyPlacer) -> str:
    return placer.slots()[0].name


def rooms_in(placer: AnyPlacer) -> list[str | None]:
    return [slot.room for slot in placer.slots()]


def test_rooms_take_slots_report_and_are_lost_by_name(placer: AnyPlacer) -> None:
    first, second = placer.place(order("hall", 1)), placer.place(order("door", 2))
    assert rooms_in(placer) == ["hall", "door"]
    if isinstance(placer, LocalPlacer):
        assert [slot.device for slot in placer.slots()] == ["default", "EGL 3"]
    with pytest.raises(NoSlotError, match="all 2 slots are in use"):
        placer.place(order("attic", 3))
    assert until(placer, lambda event: event.epoch == 2).shows
    os.kill(placer.process_ids()[first_slot(placer)], signal.SIGKILL)
    lost = until(placer, lambda event: event.kind == "lost")
    assert (lost.epoch, lost.refused) == (first.epoch, False)
    assert "exit code -9" in lost.detail
    assert rooms_in(placer) == [None, "door"]
    again = placer.place(order("hall", 4), first_slot(placer))
    endpoints = {each for place in (first, second, again) for each in (place.publish, place.control)}
    assert len(endpoints) == 6


def test_a_released_slot_is_free_once_the_process_is_gone_and_that_is_no_loss(placer: AnyPlacer) -> None:
    placement = placer.place(order("hall", 1))
    until(placer, lambda event: event.kind == "reported")
    process = psutil.Process(placer.process_ids()[first_slot(placer)])
    placer.release(placement)
    deadline_s = time.monotonic() + PATIENCE_S
    events: list[PlacementEvent] = []
    while rooms_in(placer) != [None, None] and time.monotonic() < deadline_s:
        events += placer.watch()
        time.sleep(0.02)
    assert not process.is_running()
    assert events == []
    placer.release(placement)  # it is gone already
    with pytest.raises(NoSlotError, match=f"there is no slot slot-9; the slots are {first_slot(placer)}, "):
        placer.place(order("hall", 2), "slot-9")


def test_a_server_that_refuses_its_input_says_why(make: Make) -> None:
    placer = make(lambda *_: ChildSpec("room", ("-c", REFUSING)))
    placer.place(order("hall", 1))
    lost = until(placer, lambda event: event.kind == "lost")
    assert (lost.refused, lost.detail) == (True, "The scene is wrong; mend it.")


def test_a_room_whose_device_is_gone_says_so_and_starts_once_it_is_back(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keeper, "RETRY_S", 0.5)
    gone = tmp_path / "gone"
    placer = make(
        lambda _order, placement, _device: ChildSpec(
            "room", ("-c", OF_DEVICE + REPORTING, placement.publish, str(gone))
        )
    )
    rooms = RoomKeeper(plans(tmp_path, "hall"), placer)
    ran = until_room(rooms, lambda room: room.state == "running")
    gone.touch()
    os.kill(placer.process_ids()[str(ran.slot)], signal.SIGKILL)
    until_room(rooms, lambda room: room.state == "waiting" and "There is no device" in room.why)
    gone.unlink()
    again = until_room(rooms, lambda room: room.state == "running")
    assert again.restarts > ran.restarts + 1


def until_room(rooms: RoomKeeper, wanted: Callable[[RoomStatus], bool]) -> RoomStatus:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        rooms.poll()
        (room,) = rooms.status().rooms
        if wanted(room):
            return room
        time.sleep(0.02)
    pytest.fail("it never came")


def test_closing_leaves_no_process(placer: AnyPlacer) -> None:
    placer.place(order("hall", 1))
    placer.place(order("door", 2))
    processes = [psutil.Process(each) for each in placer.process_ids().values()]
    placer.close()
    assert not any(process.is_running() for process in processes)


def test_a_spare_that_cannot_be_started_is_missed_by_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(*_: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(local_placer, "SPARE_AFTER_S", 0.0)
    monkeypatch.setattr(local_placer, "open_spare", refusing)
    with closing(LocalPlacer((None,), reporting, spare=ChildSpec("spare", ("-c", "")))) as placer:
        placer.place(order("hall", 1))
        assert until(placer, lambda event: event.kind == "reported").shows
        assert placer.spare_id is None


def test_the_spare_rehearses_a_room_that_is_placed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(local_placer, "SPARE_AFTER_S", 0.0)
    told = tmp_path / "told"
    spare = ChildSpec("spare", ("-P", "-c", TOLD, str(told)))
    with closing(LocalPlacer((None,), reporting, spare=spare, forward=lambda _line: None)) as placer:
        placement = placer.place(order("hall", 1))
        until(placer, lambda _event: told.exists())
    assert json.loads(told.read_text()) == [*ChildSpec("hall", ("-c", REPORTING, placement.publish)).words]


def test_ports_never_run_out_and_late_ones_are_not_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "PRIVATE_PORTS", range(20_000, 20_010))
    monkeypatch.setattr(ports, "REMEMBERED_PORTS", 4)
    late: set[str] = set()
    with closing(LocalPlacer((None,), lambda *_: ChildSpec("room", ("-c", "")))) as placer:
        for epoch in range(1, 8):  # ten ports would last for five
            placement = placer.place(order("hall", epoch))
            used = {placement.publish, placement.control}
            assert len(used) == 2
            assert not used & late
            late = used
            until(placer, lambda event: event.kind == "lost")


def test_a_room_takes_a_host_with_its_labels_that_is_not_drained() -> None:
    slots = [
        Slot("a/1", "", "hall", "a", {"network": "east"}),
        Slot("b/1", "", None, "b"),
        Slot("c/1", "", None, "c"),
        Slot("c/2", "", None, "c"),
    ]
    east = {"network": "east"}

    def wants(labels: dict[str, str], *avoid: str) -> RoomOrder:
        return RoomOrder("attic", 1, (), Path("unused.json"), labels, frozenset(avoid))

    assert choose_slot(slots, wants({})).name == "c/1"  # the emptier host
    assert choose_slot(slots, wants({}, "c")).name == "b/1"
    for order, slot, sentence in (
        (wants(east), None, "the only usable slot with network=east is in use"),
        (wants(east, "a"), None, "the hosts with network=east are drained"),
        (wants({"network": "west"}), None, "no host with network=west offers a slot"),
        (wants({}), "a/1", "a/1 is in use by hall"),
        (wants({}, "b"), "b/1", "the host of b/1 is drained"),
        (wants(east), "b/1", "the host of b/1 lacks network=east"),
    ):
        with pytest.raises(NoSlotError, match=sentence):
            choose_slot(slots, order, slot)


def test_a_doubted_device_is_taken_last_and_its_host_after_others() -> None:
    slots = [
        Slot("a/1", "first", None, "a"),
        Slot("a/2", "second", None, "a"),
        Slot("b/1", "first", None, "b"),
    ]

    def chosen(doubted: set[tuple[str, str]], among: Sequence[Slot] = slots) -> str:
        order = RoomOrder("attic", 1, (), Path("unused.json"), doubted=frozenset(doubted))
        return choose_slot(among, order).name

    assert chosen(set()) == "a/1"
    assert chosen({("a", "first")}) == "b/1"
    assert chosen({("a", "first")}, slots[:2]) == "a/2"
    assert chosen({("a", "first"), ("a", "second")}, slots[:2]) == "a/1"
