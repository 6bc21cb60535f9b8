"""Rooms over REST: a real service, directory and control sockets; the render servers are stand-ins."""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import structlog
from prometheus_client.parser import text_string_to_metric_families
from websockets.sync.client import connect

from deltalight.protocol.errors import DeltalightError
from deltalight.services import ports
from deltalight.services.rooms import follower as follower_module
from deltalight.services.rooms.directory import DirectoryServer
from deltalight.services.rooms.follower import RoomFollower
from deltalight.services.rooms.keeper import RoomKeeper
from deltalight.services.rooms.status import RoomEndpoints, RoomList, RoomNode, RoomStatus
from tests.deploy.test_deploy import DEPLOY, check_names
from tests.services.api_samples import RunningApi, running_api, sentence
from tests.services.live_samples import StandInStream
from tests.services.render_server_samples import Recorder
from tests.services.room_samples import NoDirectory, StandInPlacer, plans, running
from tests.services.test_api_scenes import wait_for

FLEET_BOARD = DEPLOY / "grafana" / "boards" / "fleet.json"


@dataclass(frozen=True)
class House:
    api: RunningApi
    keeper: RoomKeeper
    placer: StandInPlacer
    directory: DirectoryServer

    def get(self, path: str) -> Any:  # noqa: ANN401 - JSON
        return self.api.client.get(path).raise_for_status().json()

    def server(self, room: str) -> Recorder:
        """The stand-in of the render server that a room has now."""
        return self.placer.servers[self.placer.of(room).epoch]

    def shows(self, room: str) -> list[object]:
        """Names of the scenes that the room's render server was sent."""
        return [order["scene"]["name"] for order in self.server(room).payloads("set_scene")]

    def replaced(self, room: str) -> None:
        """Kills the room's render server and waits until the service talks to the next."""
        self.placer.lose(room)
        running(self.keeper, self.placer)
        running(self.keeper, self.placer, room)
        wait_for(lambda: bool(self.shows(room)))


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    placer = StandInPlacer(answers=True)
    keeper = RoomKeeper(plans(tmp_path, "hall", "door", "attic"), placer)
    directory = ports.endpoint(ports.private_ports(1)[0])
    server = DirectoryServer(directory, keeper)
    with closing(placer):
        running(keeper, placer, "hall", "door")
        with running_api(tmp_path / "data", rooms=directory) as api:
            found = House(api, keeper, placer, server)
            wait_for(lambda: bool(found.shows("hall")) and bool(found.shows("door")))
            yield found
    server.close()


def test_rooms_are_listed_with_scene_method_and_why_they_wait(house: House) -> None:
    answer = house.get("/rooms")
    assert [room["name"] for room in answer["rooms"]] == ["hall", "door", "attic"]
    assert [room["state"] for room in answer["rooms"]] == ["running", "running", "waiting"]
    hall, attic = answer["rooms"][0], house.get("/rooms/attic")
    assert (hall["title"], hall["nodes"], hall["slot"]) == ("The hall", ["desk"], "slot-1")
    assert (hall["scene"]["name"], hall["scene"]["method"]) == ("The hall", "dvct")
    assert "all 2 slots are in use" in attic["why"]
    assert [slot["room"] for slot in answer["slots"]] == ["hall", "door"]
    assert answer["can_move"]


def test_rooms_are_there_from_the_first_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(follower_module, "POLL_INTERVAL_S", 3600.0)
    keeper, directory = (
        RoomKeeper(plans(tmp_path, "hall"), StandInPlacer()),
        ports.endpoint(ports.private_ports(1)[0]),
    )
    with closing(DirectoryServer(directory, keeper)), running_api(tmp_path / "data", rooms=directory) as api:
        assert api.client.get("/rooms/hall").json()["name"] == "hall"


def test_every_route_is_for_the_first_room_or_for_the_one_in_its_address(house: House) -> None:
    client = house.api.client
    first = house.get("/active-scene")
    assert house.get("/rooms/hall/active-scene")["id"] == first["id"]
    other = house.get("/rooms/door/active-scene")
    assert other["id"] != first["id"]
    changed = client.patch(f"/rooms/door/scenes/{other['id']}", json={"name": "dusk"}).json()
    assert changed["picture"]["state"] == "shown"
    assert house.shows("door")[-1] == "dusk"
    assert "dusk" not in house.shows("hall")
    assert client.post("/rooms/door/live/pick", json={"x": 1, "y": 2}).json()["kind"] == "nothing"
    assert not house.server("hall").payloads("pick")
    lost = client.get("/rooms/cellar/state")
    assert "list the rooms" in sentence(lost, 404)


def test_a_scene_that_two_rooms_show_changes_in_both(house: House) -> None:
    scene = house.get("/active-scene")["id"]
    house.api.client.post(f"/rooms/door/scenes/{scene}/activate").raise_for_status()
    address = f"127.0.0.1:{house.api.client.base_url.port}"
    with connect(f"ws://{address}/api/v1/rooms/door/events") as events:
        assert json.loads(events.recv(10))["type"] == "hello"
        house.api.client.patch(f"/scenes/{scene}", json={"name": "shared"}).raise_for_status()
        event = next(
            each for each in iter(lambda: json.loads(events.recv(10)), None) if each["type"] == "scene"
        )
    assert (event["id"], event["name"], event["active"]) == (scene, "shared", True)
    wait_for(lambda: house.shows("door")[-1] == "shared")
    refused = house.api.client.delete(f"/scenes/{scene}")
    assert refused.status_code == 409


def test_the_next_render_server_of_a_room_gets_its_scene_again(house: House) -> None:
    before = house.get("/rooms/door")["epoch"]
    asked_of_hall = len(house.server("hall").payloads("set_scene"))
    house.replaced("door")
    assert house.shows("door") == ["The door"]
    wait_for(lambda: house.get("/rooms/door/state")["render_server"] == "answers")
    after = house.get("/rooms/door")
    assert (after["restarts"], after["epoch"] > before) == (1, True)
    assert len(house.server("hall").payloads("set_scene")) == asked_of_hall


def test_a_change_does_not_wait_for_a_server_that_died_while_it_was_sent(house: House) -> None:
    stuck = house.server("door")
    stuck.gate.clear()
    scene = house.get("/rooms/door/active-scene")["id"]
    address = f"/rooms/door/scenes/{scene}"
    sending = threading.Thread(target=lambda: house.api.client.patch(address, json={"name": "late"}))
    sending.start()
    assert stuck.is_busy.wait(60)
    epoch = house.placer.of("door").epoch
    del house.placer.servers[epoch]  # it never answers again, and nobody ends it
    house.replaced("door")
    assert house.shows("door")[-1] == "late"
    sending.join()
    stuck.close()


def test_pictures_follow_the_newest_epoch_and_not_the_server_before(house: House) -> None:
    def stream_of(room: str) -> StandInStream:
        return StandInStream(int(house.placer.of(room).publish.rpartition(":")[2]))

    with closing(stream_of("door")) as stale:
        wait_for(lambda: house.api.client.get("/rooms/door/live.jpg").status_code == 200)
        house.replaced("door")
        rooms = house.api.app.state.rooms  # type: ignore[attr-defined]
        live = rooms.contexts["door"].live
        seen = live.received
        sent = stale.sent
        wait_for(lambda: stale.sent > sent + 10)
        assert live.received <= seen + 1  # one may have been on its way
        with closing(stream_of("door")):
            wait_for(lambda: live.received > seen + 10)
    assert house.api.client.get("/rooms/hall/live.jpg").status_code == 503


def measured(house: House) -> dict[tuple[str, ...], float]:
    """Prometheus' samples by name and values of labels, which come by name."""
    text = house.api.client.get("/metrics").text
    samples = (sample for family in text_string_to_metric_families(text) for sample in family.samples)
    return {(sample.name, *sample.labels.values()): sample.value for sample in samples}


def test_a_monitor_reads_states_slots_and_the_gap_of_a_failover(house: House) -> None:
    before = measured(house)
    assert before["deltalight_room_state", "door", "running"] == 1
    assert before["deltalight_room_waits", "slot", "attic"] == 1
    assert before["deltalight_slots", "slot-1", "used"] == 1
    rooms = house.api.app.state.rooms  # type: ignore[attr-defined]

    def streaming() -> StandInStream:
        return StandInStream(int(house.placer.of("door").publish.rpartition(":")[2]))

    live = rooms.contexts["door"].live
    with closing(streaming()):
        wait_for(lambda: live.received > 2)
    seen, left_s = live.received, time.monotonic()
    house.replaced("door")
    with closing(streaming()):
        wait_for(lambda: live.received > seen + 2)
    away_s = time.monotonic() - left_s
    after = measured(house)
    assert after["deltalight_room_restarts_total", "door"] == 1
    assert after["deltalight_room_gap_seconds_count", "door"] == 1
    assert 0 < after["deltalight_room_gap_seconds_sum", "door"] < away_s + 1
    assert after["deltalight_room_frame_seconds_count", "door"] >= seen
    house.api.client.post("/rooms/door/drain").raise_for_status()
    wait_for(lambda: measured(house)["deltalight_room_waits", "drained", "door"] == 1)
    assert ("deltalight_room_gap_seconds_count", "hall") not in after, "it showed nothing yet"
    check_names(house.api.client.get("/metrics").text, [FLEET_BOARD])


def test_drain_start_and_move_by_rest(house: House) -> None:
    client = house.api.client
    drained = client.post("/rooms/hall/drain").json()
    assert (drained["state"], "was drained" in drained["why"]) == ("waiting", True)
    house.keeper.poll()
    wait_for(lambda: house.get("/rooms/attic")["state"] == "starting")
    full = client.post("/rooms/door/move", json={"slot": "slot-1"})
    assert "slot-1 is in use by attic" in sentence(full, 409)
    client.post("/rooms/attic/drain").raise_for_status()
    moving = client.post("/rooms/door/move", json={"slot": "slot-1"}).json()
    assert (moving["slot"], moving["moving_to"]) == ("slot-2", "slot-1")
    assert client.post("/rooms/cellar/drain").status_code == 404
    assert client.post("/rooms/hall/start").json()["state"] == "waiting"
    assert client.post("/rooms/door/move", json={"slt": "slot-1"}).status_code == 422


def test_hosts_are_listed_and_drained_by_rest(house: House) -> None:
    client = house.api.client
    host, other = house.get("/hosts")  # of stand-ins each slot is a host
    assert (host["drained"], host["slots"], host["rooms"]) == (False, 1, ["hall"])
    drained = client.post(f"/hosts/{host['name']}/drain").json()
    assert (drained["name"], drained["drained"]) == (host["name"], True)
    house.keeper.poll()
    wait_for(lambda: house.get("/rooms/hall")["state"] == "waiting")
    assert [each["drained"] for each in house.get("/hosts")] == [True, False]
    assert other["rooms"] == ["door"]
    assert client.post("/hosts/mars/drain").status_code == 404
    assert client.delete(f"/hosts/{host['name']}/drain").json()["drained"] is False
    assert "is not drained" in sentence(client.delete(f"/hosts/{host['name']}/drain"), 409)
    house.directory.close()
    assert "does not answer" in sentence(client.post(f"/hosts/{host['name']}/drain"), 503)


def test_a_web_process_of_rooms_is_ready_while_storage_and_directory_answer(house: House) -> None:
    assert house.api.client.get("/ready").status_code == 200, "though no picture came"
    house.directory.close()
    wait_for(lambda: house.api.client.get("/ready").status_code == 503)
    assert "the directory of rooms does not answer" in sentence(house.api.client.get("/ready"), 503)


def test_a_directory_that_is_gone_leaves_what_runs(house: House) -> None:
    house.directory.close()
    refused = house.api.client.post("/rooms/hall/drain")
    assert "does not answer" in sentence(refused, 503)
    assert [room["state"] for room in house.get("/rooms")["rooms"]] == ["running", "running", "waiting"]
    assert house.get("/rooms/door/state")["render_server"] == "answers"


def test_a_token_that_may_look_sees_rooms_and_moves_none(tmp_path: Path) -> None:
    placer = StandInPlacer(answers=True)
    keeper = RoomKeeper(plans(tmp_path, "hall"), placer)
    directory = ports.endpoint(ports.private_ports(1)[0])
    with (
        closing(DirectoryServer(directory, keeper)),
        running_api(tmp_path / "data", rooms=directory, host="0.0.0.0") as api,
    ):
        looks = {"Authorization": f"Bearer {api.store.tokens.create('wall', 'view')}"}
        scene = api.client.get("/rooms/hall/active-scene", headers=looks).json()["id"]
        statuses = [
            api.client.get("/rooms").status_code,
            api.client.get("/rooms", headers=looks).status_code,
            api.client.post("/rooms/hall/drain", headers=looks).status_code,
            api.client.post("/hosts/local/drain", headers=looks).status_code,
            api.client.patch(f"/rooms/hall/scenes/{scene}", headers=looks, json={"name": "x"}).status_code,
            api.client.post("/rooms/hall/tickets", headers=looks).status_code,
        ]
        assert statuses == [401, 200, 403, 403, 403, 201]


def test_an_installation_without_a_directory_has_one_room(tmp_path: Path) -> None:
    with running_api(tmp_path) as api:
        (room,) = api.client.get("/rooms").json()["rooms"]
        assert (room["name"], room["state"], room["slot"]) == ("room", "starting", None)
        assert api.client.get("/rooms/room/scenes").json() == api.client.get("/scenes").json()
        refused = api.client.post("/rooms/room/drain")
        assert "deltalight up --rooms" in sentence(refused, 409)
        assert api.client.get("/hosts").json() == []
        assert "deltalight up --rooms" in sentence(api.client.delete("/hosts/local/drain"), 409)


def room_at(epoch: int | None) -> RoomList:
    endpoints = (
        None if epoch is None else RoomEndpoints(epoch=epoch, publish=f"p{epoch}", control=f"c{epoch}")
    )
    node = RoomNode(name="desk", endpoint="n")
    room = RoomStatus(name="hall", nodes=(node,), state="running", endpoints=endpoints)
    return RoomList(rooms=(room,), slots=())


def test_a_stale_epoch_is_refused_and_counted() -> None:
    followed: list[int | None] = []
    follower = RoomFollower(
        NoDirectory(), lambda _room, found: followed.append(None if found is None else found.epoch)
    )
    with structlog.testing.capture_logs() as lines:
        for epoch in (3, 3, 5, 4, None, 4, 6):
            follower.take(room_at(epoch))
    assert followed == [3, 5, None, 6]
    assert follower.refused == 2
    assert [line["epoch"] for line in lines] == [4], "said once, not five times a second"


def test_endpoints_that_cannot_be_used_leave_the_other_rooms_alone() -> None:
    followed: list[str] = []

    def follow(room: str, _endpoints: RoomEndpoints | None) -> None:
        if room == "hall":
            raise DeltalightError("that is no endpoint")
        followed.append(room)

    follower = RoomFollower(NoDirectory(), follow)
    (hall,) = room_at(3).rooms
    told = RoomList(rooms=(hall, hall.replaced(name="door")), slots=())
    with structlog.testing.capture_logs() as lines:
        follower.take(told)
        follower.take(told)
    assert followed == ["door"]
    assert [(line["room"], line["fault"]) for line in lines] == [("hall", "that is no endpoint")]
    assert follower.newest == told


def test_a_server_of_another_epoch_gets_nothing(house: House) -> None:
    (port,) = ports.private_ports(1)
    with closing(Recorder(port, epoch=1_000)) as stale:
        link = house.api.app.state.rooms.contexts["door"].link  # type: ignore[attr-defined]
        link.follow(ports.endpoint(port), 1_001)
        wait_for(lambda: ("ping", {}) in stale.asked)
        wait_for(lambda: house.get("/rooms/door/state")["render_server"] == "silent")
        assert not stale.payloads("set_scene")
