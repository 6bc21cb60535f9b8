"""A stand-in for the render server of a room with several cameras."""

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np

from deltalight.protocol.codecs import decode_color, encode_color
from deltalight.protocol.envelope import encode
from deltalight.protocol.messages import CameraEntry, CamerasMessage, CameraStatus
from deltalight.protocol.publisher import Publisher
from deltalight.services import ports
from tests.services.api_samples import RenderServer, running_api
from tests.services.conftest import HEIGHT, WIDTH
from tests.services.live_samples import composite, report, wait_for_frames

SHADES = {"left": 60, "right": 180}
PERIOD_S = 0.1


def cameras_message(statuses: Mapping[str, CameraStatus], number: int = 1) -> CamerasMessage:
    """What a render server says of the cameras of its room."""
    entries = tuple(
        CameraEntry(node=name, status=status, frame_id=number, capture_ns=0, received_ns=0)
        for name, status in statuses.items()
    )
    return CamerasMessage(node="render-server", capture_ns=time.time_ns(), cameras=entries)


class StandInRoom:
    """Publishes a picture of each camera that is live, every `period_s`, and which cameras there are."""

    def __init__(self, port: int, period_s: float) -> None:
        self._period_s = period_s
        self.statuses: dict[str, CameraStatus] = dict.fromkeys(SHADES, "live")
        self._publisher = Publisher(ports.endpoint(port))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._publisher.close()

    def _run(self) -> None:
        number = 0
        pictures = {
            name: encode_color(np.full((HEIGHT, WIDTH, 3), shade, np.uint8)) for name, shade in SHADES.items()
        }
        while not self._stop.wait(self._period_s):
            number += 1
            statuses = dict(self.statuses)
            self._publisher.send(encode(cameras_message(statuses, number)))
            self._publisher.send(encode(report("render-server", "stand-in renderer")))
            if len(statuses) == 1:
                self._publisher.send(encode(composite(number), [pictures[next(iter(statuses))]]))
                continue
            for name in (name for name, status in statuses.items() if status == "live"):
                message = composite(number).model_copy(update={"node": name})
                self._publisher.send(encode(message, [pictures[name]]))


@dataclass(frozen=True)
class CameraApi:
    """An API of a room with two cameras; `address` is host:port."""

    client: httpx.Client
    room: StandInRoom
    server: RenderServer
    address: str

    def shade(self, **query: str) -> int:
        """The grey of `/live.jpg`."""
        answer = self.client.get("/live.jpg", params=query)
        assert answer.status_code == 200, answer.text
        return grey(answer.content)


def grey(jpeg: bytes) -> int:
    """The mean of a picture."""
    return round(float(decode_color(memoryview(jpeg), "jpeg", (HEIGHT, WIDTH, 3)).mean()))


@contextmanager
def camera_api(folder: Path, period_s: float = PERIOD_S, **settings: object) -> Iterator[CameraApi]:
    control_port, stream_port = ports.private_ports(2)
    room, server = StandInRoom(stream_port, period_s), RenderServer(control_port)
    endpoints = {"control": ports.endpoint(control_port), "subscribe": [ports.endpoint(stream_port)]}
    try:
        with running_api(folder, **endpoints, **settings) as api:
            address = f"{ports.LOOPBACK}:{api.client.base_url.port}"
            wait_for_frames(address)
            yield CameraApi(api.client, room, server, address)
    finally:
        room.close()
        server.close()
