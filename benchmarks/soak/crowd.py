"""Viewers of a soaked station: one that measures how pictures flow, and others that behave badly."""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from random import Random
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import UInt8
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from deltalight.benchmarks.soak.link import LoopThread
from deltalight.services.live_message import LiveHeader, unpack

KEPT_PICTURES = 200_000  # 55 minutes of four cameras at 15 a second each; the oldest go first
AGAIN_AFTER_S = 0.05
SLOW_S = 1.0
LONGEST_VISIT_S = 3.0


@dataclass(frozen=True)
class Seen:
    """A camera's picture as it came: seconds of the monotonic clock, its age and how much of it was waiting, ms."""

    at_s: float
    capture_ns: int
    age_ms: float
    waiting_ms: float
    camera: str = ""


@dataclass(frozen=True)
class Flow:
    """Pictures that the measuring viewers got in a span: a second, ages in ms, and the longest wait for one in s.

    `frames_per_s` is of all cameras together, `longest_gap_s` that of the camera which waited longest.
    """

    frames_per_s: float
    camera_frames_per_s: dict[str, float]
    age_p50_ms: float | None
    age_p95_ms: float | None
    unwaited_p95_ms: float | None = field(metadata={"what": "of the ages without waiting for the renderer"})
    longest_gap_s: float

    @classmethod
    def of(
        cls, seen: Sequence[Seen], began_s: float, ended_s: float, cameras: Sequence[str] = ("",)
    ) -> "Flow":
        """Describes pictures of some cameras that came between two moments."""
        came_s = {name: [each.at_s for each in seen if each.camera == name] for name in cameras}
        gaps_s = [np.max(np.diff([began_s, *own, ended_s])) for own in came_s.values()]
        ages = [each.age_ms for each in seen]
        unwaited = [each.age_ms - each.waiting_ms for each in seen]
        return cls(
            len(seen) / (ended_s - began_s),
            {name: len(own) / (ended_s - began_s) for name, own in came_s.items() if name},
            _percentile(ages, 50),
            _percentile(ages, 95),
            _percentile(unwaited, 95),
            float(max(gaps_s)),
        )


class Crowd:
    """Viewers in an event loop of their own; one of each camera measures, and connects again when it must.

    They look at the only room of the web process at `port`, or at its `room` of that name.
    """

    def __init__(
        self, thread: LoopThread, port: int, cameras: Sequence[str], room: str | None = None
    ) -> None:
        self.cameras = cameras
        self.seen: deque[Seen] = deque(maxlen=KEPT_PICTURES)
        self._thread = thread
        place = "" if room is None else f"/rooms/{room}"
        self._address = f"ws://127.0.0.1:{port}/api/v1{place}/live"
        self._newest: dict[str, tuple[LiveHeader, bytes]] = {}
        self._lock = threading.Lock()
        for camera in cameras:
            thread.start(self._measure(camera))

    def pictures(self) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
        """Returns the pixels of each camera's newest picture; a camera that has sent none is missing."""
        with self._lock:
            newest = {name: jpeg for name, (_, jpeg) in self._newest.items()}
        pixels = {name: cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1) for name, jpeg in newest.items()}
        return {name: each.astype(np.uint8) for name, each in pixels.items() if each is not None}

    def between(self, began_s: float, ended_s: float) -> list[Seen]:
        """Returns the pictures that came in a span of the monotonic clock."""
        with self._lock:
            return [each for each in self.seen if began_s <= each.at_s < ended_s]

    def flow(self, began_s: float, ended_s: float) -> Flow:
        """Describes the pictures that came in a span of the monotonic clock."""
        return Flow.of(self.between(began_s, ended_s), began_s, ended_s, self.cameras)

    def join(self, behaviour: str) -> Callable[[], None]:
        """Adds a viewer of BEHAVIOURS; returns what makes it leave."""
        task = self._thread.start(_visit(self._address, BEHAVIOURS[behaviour]))
        return lambda: self._thread.cancel(task)

    def come_and_go(self, viewers: int, seed: int) -> Callable[[], None]:
        """Has so many viewers at a time join and leave at random; returns what makes all leave."""
        dice = Random(seed)
        visits = [self._thread.start(_visits(self._address, Random(dice.random()))) for _ in range(viewers)]

        def leave() -> None:
            for task in visits:
                self._thread.cancel(task)

        return leave

    async def _measure(self, camera: str) -> None:
        address = f"{self._address}?camera={camera}"  # refused until the render server has named it
        while True:
            with suppress(OSError, WebSocketException, TimeoutError):
                async with connect(address, max_size=None, compression=None) as socket:
                    while True:
                        self._note(camera, await socket.recv())
                        await socket.send("ack")
            await asyncio.sleep(AGAIN_AFTER_S)

    def _note(self, camera: str, message: str | bytes) -> None:
        assert isinstance(message, bytes)
        header, jpeg = unpack(message)
        is_own = header.node == camera or (header.node is None and len(self.cameras) == 1)
        if header.status != "ok" or not is_own:
            return  # of a stranger, whom nothing tells where it is, or of another camera while its own is missing
        age_ms = (time.time_ns() - header.capture_ns) / 1e6  # one host, one clock
        waiting_ms = max(0.0, header.render_ms - sum(header.pass_times_ms.values()))
        with self._lock:
            self._newest[camera] = header, jpeg
            self.seen.append(Seen(time.monotonic(), header.capture_ns, age_ms, waiting_ms, camera))


Behaviour = Callable[[ClientConnection], Coroutine[Any, Any, None]]


async def _slow(socket: ClientConnection) -> None:
    while True:
        await socket.recv()
        await asyncio.sleep(SLOW_S)
        await socket.send("ack")


async def _never_acknowledging(socket: ClientConnection) -> None:
    while True:
        await socket.recv()


async def _silent(_socket: ClientConnection) -> None:
    await asyncio.Event().wait()


BEHAVIOURS: Final[dict[str, Behaviour]] = {
    "slow": _slow,
    "never acknowledging": _never_acknowledging,
    "silent": _silent,
}


async def _visit(address: str, behaviour: Behaviour) -> None:
    with suppress(OSError, WebSocketException, TimeoutError):
        async with connect(address, max_size=None, compression=None) as socket:
            await behaviour(socket)


async def _visits(address: str, dice: Random) -> None:
    while True:
        stay_s = dice.uniform(0, LONGEST_VISIT_S)
        with suppress(TimeoutError):
            await asyncio.wait_for(_visit(address, _quick), stay_s)
        await asyncio.sleep(dice.uniform(0, 1))


async def _quick(socket: ClientConnection) -> None:
    while True:
        await socket.recv()
        await socket.send("ack")


def _percentile(values: Sequence[float], percent: float) -> float | None:
    return float(np.percentile(values, percent)) if values else None
