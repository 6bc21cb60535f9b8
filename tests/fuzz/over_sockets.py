"""Mutated messages of all streams to a running station: `python -m tests.fuzz.over_sockets --messages 100000`.

What is published goes to the render server and the web process as from a node, requests and replies to the render
server's control endpoint, each of which is answered.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from random import Random
from typing import Any

import httpx
import psutil
import zmq

from deltalight.benchmarks.soak.link import LoopThread
from deltalight.benchmarks.soak.nonsense import mutated
from deltalight.benchmarks.soak.profiles import PROFILES
from deltalight.benchmarks.soak.station import Station, running_station
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.sockets import open_context
from deltalight.protocol.vectors import FOLDER, unframe_pieces
from deltalight.services import ports

COMMANDS = (b"request", b"reply")
LOOK_EVERY = 200  # messages
START_S, ANSWER_MS = 300.0, 10_000
SMALLEST_PAUSE_S = 0.05  # after each look: the receivers have their turn too


def main() -> None:
    """Sends them, and prints the figures as a JSON line."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.over_sockets", description=__doc__)
    parser.add_argument("--messages", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with small_station(options.seed) as station:
        print(json.dumps(attacked(station, options.messages, Random(options.seed))), flush=True)


@contextmanager
def small_station(seed: int) -> Iterator[Station]:
    """Runs a station of profile `small`, whose first picture is there."""
    with LoopThread("links") as thread, running_station(PROFILES["small"], thread, seed) as station:
        until_shown(station)
        yield station


def attacked(station: Station, messages: int, dice: Random) -> dict[str, Any]:
    """Sends so many, and tells what became of the processes, their memory (MB), and the pictures meanwhile."""
    vectors = [unframe_pieces(path.read_bytes()) for path in sorted(FOLDER.glob("*.bin"))]
    before, peaks, gaps = memory_mb(station), memory_mb(station), Gaps(station)
    began_s = time.monotonic()
    with ExitStack() as stack:
        publisher = stack.enter_context(closing(Publisher(ports.endpoint(station.places.stranger))))
        ask = _asking(stack, ports.endpoint(station.places.control))
        unanswered, slowest_s = 0, 0.0
        for number in range(messages):
            pieces = mutated(dice, dice.choice(vectors))
            if pieces[0].startswith(COMMANDS):
                asked_s = time.monotonic()
                unanswered += not ask(pieces)
                slowest_s = max(slowest_s, time.monotonic() - asked_s)
            else:
                publisher.send(pieces)
            if number % LOOK_EVERY == 0:
                peaks |= {name: max(peaks.get(name, 0.0), now) for name, now in memory_mb(station).items()}
                gaps.look()
                time.sleep(SMALLEST_PAUSE_S)
    return {
        "messages": messages,
        "seconds": round(time.monotonic() - began_s),
        "streams": len({pieces[0].partition(b".")[0] for pieces in vectors}),
        "deaths": station.deaths(),
        "unanswered": unanswered,
        "slowest_answer_ms": round(1e3 * slowest_s),
        "memory_mb": {name: (before[name], peaks[name]) for name in before},
        "longest_gap_s": round(gaps.longest_s, 2),
    }


def memory_mb(station: Station) -> dict[str, float]:
    """Resident memory of each process; one that has just died is left out."""
    found = {}
    for name in station.names:
        with suppress(psutil.NoSuchProcess):
            found[name] = round(psutil.Process(station.process_id(name)).memory_info().rss / 1e6, 1)
    return found


class Gaps:
    """The longest time in which no other picture was shown."""

    def __init__(self, station: Station) -> None:
        self.longest_s = 0.0
        self._client, self._shown, self._since_s = station.client, b"", time.monotonic()

    def look(self) -> None:
        """Compares the picture with that of the last look."""
        shown = self._shown
        with suppress(httpx.TransportError):  # the web process has just died
            shown = self._client.get("/live.jpg").content
        now_s = time.monotonic()
        if shown != self._shown:
            self.longest_s = max(self.longest_s, now_s - self._since_s)
            self._shown, self._since_s = shown, now_s


def until_shown(station: Station) -> None:
    """Waits for the first picture."""
    deadline_s = time.monotonic() + START_S
    while time.monotonic() < deadline_s:
        station.check()
        try:
            if station.client.get("/live.jpg").status_code == httpx.codes.OK:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.2)
    raise SystemExit("no picture came; see whether `deltalight bench soak --profile small` runs here")


def _asking(stack: ExitStack, endpoint: str) -> Callable[[Sequence[bytes]], bool]:
    """Returns what sends a request and tells whether an answer came."""
    context = open_context()
    stack.callback(context.destroy, 0)
    socket = context.socket(zmq.DEALER)
    socket.connect(endpoint)

    def ask(pieces: Sequence[bytes]) -> bool:
        socket.send_multipart([b"", *pieces])
        answered = bool(socket.poll(ANSWER_MS))
        if answered:
            socket.recv_multipart()
        return answered

    return ask


if __name__ == "__main__":
    main()
