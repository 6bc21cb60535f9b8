"""A bad network between a node and the render server: a proxy of one TCP connection at a time or more, on loopback.

TCP keeps the order and loses nothing, so what a network loses or reorders shows as a wait of all that is behind it.
Nothing here needs rights beyond the user's, nor anything of the kernel.
"""

import asyncio
import random
import socket
import threading
import time
from collections.abc import Coroutine
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Self

from deltalight.services.coroutines import run_until_first_ends
from deltalight.services.ports import LOOPBACK

SEGMENT_BYTES = 1448  # of TCP over Ethernet
CHUNK_BYTES = 16 * SEGMENT_BYTES
WAITING_CHUNKS = 4  # 64 segments, what is under way of a usual connection; then the sender has to wait
RECEIVED_BYTES = 1 << 16  # that the kernel keeps for a link
RETRANSMISSION_S = 0.2  # the least timeout of Linux; it doubles (RFC 6298, section 5)
MOST_LOSSES = 8  # of one segment: the dice would allow more once in 15 000


@dataclass(frozen=True)
class Shape:
    """What a link does to data: bits a second, seconds of delay and its jitter, fraction of segments that are lost.

    `overtaken` is the fraction of segments that take a way of twice the delay, so that later ones overtake them.
    """

    bits_per_s: float
    delay_s: float
    jitter_s: float
    loss: float
    overtaken: float = 0.0


SHAPES = {  # the networks that the documentation of others names
    "arm": Shape(25e6, 0.020, 0.010, 0.005),
    "foxglove": Shape(100e6, 0.080, 0.020, 0.02),
    "lossy": Shape(25e6, 0.020, 0.010, 0.30),
    "reorder": Shape(25e6, 0.020, 0.010, 0.0, overtaken=0.25),
}


@dataclass
class Schedule:
    """When what enters a link leaves it; times are seconds of one clock, in the order of the calls."""

    dice: random.Random
    _free_s: float = 0.0
    _left_s: float = 0.0

    def leaves_s(self, now_s: float, size: int, shape: Shape | None) -> float:
        """Returns when `size` bytes that enter now have left.

        A lost segment holds up all that is behind it: it is sent again once that is noticed, after a round trip; if
        it is lost once more, after a timeout, which doubles each time. An overtaken one holds up for its longer way.
        """
        if shape is None:
            self._free_s = self._left_s = max(now_s, self._left_s)
            return self._left_s
        segments = -(-size // SEGMENT_BYTES)
        losses = max(self._losses(shape.loss) for _ in range(segments))
        self._free_s = max(now_s, self._free_s) + 8 * size / shape.bits_per_s + held_up_s(losses, shape)
        is_overtaken = any(self.dice.random() < shape.overtaken for _ in range(segments))
        way_s = shape.delay_s * (2 if is_overtaken else 1) + self.dice.uniform(
            -shape.jitter_s, shape.jitter_s
        )
        self._left_s = max(self._left_s, self._free_s + way_s)
        return self._left_s

    def _losses(self, probability: float) -> int:
        """Returns how often a segment is lost before it arrives."""
        return next((count for count in range(MOST_LOSSES) if self.dice.random() >= probability), MOST_LOSSES)


def held_up_s(losses: int, shape: Shape) -> float:
    """Returns how long a segment that was lost so often holds up those behind it."""
    if losses == 0:
        return 0.0
    round_trip_s = 2 * shape.delay_s
    return round_trip_s + max(RETRANSMISSION_S, round_trip_s) * (2.0 ** (losses - 1) - 1)


class Link:
    """Forwards connections to `port` from a port of its own to `node_port`; `shape` None forwards at once."""

    def __init__(self, port: int, node_port: int, seed: int) -> None:
        self.port = port
        self.shape: Shape | None = None
        self._node_port = node_port
        self._dice = random.Random(seed)
        self._uncut = asyncio.Event()
        self._uncut.set()
        self._loop: asyncio.AbstractEventLoop | None = None

    def cut(self, is_cut: bool) -> None:
        """Lets nothing through, as a cable that is drawn, or everything again (any thread)."""
        change = self._uncut.clear if is_cut else self._uncut.set
        if self._loop is not None:
            self._loop.call_soon_threadsafe(change)

    async def serve(self) -> None:
        """Forwards until cancelled."""
        self._loop = asyncio.get_running_loop()
        server = await asyncio.start_server(self._forward, LOOPBACK, self.port)
        async with server:
            await server.serve_forever()

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            with suppress(OSError):  # the node is not there; ZeroMQ connects again
                from_node, to_node = await self._connect()
                try:
                    await run_until_first_ends(self._carry(from_node, writer), self._carry(reader, to_node))
                finally:
                    to_node.close()
        finally:
            writer.close()

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Connects to the node with a small buffer here: what waits in the kernel would add to the link's delay."""
        end = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVED_BYTES)
        try:
            await asyncio.get_running_loop().sock_connect(end, (LOOPBACK, self._node_port))
        except OSError:
            end.close()
            raise
        return await asyncio.open_connection(sock=end)

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        waiting: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(WAITING_CHUNKS)
        await run_until_first_ends(self._take(reader, waiting), self._give(waiting, writer))

    async def _take(self, reader: asyncio.StreamReader, waiting: asyncio.Queue[tuple[float, bytes]]) -> None:
        schedule = Schedule(self._dice)
        while chunk := await reader.read(CHUNK_BYTES):
            await waiting.put((schedule.leaves_s(time.monotonic(), len(chunk), self.shape), chunk))

    async def _give(self, waiting: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter) -> None:
        while True:
            leaves_s, chunk = await waiting.get()
            if (wait_s := leaves_s - time.monotonic()) > 0:
                await asyncio.sleep(wait_s)
            await self._uncut.wait()
            writer.write(chunk)
            await writer.drain()


class LoopThread:
    """An event loop in a thread of its own; what still runs in it ends with the block."""

    def __init__(self, name: str) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever, name=name, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_fault: object) -> None:
        asyncio.run_coroutine_threadsafe(_end_others(), self.loop).result(10.0)
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()

    def start(self, work: Coroutine[Any, Any, None]) -> "asyncio.Task[None]":
        """Starts a coroutine in the loop (any thread)."""

        async def started() -> "asyncio.Task[None]":
            return asyncio.create_task(work)

        return asyncio.run_coroutine_threadsafe(started(), self.loop).result(10.0)

    def cancel(self, task: "asyncio.Task[None]") -> None:
        """Cancels what `start` returned (any thread)."""
        self.loop.call_soon_threadsafe(task.cancel)


async def _end_others() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)
