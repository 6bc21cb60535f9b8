"""What `benchmarks.fleet` needs to know and no other report says: answers of the directory, sizes of pictures.

`python -m deltalight.benchmarks.fleet_costs` measures them on this machine and writes `fleet-costs-2cores.json`.
"""

import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import mean, median

import numpy as np

from deltalight.benchmarks.fleet import RESULTS
from deltalight.protocol.codecs import encode_color
from deltalight.protocol.messages import ControlReply
from deltalight.protocol.payloads import encode_control
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.render_server.server.process import ServerSettings
from deltalight.services import ports
from deltalight.services.demo import RECORDING
from deltalight.services.rooms.keeper import RoomKeeper, RoomPlan
from deltalight.services.rooms.placer import Placement, PlacementEvent, RoomOrder, Slot
from deltalight.services.rooms.status import RoomNode

ROOMS = (10, 100, 300, 1000)
TIMES = 20


class Everywhere:
    """A placer with a slot for every room, which starts nothing (a `Placer`)."""

    def __init__(self) -> None:
        self._slots: list[Slot] = []

    def slots(self) -> Sequence[Slot]:
        """Return the slots in use."""
        return self._slots

    def place(self, order: RoomOrder, slot: str | None = None) -> Placement:
        """Invent a placement."""
        name = slot or f"slot-{len(self._slots) + 1}"
        self._slots.append(Slot(name, "EGL 0", order.room))
        endpoint = ports.endpoint(ports.PRIVATE_PORTS.start + order.epoch)
        return Placement(order.room, order.epoch, name, endpoint, endpoint)

    def release(self, placement: Placement) -> None:
        """Do nothing."""

    def watch(self) -> Sequence[PlacementEvent]:
        """Nothing happens."""
        return []

    def close(self) -> None:
        """Do nothing."""


def kept(rooms: int) -> RoomKeeper:
    """Return a keeper of so many rooms, all of them placed."""
    node = RoomNode(name="camera", endpoint=ports.endpoint(ports.NODE_PORT))
    plans = [RoomPlan(f"room-{number}", "", (node,), Path("unused")) for number in range(rooms)]
    keeper = RoomKeeper(plans, Everywhere())
    keeper.poll()
    return keeper


def answer(keeper: RoomKeeper) -> list[bytes]:
    """Return an answer about all rooms as it is sent."""
    payload = keeper.status().model_dump(mode="json")
    return encode_control(ControlReply(node="rooms", id="fleet", ok=True, payload=payload))


def seconds_of(work: Callable[[], object]) -> float:
    """Return the median processor time of a call, s."""
    taken_s = []
    for _ in range(TIMES):
        began_s = time.thread_time()
        work()
        taken_s.append(time.thread_time() - began_s)
    return median(taken_s)


def measure() -> dict[str, float]:
    """Measure and return the costs."""
    keepers = {rooms: kept(rooms) for rooms in ROOMS}
    taken_s = [seconds_of(lambda keeper=keeper: answer(keeper)) for keeper in keepers.values()]  # type: ignore[misc]
    per_room_s, fixed_s = np.polyfit(ROOMS, taken_s, 1)
    reader = RecordingReader(RECORDING)
    frames = len(reader.timestamps_ns)
    quality = ServerSettings.model_fields["jpeg_quality"].default
    pictures = [len(encode_color(reader[number].color, "jpeg", quality)) for number in range(0, frames, 5)]
    return {
        "node_frame_bytes": RECORDING.stat().st_size / frames,
        "picture_bytes": mean(pictures),
        "answer_s": max(float(fixed_s), 0.0),
        "answer_s_per_room": float(per_room_s),
        "answer_bytes_per_room": sum(map(len, answer(keepers[ROOMS[-1]]))) / ROOMS[-1],
    }


if __name__ == "__main__":
    machine = {"cpus": os.cpu_count(), "load_before": os.getloadavg()[0]}
    path = RESULTS / f"fleet-costs-{os.cpu_count()}cores.json"
    path.write_text(json.dumps({**machine, **measure()}, indent=1) + "\n")
    print(path.read_text())
