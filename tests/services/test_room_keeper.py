"""Which room runs where: slots, losses, moves and drains, with a placer that places nothing."""

import errno
import time
from pathlib import Path

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import ControlReply
from deltalight.protocol.payloads import encode_control
from deltalight.services.rooms.follower import RoomFollower
from deltalight.services.rooms.keeper import MAXIMUM_FAILED_STARTS, RETRY_S, RoomKeeper
from deltalight.services.rooms.placer import Placement, RoomOrder
from deltalight.services.rooms.status import RoomList, RoomStatus
from deltalight.services.storage.drained import Drained, DrainedStore
from deltalight.services.storage.faults import StorageFaultError
from deltalight.services.storage.store import Store
from tests.services.room_samples import NoDirectory, StandInPlacer, plans, running


@pytest.fixture
def placer() -> StandInPlacer:
    return StandInPlacer()


@pytest.fixture
def keeper(placer: StandInPlacer, tmp_path: Path) -> RoomKeeper:
    return RoomKeeper(plans(tmp_path, "hall", "door", "attic"), placer)


def rooms(keeper: RoomKeeper) -> dict[str, RoomStatus]:
    return {room.name: room for room in keeper.status().rooms}


def states(keeper: RoomKeeper) -> list[str]:
    return [room.state for room in keeper.status().rooms]


def epoch(keeper: RoomKeeper, name: str) -> int:
    endpoints = rooms(keeper)[name].endpoints
    assert endpoints is not None
    return endpoints.epoch


def test_a_room_without_a_slot_waits_and_says_so_until_one_is_free(
    keeper: RoomKeeper, placer: StandInPlacer
) -> None:
    assert states(keeper) == ["waiting"] * 3
    keeper.poll()
    assert states(keeper) == ["starting", "starting", "waiting"]
    running(keeper, placer, "hall", "door")
    assert states(keeper) == ["running", "running", "waiting"]
    assert "all 2 slots are in use" in rooms(keeper)["attic"].why
    assert [slot.room for slot in keeper.status().slots] == ["hall", "door"]
    keeper.drain("hall")
    keeper.poll()
    running(keeper, placer, "attic")
    assert states(keeper) == ["waiting", "running", "running"]
    assert "was drained" in rooms(keeper)["hall"].why
    assert rooms(keeper)["attic"].slot == "slot-1"


def test_a_lost_room_is_placed_again_before_those_that_wait_with_a_newer_epoch(
    keeper: RoomKeeper, placer: StandInPlacer
) -> None:
    running(keeper, placer, "hall", "door")
    before, other = epoch(keeper, "hall"), epoch(keeper, "door")
    placer.lose("hall")
    keeper.poll()
    assert states(keeper) == ["starting", "running", "waiting"]
    assert epoch(keeper, "hall") > before
    assert epoch(keeper, "door") == other
    assert rooms(keeper)["hall"].restarts == 1


def test_a_room_that_waits_uses_up_no_epochs(keeper: RoomKeeper, placer: StandInPlacer) -> None:
    running(keeper, placer, "hall", "door")
    newest = epoch(keeper, "door")
    for _ in range(1000):
        keeper.poll()
    keeper.drain("hall")
    keeper.poll()
    assert epoch(keeper, "attic") == newest + 1


def test_the_next_keeper_is_followed_and_the_one_before_refused(tmp_path: Path) -> None:
    """Web processes of other hosts outlive the keeper; they know endpoints by their epochs."""
    followed: list[int | None] = []
    follower = RoomFollower(
        NoDirectory(), lambda _room, found: followed.append(None if found is None else found.epoch)
    )
    lists: list[RoomList] = []
    for _ in range(2):
        keeper = RoomKeeper(plans(tmp_path, "hall"), StandInPlacer())
        for _loss in range(3):
            keeper.poll()
            lists.append(keeper.status())
            keeper.drain("hall")
            keeper.start("hall")
        time.sleep(0.01)  # no keeper starts within milliseconds of the one before
    for found in lists:
        follower.take(found)
    assert follower.refused == 0
    assert len(followed) == len(set(followed)) == 6
    follower.take(lists[0])
    assert follower.refused == 1


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        (DeltalightError("no key; make one."), "tried again: no key"),
        (OSError(errno.EMFILE, "Too many open files"), "no more of what it needs (Too many open files)"),
    ],
)
def test_a_room_that_cannot_be_started_is_tried_again_and_ends_no_other(
    keeper: RoomKeeper, placer: StandInPlacer, monkeypatch: pytest.MonkeyPatch, fault: Exception, why: str
) -> None:
    place = placer.place

    def refusing(order: RoomOrder, slot: str | None = None) -> Placement:
        if order.room == "hall":
            raise fault
        return place(order, slot)

    monkeypatch.setattr(placer, "place", refusing)
    running(keeper, placer, "door", "attic")
    assert states(keeper) == ["waiting", "running", "running"]
    assert why in rooms(keeper)["hall"].why
    monkeypatch.undo()
    keeper.drain("attic")
    running(keeper, placer, "hall")
    assert states(keeper) == ["running", "running", "waiting"]


def test_what_a_server_said_last_is_cut_to_what_a_directory_can_tell(
    keeper: RoomKeeper, placer: StandInPlacer
) -> None:
    running(keeper, placer, "hall")
    placer.lose("hall", detail="x" * 5_000_000, refused=True)
    keeper.poll()
    answer = ControlReply(node="rooms", capture_ns=0, id="1", ok=True, payload=keeper.status().model_dump())
    assert sum(map(len, encode_control(answer))) < 10_000


def test_a_room_that_ran_is_never_given_up(keeper: RoomKeeper, placer: StandInPlacer) -> None:
    for _ in range(20):
        running(keeper, placer, "hall")
        placer.lose("hall")
        keeper.poll()
    assert states(keeper)[0] == "starting"
    assert rooms(keeper)["hall"].restarts == 20


def test_a_room_that_never_starts_fails_and_frees_its_slot(keeper: RoomKeeper, placer: StandInPlacer) -> None:
    keeper.poll()
    for _ in range(MAXIMUM_FAILED_STARTS):
        placer.lose("hall")
        keeper.poll()
    assert states(keeper) == ["failed", "starting", "starting"]
    assert rooms(keeper)["hall"].why == "It broke."
    keeper.drain("door")
    keeper.start("hall")
    running(keeper, placer, "hall")
    assert states(keeper) == ["running", "waiting", "starting"]


class FullDisk(DrainedStore):
    """Refuses to keep anything."""

    def keep(self, drained: Drained) -> None:
        raise StorageFaultError(f"{sorted(drained.rooms)} cannot be stored; free some space.")


def test_drained_rooms_and_hosts_stay_so_over_a_restart(placer: StandInPlacer, tmp_path: Path) -> None:
    named = plans(tmp_path, "hall", "door", "attic")
    with Store(tmp_path / "data") as store:
        placer.slot_names = ("here/1", "here/2")
        before = RoomKeeper(named, placer, memory=store.drained)
        before.poll()
        before.drain("attic")
        before.drain("hall")
        before.start("hall")
        before.drain_host("here")
    with Store(tmp_path / "data") as store:
        again = StandInPlacer()
        again.slot_names = placer.slot_names
        after = RoomKeeper(named[1:], again, memory=store.drained)
        after.poll()
        assert "It was drained" in rooms(after)["attic"].why
        assert "drained" in rooms(after)["door"].why, "its only host is"
        assert again.placed == {}
        after.undrain_host("here")
        after.start("attic")
        after.poll()
        assert {room.state for room in after.status().rooms} == {"starting"}
        assert store.drained.load() == Drained()


def test_what_cannot_be_kept_is_not_drained(placer: StandInPlacer, tmp_path: Path) -> None:
    with Store(tmp_path / "data") as store:
        keeper = RoomKeeper(plans(tmp_path, "hall"), placer, memory=FullDisk(store._database))
        keeper.poll()
        with pytest.raises(StorageFaultError, match="free some space"):
            keeper.drain("hall")
        with pytest.raises(StorageFaultError, match="free some space"):
            keeper.drain_host(placer.slots()[0].host)
        assert rooms(keeper)["hall"].state == "starting"
        assert not any(slot.drained for slot in keeper.status().slots)


def test_hosts_that_are_refused_are_no_failed_starts_of_the_room(
    keeper: RoomKeeper, placer: StandInPlacer
) -> None:
    keeper.poll()
    for _ in range(MAXIMUM_FAILED_STARTS + 1):
        placer.lose("hall", host_refused=True)
        keeper.poll()
    assert rooms(keeper)["hall"].state == "starting"


def test_a_room_whose_gpu_is_gone_starts_on_another_one_of_its_host(tmp_path: Path) -> None:
    """Its render server dies with the GPU, and the next one there finds no device and refuses to start."""
    devices = {"here/1": "EGL 0", "here/2": "EGL 0", "here/3": "EGL 1"}
    placer = StandInPlacer(tuple(devices), devices=devices)
    keeper = RoomKeeper(plans(tmp_path, "hall"), placer)
    running(keeper, placer, "hall")
    assert rooms(keeper)["hall"].slot == "here/1"
    placer.lose("hall")  # a crash is not the device's fault
    keeper.poll()
    assert rooms(keeper)["hall"].slot == "here/1"
    placer.lose("hall", refused=True, detail="Only the software renderer llvmpipe was found.")
    keeper.poll()
    assert (states(keeper), rooms(keeper)["hall"].slot) == (["starting"], "here/3")
    running(keeper, placer, "hall")
    placer.lose("hall")
    keeper.poll()
    assert rooms(keeper)["hall"].slot == "here/3"


def test_a_room_whose_only_gpu_is_gone_waits_is_tried_again_and_leaves_no_other_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    placer, now_s = StandInPlacer(("slot-1",)), [1000.0]
    monkeypatch.setattr("deltalight.services.rooms.keeper.time.monotonic", lambda: now_s[0])
    keeper = RoomKeeper(plans(tmp_path, "hall", "door"), placer)
    running(keeper, placer, "hall")
    placer.lose("hall")
    keeper.poll()
    for attempt in range(5):
        placer.lose("hall", refused=True, detail="There is no device.")
        keeper.poll()
        assert states(keeper) == ["waiting", "starting"], attempt  # the other one may be luckier
        assert "There is no device" in rooms(keeper)["hall"].why
        keeper.drain("door")
        keeper.poll()
        assert states(keeper)[0] == "waiting"
        now_s[0] += RETRY_S + 0.1
        keeper.poll()
        assert states(keeper)[0] == "starting"
        keeper.start("door")
    running(keeper, placer, "hall")
    assert states(keeper)[0] == "running"


def test_a_room_whose_input_is_refused_fails_at_once(keeper: RoomKeeper, placer: StandInPlacer) -> None:
    keeper.poll()
    placer.lose("door", refused=True)
    keeper.poll()
    assert states(keeper) == ["starting", "failed", "starting"]


def test_a_room_moves_once_its_pictures_come_from_the_new_slot(
    keeper: RoomKeeper, placer: StandInPlacer
) -> None:
    keeper.drain("attic")
    keeper.drain("door")
    running(keeper, placer, "hall")
    before = epoch(keeper, "hall")
    keeper.move("hall", "slot-2")
    placer.report("hall", shows=False, slot="slot-2")
    keeper.poll()
    assert (epoch(keeper, "hall"), rooms(keeper)["hall"].moving_to) == (before, "slot-2")
    placer.report("hall", slot="slot-2")
    keeper.poll()
    moved = rooms(keeper)["hall"]
    assert (moved.slot, moved.moving_to, moved.state, moved.restarts) == ("slot-2", None, "running", 0)
    assert epoch(keeper, "hall") > before
    assert [each.slot for each in placer.released] == ["slot-1"]


def test_a_move_that_fails_leaves_the_room_where_it_is(keeper: RoomKeeper, placer: StandInPlacer) -> None:
    keeper.drain("attic")
    keeper.drain("door")
    running(keeper, placer, "hall")
    keeper.move("hall")
    placer.lose("hall", slot="slot-2")
    keeper.poll()
    stays = rooms(keeper)["hall"]
    assert (stays.slot, stays.moving_to, stays.state) == ("slot-1", None, "running")


def test_a_room_that_dies_while_it_moves_goes_on_in_the_new_slot(
    keeper: RoomKeeper, placer: StandInPlacer
) -> None:
    keeper.drain("attic")
    keeper.drain("door")
    running(keeper, placer, "hall")
    keeper.move("hall")
    placer.lose("hall", slot="slot-1")
    keeper.poll()
    assert (rooms(keeper)["hall"].slot, states(keeper)[0]) == ("slot-2", "starting")


def test_what_cannot_be_done_is_one_sentence(keeper: RoomKeeper, placer: StandInPlacer) -> None:
    keeper.poll()
    with pytest.raises(DeltalightError, match="no room halll; did you mean hall"):
        keeper.drain("halll")
    with pytest.raises(DeltalightError, match="the room attic is waiting; move it when it runs"):
        keeper.move("attic")
    running(keeper, placer, "hall", "door")
    with pytest.raises(DeltalightError, match="all 2 slots are in use"):
        keeper.move("hall")
    assert states(keeper) == ["running", "running", "waiting"]


def test_a_room_says_which_node_is_away(keeper: RoomKeeper, placer: StandInPlacer) -> None:
    keeper.poll()
    placer.report("hall", shows=False)
    keeper.note_nodes({"desk": "The camera is gone; plug it in."})
    keeper.poll()
    assert rooms(keeper)["hall"].why == "No frames come from desk. desk: The camera is gone; plug it in."


def test_a_drained_host_is_emptied_one_room_at_a_time_and_what_has_no_slot_waits(
    keeper: RoomKeeper, placer: StandInPlacer
) -> None:
    placer.slot_names = ("east/1", "east/2", "west/1")
    keeper.drain("attic")
    running(keeper, placer, "hall", "door")
    keeper.drain_host("east")
    keeper.poll()
    moving = [(room.moving_to, room.state) for room in keeper.status().rooms]
    assert moving[:2] == [("west/1", "running"), (None, "running")]
    placer.report("hall", slot="west/1")
    keeper.poll()
    keeper.poll()
    hall, door = rooms(keeper)["hall"], rooms(keeper)["door"]
    assert (hall.slot, hall.restarts, door.state) == ("west/1", 0, "waiting")
    assert "the only usable slot is in use" in door.why
    assert [slot.drained for slot in keeper.status().slots] == [True, True, False]
    keeper.undrain_host("east")
    keeper.poll()
    assert rooms(keeper)["door"].slot == "east/1"


def test_a_room_does_not_move_to_a_host_that_is_drained_meanwhile(
    keeper: RoomKeeper, placer: StandInPlacer
) -> None:
    placer.slot_names = ("east/1", "west/1")
    keeper.drain("door")
    keeper.drain("attic")
    running(keeper, placer, "hall")
    keeper.move("hall", "west/1")
    keeper.drain_host("west")
    keeper.poll()
    assert (rooms(keeper)["hall"].slot, rooms(keeper)["hall"].moving_to) == ("east/1", None)
    with pytest.raises(DeltalightError, match="there is no host wset with a slot; did you mean west"):
        keeper.drain_host("wset")
    with pytest.raises(DeltalightError, match="the host east is not drained"):
        keeper.undrain_host("east")
    with pytest.raises(DeltalightError, match="the host of west/1 is drained"):
        keeper.move("hall", "west/1")
