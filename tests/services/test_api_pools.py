"""Requests that take long wait for each other only: every other route answers meanwhile."""

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from deltalight.services.api import request_bodies
from deltalight.services.api.pools import Pool
from deltalight.services.api.problems import ProblemError
from deltalight.services.storage.asset_kinds import AssetKind, Facts
from tests.services.api_samples import UPLOAD, RunningApi, running_api, sentence
from tests.services.storage_samples import TETRAHEDRON, trusting_probe

MANY = 48  # more than the framework has threads
OTHER_ROUTES = ("/health", "/scenes", "/state", "/assets", "/recordings", "/replay")


class Gate:
    """What waits in here waits until the gate opens."""

    def __init__(self) -> None:
        self.inside = 0
        self._opened = threading.Event()

    def wait(self) -> None:
        self.inside += 1
        assert self._opened.wait(60)

    def open(self) -> None:
        self._opened.set()


@pytest.fixture
def gate() -> Gate:
    return Gate()


@pytest.fixture
def api(gate: Gate, tmp_path: Path) -> Iterator[RunningApi]:
    """Every check of an upload waits at the gate."""

    def probe(path: Path, kind: AssetKind, name: str) -> Facts:
        gate.wait()
        return trusting_probe(path, kind, name)

    with running_api(tmp_path, probe) as running:
        yield running


def begun(
    count: int, api: RunningApi, method: str, path: str, **more: object
) -> list[Future[httpx.Response]]:
    executor = ThreadPoolExecutor(count)
    return [executor.submit(api.client.request, method, path, **more) for _ in range(count)]  # type: ignore[arg-type]


def require_others_answer(api: RunningApi) -> None:
    for path in OTHER_ROUTES:
        assert api.client.get(path).status_code == 200, path


def test_uploads_that_wait_stop_no_other_route(api: RunningApi, gate: Gate) -> None:
    pools = api.app.state.context.pools  # type: ignore[attr-defined]
    pools["assets"].patience_s = 1.0
    uploads = begun(MANY, api, "POST", "/assets?name=t.obj", content=TETRAHEDRON, headers=UPLOAD)
    while sum(each.done() for each in uploads) < MANY // 2:  # refused, while nobody is served
        require_others_answer(api)
    assert gate.inside
    gate.open()
    answers = [each.result(60) for each in uploads]
    refused = [answer for answer in answers if answer.status_code == 503]
    assert len(refused) >= MANY // 2
    assert {answer.status_code for answer in answers} == {200, 201, 503}
    assert all("wait for the assets" in sentence(answer, 503) for answer in refused)
    assert {answer.headers["Retry-After"] for answer in refused} == {"1"}
    assert not list((api.store.folder / "assets" / ".incoming").iterdir())


def test_yaml_is_parsed_beside_the_event_loop(
    api: RunningApi, gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    def parse(*_arguments: object, **_options: object) -> dict[str, object]:
        gate.wait()
        return {"name": "late"}

    monkeypatch.setattr(request_bodies, "parse_mapping", parse)
    yaml_type = {"Content-Type": "application/yaml"}
    (made,) = begun(1, api, "POST", "/scenes", content=b"name: late", headers=yaml_type)
    while not gate.inside:
        require_others_answer(api)
    require_others_answer(api)
    gate.open()
    assert made.result(60).json()["document"]["name"] == "late"


def test_who_waits_too_long_is_told_when_to_come_again() -> None:
    async def scenario() -> None:
        pool, gate = Pool("cameras", 1, patience_s=0.01), Gate()
        first = asyncio.ensure_future(pool.run(gate.wait))
        await asyncio.sleep(0)
        with pytest.raises(ProblemError, match="wait for the cameras") as refusal:
            await pool.run(gate.wait)
        assert refusal.value.status_code == 503
        assert refusal.value.headers == {"Retry-After": "1"}
        gate.open()
        await first
        assert await pool.run(lambda: 7) == 7

    asyncio.run(scenario())
