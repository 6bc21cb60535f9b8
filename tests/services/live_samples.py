"""A stand-in for node and render server that publishes composites, reports and fish-eye light; clients for them."""

import itertools
import json
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict, Unpack, get_args

import httpx
import numpy as np
import pytest
from websockets import Origin
from websockets.sync.client import ClientConnection, connect

from deltalight.protocol.codecs import encode_color
from deltalight.protocol.envelope import encode
from deltalight.protocol.messages import CompositeMessage, OtherPicture, StatsMessage
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.scene_fields import ShownView
from deltalight.services import ports
from tests.services.api_samples import RenderServer, RunningApi, running_api
from tests.services.conftest import HEIGHT, IDENTITY, WIDTH, camera

PERIOD_S = 0.1  # each picture takes 1 ms of its processor, and of that of each process that hears it
PATIENCE_S = 60.0  # on a busy machine
AGE_S = 0.005
NOISE = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
LIGHT: dict[str, object] = {
    "type": "sphere",
    "position_m": [0.0, 0.0, 2.0],
    "intensity": [2.0, 1.0, 1.0],
    "radius_m": 0.1,
}
AROUND: dict[str, object] = {"type": "environment", "mean_radiance": [0.1, 0.1, 0.1]}


class StandInStream:
    """Publishes a composite every `period_s`, each second time a report too; `scene`: id and revision of what it has.

    While `is_busy` it does neither, as a renderer that is at work on a slow frame; a camera that sends `camera_fps`
    frames a second reports meanwhile. `ages_s` are the times since the composites' capture, in turn. `watched`
    returns the views that are wanted beside the picture: `shade` tells them apart.
    """

    def __init__(self, port: int, period_s: float = PERIOD_S, picture: np.ndarray = NOISE) -> None:
        self.sent, self._period_s = 0, period_s
        self.scene: tuple[str | None, int | None] = (None, None)
        self.is_busy = False
        self.camera_fps: float | None = None
        self.ages_s: tuple[float, ...] = (AGE_S,)
        self.watched: Callable[[], Sequence[ShownView]] = tuple
        self._picture = picture
        self._stop = threading.Event()
        self.publisher = Publisher(ports.endpoint(port))
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.publisher.close()

    def _run(self) -> None:
        shape, jpeg = self._picture.shape, encode_color(self._picture)
        sent = {"shape": shape, "camera": camera().resized(shape[1], shape[0]).to_dict()}
        for number in itertools.count(1):
            if self._stop.wait(self._period_s):
                return
            if number % 2 == 0 and self.camera_fps is not None:
                self.publisher.send(encode(report("camera", rates={"fps": self.camera_fps})))
            if self.is_busy:
                continue
            age_s = self.ages_s[number % len(self.ages_s)]
            others = tuple(OtherPicture(view=view) for view in self.watched())
            message = composite(number, *self.scene, age_s=age_s).model_copy(
                update={"others": others, **sent}
            )
            pictures = [encode_color(np.full(shape, shade(each.view), np.uint8)) for each in others]
            self.publisher.send(encode(message, [jpeg, *pictures]))
            if number % 2 == 0:
                self.publisher.send(encode(report("render-server", "stand-in renderer")))
            self.sent = number


def shade(view: ShownView) -> int:
    """The grey of the stand-in's picture in a view."""
    return 30 * (1 + get_args(ShownView).index(view))


def composite(
    number: int, scene_id: str | None = None, revision: int | None = None, age_s: float = AGE_S
) -> CompositeMessage:
    now_ns = time.time_ns()
    return CompositeMessage(
        node="render-server",
        frame_id=number,
        capture_ns=now_ns - round(age_s * 1e9),
        encoding="jpeg",
        shape=(HEIGHT, WIDTH, 3),
        status="ok",
        scene_id=scene_id,
        scene_revision=revision,
        camera=camera().to_dict(),
        world_from_camera=IDENTITY,
        received_ns=now_ns - 2_000_000,
        rendered_ns=now_ns,
        pass_times_ms={"trace cones": 12.5, "compose": 1.0},
        reused_pass_times_ms={"shadow maps": 3.0},
        drops={"color.cam": 3},
        lights=(LIGHT, AROUND),
    )


def report(node: str, detail: str = "", **more: object) -> StatsMessage:
    return StatsMessage(node=node, capture_ns=time.time_ns(), state="running", detail=detail, **more)  # type: ignore[arg-type]


@dataclass(frozen=True)
class LiveApi:
    """An API whose composites come from `stream`; `address` is host:port."""

    api: RunningApi
    stream: StandInStream
    server: RenderServer
    control_port: int
    address: str

    @property
    def client(self) -> httpx.Client:
        return self.api.client


@contextmanager
def live_api(
    folder: Path, *, period_s: float = PERIOD_S, picture: np.ndarray = NOISE, **settings: object
) -> Iterator[LiveApi]:
    control_port, stream_port = ports.private_ports(2)
    endpoints = {"control": ports.endpoint(control_port), "subscribe": [ports.endpoint(stream_port)]}
    stream, server = StandInStream(stream_port, period_s, picture), RenderServer(control_port)
    stream.watched = lambda: server.session.watched
    try:
        with running_api(folder, **endpoints, **settings) as api:
            address = f"{ports.LOOPBACK}:{api.client.base_url.port}"
            wait_for_frames(address)
            yield LiveApi(api, stream, server, control_port, address)
    finally:
        stream.close()
        server.close()


def wait_for_frames(address: str, patience_s: float = PATIENCE_S) -> None:
    deadline_s = time.monotonic() + patience_s
    # One client for all requests: each made anew takes 40 ms of processor time.
    with httpx.Client(base_url=f"http://{address}/api/v1", timeout=patience_s) as client:
        while time.monotonic() < deadline_s:
            with suppress(httpx.TransportError, KeyError):
                if client.get("/health").json()["stream"]["status"] == "ok":
                    return
            time.sleep(0.05)
    pytest.fail("no frame ever came")


class SocketOptions(TypedDict, total=False):
    origin: Origin
    additional_headers: Mapping[str, str]


def live_socket(address: str, query: str = "", **options: Unpack[SocketOptions]) -> ClientConnection:
    url = f"ws://{address}/api/v1/live{query}"
    return connect(url, compression=None, open_timeout=PATIENCE_S, **options)


def event_socket(address: str, query: str = "", **options: Unpack[SocketOptions]) -> ClientConnection:
    return connect(f"ws://{address}/api/v1/events{query}", open_timeout=PATIENCE_S, **options)


def read_frame(socket: ClientConnection, timeout_s: float = PATIENCE_S) -> dict[str, Any]:
    """The header of the next frame, whose picture is checked to be a JPEG."""
    message = socket.recv(timeout=timeout_s)
    assert isinstance(message, bytes)
    (length,) = struct.unpack_from("<I", message)
    assert message[4 + length :][:2] == b"\xff\xd8"
    header = json.loads(message[4 : 4 + length])
    assert isinstance(header, dict)
    return header


def next_event(socket: ClientConnection, *types: str, timeout_s: float = PATIENCE_S) -> dict[str, Any]:
    """The next event of one of these types."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        event = json.loads(socket.recv(timeout=max(deadline_s - time.monotonic(), 0)))
        if event["type"] in types:
            assert isinstance(event, dict)
            return event
