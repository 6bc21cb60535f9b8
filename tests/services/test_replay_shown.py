"""A replay seen at the render server's end: real processes, with sockets in a folder as in docker-compose.yml."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import psutil
import pytest
from jaxtyping import UInt8

from deltalight.protocol.source import open_source
from deltalight.services import ports
from tests.services.conftest import ROOT
from tests.services.record_samples import PERIOD_NS, feeding, frames, write

pytestmark = pytest.mark.slow(seconds=10)
COUNT = 40
# JPEG loses a few steps of 255; two of these pictures differ by 80 in the mean.
SAME, ANOTHER = 15.0, 40.0


def wait_for(condition: Callable[[], object]) -> None:
    for _ in range(600):
        with suppress(httpx.TransportError, KeyError):
            if condition():
                return
        time.sleep(0.1)
    pytest.fail("it never came")


@contextmanager
def process(*arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    running = subprocess.Popen(
        [sys.executable, "-m", "deltalight.services.cli", *map(str, arguments)], cwd=ROOT
    )
    try:
        yield running
    finally:
        running.terminate()
        try:
            running.wait(60)
        except subprocess.TimeoutExpired:
            running.kill()
            running.wait()


@dataclass(frozen=True)
class Host:
    """A node that sends, a render server, and where an API beside them keeps its sockets and files."""

    node: str
    sockets: Path
    data: Path

    @property
    def control(self) -> str:
        return f"ipc://{self.sockets}/control"

    @property
    def composites(self) -> str:
        return f"ipc://{self.sockets}/composites"


@pytest.fixture(scope="module")
def host(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Host]:
    data = tmp_path_factory.mktemp("data")
    (data / "recordings").mkdir()
    write(data / "recordings" / "take.mcap", frames(COUNT))
    with feeding() as (node, _):
        host = Host(node, tmp_path_factory.mktemp("run"), data)
        words = ("--subscribe", node, "--publish", host.composites, "--control", host.control)
        with process("server", "--allow-software", *words):
            yield host


@dataclass(frozen=True)
class Api:
    """A web process."""

    client: httpx.Client
    process: subprocess.Popen[bytes]

    def shows(self, picture: UInt8[np.ndarray, "h w 3"]) -> bool:
        """Whether the newest composite is this picture."""
        shown = self.client.get("/live.jpg")
        if shown.status_code != 200:
            return False
        decoded = cv2.imdecode(np.frombuffer(shown.content, np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None
        small = cv2.resize(decoded[..., ::-1], picture.shape[1::-1], interpolation=cv2.INTER_AREA)
        return bool(np.abs(small.astype(int) - picture).mean() < SAME)

    def children(self, command: str) -> list[psutil.Process]:
        return [each for each in psutil.Process(self.process.pid).children() if command in each.cmdline()]


@contextmanager
def serving(host: Host) -> Iterator[Api]:
    (port,) = ports.private_ports(1)
    words = ["--data", host.data, "--control", host.control]
    words += ["--subscribe", host.composites, "--subscribe", host.node]
    url = f"http://{ports.LOOPBACK}:{port}/api/v1"
    with process("api", "--port", port, *words) as running, httpx.Client(base_url=url, timeout=60) as client:
        wait_for(lambda: client.get("/state").json()["render_server"] == "answers")
        yield Api(client, running)


@pytest.fixture
def api(host: Host) -> Iterator[Api]:
    with serving(host) as running:
        yield running


def recorded(host: Host) -> list[UInt8[np.ndarray, "h w 3"]]:
    return [np.asarray(frame.color) for frame in open_source(host.data / "recordings" / "take.mcap")]


def test_the_composite_shows_the_recording_where_it_was_sought_and_then_live(host: Host, api: Api) -> None:
    pictures = recorded(host)
    live = pictures[:4]  # what the node sends in turns
    shown_at = (10, 33)
    assert np.abs(pictures[10].astype(int) - pictures[33]).mean() > ANOTHER
    wait_for(lambda: any(api.shows(each) for each in live))
    for number in shown_at:
        body = {"position_s": number * PERIOD_NS / 1e9, "playing": False}
        if number == shown_at[0]:
            answer = api.client.put("/replay", json={"recording": "take", **body})
        else:
            answer = api.client.patch("/replay", json=body)
        assert answer.status_code == 200, answer.text
        wait_for(lambda wanted=pictures[number]: api.shows(wanted))  # type: ignore[misc]
        assert not any(api.shows(each) for each in live)
    (child,) = api.children("replay")
    assert not [each for each in child.net_connections("tcp") if each.status == psutil.CONN_LISTEN]
    assert {path.name for path in host.sockets.glob("*replay*")} == {
        "control-replay",
        "control-replay-control",
    }
    api.client.delete("/replay").raise_for_status()
    wait_for(lambda: any(api.shows(each) for each in live))
    assert not api.children("replay")
    assert not list(host.sockets.glob("*replay*"))


def test_it_goes_on_at_its_rate_and_around_or_stays_at_its_end(api: Api) -> None:
    end_s = (COUNT - 1) * PERIOD_NS / 1e9

    def position_s() -> float:
        return float(api.client.get("/replay").json()["position_s"])

    api.client.put("/replay", json={"recording": "take", "rate": 0.05}).raise_for_status()
    before_s, from_s = time.monotonic(), position_s()
    asked_s = time.monotonic()
    wait_for(lambda: position_s() > from_s)
    again_s, to_s = time.monotonic(), position_s()
    after_s = time.monotonic()
    frame_s = PERIOD_NS / 1e9
    assert 0.05 * (again_s - asked_s) - frame_s <= to_s - from_s <= 0.05 * (after_s - before_s) + frame_s

    api.client.patch("/replay", json={"rate": 1.0, "position_s": end_s - 0.2}).raise_for_status()
    wait_for(lambda: position_s() < end_s / 2)
    whole = {"recording": "take", "position_s": end_s - 0.2, "loop": False}
    api.client.put("/replay", json=whole).raise_for_status()
    wait_for(lambda: not api.client.get("/replay").json()["playing"])
    assert position_s() == pytest.approx(end_s, abs=frame_s)
    api.client.patch("/replay", json={"position_s": 0, "rate": 0.05, "playing": True}).raise_for_status()
    assert api.client.get("/replay").json()["playing"]


def set_to_work(api: Api, name: str) -> list[psutil.Process]:
    """Lets it show a recording and makes another, called `name`; the processes that do so."""
    shown = api.client.put("/replay", json={"recording": "take"})
    assert shown.status_code == 200, shown.text
    api.client.post("/recordings", json={"name": name}).raise_for_status()
    wait_for(lambda: (api.client.get(f"/recordings/{name}").json()["frames"] or 0) > 3)
    children = api.children("replay") + api.children("record")
    assert len(children) == 2
    return children


def require_whole(host: Host, name: str) -> None:
    folder = host.data / "recordings"
    assert len(open_source(folder / f"{name}.mcap")) > 3
    left = {path.name for path in folder.iterdir()} - {".cache", ".incoming"}
    assert not [each for each in left if each.endswith(".active") or each.startswith(".")]


def test_recorder_and_replay_end_with_the_api_and_the_next_one_begins_live(host: Host) -> None:
    with serving(host) as api:
        children = set_to_work(api, "killed")
        api.process.kill()
        assert len(psutil.wait_procs(children, 30)[0]) == 2
    require_whole(host, "killed")
    with serving(host) as api:
        found: dict[str, Any] = {each["id"]: each for each in api.client.get("/recordings").json()}
        assert (found["killed"]["state"], found["killed"]["detail"]) == ("finished", "")
        assert api.client.get("/replay").json()["recording"] is None
        live = recorded(host)[:4]
        wait_for(lambda: any(api.shows(each) for each in live))
        children = set_to_work(api, "told-to-end")  # over the sockets that the killed one left
    assert not any(child.is_running() for child in children), "they are ended before the API is"
    require_whole(host, "told-to-end")
    assert not list(host.sockets.glob("*replay*"))
