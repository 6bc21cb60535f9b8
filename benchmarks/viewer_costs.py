"""What strangers cost a station in processor time: viewers that join and leave, and messages that are refused.

`python -m deltalight.benchmarks.viewer_costs` starts a web process of its own, publishes composites to it, and joins
it as viewers do; it needs Linux, because /proc tells the time. Costs are those of the web process, or of the
receiving side of a message, beyond what the same time without them costs.
"""

import asyncio
import itertools
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from random import Random
from statistics import mean, median
from tempfile import TemporaryDirectory
from typing import Any

import httpx
from websockets.asyncio.client import connect

from deltalight.benchmarks.soak.nonsense import known_messages, mutated
from deltalight.protocol.codecs import encode_color
from deltalight.protocol.envelope import decode, encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import CompositeMessage
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.services import ports
from deltalight.services.demo import RECORDING

PICTURES_PER_S = 10.0
JOINS, ROUNDS = 50, 5
NONSENSE = 5000
START_TIMEOUT_S = 60.0
REQUESTS_PER_S = 10_000  # all viewers are one client here


def main() -> None:
    """Measures and prints."""
    with _web_process() as (process_id, address):
        for codec in ("jpeg", "h264"):
            join = partial(_joined, f"{address}?codec={codec}")
            costs = [round(_cost_ms(process_id, join), 2) for _ in range(ROUNDS)]
            print(json.dumps({"join": codec, "ms_each": median(costs), "rounds": costs}), flush=True)
    print(json.dumps(_refusals(Random(7))))


def _cost_ms(process_id: int, load: Callable[[], Coroutine[Any, Any, None]]) -> float:
    """Returns the processor time of a process for one of `JOINS` loads, beyond its own."""
    began_s, before_s = time.monotonic(), _processor_s(process_id)
    time.sleep(2.0)
    idle = (_processor_s(process_id) - before_s) / (time.monotonic() - began_s)
    began_s, before_s = time.monotonic(), _processor_s(process_id)
    asyncio.run(load())
    spent_s = _processor_s(process_id) - before_s - idle * (time.monotonic() - began_s)
    return 1e3 * spent_s / JOINS


async def _joined(address: str) -> None:
    for _ in range(JOINS):
        async with connect(address, max_size=None, compression=None) as socket:
            await socket.recv()


def _processor_s(process_id: int) -> float:
    """Returns what a process has computed, nanoseconds of all its threads as the scheduler counts them."""
    spent = 0
    for task in Path(f"/proc/{process_id}/task").iterdir():
        with suppress(OSError):  # it has just ended
            spent += int((task / "schedstat").read_text().split()[0])
    return spent / 1e9


@contextmanager
def _web_process() -> Iterator[tuple[int, str]]:
    """Runs a web process that composites come to; yields its id and the address of its live pictures."""
    port, control, stream = ports.private_ports(3)
    with TemporaryDirectory() as folder, _published(stream):
        settings = Path(folder) / "deltalight.toml"
        settings.write_text(f"[api]\nrequests_per_s = {REQUESTS_PER_S}\n")
        options = {"--port": port, "--data": folder, "--config": settings}
        options |= {"--control": ports.endpoint(control), "--subscribe": ports.endpoint(stream)}
        words = [str(word) for pair in options.items() for word in pair]
        command = [sys.executable, "-m", "deltalight.services.cli", "--log-level", "error", "api", *words]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
            try:
                _await_picture(f"http://{ports.LOOPBACK}:{port}/api/v1/live.jpg")
                yield process.pid, f"ws://{ports.LOOPBACK}:{port}/api/v1/live"
            finally:
                process.terminate()


def _await_picture(address: str) -> None:
    ends_s = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < ends_s:
        with suppress(httpx.TransportError):
            if httpx.get(address).is_success:
                return
        time.sleep(0.1)
    raise DeltalightError("The web process shows no picture; start it by hand and read its log.")


@contextmanager
def _published(port: int) -> Iterator[None]:
    """Publishes the pictures of the demo as composites."""
    publisher, ended = Publisher(ports.endpoint(port)), threading.Event()
    frames = [
        (frame.camera, encode_color(frame.color))
        for frame in itertools.islice(RecordingReader(RECORDING), 20)
    ]

    def publish() -> None:
        for number, (camera, jpeg) in enumerate(itertools.cycle(frames), start=1):
            if ended.wait(1 / PICTURES_PER_S):
                return
            now_ns = time.time_ns()
            message = CompositeMessage(
                node="render-server",
                frame_id=number,
                capture_ns=now_ns,
                encoding="jpeg",
                shape=(camera.height, camera.width, 3),
                status="no_pose",
                camera=camera.to_dict(),
                received_ns=now_ns,
                rendered_ns=now_ns,
                pass_times_ms={},
                drops={},
                lights=(),
            )
            publisher.send(encode(message, [jpeg]))

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        publisher.close()


def _refusals(dice: Random) -> dict[str, object]:
    """Returns what it costs to find that a message is nonsense, microseconds of processor time."""
    known, refused_us = known_messages(), []
    for message in [mutated(dice, dice.choice(known)) for _ in range(NONSENSE)]:
        began_ns = time.thread_time_ns()
        try:
            decode(message)
        except DeltalightError as fault:
            str(fault)
            refused_us.append((time.thread_time_ns() - began_ns) / 1e3)
    return {
        "refused": len(refused_us),
        "of": NONSENSE,
        "us_median": round(median(refused_us), 1),
        "us_mean": round(mean(refused_us), 1),
        "us_most": round(max(refused_us)),
    }


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
