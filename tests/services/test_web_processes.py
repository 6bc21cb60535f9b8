"""Several web processes of one database: each change is everybody's, once; and a database that goes, and returns."""

import gc
import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import count, cycle
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
from structlog.testing import capture_logs

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument
from deltalight.services import ports
from deltalight.services.api import serve
from deltalight.services.api.heard_jobs import LIFE_S as HEARD_S
from deltalight.services.api.heard_jobs import HeardJobs
from deltalight.services.api.settings import ApiSettings
from deltalight.services.host_store import activate_first
from deltalight.services.storage.data_folder import doing_jobs
from deltalight.services.storage.faults import DatabaseGoneError, StorageFaultError
from deltalight.services.storage.feed import LONGEST_BYTES
from deltalight.services.storage.last_known import LIFE_S, MOST_ANSWERS, LastKnown
from deltalight.services.storage.store import Store
from tests.services.api_samples import UPLOAD, RenderServer, RunningApi, running_api, sentence
from tests.services.conftest import ROOT, RunCli
from tests.services.live_samples import event_socket, live_socket, next_event
from tests.services.postgres_samples import PostgresServer
from tests.services.storage_samples import TETRAHEDRON, trusting_probe

PROCESSES, WRITERS, CHANGES_EACH = 4, 20, 3


@dataclass(frozen=True)
class Pair:
    """Two web processes of one database and one render server; the second one leaves jobs to the first."""

    first: RunningApi
    second: RunningApi
    server: RenderServer


def address(api: RunningApi) -> str:
    return f"{ports.LOOPBACK}:{api.client.base_url.port}"


def wait_for(condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline_s, "it never came"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory, module_database: str | None) -> Iterator[Pair]:
    folder = tmp_path_factory.mktemp("data")
    (control,) = ports.private_ports(1)
    settings = {"control": ports.endpoint(control), "database": module_database}
    server = RenderServer(control)
    try:
        with (
            running_api(folder, **settings) as first,
            running_api(folder, jobs=False, **settings) as second,
        ):
            yield Pair(first, second, server)
    finally:
        server.close()


def test_a_change_through_one_is_heard_and_seen_through_the_other(pair: Pair) -> None:
    scene_id = pair.first.client.post("/scenes", json={"name": "shared"}).json()["id"]
    pair.first.client.post(f"/scenes/{scene_id}/activate")
    with event_socket(address(pair.second)) as socket:
        for number, (here, there) in enumerate(((pair.first, pair.second), (pair.second, pair.first)), 2):
            here.client.patch(f"/scenes/{scene_id}", json={"name": f"change {number}"})
            heard = next_event(socket, "scene")
            while heard["revision"] != number:
                heard = next_event(socket, "scene")
            assert (heard["id"], heard["name"], heard["active"]) == (scene_id, f"change {number}", True)
            assert there.client.get(f"/scenes/{scene_id}").json()["revision"] == number
            wait_for(lambda: pair.server.session.scene.name == f"change {number}")  # noqa: B023
        here.client.post("/assets?name=t.obj", content=TETRAHEDRON, headers=UPLOAD)
        assert next_event(socket, "asset")["name"] == "t.obj"
    for api in (pair.first, pair.second):
        wait_for(lambda: api.client.get("/state").json()["picture"]["state"] == "shown")  # noqa: B023


def test_each_of_many_changes_to_one_revision_wins_once(pair: Pair) -> None:
    scene_id = pair.first.client.post("/scenes", json={"name": "race"}).json()["id"]

    def attempt(number: int) -> int:
        api = (pair.first, pair.second)[number % 2]
        headers = {"If-Match": '"1"'}
        return api.client.patch(
            f"/scenes/{scene_id}", json={"name": str(number)}, headers=headers
        ).status_code

    with ThreadPoolExecutor(8) as pool:
        assert Counter(pool.map(attempt, range(16))) == {200: 1, 409: 15}
    assert pair.second.client.get(f"/scenes/{scene_id}").json()["revision"] == 2


OTHER_WITH_JOBS = """
import os, pathlib, sys
from deltalight.services.storage.data_folder import doing_jobs
with doing_jobs(pathlib.Path(sys.argv[1])) as is_shared:
    if os.fork():  # the child keeps what it inherited until the pipe ends
        print(is_shared, flush=True)
    sys.stdin.read()
"""


@contextmanager
def other_with_jobs(folder: Path) -> Iterator["subprocess.Popen[str]"]:
    """Another process that records and replays, and one that it forked."""
    command, pipe = [sys.executable, "-c", OTHER_WITH_JOBS, str(folder)], subprocess.PIPE
    with subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "False\n"
            yield process
        finally:
            process.kill()


def test_the_second_process_with_jobs_hears_of_the_first(tmp_path: Path) -> None:
    with other_with_jobs(tmp_path) as other:
        for _ in range(2):  # having heard of it changes nothing
            with doing_jobs(tmp_path) as is_shared:
                assert is_shared
        other.kill()
        other.wait(60)
        with doing_jobs(tmp_path) as is_shared:
            assert not is_shared


@pytest.mark.parametrize("jobs", [True, False])
def test_a_web_process_tells_of_another_one_with_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, jobs: bool
) -> None:
    monkeypatch.setattr(serve, "http_server", lambda _app: SimpleNamespace(run=lambda **_: None))
    monkeypatch.setattr(gc, "freeze", lambda: None)
    page, control = ports.private_ports(2)
    settings = ApiSettings(data=tmp_path, port=page, control=ports.endpoint(control), subscribe=(), jobs=jobs)
    with other_with_jobs(tmp_path), capture_logs() as told:
        serve.run_api(settings)
    assert [line["event"] for line in told].count(serve.OTHER_JOBS) == jobs


def test_tokens_and_tickets_are_those_of_all(tmp_path: Path, database: str | None) -> None:
    settings = {"host": "0.0.0.0", "database": database}
    with running_api(tmp_path, **settings) as first, running_api(tmp_path, **settings) as second:
        token = {"Authorization": f"Bearer {first.store.tokens.create('wall', 'view')}"}
        ticket = first.client.post("/tickets", headers=token).json()["ticket"]
        for api, status in ((second, 200), (first, 401), (second, 401)):
            assert api.client.get(f"/scenes?ticket={ticket}").status_code == status
        second.store.tokens.revoke("wall")
        assert first.client.get("/scenes", headers=token).status_code == 401


def test_what_viewers_of_either_look_at_is_rendered(pair: Pair) -> None:
    with (
        live_socket(address(pair.first), "?view=delta"),
        live_socket(address(pair.second), "?view=volume"),
    ):
        wait_for(lambda: set(pair.server.session.watched) == {"delta", "volume"})
    wait_for(lambda: pair.server.session.watched == ())


def test_one_alone_records_and_replays(pair: Pair) -> None:
    for method, path in (("POST", "/recordings"), ("PUT", "/replay"), ("DELETE", "/replay")):
        answer = pair.second.client.request(method, path, json={})
        assert "ask the one that does" in sentence(answer, 409)
    assert pair.second.client.get("/recordings").json() == []
    assert pair.first.client.delete("/replay").status_code == 204


def test_of_several_that_start_one_makes_the_first_scene(tmp_path: Path, database: str | None) -> None:
    def begin(_number: int) -> None:
        with Store(tmp_path, database=database, probe=trusting_probe) as store:
            activate_first(store, SceneDocument(name="First scene"))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(begin, range(8)))
    with Store(tmp_path, database=database) as store:
        assert [head.is_active for head in store.scenes.all()] == [True]


def test_a_process_whose_first_scene_another_deleted_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store(tmp_path, probe=trusting_probe) as store:
        activate_first(store, SceneDocument(name="Faster"))

        def deleted_meanwhile(scene_id: str) -> bool:
            store.scenes.delete(scene_id)
            return False

        monkeypatch.setattr(store.scenes, "activate_first", deleted_meanwhile)
        activate_first(store, SceneDocument(name="Slower"))
        assert [head.name for head in store.scenes.all()] == ["Faster"]


def test_feeds_reach_all_but_the_sender_and_outlive_killed_ones(tmp_path: Path, database: str | None) -> None:
    heard: dict[str, list[str]] = {"a": [], "b": [], "c": []}
    with Store(tmp_path, database=database) as store, ExitStack() as open_feeds:
        feeds = {name: store.feed() for name in heard}
        for name, feed in feeds.items():
            open_feeds.callback(feed.close)
            feed.start(heard[name].append, lambda: None)
        if database is None:
            (
                tmp_path / ".feed" / "of a killed one"
            ).touch()  # connecting to it is refused, as to a dead socket

        def greet() -> bool:
            """Whether each has heard both others; what is sent before all listen is lost."""
            for name, feed in feeds.items():
                feed.send(f"from {name}")
            return all(
                {f"from {other}" for other in heard.keys() - {name}} <= {*heard[name]} for name in heard
            )

        def told() -> dict[str, list[str]]:
            return {
                name: sorted(text for text in heard[name] if not text.startswith("from ")) for name in heard
            }

        wait_for(greet)
        feeds["a"].send("one")
        feeds["a"].send("x" * (LONGEST_BYTES + 1))
        feeds["b"].send("two ä")
        wait_for(lambda: sum(map(len, told().values())) == 4)
    assert told() == {
        "a": ["two ä"],
        "b": ["one"],
        "c": ["one", "two ä"],
    }
    if database is None:
        assert list((tmp_path / ".feed").iterdir()) == []


def test_what_is_heard_of_jobs_is_kept_while_it_is_repeated() -> None:
    now_s = 0.0
    heard = HeardJobs(lambda: now_s)
    assert heard.replay() is None
    heard.hear("replay", {"recording": "take"})
    for name, state in (
        ("one", "waiting"),
        ("two", "recording"),
        ("two", "finished"),
        ("three", "recording"),
    ):
        heard.hear("recording", {"id": name, "state": state})
    heard.hear("recording", {"id": "three", "deleted": True})
    heard.hear("scene", {"id": "one"})
    assert [each["id"] for each in heard.growing()] == ["one"]
    now_s = HEARD_S / 2
    heard.hear("recording", {"id": "one", "state": "recording"})
    now_s = HEARD_S * 1.25
    assert heard.replay() is None
    assert [each["state"] for each in heard.growing()] == ["recording"]
    now_s = HEARD_S * 2
    assert heard.growing() == []


def test_what_is_known_ends_and_is_bounded() -> None:
    now_s, is_gone = 0.0, False

    def read(answer: int) -> int:
        if is_gone:
            raise DatabaseGoneError("gone")
        return answer

    known = LastKnown(lambda: now_s)
    for number in range(MOST_ANSWERS + 1):
        known.answer(number, lambda number=number: read(number))  # type: ignore[misc]
    is_gone = True
    known.tick(is_changed=True)
    assert known.answer(1, lambda: read(1)) == 1
    with pytest.raises(DatabaseGoneError):
        known.answer(0, lambda: read(0))
    is_gone, now_s = False, LIFE_S + 1
    known.tick(is_changed=False)  # nothing was asked for long, so all is read again
    is_gone, now_s = True, 2 * LIFE_S
    assert known.answer(1, lambda: read(1)) == 1
    now_s += 2
    with pytest.raises(DatabaseGoneError):
        known.answer(1, lambda: read(1))


def test_a_slow_read_does_not_replace_the_answer_of_a_later_one() -> None:
    """A process reads again what was asked for when others change something, beside requests that read it too."""
    clock_s = count()
    known = LastKnown(lambda: float(next(clock_s)))

    def slow() -> str:
        assert known.answer("name", lambda: "two") == "two"  # on another thread, after a change
        return "one"

    def gone() -> str:
        raise DatabaseGoneError("gone")

    assert known.answer("name", slow) == "one"
    assert known.answer("name", gone) == "two"


def test_a_service_that_begins_waits_for_its_database(
    unsteady: PostgresServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ApiSettings(data=tmp_path, database=unsteady.fresh_database())
    unsteady.stop()
    with monkeypatch.context() as patch:
        patch.setattr(serve, "DATABASE_PATIENCE_S", 0.0)
        with pytest.raises(DatabaseGoneError, match="correct its address"):
            serve.open_patiently(settings)
    with ThreadPoolExecutor(1) as pool:
        opening = pool.submit(serve.open_patiently, settings)
        time.sleep(0.2)
        unsteady.start()
        with opening.result() as store:
            assert store.scenes.all() == []


def test_a_wrong_address_of_a_database_is_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("psycopg")
    for wrong in ("mysql://x@/y", "postgresql://", "///"):
        with pytest.raises(DeltalightError, match="must be that of PostgreSQL"):
            Store(tmp_path, database=wrong)
    with pytest.raises(StorageFaultError, match=r"does not answer \(.*correct its address") as refusal:
        Store(tmp_path, database=f"postgresql://me:secret@/scenes?host={tmp_path}")
    assert "secret" not in str(refusal.value)


def test_the_command_line_makes_tokens_in_the_database(
    cli: RunCli, postgres: PostgresServer, tmp_path: Path
) -> None:
    place = ("--data", tmp_path, "--database", postgres.fresh_database())
    token = cli("api", "token", "wall", *place).stdout.strip()
    assert [each["name"] for each in json.loads(cli("api", "tokens", "--json", *place).stdout)] == ["wall"]
    with Store(tmp_path, database=place[-1]) as store:
        assert store.tokens.verify(token) is not None
        assert cli("api", "revoke", "wall", *place).returncode == 0
        assert store.tokens.verify(token) is None
    assert not (tmp_path / "store.sqlite3").exists()
    refused = cli("api", "tokens", "--data", tmp_path, "--database", "mysql://x@/y")
    assert (refused.returncode, "must be that of PostgreSQL" in refused.stderr) == (2, True)


def test_texts_that_postgresql_cannot_keep_are_refused(postgres: PostgresServer, tmp_path: Path) -> None:
    with Store(tmp_path, database=postgres.fresh_database()) as store:
        with pytest.raises(DeltalightError, match="must not hold a NUL character"):
            store.scenes.create({"name": "a\0b"})
        with pytest.raises(DeltalightError, match="remove NUL characters"):
            store.scenes.get("a\0b")


@pytest.fixture
def unsteady(tmp_path: Path) -> Iterator[PostgresServer]:
    """A server of this test's own, which it may stop."""
    del tmp_path
    server = PostgresServer()
    try:
        server.start()
        yield server
    finally:
        server.close()


def test_while_the_database_is_away_reads_go_on_and_nothing_is_lost(
    unsteady: PostgresServer, tmp_path: Path
) -> None:
    settings = {"host": "0.0.0.0", "database": unsteady.fresh_database()}
    with running_api(tmp_path, **settings) as first, running_api(tmp_path, **settings) as second:
        headers = {"Authorization": f"Bearer {first.store.tokens.create('me', 'control')}"}
        for api in (first, second):
            api.client.headers.update(headers)
        scene_id = first.client.post("/scenes", json={"name": "one"}).json()["id"]
        first.client.post(f"/scenes/{scene_id}/activate")
        first.client.post("/assets?name=t.obj", content=TETRAHEDRON, headers=UPLOAD)
        paths = (
            "/scenes",
            f"/scenes/{scene_id}",
            "/active-scene",
            "/assets",
            "/settings",
            "/state",
            "/health",
        )
        assert first.client.get(f"/scenes/{scene_id}/revisions").status_code == 200
        changed = first.client.patch(f"/scenes/{scene_id}", json={"name": "two"})
        assert changed.json()["revision"] == 2
        wait_for(lambda: second.client.get(f"/scenes/{scene_id}").json()["revision"] == 2)
        ticket = first.client.post("/tickets").json()["ticket"]
        (mine,) = first.store.tokens.all()
        with event_socket(address(first), f"?ticket={ticket}") as socket:
            for is_power_cut in (False, True):
                unsteady.stop(at_once=is_power_cut)
                for api in (first, second):
                    assert api.store.tokens.knows(mine.id), "streams go on"
                    for path in paths:
                        assert api.client.get(path).status_code == 200, path
                    assert api.client.get(f"/scenes/{scene_id}").json()["document"]["name"] == "two"
                    refused = api.client.patch(f"/scenes/{scene_id}", json={"name": "three"})
                    assert "does not answer" in sentence(refused, 503)
                    assert "deltalight@" not in refused.text, "clients need not know where it is"
                    ticket = api.client.post("/tickets").json()["ticket"]
                    assert api.client.get(f"/scenes?ticket={ticket}").status_code == 200
                assert api.client.get("/scenes/never-read").status_code == 503
                assert "the storage does not answer" in sentence(api.client.get("/ready"), 503)
                unsteady.start()
                next_event(socket, "lost")
                for api in (first, second):  # they wait for a picture alone
                    wait_for(lambda: "storage" not in sentence(api.client.get("/ready"), 503))  # noqa: B023
                assert first.client.get(f"/scenes/{scene_id}/revisions").json()
        wait_for(lambda: second.client.patch(f"/scenes/{scene_id}", json={"name": "3"}).status_code == 200)
        assert first.client.get(f"/scenes/{scene_id}").json()["revision"] == 3
        assert first.client.get("/active-scene").json()["document"]["name"] == "3"


@pytest.mark.slow
def test_of_20_writers_at_4_processes_each_revision_is_won_once(tmp_path: Path, database: str | None) -> None:
    numbers = ports.private_ports(PROCESSES)
    options = [] if database is None else ["--database", database]
    with ExitStack() as running:
        for number in numbers:
            words = ["api", "--config", "/dev/null", "--data", tmp_path, "--port", number, *options]
            command = [sys.executable, "-m", "deltalight.services.cli", *map(str, words)]
            process = running.enter_context(subprocess.Popen(command, cwd=ROOT))
            running.callback(process.kill)
        clients = [
            running.enter_context(
                httpx.Client(base_url=f"http://{ports.LOOPBACK}:{number}/api/v1", timeout=60)
            )
            for number in numbers
        ]
        for client in clients:
            wait_for(lambda: answers(client))  # noqa: B023
        (only,) = clients[0].get("/scenes").json()
        won = write_at_once(clients, f"/scenes/{only['id']}")
        assert sorted(won) == list(range(2, 2 + WRITERS * CHANGES_EACH))
        for client in clients:
            assert client.get("/active-scene").json()["revision"] == 1 + len(won)
        history = clients[-1].get(f"/scenes/{only['id']}/revisions?limit=200").json()
        assert [each["revision"] for each in history] == list(range(1 + len(won), 0, -1))


def answers(client: httpx.Client) -> bool:
    with suppress(httpx.TransportError):
        return client.get("/health").status_code == 200
    return False


def write_at_once(clients: list[httpx.Client], path: str) -> list[int]:
    """Each writer makes changes until some of them have won; returns the revisions that they were told."""

    def write(number: int) -> list[int]:
        won: list[int] = []
        newest = 1
        for attempt, client in enumerate(cycle(clients)):
            if len(won) == CHANGES_EACH:
                return won
            body, headers = {"name": f"{number}-{attempt}"}, {"If-Match": f'"{newest}"'}
            answer = client.patch(path, json=body, headers=headers)
            assert answer.status_code in {200, 409}, answer.text
            newest = answer.json()["revision"]
            if answer.status_code == 200:
                won.append(newest)
        return won

    with ThreadPoolExecutor(WRITERS) as pool:
        return [revision for each in pool.map(write, range(WRITERS)) for revision in each]
