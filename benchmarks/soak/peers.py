"""Two ways to send pictures over a bad link, without rendering: the newest wins, as here, or everything is queued.

A queue without end is what publishers and subscribers of other systems do unless told otherwise (ROS 2: reliability
`reliable`, history `keep all`). Both send messages of a node's size at a node's rate, each over a link of its own.
"""

import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from random import Random

import zmq

from deltalight.benchmarks.soak.crowd import Flow, Seen
from deltalight.benchmarks.soak.link import Link, LoopThread, Shape
from deltalight.benchmarks.soak.profiles import Profile
from deltalight.benchmarks.soak.station import resized
from deltalight.protocol.codecs import encode_color, encode_depth
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.sockets import open_context
from deltalight.services import ports
from deltalight.services.demo import RECORDING

TOPIC = b"color.peer"
START_S = 10.0
POLL_S = 0.05
STAMP = struct.Struct("<q")


class _Peer(ABC):
    """A sender at one port and a receiver that connects to another."""

    @abstractmethod
    def send(self, message: list[bytes]) -> None:
        """Sends a message."""

    @abstractmethod
    def receive(self) -> bytes | None:
        """Returns the time stamp of a message; None if none came for a moment."""

    @abstractmethod
    def close(self) -> None:
        """Closes both ends."""


class Newest(_Peer):
    """Sends and receives as nodes and servers do."""

    def __init__(self, port: int, link_port: int) -> None:
        self._publisher = Publisher(ports.endpoint(port), streams=1)
        self._receiver = Receiver([ports.endpoint(link_port)], [TOPIC.decode()])

    def send(self, message: list[bytes]) -> None:
        """Sends a message."""
        self._publisher.send(message)

    def receive(self) -> bytes | None:
        """Returns the time stamp of the newest message."""
        taken = self._receiver.latest(POLL_S)
        return None if taken is None else bytes(taken[TOPIC.decode()][1])

    def close(self) -> None:
        """Closes both ends."""
        self._receiver.close()
        self._publisher.close()


class Queued(_Peer):
    """Queues everything at both ends, and lets the kernel hold what it wants."""

    def __init__(self, port: int, link_port: int) -> None:
        self._context = open_context()
        self._sender, self._receiver = self._context.socket(zmq.PUB), self._context.socket(zmq.SUB)
        self._sender.sndhwm = self._receiver.rcvhwm = 0
        self._receiver.subscribe(TOPIC)
        self._sender.bind(ports.endpoint(port))
        self._receiver.connect(ports.endpoint(link_port))

    def send(self, message: list[bytes]) -> None:
        """Sends a message."""
        self._sender.send_multipart(message)

    def receive(self) -> bytes | None:
        """Returns the time stamp of the oldest message."""
        return self._receiver.recv_multipart()[1] if self._receiver.poll(round(1e3 * POLL_S)) else None

    def close(self) -> None:
        """Closes both ends."""
        self._context.destroy(0)


PEERS: dict[str, Callable[[int, int], _Peer]] = {"newest": Newest, "queued": Queued}


def peers_on(
    thread: LoopThread, shape: Shape | None, profile: Profile, seed: int, *, cut_s: float = 0.0
) -> dict[str, Flow]:
    """Has both send over links of a shape for the profile's time of load; returns how messages flowed, by PEERS.

    Before that, they send for `cut_s` into links that are cut.
    """
    size, rate, seconds = message_bytes(profile.size), profile.frames_per_s, cut_s + profile.load_s
    with ThreadPoolExecutor(len(PEERS)) as pool:
        runs = {
            name: pool.submit(measure_peer, peer, thread, shape, (size, rate, seconds), seed, cut_s=cut_s)
            for name, peer in PEERS.items()
        }
        return {name: run.result() for name, run in runs.items()}


def measure_peer(
    peer: Callable[[int, int], _Peer],
    thread: LoopThread,
    shape: Shape | None,
    load: tuple[int, float, float],
    seed: int,
    *,
    cut_s: float,
) -> Flow:
    """Sends messages for a while; `load` is their size in bytes, how many a second, and for how many seconds.

    The link is cut for the first `cut_s` of these.

    Raises:
        DeltalightError: the peers did not find each other.
    """
    size, rate, seconds = load
    port, link_port = ports.private_ports(2)
    link, content, seen = Link(link_port, port, seed), Random(seed).randbytes(size), list[Seen]()
    serving = thread.start(link.serve())
    pair = peer(port, link_port)
    try:
        _meet(pair)
        link.shape = shape
        began_s = time.monotonic()
        with _receiving(pair, seen), _cut(link, cut_s):
            for number in range(round(rate * seconds)):
                time.sleep(max(0.0, began_s + number / rate - time.monotonic()))
                pair.send([TOPIC, STAMP.pack(time.time_ns()), content])
            time.sleep(max(0.0, began_s + seconds - time.monotonic()))
        return Flow.of(seen, began_s, time.monotonic())
    finally:
        pair.close()
        thread.cancel(serving)


def _meet(pair: _Peer) -> None:
    deadline_s = time.monotonic() + START_S
    while time.monotonic() < deadline_s:
        pair.send([TOPIC, STAMP.pack(0), b""])
        if pair.receive() is not None:
            while pair.receive() is not None:
                pass
            return
    raise DeltalightError("the peers of a link did not find each other on loopback; run it again.")


@contextmanager
def _cut(link: Link, seconds: float) -> Iterator[None]:
    """Cuts a link for the first seconds of a block, which lasts longer."""
    link.cut(seconds > 0)
    mending = threading.Timer(seconds, link.cut, (False,))
    mending.start()
    try:
        yield
    finally:
        mending.cancel()
        mending.join()


@contextmanager
def _receiving(pair: _Peer, seen: list[Seen]) -> Iterator[None]:
    """Notes what comes, in a thread, during the block."""
    ending = threading.Event()

    def note() -> None:
        while not ending.is_set():
            stamp = pair.receive()
            if stamp is not None:
                (sent_ns,) = STAMP.unpack(stamp)
                seen.append(Seen(time.monotonic(), sent_ns, (time.time_ns() - sent_ns) / 1e6, 0.0))

    receiving = threading.Thread(target=note, name="peer", daemon=True)
    receiving.start()
    try:
        yield
    finally:
        ending.set()
        receiving.join()


@cache
def message_bytes(size: tuple[int, int]) -> int:
    """Returns what colour and depth of one frame of a node take, coded as nodes do; `size` in pixels."""
    frame = resized(RecordingReader(RECORDING)[0], size)
    depth = frame.depth
    coded = b"" if depth is None else encode_depth(depth.depth_m, depth.valid)
    return len(encode_color(frame.color)) + len(coded)
