"""Load for a web process: requests at a steady rate, and viewers of the live video."""

import asyncio
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np

REQUEST_TIMEOUT_S = 30.0
WARM_UP_ROUNDS = 5  # a new process imports and caches in its first responses


@dataclass(frozen=True)
class Call:
    """A repeated request; `bodies` in turn."""

    method: str
    path: str
    bodies: Sequence[object] = (None,)


@dataclass
class Times:
    """Seconds from when a request was due to the end of its response, by method; and the failed ones.

    `pictures` counts the status of the changes, as their responses report it.
    """

    seconds: dict[str, list[float]] = field(default_factory=dict)
    failed: int = 0
    pictures: Counter[str] = field(default_factory=Counter)

    def figures(self) -> dict[str, Any]:
        """Returns median and 99th percentile by method, milliseconds."""
        found: dict[str, Any] = {}
        for method, values in sorted(self.seconds.items()):
            p50_s, p99_s = np.percentile(values, (50, 99))
            found[method] = {
                "requests": len(values),
                "p50_ms": 1e3 * float(p50_s),
                "p99_ms": 1e3 * float(p99_s),
            }
        return {**found, "failed": self.failed, "pictures": dict(self.pictures)}


async def send_paced(address: str, calls: Sequence[Call], per_s: float, seconds: float) -> Times:
    """Sends `calls` in turn, `per_s` a second, whether or not earlier ones were answered.

    Times count from when a request was due, so that one that had to wait for its turn does not count as fast.
    """
    times = Times()
    limits = httpx.Limits(max_connections=100)
    async with httpx.AsyncClient(base_url=address, timeout=REQUEST_TIMEOUT_S, limits=limits) as client:
        for call in WARM_UP_ROUNDS * list(calls):
            await _send(client, call, 0, 0.0, Times())
        began_s, under_way = time.perf_counter(), []
        for number in range(max(1, round(per_s * seconds))):
            due_s = began_s + number / per_s
            await asyncio.sleep(max(0.0, due_s - time.perf_counter()))
            call, turn = calls[number % len(calls)], number // len(calls)
            under_way.append(asyncio.create_task(_send(client, call, turn, due_s, times)))
        await asyncio.gather(*under_way)
    return times


async def _send(client: httpx.AsyncClient, call: Call, turn: int, due_s: float, times: Times) -> None:
    body = call.bodies[turn % len(call.bodies)]
    try:
        answer = await client.request(call.method, call.path, json=body)
    except httpx.TransportError:
        times.failed += 1
        return
    if answer.is_error:
        times.failed += 1
        return
    times.seconds.setdefault(call.method, []).append(time.perf_counter() - due_s)
    if call.method == "PATCH":
        times.pictures[answer.json()["picture"]["state"]] += 1


async def watch(address: str, viewers: int, frames_per_s: float, seconds: float) -> list[int]:
    """Watches with many viewers, each at most at this rate; returns how many frames each got."""
    ends_s = time.perf_counter() + seconds
    return list(await asyncio.gather(*(_view(address, 1 / frames_per_s, ends_s) for _ in range(viewers))))


async def _view(address: str, period_s: float, ends_s: float) -> int:
    """Runs one viewer: it acknowledges a frame when the next is due, like a slow browser."""
    from websockets.asyncio.client import connect

    frames = 0
    async with connect(f"ws{address.removeprefix('http')}/live", max_size=None, compression=None) as socket:
        while (left_s := ends_s - time.perf_counter()) > 0:
            came_s = time.perf_counter()
            try:
                await asyncio.wait_for(socket.recv(), left_s)
            except TimeoutError:
                break
            frames += 1
            await asyncio.sleep(max(0.0, came_s + period_s - time.perf_counter()))
            await socket.send("ack")
    return frames
