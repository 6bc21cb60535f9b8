"""A trusted peer that has libzmq abort its receivers: `python -m tests.fuzz.aborted --rounds 6`.

It is a node of a station of profile `small`: it sends heartbeats of its own among more messages than a queue takes,
then hangs up, until a process has died (docs/security.md). Prints which, and when the next picture came.
"""

import argparse
import json
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

from deltalight.benchmarks.soak.crowd import Crowd
from deltalight.benchmarks.soak.link import LoopThread
from deltalight.benchmarks.soak.profiles import PROFILES
from deltalight.benchmarks.soak.station import Station, running_station
from deltalight.services import ports
from tests.fuzz.over_sockets import until_shown
from tests.protocol.raw_peers import PING, RawPeer, multipart

FLOOD = (multipart([b"stats.stranger", bytes(600)]) + PING) * 4000
SPARE_S = 8.0  # until the next ones wait
PATIENCE_S = 120.0


def main() -> None:
    """Does it some times, and prints a JSON line for each."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.aborted", description=__doc__)
    parser.add_argument("--rounds", type=int, default=6)
    options = parser.parse_args()
    with ExitStack() as stack:
        thread = stack.enter_context(LoopThread("links and viewers"))
        station = stack.enter_context(running_station(PROFILES["small"], thread, 1))
        until_shown(station)
        crowd = Crowd(thread, station.places.page, station.cameras)
        for _ in range(options.rounds):
            time.sleep(SPARE_S)
            print(json.dumps(aborted(station, crowd)), flush=True)


def aborted(station: Station, crowd: Crowd) -> dict[str, object]:
    """Attack until a process has died, and tell which died and how long no new picture came."""
    before, began_s = station.restarts(), time.monotonic()
    peers = 0
    with listening(station.places.stranger) as listener:
        while station.restarts() == before and time.monotonic() < began_s + PATIENCE_S:
            peers += 1
            flood_and_hang_up(listener)
    died_s, died_ns = time.monotonic(), time.time_ns()
    while time.monotonic() < died_s + PATIENCE_S:
        if any(each.capture_ns > died_ns for each in crowd.between(died_s, float("inf"))):
            break
        time.sleep(0.02)
    died = [name for name, count in station.restarts().items() if count != before[name]]
    return {"died": died, "peers": peers, "back_s": round(time.monotonic() - died_s, 2)}


@contextmanager
def listening(port: int) -> Iterator[socket.socket]:
    """Listens where the station expects another node."""
    with socket.create_server((ports.LOOPBACK, port)) as listener:
        listener.settimeout(1.0)
        yield listener


def flood_and_hang_up(listener: socket.socket) -> None:
    """Be a publisher to the next process that connects."""
    with suppress(OSError, AssertionError):  # it did not come, or has just died
        peer = RawPeer.accepted(listener, "PUB").wait_until_ready()
        peer.send_what_fits(FLOOD)
        peer.hang_up()


if __name__ == "__main__":
    main()
