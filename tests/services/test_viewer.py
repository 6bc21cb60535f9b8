"""The viewer's process: page, live stream with slow and fast clients, buttons, refusals."""

import itertools
import json
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import httpx
import pytest
import websockets
from websockets.sync.client import ClientConnection, connect

from protocol.codecs import encode_color
from protocol.envelope import encode
from protocol.errors import DeltalightError
from protocol.messages import CompositeMessage, ControlRequest, StatsMessage
from protocol.scene import SceneDocument, parse_scene
from protocol.transport import Publisher, ReplyServer
from services import ports
from services.live import LiveHub
from services.viewer import WINDOW
from tests.services.conftest import HEIGHT, ROOT, WIDTH, picture

PERIOD_S = 0.02
ENDED_BY_SIGTERM = 143


class StandInServer:
    """Publishes composites every 20 ms and answers commands, as the render server does."""

    def __init__(self, composite_port: int, control_port: int) -> None:
        self.scene = SceneDocument(name="test room")
        self.sent = 0
        self._stop = threading.Event()
        self._publisher = Publisher(ports.endpoint(composite_port))
        self._replies = ReplyServer(ports.endpoint(control_port), self._carry_out)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._replies.close()
        self._publisher.close()

    def _run(self) -> None:
        jpeg = encode_color(picture(128))
        for number in itertools.count():
            if self._stop.wait(PERIOD_S):
                return
            self._publisher.send(encode(composite(number), [jpeg]))
            if number % 10 == 0:
                stats = StatsMessage(node="server", capture_ns=1, state="running", detail="stand-in renderer")
                self._publisher.send(encode(stats))
            self.sent = number

    def _carry_out(self, request: ControlRequest) -> dict[str, object]:
        document = self.scene.model_dump(mode="json")
        if request.op == "set_view":
            document["output"]["view"] = request.payload["view"]
            self.scene = parse_scene(document)
        elif request.op == "set_scene":
            self.scene = parse_scene({**request.payload["scene"], "revision": request.revision})  # type: ignore[dict-item]
        elif request.op != "get_scene":
            raise DeltalightError(f"no {request.op} here; ask another.")
        return {"scene": self.scene.model_dump(mode="json")}


def composite(number: int) -> CompositeMessage:
    now_ns = time.time_ns()
    return CompositeMessage(
        node="server",
        frame_id=number,
        capture_ns=now_ns - 5_000_000,
        encoding="jpeg",
        shape=(HEIGHT, WIDTH, 3),
        status="ok",
        received_ns=now_ns,
        rendered_ns=now_ns,
        pass_times_ms={"trace cones": 12.5, "compose": 1.0},
        drops={"color.cam": 3},
    )


@pytest.fixture(scope="module")
def stand_in() -> Iterator[tuple[StandInServer, str]]:
    """A stand-in server and the viewer process at `127.0.0.1:port`."""
    composite_port, control_port, page_port = ports.private_ports(3)
    server = StandInServer(composite_port, control_port)
    command = [
        *(sys.executable, "-m", "services.cli", "viewer"),
        *("--subscribe", ports.endpoint(composite_port), "--control", ports.endpoint(control_port)),
        *("--port", str(page_port)),
    ]
    process = subprocess.Popen(command, cwd=ROOT)
    address = f"{ports.LOOPBACK}:{page_port}"
    wait_for_frames(address)
    yield server, address
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=10) == ENDED_BY_SIGTERM
    server.close()


def wait_for_frames(address: str) -> None:
    for _ in range(200):
        with suppress(httpx.TransportError):
            if httpx.get(f"http://{address}/api/v1/health").json()["status"] == "ok":
                return
        time.sleep(0.05)
    pytest.fail("the viewer never showed a frame")


def read_frame(socket: ClientConnection) -> dict[str, object]:
    message = socket.recv(timeout=10)
    assert isinstance(message, bytes)
    (length,) = struct.unpack_from("<I", message)
    assert message[4 + length :][:2] == b"\xff\xd8"
    header = json.loads(message[4 : 4 + length])
    assert isinstance(header, dict)
    return header


def test_page_and_its_files_come_from_the_same_origin(stand_in: tuple[StandInServer, str]) -> None:
    _, address = stand_in
    page = httpx.get(f"http://{address}/")
    assert page.status_code == 200
    for name in ("viewer.js", "viewer.css"):
        assert f"static/{name}" in page.text
        body = httpx.get(f"http://{address}/static/{name}").text
        assert "http://" not in body
        assert "https://" not in body.replace('https:"', "")


def test_frame_header_says_where_time_went(stand_in: tuple[StandInServer, str]) -> None:
    _, address = stand_in
    with connect(f"ws://{address}/api/v1/live") as socket:
        header = read_frame(socket)
    assert header["pass_times_ms"] == {"trace cones": 12.5, "compose": 1.0}
    assert header["drops"] == {"color.cam": 3}
    assert header["status"] == "ok"
    assert isinstance(header["age_ms"], float)
    assert header["age_ms"] >= 5


def test_slow_client_gets_the_newest_frame_and_does_not_delay_a_fast_one(
    stand_in: tuple[StandInServer, str],
) -> None:
    server, address = stand_in
    with connect(f"ws://{address}/api/v1/live") as slow, connect(f"ws://{address}/api/v1/live") as fast:
        first_of_slow = read_frame(slow)
        numbers = []
        for _ in range(40):
            numbers.append(read_frame(fast)["frame_id"])
            fast.send("ack")
        assert numbers == sorted(set(numbers))
        for _ in range(WINDOW - 1):
            read_frame(slow)
        with pytest.raises(TimeoutError):
            slow.recv(timeout=0.3)  # nothing more on the way without an acknowledgement
        before_ack = server.sent
        slow.send("ack")
        assert read_frame(slow)["frame_id"] >= before_ack - 1
        assert first_of_slow["frame_id"] < before_ack


def test_client_that_acknowledges_what_it_never_got_is_closed(stand_in: tuple[StandInServer, str]) -> None:
    _, address = stand_in
    with connect(f"ws://{address}/api/v1/live") as socket:
        for _ in range(WINDOW + 3):
            socket.send("ack")
        with pytest.raises(websockets.ConnectionClosed):
            list(iter(lambda: socket.recv(timeout=5), None))


def test_mjpeg_fallback_streams_pictures(stand_in: tuple[StandInServer, str]) -> None:
    _, address = stand_in
    with httpx.stream("GET", f"http://{address}/stream.mjpg") as response:
        assert response.headers["content-type"].startswith("multipart/x-mixed-replace")
        received = b""
        for chunk in response.iter_bytes():
            received += chunk
            if received.count(b"--frame") >= 3:
                break
    assert received.count(b"\xff\xd8") >= 2


def test_buttons_change_the_scene(stand_in: tuple[StandInServer, str]) -> None:
    server, address = stand_in
    url = f"http://{address}/api/v1/scene/choice"
    assert httpx.get(url).json() == {"name": "test room", "view": "composite", "operator": "exact"}
    assert httpx.put(url, json={"view": "delta"}).json()["view"] == "delta"
    revision = server.scene.revision
    assert httpx.put(url, json={"operator": "paper"}).json()["operator"] == "paper"
    assert server.scene.revision == revision + 1
    assert httpx.put(url, json={"operator": "guess"}).status_code == 422


def test_other_sites_are_refused(stand_in: tuple[StandInServer, str]) -> None:
    _, address = stand_in
    assert httpx.get(f"http://{address}/", headers={"Host": "evil.example"}).status_code == 400
    with pytest.raises(websockets.InvalidStatus):
        connect(f"ws://{address}/api/v1/live", origin=websockets.Origin("http://evil.example")).__enter__()


def test_sigterm_ends_the_viewer_in_spite_of_open_streams() -> None:
    composite_port, control_port, page_port = ports.private_ports(3)
    server = StandInServer(composite_port, control_port)
    endpoints = ("--subscribe", ports.endpoint(composite_port), "--control", ports.endpoint(control_port))
    command = [sys.executable, "-m", "services.cli", "viewer", *endpoints, "--port", str(page_port)]
    process = subprocess.Popen(command, cwd=ROOT)
    address = f"{ports.LOOPBACK}:{page_port}"
    wait_for_frames(address)
    with connect(f"ws://{address}/api/v1/live"), httpx.stream("GET", f"http://{address}/stream.mjpg"):
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=10) == ENDED_BY_SIGTERM
    server.close()
    assert ports.is_free(page_port)


def test_port_in_use_is_a_sentence() -> None:
    taken = ports.listen(ports.private_ports(1)[0])
    taken.listen()
    port = taken.getsockname()[1]
    command = [sys.executable, "-m", "services.cli", "viewer", "--port", str(port)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=30, check=False)
    taken.close()
    assert done.returncode == 2
    assert f"Port {port} is in use" in done.stderr
    assert "Traceback" not in done.stderr


def test_health_before_the_first_frame_says_waiting() -> None:
    assert LiveHub().health()["status"] == "waiting"
