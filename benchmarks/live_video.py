"""Bandwidth, delay and processor time of live pictures: JPEG, H.264, and WHEP, for one viewer and for twenty.

python -m deltalight.benchmarks.live_video

The demo's recording is relit once (a minute in software); its pictures then go to a web process of their own at the
recording's rate, and from there to viewers on loopback, each by `WS /live` or `POST /whep`.
"""

import argparse
import asyncio
import itertools
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import cast

import cv2
import httpx
import numpy as np
from jaxtyping import Float64, UInt8
from rich.console import Console
from rich.progress import track
from rich.table import Table

import deltalight as dl
from deltalight.benchmarks.rest_usage import WEB, sample
from deltalight.protocol.codecs import decode_color, encode_color
from deltalight.protocol.envelope import encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import CompositeMessage
from deltalight.protocol.publisher import Publisher
from deltalight.services import ports
from deltalight.services.demo import RECORDING
from deltalight.services.h264 import H264Decoder, rgb_picture
from deltalight.services.live_message import LiveHeader, Row, unpack

SIZES = ((640, 480), (320, 240))
MOTIONS = ("moving", "still", "paused")
WAYS = ("jpeg", "h264", "whep")
CROWDS = (1, 20)
LONG_START_CODE = b"\0\0\0\1"
RATE_PER_S = 15.0  # of the demo's recording
NOISE_CODES = 1.5  # of a still camera's pictures, r.m.s.; those of a paused replay are equal
SETTLING_S = 2.0  # before each measurement, for keys and refinement
START_TIMEOUT_S = 60.0

Picture = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class Relit:
    """A relit picture, and the message that goes before it."""

    color: Picture
    message: CompositeMessage


@dataclass
class Seen:
    """What viewers got; delays are those of the one that decodes, from sending to its decoded picture.

    By WHEP no header says when a picture was captured; a WebSocket beside it tells.
    """

    joined: int = 0
    bytes: int = 0
    messages: int = 0
    delays_ms: list[float] = field(default_factory=list)


def relit_pictures() -> list[Relit]:
    """Renders the demo's recording.

    Raises:
        DeltalightError: the recording is not there, or no OpenGL.
    """
    take = dl.open(RECORDING)
    if not isinstance(take, dl.Take) or take.scene is None:
        raise DeltalightError(f"{RECORDING} has no scene; make the demo's recording again.")
    with dl.Renderer() as renderer:
        relit = [renderer.render(frame, take.scene) for frame in take]
    return [Relit(each.color, _message(each)) for each in relit]


def _message(relit: "dl.RelitPicture") -> CompositeMessage:
    composite = relit.composite
    return CompositeMessage(
        node="render-server",
        frame_id=composite.frame_id,
        capture_ns=0,
        encoding="jpeg",
        shape=(*relit.color.shape[:2], 3),
        status="ok" if composite.status == "ok" else "no_pose",
        camera=composite.camera.to_dict(),
        world_from_camera=_rows(composite.world_from_camera),
        received_ns=0,
        rendered_ns=0,
        pass_times_ms=composite.pass_times_ms,
        reused_pass_times_ms=composite.reused_pass_times_ms,
        lights=tuple(composite.lights),
    )


def _rows(pose: Float64[np.ndarray, "4 4"] | None) -> tuple[Row, Row, Row, Row] | None:
    return None if pose is None else cast("tuple[Row, Row, Row, Row]", tuple(map(tuple, pose.tolist())))


def coded(relit: Sequence[Relit], size: tuple[int, int], motion: str) -> list[tuple[CompositeMessage, bytes]]:
    """Returns the messages and JPEGs of a motion, to be repeated without a jump."""
    chosen = [*relit, *relit[-2:0:-1]] if motion == "moving" else [relit[0]] * len(relit)
    dice = np.random.default_rng(1)
    made = []
    for each in chosen:
        color = np.asarray(cv2.resize(each.color, size, interpolation=cv2.INTER_AREA))
        if motion == "still":
            noisy = color + dice.normal(0.0, NOISE_CODES, color.shape)
            color = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        camera = {**each.message.camera, "width": size[0], "height": size[1]}
        message = each.message.model_copy(update={"shape": (size[1], size[0], 3), "camera": camera})
        made.append((message, encode_color(color)))
    return made


@dataclass
class Matched:
    """When pictures were captured, as a WebSocket's headers say, and when a peer had decoded them, by access unit.

    Both get the same access units, but for the length of start codes.
    """

    captured_ns: dict[bytes, int] = field(default_factory=dict)
    decoded_ns: dict[bytes, int] = field(default_factory=dict)

    def delays_ms(self) -> list[float]:
        """Returns the delays of the pictures that both got."""
        both = self.captured_ns.keys() & self.decoded_ns.keys()
        return [(self.decoded_ns[unit] - self.captured_ns[unit]) / 1e6 for unit in both]


def _unit(data: bytes) -> bytes:
    return data.replace(LONG_START_CODE, LONG_START_CODE[1:])


@contextmanager
def publishing(port: int, pictures: Sequence[tuple[CompositeMessage, bytes]]) -> Iterator[None]:
    """Publishes pictures in turn, at the recording's rate, as captured at that moment."""
    stop = threading.Event()

    def run() -> None:
        publisher = Publisher(ports.endpoint(port))
        began_s = time.monotonic()
        for number in itertools.count(1):
            if stop.wait(max(0.0, began_s + number / RATE_PER_S - time.monotonic())):
                break
            message, jpeg = pictures[number % len(pictures)]
            now_ns = time.time_ns()
            times = {"capture_ns": now_ns, "received_ns": now_ns, "rendered_ns": now_ns, "frame_id": number}
            publisher.send(encode(message.model_copy(update=times), [jpeg]))
        publisher.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextmanager
def web_process(stream_port: int) -> Iterator[httpx.Client]:
    """Runs a web process that listens to a port; a client of its API.

    Raises:
        DeltalightError: it does not answer.
    """
    port, control_port = ports.private_ports(2)
    with tempfile.TemporaryDirectory(prefix="deltalight-bench-") as data:
        command = [
            sys.executable,
            "-m",
            "deltalight.services.cli",
            "api",
            "--port",
            str(port),
            "--data",
            data,
        ]
        command += ["--control", ports.endpoint(control_port), "--subscribe", ports.endpoint(stream_port)]
        env = {**os.environ, "DELTALIGHT_API__WHEP_SESSIONS": str(max(CROWDS))}
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, env=env)
        try:
            deadline_s = time.monotonic() + START_TIMEOUT_S
            while not ports.answers(port):
                if process.poll() is not None or time.monotonic() > deadline_s:
                    raise DeltalightError("The web process does not start; try `deltalight api` by hand.")
                time.sleep(0.1)
            with httpx.Client(base_url=f"http://{ports.LOOPBACK}:{port}/api/v1") as client:
                yield client
        finally:
            process.terminate()
            process.wait()


async def _view(address: str, codec: str, seen: Seen, measures: asyncio.Event, decoder: bool) -> None:
    from websockets.asyncio.client import connect

    h264, header, has_joined = H264Decoder(), None, False
    async with connect(f"{address}?codec={codec}", max_size=None, compression=None) as socket:
        while True:
            message = await socket.recv()
            assert isinstance(message, bytes)
            await socket.send("ack")
            has_joined, seen.joined = True, seen.joined + (not has_joined)
            if decoder:
                header, content = unpack(message, header)
                _decode(h264, header, content)
            if not measures.is_set():
                continue
            seen.bytes += len(message)
            seen.messages += 1
            if decoder and header is not None:
                seen.delays_ms.append((time.time_ns() - header.capture_ns) / 1e6)


def _decode(h264: H264Decoder, header: LiveHeader, content: bytes) -> None:
    width, height = header.camera.width, header.camera.height
    if header.codec == "jpeg":
        decode_color(memoryview(content), "jpeg", (height, width, 3))
    elif content:
        h264.decode(content, width, height)


async def _watch(address: str, seen: Seen, measures: asyncio.Event, matched: Matched | None) -> None:
    """Watches by WHEP; the one with `matched` decodes, and notes there when."""
    from av import CodecContext, Packet

    from deltalight.benchmarks.whep_viewer import WhepViewer

    h264, has_joined = CodecContext.create("h264", "r"), False

    def take(data: bytes) -> None:
        nonlocal has_joined
        has_joined, seen.joined = True, seen.joined + (not has_joined)
        if matched is not None:
            for frame in h264.decode(Packet(data)):
                rgb_picture(frame)
        if measures.is_set():
            seen.messages += 1
            if matched is not None:
                matched.decoded_ns[_unit(data)] = time.time_ns()

    async with WhepViewer(address, take) as viewer:
        await measures.wait()
        before = await viewer.received_bytes()
        try:
            await asyncio.Future()
        finally:
            seen.bytes += await viewer.received_bytes() - before


async def _note_captures(address: str, matched: Matched) -> None:
    """Notes when each picture in H.264 was captured."""
    from websockets.asyncio.client import connect

    header = None
    async with connect(f"{address}?codec=h264", max_size=None, compression=None) as socket:
        while True:
            message = await socket.recv()
            assert isinstance(message, bytes)
            await socket.send("ack")
            header, content = unpack(message, header)
            if content:
                matched.captured_ns[_unit(content)] = header.capture_ns


async def _crowd(client: httpx.Client, way: str, viewers: int, seconds: float) -> tuple[Seen, float]:
    """Returns what viewers got together, and the web process's fraction of a core."""
    base = str(client.base_url).rstrip("/")
    socket, whep = base.replace("http", "ws", 1) + "/live", f"{base}/whep"
    seen, measures, matched = Seen(), asyncio.Event(), Matched()

    def viewer(number: int) -> Coroutine[None, None, None]:
        if way == "whep":
            return _watch(whep, seen, measures, matched if number == 0 else None)
        return _view(socket, way, seen, measures, decoder=number == 0)

    tasks = [asyncio.create_task(viewer(number)) for number in range(viewers)]
    if way == "whep":
        tasks.append(asyncio.create_task(_note_captures(socket, matched)))
    async with asyncio.timeout(START_TIMEOUT_S):
        while seen.joined < viewers:
            await asyncio.sleep(0.05)
    await asyncio.sleep(SETTLING_S)
    before = sample(client)
    measures.set()
    await asyncio.sleep(seconds)
    measures.clear()
    after = sample(client)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    seen.delays_ms += matched.delays_ms()
    return seen, (after.cpu_s[WEB] - before.cpu_s[WEB]) / (after.at_s - before.at_s)


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=6.0, help="Of each measurement.")
    seconds = parser.parse_args().seconds
    table = Table(title=f"live pictures at {RATE_PER_S:g} a second")
    for head in (
        "size",
        "camera",
        "as",
        "viewers",
        "kbit/s each",
        "pictures/s",
        "delay ms",
        "p95",
        "web ms/s",
    ):
        table.add_column(head, justify="right")
    relit = relit_pictures()
    (stream_port,) = ports.private_ports(1)
    with web_process(stream_port) as client:
        for size, motion in itertools.product(SIZES, MOTIONS):
            with publishing(stream_port, coded(relit, size, motion)):
                what = f"{size[0]}x{size[1]}, {motion}"
                for way, viewers in track([*itertools.product(WAYS, CROWDS)], description=what):
                    seen, cores = asyncio.run(_crowd(client, way, viewers, seconds))
                    table.add_row(
                        f"{size[0]}x{size[1]}",
                        motion,
                        way,
                        str(viewers),
                        f"{8e-3 * seen.bytes / seconds / viewers:.0f}",
                        f"{seen.messages / seconds / viewers:.1f}",
                        *(f"{np.percentile(seen.delays_ms or [np.nan], rank):.0f}" for rank in (50, 95)),
                        f"{1e3 * cores:.0f}",
                    )
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
