"""A stand-in for a render server that publishes a moving picture, and a web process that shows it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.codecs import decode_color, encode_color
from deltalight.protocol.envelope import encode
from deltalight.protocol.publisher import Publisher
from deltalight.services import ports
from deltalight.services.live_message import LiveHeader
from tests.services.api_samples import RenderServer, RunningApi, running_api
from tests.services.live_samples import composite, wait_for_frames

Picture = UInt8[np.ndarray, "h w 3"]
WIDTH, HEIGHT = 160, 120
PERIOD_S = 0.04


class MovingStream:
    """Publishes a moving picture of smooth shapes and some texture; none while it `is_paused`."""

    def __init__(self, port: int, width: int = WIDTH, height: int = HEIGHT) -> None:
        self.size, self.is_paused, self.is_still = (width, height), False, False
        self.jpegs: dict[int, bytes] = {}  # by frame id
        self._publisher = Publisher(ports.endpoint(port))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._publisher.close()

    def _run(self) -> None:
        number, phase = 0, 0
        while not self._stop.wait(PERIOD_S):
            if self.is_paused:
                continue
            number, phase = number + 1, phase + (not self.is_still)
            width, height = self.size
            self.jpegs[number] = encode_color(picture(width, height, phase))
            camera = composite(1).camera | {"width": width, "height": height}
            message = composite(number).model_copy(
                update={"shape": (height, width, 3), "camera": camera, "reused_pass_times_ms": {}}
            )
            self._publisher.send(encode(message, [self.jpegs[number]]))


def picture(width: int, height: int, phase: int) -> Picture:
    """Coloured shapes with soft edges that move by two pixels a phase."""
    rows, columns = np.mgrid[:height, :width]
    waves = [np.sin((columns + 2 * phase) / 17.0), np.cos(rows / 13.0), np.sin((rows + columns) / 23.0)]
    return np.stack([127 + 100 * wave for wave in waves], axis=-1).astype(np.uint8)


def psnr_db(one: Picture, other: Picture) -> float:
    return float(10 * np.log10(255**2 / max(1e-6, np.mean((one.astype(float) - other) ** 2))))


@dataclass(frozen=True)
class Running:
    """A web process over a moving stream; `address` is host:port."""

    address: str
    stream: MovingStream
    api: RunningApi

    def agrees(self, header: LiveHeader, seen: Picture | None) -> float:
        """PSNR of a picture from the JPEG of its frame, dB."""
        assert seen is not None
        return self._agreement_db(header.frame_id, seen)

    def closest(self, seen: Picture, after: int | None = None) -> tuple[float, int]:
        """PSNR from the JPEG that agrees most, dB, and its frame's id: of the newest 50, or of all after a frame."""
        sent = sorted(self.stream.jpegs)
        chosen = sent[-50:] if after is None else [frame_id for frame_id in sent if frame_id > after]
        return max((self._agreement_db(frame_id, seen), frame_id) for frame_id in chosen)

    def _agreement_db(self, frame_id: int, seen: Picture) -> float:
        jpeg = memoryview(self.stream.jpegs[frame_id])
        return psnr_db(seen, decode_color(jpeg, "jpeg", seen.shape))


@contextmanager
def moving_api(folder: Path, **settings: object) -> Iterator[Running]:
    control, published = ports.private_ports(2)
    stream, server = MovingStream(published), RenderServer(control)
    endpoints = {"control": ports.endpoint(control), "subscribe": [ports.endpoint(published)]}
    try:
        with running_api(folder, **endpoints, **settings) as api:
            address = f"{ports.LOOPBACK}:{api.client.base_url.port}"
            wait_for_frames(address)
            yield Running(address, stream, api)
    finally:
        stream.close()
        server.close()
