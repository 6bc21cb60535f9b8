"""A web process, as it runs, under requests that take long: everybody else gets all answers meanwhile.

Forty senders always have a request under way, until some rounds of all other requests have been answered; each waits
as long as `Retry-After` tells. Nothing depends on how fast this machine is.
"""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import httpx
import pytest

from deltalight.services import ports
from tests.services.api_samples import UPLOAD, sentence
from tests.services.camera_samples import StandInRoom
from tests.services.live_samples import live_socket, read_frame, wait_for_frames
from tests.services.render_server_samples import Recorder
from tests.services.storage_samples import TETRAHEDRON
from tests.services.test_api_process import process

pytestmark = pytest.mark.slow(seconds=10)

SENDERS, ROUNDS = 40, 3
SHOWN, IDLE = "left", "right"  # cameras: one sends pictures, the other none
PERIOD_S = 0.1
NO_PAGE = 503  # there is a page that tells how to build it
YAML = {"Content-Type": "application/yaml"}


@dataclass(frozen=True)
class Busy:
    client: httpx.Client
    address: str
    server: Recorder

    def round(self) -> None:
        """One request of every other kind; each is answered."""
        for path in ("/state", "/scenes", "/rooms", "/health", "/assets", f"/live.jpg?camera={SHOWN}"):
            assert self.client.get(path).status_code == 200, path
        page = self.client.get(f"http://{self.address}/")
        assert page.status_code in (200, NO_PAGE)
        assert page.headers["content-type"].startswith("text/html")
        with live_socket(self.address, f"?camera={SHOWN}") as socket:
            first = read_frame(socket)
            socket.send("")
            assert read_frame(socket)["frame_id"] > first["frame_id"]


@pytest.fixture(scope="module")
def busy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Busy]:
    folder = tmp_path_factory.mktemp("busy")
    port, control, stream = ports.private_ports(3)
    (folder / "deltalight.toml").write_text("[api]\nrequests_per_s = 10000\n")
    words: list[object] = ["api", "--config", folder / "deltalight.toml", "--data", folder, "--port", port]
    words += ["--control", ports.endpoint(control), "--subscribe", ports.endpoint(stream)]
    address = f"{ports.LOOPBACK}:{port}"
    with ExitStack() as stack:
        server = stack.enter_context(closing(Recorder(control)))
        room = stack.enter_context(closing(StandInRoom(stream, PERIOD_S)))
        room.statuses[IDLE] = "silent"
        stack.enter_context(process(*words))
        wait_for_frames(address)
        limits = httpx.Limits(max_connections=SENDERS + 10)
        client = stack.enter_context(
            httpx.Client(base_url=f"http://{address}/api/v1", timeout=120, limits=limits)
        )
        yield Busy(client, address, server)


class Senders:
    """Sends a request `SENDERS` times at once, again and again until it is stopped; keeps the answers."""

    def __init__(self, send: Callable[[], httpx.Response]) -> None:
        self._send = send
        self._stop = threading.Event()
        self.answers: list[httpx.Response] = []
        self._pool = ThreadPoolExecutor(SENDERS)
        self._sending = [self._pool.submit(self._run) for _ in range(SENDERS)]

    def _run(self) -> None:
        while not self._stop.is_set():
            answer = self._send()
            self.answers.append(answer)
            self._stop.wait(float(answer.headers.get("Retry-After", 0)))

    @property
    def refused(self) -> list[httpx.Response]:
        """Those that were told to come again."""
        return [each for each in self.answers if each.status_code == 503]

    def close(self) -> None:
        """Lets each take its last answer."""
        self._stop.set()
        for each in self._sending:
            each.result(180)
        self._pool.shutdown()


@contextmanager
def sending(send: Callable[[], httpx.Response]) -> Iterator[Senders]:
    with closing(Senders(send)) as senders:
        yield senders


def require_told_to_come_again(senders: Senders) -> None:
    for answer in senders.refused:
        assert sentence(answer, 503)
        assert int(answer.headers["Retry-After"]) >= 1


def nested(count: int, form: str) -> str:
    lines = ["a0: &a0 {x: 1}", *(f"a{n}: &a{n} " + form.format(f"*a{n - 1}") for n in range(1, count))]
    return "\n".join(lines)


BOMBS = {
    "merge keys": nested(18, "{{<<: [{0}, {0}]}}"),
    "depth": "a: " + "[" * 3000,
    "500 kB": "values:\n" + "- 1\n" * 125_000,
    "1.9 MB": "values:\n" + "- abcdefghijklmnop\n" * 100_000,
}


WORK: dict[str, tuple[str, str | bytes, dict[str, str]]] = {
    **{f"YAML bombs: {name}": ("/scenes", text, YAML) for name, text in BOMBS.items()},
    "uploads": ("/assets?name=t.obj", TETRAHEDRON, UPLOAD),
}


@pytest.mark.parametrize("kind", WORK)
def test_while_documents_and_uploads_are_checked_all_others_get_answers(busy: Busy, kind: str) -> None:
    path, content, headers = WORK[kind]
    with sending(partial(busy.client.post, path, content=content, headers=headers)) as senders:
        for _ in range(ROUNDS):
            before = len(senders.answers)
            busy.round()
            while len(senders.answers) == before:  # these come to an end as well
                busy.round()
    checked = {answer.status_code for answer in senders.answers if answer not in senders.refused}
    assert checked
    assert checked <= ({200, 201} if kind == "uploads" else {422})
    require_told_to_come_again(senders)


SLOW: dict[str, tuple[str, str, dict[str, Any]]] = {
    "pictures in a view that never comes": ("GET", "/live.jpg?view=rsm", {}),
    "pictures of a camera that sends none": ("GET", f"/live.jpg?camera={IDLE}", {}),
    "picks": ("POST", "/live/pick", {"json": {"x": 0, "y": 0}}),
    "snapshots": ("POST", "/snapshots", {"json": {"pictures": [{"name": "a"}]}}),
}


@pytest.mark.parametrize("kind", SLOW)
def test_while_requests_wait_for_ever_all_others_get_answers(busy: Busy, kind: str) -> None:
    method, path, body = SLOW[kind]
    busy.server.gate.clear()
    try:
        with sending(partial(busy.client.request, method, path, **body)) as senders:
            for _ in range(ROUNDS):
                busy.round()
            while not senders.answers:
                busy.round()
            assert {answer.status_code for answer in senders.answers} == {503}, "the gate is closed"
            busy.server.gate.set()
    finally:
        busy.server.gate.set()
    require_told_to_come_again(senders)
