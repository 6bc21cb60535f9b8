"""Replay over REST: a real replay child, what the render server is told, and the way back to live."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from threading import Event

import httpx
import psutil
import pytest

from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import RequestClient
from deltalight.protocol.source import open_source
from deltalight.sensor_node.cameras.playback import PlaybackCamera
from deltalight.services import ports
from deltalight.services.api.replay_control import ReplayEndpoints
from deltalight.services.node_process import playback_control
from deltalight.services.recorder import Recorder as StreamRecorder
from deltalight.services.recorder import RecordJob
from deltalight.services.storage.faults import ConflictError
from tests.services.api_samples import RunningApi, running_api, sentence
from tests.services.live_samples import event_socket, next_event
from tests.services.record_samples import PERIOD_NS, frames, write
from tests.services.render_server_samples import Recorder

COUNT = 30
LENGTH_S = (COUNT - 1) * PERIOD_NS / 1e9


def wait_for(condition: Callable[[], bool]) -> None:
    for _ in range(600):
        if condition():
            return
        time.sleep(0.05)
    pytest.fail("it never came")


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    folder = tmp_path_factory.mktemp("data")
    (folder / "recordings").mkdir()
    write(folder / "recordings" / "take.mcap", frames(COUNT))
    (folder / "recordings" / "bad.mcap").write_bytes(b"no recording")
    with running_api(folder) as running:
        yield running


@pytest.fixture
def server(api: RunningApi) -> Iterator[Recorder]:
    server = Recorder(api.control_port)
    wait_for(lambda: bool(server.payloads("ping")))
    yield server
    api.client.delete("/replay").raise_for_status()
    server.close()


@pytest.fixture
def client(api: RunningApi) -> httpx.Client:
    return api.client


def children() -> list[psutil.Process]:
    return [child for child in psutil.Process().children() if "replay" in child.cmdline()]


def source(server: Recorder) -> list[str] | None:
    """Where the render server was told to read from last."""
    endpoints: list[str] | None = server.payloads("set_source")[-1]["endpoints"]
    return endpoints


def test_a_recording_is_shown_moved_through_and_left(
    client: httpx.Client, server: Recorder, tmp_path_factory: pytest.TempPathFactory
) -> None:
    assert client.get("/replay").json()["recording"] is None
    shown = client.put("/replay", json={"recording": "take", "position_s": 0.5, "playing": False})
    assert shown.status_code == 200, shown.text
    state = shown.json()
    assert (state["recording"], state["playing"], state["rate"], state["loop"]) == ("take", False, 1.0, True)
    assert state["position_s"] == pytest.approx(0.5, abs=1 / 30)
    assert state["duration_s"] == pytest.approx(LENGTH_S)
    endpoints = source(server)
    assert endpoints is not None
    (endpoint,) = endpoints
    assert endpoint.startswith("tcp://127.0.0.1:")
    out = tmp_path_factory.mktemp("out") / "b.mcap"
    status = StreamRecorder(RecordJob(out, (endpoint,), frames=2), print).run(Event())
    assert status.frames == 2, "while paused the frame is sent again and again"

    moved = client.patch("/replay", json={"position_s": 0.2, "rate": 0.05, "playing": True}).json()
    assert (moved["playing"], moved["rate"]) == (True, 0.05)
    assert 0.1 < moved["position_s"] < 0.5
    assert client.patch("/replay", json={"playing": False}).json()["playing"] is False
    held = client.get("/replay").json()["position_s"]
    assert client.get("/replay").json()["position_s"] == held
    on = client.patch("/replay", json={"step_frames": 2}).json()
    assert (on["position_s"], on["playing"]) == (pytest.approx(held + 2 * PERIOD_NS / 1e9, abs=1e-6), False)
    assert client.patch("/replay", json={"step_frames": -2}).json()["position_s"] == held
    assert client.patch("/replay", json={"position_s": 0.2, "step_frames": -999}).json()["position_s"] == 0
    assert "step_frames" in sentence(client.patch("/replay", json={"step_frames": 0.5}), 422)
    assert "is being replayed" in sentence(client.delete("/recordings/take"), 409)
    assert client.delete("/replay").status_code == 204
    assert source(server) is None
    assert client.get("/replay").json()["recording"] is None
    assert not children()
    assert "no recording is replayed" in sentence(client.patch("/replay", json={"playing": True}), 409)


def test_a_recording_that_the_node_plays_is_moved_through_where_no_other_is_shown(
    tmp_path: Path,
) -> None:
    (port, control_port) = ports.private_ports(2)
    (tmp_path / "recordings").mkdir()
    take = write(tmp_path / "recordings" / "take.mcap", frames(COUNT))
    camera = PlaybackCamera(open_source(take), loop=True, playing=False, stays=True)
    endpoint, server = ports.endpoint(port), Recorder(control_port)
    with ExitStack() as stack:
        stack.callback(server.close)
        stack.enter_context(playback_control(camera, endpoint, None))
        options = {"playback": endpoint, "control": ports.endpoint(control_port)}
        client = stack.enter_context(running_api(tmp_path, **options)).client
        first = client.get("/replay").json()
        assert (first["recording"], first["position_s"], first["playing"]) == (None, 0, False)
        moved = client.patch("/replay", json={"step_frames": 2, "rate": 2}).json()
        assert (moved["position_s"], moved["rate"]) == (pytest.approx(2 * PERIOD_NS / 1e9, abs=1e-6), 2)
        assert client.put("/replay", json={"recording": "take"}).json()["recording"] == "take"
        client.patch("/replay", json={"playing": False, "position_s": 0}).raise_for_status()
        assert camera.playback.position_s == moved["position_s"], "which is another one"
        client.delete("/replay").raise_for_status()
        assert client.get("/replay").json() == moved
        with event_socket(f"{ports.LOOPBACK}:{client.base_url.port}") as events:
            camera.seek(LENGTH_S)
            while next_event(events, "replay")["position_s"] < LENGTH_S - 1e-6:
                pass


def test_a_node_that_plays_and_does_not_answer_keeps_the_service_from_nothing(tmp_path: Path) -> None:
    (port,) = ports.private_ports(1)
    with running_api(tmp_path, playback=ports.endpoint(port)) as api:
        assert api.client.get("/replay").json()["position_s"] is None
        sentence(api.client.patch("/replay", json={"playing": True}), 503)


def test_what_a_killed_service_left_is_put_right(api: RunningApi, client: httpx.Client) -> None:
    wait_for(lambda: client.get("/state").json()["render_server"] == "silent")
    server = Recorder(api.control_port)
    wait_for(lambda: bool(server.payloads("set_source")))
    assert source(server) is None
    server.close()


def test_one_replay_takes_the_place_of_another(client: httpx.Client, server: Recorder) -> None:
    first = client.put("/replay", json={"recording": "take"})
    assert first.status_code == 200, first.text
    before = source(server)
    assert client.put("/replay", json={"recording": "take", "loop": False}).json()["loop"] is False
    assert source(server) != before
    assert len(children()) == 1


def test_a_dead_replay_gives_live_back(client: httpx.Client, server: Recorder) -> None:
    client.put("/replay", json={"recording": "take"}).raise_for_status()
    (child,) = children()
    child.kill()
    wait_for(lambda: client.get("/replay").json()["recording"] is None)
    wait_for(lambda: source(server) is None)
    assert client.put("/replay", json={"recording": "take"}).status_code == 200, "and it can be tried again"


def test_a_render_server_that_comes_back_is_told_again(api: RunningApi, client: httpx.Client) -> None:
    wait_for(lambda: client.get("/state").json()["render_server"] == "silent")
    first = Recorder(api.control_port)
    wait_for(lambda: client.get("/state").json()["render_server"] == "answers")
    client.put("/replay", json={"recording": "take"}).raise_for_status()
    shown = source(first)
    first.close()
    wait_for(lambda: client.get("/state").json()["render_server"] == "silent")
    second = Recorder(api.control_port)
    wait_for(lambda: bool(second.payloads("set_source")))
    assert source(second) == shown
    client.delete("/replay").raise_for_status()
    assert source(second) is None
    second.close()


@pytest.mark.parametrize(
    ("body", "status", "expected"),
    [
        ({"recording": "none"}, 404, "no recording 'none'"),
        ({"recording": "bad"}, 422, "bad is not an MCAP"),
        ({"recording": "../take"}, 422, "recording"),
        ({"recording": "take", "rate": 0}, 422, "rate"),
        ({"recording": "take", "position_s": -1}, 422, "position_s"),
        ({"recording": "take", "position_s": 1000}, 422, "s long; start it before that"),
        ({}, 422, "the key `recording` is missing"),
    ],
)
@pytest.mark.usefixtures("server")
def test_wrong_wishes_are_one_sentence(
    client: httpx.Client, body: dict[str, object], status: int, expected: str
) -> None:
    answer = client.put("/replay", json=body)
    assert expected in sentence(answer, status)
    assert not children()


def test_sockets_lie_beside_the_servers_and_other_hosts_are_refused() -> None:
    places = ReplayEndpoints.beside("ipc:///run/deltalight/control")
    assert {places.streams, places.control} == {
        "ipc:///run/deltalight/control-replay",
        "ipc:///run/deltalight/control-replay-control",
    }
    with pytest.raises(ConflictError, match="on another host"):
        ReplayEndpoints.beside("tcp://gpu@192.0.2.7:5603")


def test_the_control_endpoint_refuses_what_it_does_not_know(client: httpx.Client, server: Recorder) -> None:
    client.put("/replay", json={"recording": "take"}).raise_for_status()
    (child,) = children()
    words = child.cmdline()
    control = RequestClient(words[words.index("--control") + 1])

    def error(op: str, **payload: object) -> str:
        request = ControlRequest(node="test", id=f"{time.time_ns()}", op=op, payload=dict(payload))
        return str(control.request(request, 10).error)

    assert "did you mean seek?" in error("sek")
    assert "number as `position_s`" in error("seek")
    assert "number as `rate`" in error("rate", rate=True)
    assert "whole number as `frames`" in error("step", frames=0.5)
    assert "rate of 0.05 to 20" in error("rate", rate=100.0)
    control.close()
    assert source(server) == [words[words.index("--publish") + 1]]
    assert ports.LOOPBACK in words[words.index("--control") + 1]
