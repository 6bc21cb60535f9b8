"""`deltalight up --rooms` with real processes and either placer: what is killed comes back, and the others go on."""

import os
import signal
import time
from collections.abc import Iterator

import psutil
import pytest

from deltalight.benchmarks.rooms.installation import Installation, settled, started
from deltalight.benchmarks.rooms.processes import is_gone, wait_for
from deltalight.services.rooms.follower import RoomFollower
from tests.services.room_samples import WITHOUT_RAY, is_rendering

pytestmark = pytest.mark.slow(seconds=20)
KILLS = 20
PLACERS = ("local", pytest.param("ray", marks=WITHOUT_RAY))


@pytest.fixture(scope="module", params=PLACERS)
def installation(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Installation]:
    """Three rooms in two slots of this host."""
    with started(tmp_path_factory.mktemp("rooms"), "--placer", request.param) as found:
        yield found


def arrange(installation: Installation) -> None:
    """Brings it about that hall and door run, and that attic is drained."""
    installation.directory.command("drain", "attic")
    for name in ("hall", "door"):
        installation.directory.command("start", name)
        wait_for(lambda: installation.is_shown(name))  # noqa: B023


def test_a_killed_room_returns_with_an_equal_picture_and_a_newer_epoch_and_the_other_goes_on(
    installation: Installation, capsys: pytest.CaptureFixture[str]
) -> None:
    arrange(installation)
    scene = installation.client.get("/rooms/door/active-scene").json()
    item = scene["document"]["objects"][0]["id"]
    moved = {"pose": {"translation_m": [0, 0, 0.05]}}
    address = f"/rooms/door/scenes/{scene['id']}/objects/{item}"
    installation.client.patch(address, json=moved).raise_for_status()
    before, hall = settled(installation, "door"), settled(installation, "hall")
    assert before != hall, "the object was moved, and is not seen"
    other, slot = installation.server("hall"), installation.room("door").slot
    frames, restarts = installation.frames("hall"), installation.room("hall").restarts
    follower = RoomFollower(installation.directory, lambda _room, _endpoints: None)
    stale = installation.directory.rooms()
    installation.wait_for_spares()
    gap = installation.kill("door")
    with capsys.disabled():
        print(f"\na killed room was away for {gap}")
    assert "by the spare" in gap
    assert (settled(installation, "door"), installation.room("door").slot) == (before, slot)
    assert installation.picture("hall") == hall
    assert installation.frames("hall") > frames
    assert other.is_running()
    assert installation.room("hall").restarts == restarts
    follower.take(installation.directory.rooms())
    follower.take(stale)
    assert follower.refused == 1, "of the room that was killed"


def test_the_third_room_of_two_slots_waits_until_one_is_free_and_rooms_move_with_their_pictures(
    installation: Installation,
) -> None:
    arrange(installation)
    installation.client.post("/rooms/attic/start").raise_for_status()
    wait_for(lambda: "all 2 slots are in use" in installation.room("attic").why)
    assert installation.room("attic").state == "waiting"
    installation.client.post("/rooms/hall/drain").raise_for_status()
    wait_for(lambda: installation.is_shown("attic"))
    assert settled(installation, "attic") != b""
    installation.client.post("/rooms/attic/drain").raise_for_status()
    wait_for(lambda: any(slot.room is None for slot in installation.directory.rooms().slots))
    epoch, slot = installation.epoch("door"), installation.room("door").slot
    picture = settled(installation, "door")
    installation.client.post("/rooms/door/move", json={}).raise_for_status()
    wait_for(lambda: installation.epoch("door") > epoch)
    assert settled(installation, "door") == picture
    assert installation.room("door").slot != slot
    installation.client.post("/rooms/hall/start").raise_for_status()
    wait_for(lambda: installation.is_shown("hall"))


@pytest.mark.slow(seconds=60)
def test_twenty_kills_in_a_row_lose_no_room_and_leave_no_process(
    installation: Installation, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two at a time, of which one finds a spare at most."""
    arrange(installation)
    installation.wait_for_spares()
    before, earlier = rendering(installation), restarts(installation)
    gaps_s = [kill_both(installation) for _ in range(KILLS // 2)]
    with capsys.disabled():
        print(f"\nboth rooms were back after {', '.join(f'{gap_s:.2f}' for gap_s in gaps_s)} s")
    assert restarts(installation) >= earlier + KILLS
    installation.wait_for_spares()
    assert len(rendering(installation)) == len(before)
    assert not {*before} & {*rendering(installation)}, "all were killed, or have taken over"


def kill_both(installation: Installation) -> float:
    """Kills the render servers of two rooms at once; returns the seconds until pictures of both come again."""
    killed = {name: (installation.epoch(name), installation.server(name)) for name in ("hall", "door")}
    for _, server in killed.values():
        os.kill(server.pid, signal.SIGKILL)
    killed_s = time.monotonic()
    wait_for(lambda: all(is_gone(server) for _, server in killed.values()))
    return max(installation.shown_after(name, epoch) for name, (epoch, _) in killed.items()) - killed_s


def rendering(installation: Installation) -> list[psutil.Process]:
    return [process for process in installation.processes() if is_rendering(process)]


def restarts(installation: Installation) -> int:
    return installation.room("hall").restarts + installation.room("door").restarts
