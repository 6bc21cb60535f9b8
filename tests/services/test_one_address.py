"""Several web processes behind one address: whichever takes a connection, clients see one service."""

import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from deltalight.services import ports
from deltalight.services.rooms.directory import DirectoryServer
from deltalight.services.rooms.keeper import RoomKeeper
from deltalight.services.rooms.status import RoomNode
from deltalight.services.storage.store import Store
from tests.services.api_samples import UPLOAD, sentence
from tests.services.balancer import Balancer
from tests.services.conftest import ROOT
from tests.services.live_samples import StandInStream, event_socket, live_socket, next_event, read_frame
from tests.services.record_samples import feeding
from tests.services.room_samples import StandInPlacer, plans, running
from tests.services.storage_samples import TETRAHEDRON

pytestmark = pytest.mark.slow(seconds=10)
PROCESSES = 3
PATIENCE_S = 60.0


def wait_for(condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        with suppress(httpx.HTTPStatusError):  # a process that has not heard of it yet
            if condition():
                return
        time.sleep(0.05)
    pytest.fail("it never came")


class Service:
    """Web processes of two rooms behind a balancer; the first one records and replays. Each request connects anew."""

    def __init__(self, folder: Path, directory: str, database: str | None) -> None:
        self.folder, self._directory, self._database = folder, directory, database
        self.numbers = ports.private_ports(PROCESSES)
        self.processes: dict[int, subprocess.Popen[bytes]] = {}
        # One for all questions: each client that is made takes 20 ms of processor time.
        self._asking = httpx.Client(limits=httpx.Limits(max_keepalive_connections=0), timeout=PATIENCE_S)
        with Store(folder, database=database) as store:
            token = store.tokens.create("me", "control")
        for number in self.numbers:
            self.start(number)
        for number in self.numbers:
            wait_for(lambda: self.is_shown(number))  # noqa: B023
        self.balancer = Balancer(self.numbers)
        self.address = f"{ports.LOOPBACK}:{self.balancer.port}"
        self.client = httpx.Client(
            base_url=f"http://{self.address}/api/v1",
            headers={"Authorization": f"Bearer {token}"},
            limits=httpx.Limits(max_keepalive_connections=0),
            timeout=PATIENCE_S,
        )

    def close(self) -> None:
        self._asking.close()
        self.client.close()
        self.balancer.close()
        for number in list(self.processes):
            self.kill(number)

    def start(self, number: int) -> None:
        words: list[object] = ["api", "--config", "/dev/null", "--data", self.folder, "--port", number]
        words += ["--host", "0.0.0.0", "--rooms", self._directory]
        words += [] if self._database is None else ["--database", self._database]
        command = [sys.executable, "-m", "deltalight.services.cli", *map(str, words)]
        has_jobs = {"DELTALIGHT_API__JOBS": str(number == self.numbers[0]).lower()}
        self.processes[number] = subprocess.Popen(command, cwd=ROOT, env={**os.environ, **has_jobs})

    def is_shown(self, number: int) -> bool:
        """Whether a process has a render server and pictures."""
        with suppress(httpx.TransportError):
            answer = self._asking.get(f"http://{ports.LOOPBACK}:{number}/api/v1/ready")
            return answer.status_code == 200
        return False

    def kill(self, number: int) -> None:
        process = self.processes.pop(number)
        process.kill()
        process.wait()

    def at_each(self, path: str) -> list[Any]:
        """The answers of all processes."""
        before = self.balancer.served.copy()
        answers = [self.client.get(path).raise_for_status().json() for _ in self.numbers]
        assert self.balancer.served - before == Counter(self.numbers)
        return answers

    def ticket(self) -> str:
        return "?ticket=" + str(self.client.post("/tickets").raise_for_status().json()["ticket"])

    def listeners(self, open_sockets: ExitStack) -> list[ClientConnection]:
        """A listener at each process."""
        tickets = [self.ticket() for _ in self.numbers]
        return [open_sockets.enter_context(event_socket(self.address, ticket)) for ticket in tickets]


@pytest.fixture(scope="module")
def service(
    tmp_path_factory: pytest.TempPathFactory, module_database: str | None
) -> Iterator[tuple[Service, StandInPlacer]]:
    folder, placer = tmp_path_factory.mktemp("data"), StandInPlacer(answers=True)
    directory = ports.endpoint(ports.private_ports(1)[0])
    with ExitStack() as open_parts:
        open_parts.enter_context(closing(placer))
        endpoint, _ = open_parts.enter_context(feeding())
        node = RoomNode(name="desk", endpoint=endpoint)
        keeper = RoomKeeper([replace(plan, nodes=(node,)) for plan in plans(folder, "hall", "door")], placer)
        open_parts.enter_context(closing(DirectoryServer(directory, keeper)))
        running(keeper, placer, "hall", "door")
        for room in ("hall", "door"):
            port = int(placer.of(room).publish.rpartition(":")[2])
            open_parts.enter_context(closing(StandInStream(port)))
        yield open_parts.enter_context(closing(Service(folder, directory, module_database))), placer


@pytest.fixture
def one(service: tuple[Service, StandInPlacer]) -> Service:
    return service[0]


def test_tickets_and_revisions_are_those_of_all(one: Service) -> None:
    ticket = one.ticket()
    without = httpx.Client(base_url=one.client.base_url, limits=httpx.Limits(max_keepalive_connections=0))
    with without as client:
        assert [client.get(f"/scenes{ticket}").status_code for _ in range(4)] == [200, 401, 401, 401]
    scene = one.client.get("/active-scene").json()
    path, revision = f"/scenes/{scene['id']}", scene["revision"]
    for number in range(2 * PROCESSES):
        stale = one.client.patch(path, json={"name": "late"}, headers={"If-Match": f'"{revision - 1}"'})
        assert stale.status_code == 409
        answer = one.client.patch(path, json={"name": f"{number}"}, headers={"If-Match": f'"{revision}"'})
        assert answer.status_code == 200, answer.text
        assert (answer.json()["revision"], answer.headers["etag"]) == (revision + 1, f'"{revision + 1}"')
        revision += 1
        assert {each["revision"] for each in one.at_each(path)} == {revision}
    undone = one.client.post(f"{path}/undo").json()
    assert {each["document"]["name"] for each in one.at_each(path)} == {undone["document"]["name"]}
    wait_for(lambda: all(each["picture"]["state"] == "shown" for each in one.at_each("/state")))


def test_listeners_at_all_hear_what_any_takes(one: Service) -> None:
    scene = one.client.get("/active-scene").json()["id"]
    with ExitStack() as open_sockets:
        sockets = one.listeners(open_sockets)
        for number in range(PROCESSES):
            revision = one.client.patch(f"/scenes/{scene}", json={"name": f"heard {number}"}).json()[
                "revision"
            ]
            for socket in sockets:
                wait_for(lambda: next_event(socket, "scene")["revision"] == revision)  # noqa: B023
        kept = one.client.post("/assets?name=t.obj", content=TETRAHEDRON, headers=UPLOAD).json()
        for socket in sockets:
            assert next_event(socket, "asset")["name"] == "t.obj"
    for _ in range(PROCESSES):
        assert one.client.get(f"/assets/{kept['asset']}/content").content == TETRAHEDRON


def test_pictures_and_snapshots_come_from_all(one: Service) -> None:
    for _ in range(PROCESSES):
        with live_socket(one.address, one.ticket()) as socket:
            first = read_frame(socket)["frame_id"]
            assert read_frame(socket)["frame_id"] > first
        assert one.client.get("/live.jpg").content.startswith(b"\xff\xd8")
        taken = one.client.post("/snapshots", json={"pictures": [{"name": "a"}]}).raise_for_status().json()
        for _ in range(PROCESSES):
            assert one.client.get(f"/snapshots/{taken['id']}/a.png").status_code == 200
    assert len({len(each) for each in one.at_each("/snapshots")}) == 1


def test_all_say_what_the_one_that_records_and_replays_does(one: Service) -> None:
    answers = [one.client.post("/recordings", json={"name": "take"}) for _ in range(PROCESSES)]
    assert Counter(each.status_code for each in answers) == {201: 1, 409: PROCESSES - 1}
    assert all("ask the one that does" in sentence(each, 409) for each in answers if each.status_code == 409)
    wait_for(lambda: [each["state"] for each in one.at_each("/recordings/take")] == ["recording"] * PROCESSES)
    refused = [one.client.get("/recordings/take/content") for _ in range(PROCESSES)]
    assert all("still being recorded" in sentence(each, 409) for each in refused)
    _until_taken(one, "POST", "/recordings/take/stop")
    wait_for(lambda: [each[0]["state"] for each in one.at_each("/recordings")] == ["finished"] * PROCESSES)
    _until_taken(one, "PUT", "/replay", {"recording": "take", "playing": False})
    wait_for(lambda: [each["recording"] for each in one.at_each("/replay")] == ["take"] * PROCESSES)
    assert {each["playing"] for each in one.at_each("/replay")} == {False}
    _until_taken(one, "DELETE", "/replay")
    wait_for(lambda: [each["recording"] for each in one.at_each("/replay")] == [None] * PROCESSES)


def _until_taken(one: Service, method: str, path: str, body: object = None) -> None:
    """Repeats what one process alone does, until a connection reaches it."""
    answers = [one.client.request(method, path, json=body) for _ in range(PROCESSES)]
    assert sum(each.is_success for each in answers) == 1, [each.text for each in answers]


def test_rooms_are_the_same_at_all(service: tuple[Service, StandInPlacer]) -> None:
    one, placer = service

    def states() -> list[str]:
        return [each["rooms"][1]["state"] for each in one.at_each("/rooms")]

    scene = one.client.get("/rooms/door/active-scene").json()["id"]
    for number in range(PROCESSES):
        one.client.patch(f"/rooms/door/scenes/{scene}", json={"name": f"door {number}"}).raise_for_status()
        orders = placer.servers[placer.of("door").epoch].payloads
        wait_for(lambda: orders("set_scene")[-1]["scene"]["name"] == f"door {number}")  # noqa: B023
    with ExitStack() as open_sockets:
        sockets = one.listeners(open_sockets)
        one.client.post("/rooms/door/drain").raise_for_status()
        for socket in sockets:
            next_event(socket, "rooms")
    wait_for(lambda: states() == ["waiting"] * PROCESSES)


def test_the_others_go_on_when_one_is_killed(one: Service) -> None:
    scene = one.client.get("/active-scene").json()["id"]
    with ExitStack() as open_sockets:
        sockets = one.listeners(open_sockets)
        one.kill(one.numbers[1])
        for number in range(2 * PROCESSES):
            answer = one.client.patch(f"/scenes/{scene}", json={"name": f"without {number}"})
            assert answer.status_code == 200
        closed = [socket for socket in sockets if not _hears(socket, "without 5")]
        assert len(closed) == 1
        again = open_sockets.enter_context(event_socket(one.address, one.ticket()))
        one.client.patch(f"/scenes/{scene}", json={"name": "reconnected"}).raise_for_status()
        assert _hears(again, "reconnected")
    one.start(one.numbers[1])
    wait_for(lambda: one.is_shown(one.numbers[1]))
    assert {each["document"]["name"] for each in one.at_each("/active-scene")} == {"reconnected"}


def _hears(socket: ClientConnection, name: str) -> bool:
    """Whether a listener hears of a scene's name before its connection ends."""
    with suppress(ConnectionClosed):
        while True:
            event = json.loads(socket.recv(timeout=PATIENCE_S))
            if event["type"] == "scene" and event["name"] == name:
                return True
    return False
