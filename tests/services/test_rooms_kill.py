"""`deltalight up --rooms` with real processes: render servers are killed and come back, and the others go on."""

from collections.abc import Iterator

import pytest

from deltalight.benchmarks.rooms.installation import Installation, settled, started
from deltalight.benchmarks.rooms.processes import wait_for

pytestmark = pytest.mark.slow(seconds=20)
KILLS = 20


@pytest.fixture(scope="module")
def installation(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    with started(tmp_path_factory.mktemp("rooms")) as found:
        yield found


def test_a_killed_room_returns_with_an_equal_picture_and_the_other_goes_on(
    installation: Installation, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = installation.client.get("/rooms/door/active-scene").json()
    item = scene["document"]["objects"][0]["id"]
    moved = {"pose": {"translation_m": [0, 0, 0.05]}}
    address = f"/rooms/door/scenes/{scene['id']}/objects/{item}"
    installation.client.patch(address, json=moved).raise_for_status()
    before, hall = settled(installation, "door"), settled(installation, "hall")
    assert before != hall, "the object was moved, and is not seen"
    other = installation.server("hall")
    frames, restarts = installation.frames("hall"), installation.room("hall").restarts
    installation.wait_for_spares()
    gap = installation.kill("door")
    with capsys.disabled():
        print(f"\na killed room was away for {gap}")
    assert settled(installation, "door") == before
    assert installation.picture("hall") == hall
    assert installation.frames("hall") > frames
    assert other.is_running()
    assert installation.room("hall").restarts == restarts


def test_a_drained_room_makes_place_for_the_one_that_waits(installation: Installation) -> None:
    installation.client.post("/rooms/attic/start").raise_for_status()
    wait_for(lambda: "slots are in use" in installation.room("attic").why)
    assert installation.room("attic").state == "waiting"
    installation.client.post("/rooms/hall/drain").raise_for_status()
    wait_for(lambda: installation.is_shown("attic"))
    assert settled(installation, "attic") != b""
    installation.client.post("/rooms/attic/drain").raise_for_status()
    wait_for(lambda: any(slot.room is None for slot in installation.directory.rooms().slots))
    epoch = installation.epoch("door")
    picture = settled(installation, "door")
    installation.client.post("/rooms/door/move", json={}).raise_for_status()
    wait_for(lambda: installation.epoch("door") > epoch)
    assert settled(installation, "door") == picture
    installation.client.post("/rooms/hall/start").raise_for_status()
    wait_for(lambda: installation.is_shown("hall"))


@pytest.mark.slow(seconds=120)
def test_twenty_kills_in_a_row_lose_no_room_and_leave_no_process(
    installation: Installation, capsys: pytest.CaptureFixture[str]
) -> None:
    wait_for(lambda: installation.is_shown("hall") and installation.is_shown("door"))
    installation.wait_for_spares()
    before, earlier = installation.count_of(""), restarts(installation)
    gaps = [installation.kill(("hall", "door")[number % 2]) for number in range(KILLS)]
    with capsys.disabled():
        print("\n" + "; ".join(gaps))
    wait_for(lambda: installation.is_shown("hall") and installation.is_shown("door"))
    assert restarts(installation) >= earlier + KILLS
    installation.wait_for_spares()
    assert installation.count_of("") == before


def restarts(installation: Installation) -> int:
    return installation.room("hall").restarts + installation.room("door").restarts
