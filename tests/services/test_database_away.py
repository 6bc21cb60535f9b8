"""Rooms, pictures and reads go on while PostgreSQL is stopped or hangs; changes are refused meanwhile."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx
import pytest

from deltalight.benchmarks.rooms.installation import ROOMS, Installation, started
from deltalight.benchmarks.rooms.processes import wait_for
from tests.services.api_samples import sentence
from tests.services.postgres_samples import PostgresServer

pytestmark = pytest.mark.slow(seconds=40)
OUTAGE_S = float(os.environ.get("DELTALIGHT_OUTAGE_S", "3"))
Act = Callable[[PostgresServer], None]
OUTAGES: dict[str, tuple[Act, Act]] = {
    "stopped": (lambda server: server.stop(at_once=True), PostgresServer.start),
    "hanging": (PostgresServer.hang, PostgresServer.go_on),
}


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    found = PostgresServer()
    try:
        found.start()
        yield found
    finally:
        found.close()


@pytest.fixture(scope="module")
def installation(server: PostgresServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    folder: Path = tmp_path_factory.mktemp("rooms")
    config = folder / "deltalight.toml"
    config.write_text(f'[api]\ndatabase = "{server.fresh_database()}"\nrequests_per_s = 1000\n')
    with started(folder, "--config", str(config), rooms=ROOMS[:2]) as found:
        yield found


@pytest.mark.parametrize("outage", OUTAGES)
def test_reads_and_rooms_go_on_changes_are_refused_and_all_is_well_when_it_is_back(
    installation: Installation, server: PostgresServer, outage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    client, (begin, end) = installation.client, OUTAGES[outage]
    scene = client.get("/rooms/hall/active-scene").json()
    place = f"/rooms/hall/scenes/{scene['id']}"
    before = renamed(client, place, f"before: {outage}").json()
    reads = (
        "/rooms",
        "/rooms/hall/active-scene",
        "/rooms/door/active-scene",
        place,
        "/scenes",
        "/assets",
        "/hosts",
    )
    assert statuses(client, reads) == {httpx.codes.OK}
    epoch, started_s, longest_s = installation.epoch("door"), time.monotonic(), 0.0
    begin(server)
    try:
        while time.monotonic() < started_s + OUTAGE_S:
            asked_s, frames = time.monotonic(), installation.frames("hall")
            assert "does not answer" in sentence(renamed(client, place, "lost"), 503)
            assert "does not answer" in sentence(client.post("/rooms/hall/drain"), 503)
            assert statuses(client, reads) == {httpx.codes.OK}
            longest_s = max(longest_s, time.monotonic() - asked_s)
            wait_for(lambda: installation.frames("hall") > frames)  # noqa: B023
        said = installation.kill("door")
        assert installation.room("hall").state == "running"
    finally:
        end(server)
    back_s = time.monotonic()
    wait_for(lambda: renamed(client, place, "after").is_success)
    back_s = time.monotonic() - back_s
    with capsys.disabled():
        print(
            f"\nPostgreSQL {outage} for {OUTAGE_S:g} s: {len(reads) + 2} requests took {longest_s:.2f} s at most,"
            f" a killed room was away for {said}, and a change was stored {back_s:.2f} s after its return"
        )
    shown: dict[str, Any] = client.get("/rooms/hall/active-scene").json()
    assert (shown["revision"], shown["document"]["name"]) == (before["revision"] + 1, "after")
    numbers = [each["revision"] for each in client.get(f"{place}/revisions?limit=200").json()]
    assert numbers == list(range(shown["revision"], 0, -1))
    assert not any(room.waits_for for room in installation.directory.rooms().rooms)
    assert installation.epoch("door") > epoch
    wait_for(lambda: client.get("/rooms/hall/state").json()["picture"]["state"] == "shown")


def renamed(client: httpx.Client, place: str, name: str) -> httpx.Response:
    return client.patch(place, json={"name": name})


def statuses(client: httpx.Client, paths: Sequence[str]) -> set[int]:
    return {client.get(path).status_code for path in paths}
