"""What `benchmarks.fleet` needs to know and no other report says: the control plane's costs, sizes of pictures.

`python -m deltalight.benchmarks.fleet_costs` measures them on this machine and writes `fleet-costs-2cores.json`.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from statistics import mean, median
from tempfile import TemporaryDirectory

import numpy as np

from deltalight.benchmarks.fleet import RESULTS
from deltalight.benchmarks.fleet_ray_costs import measure_ray
from deltalight.benchmarks.soak.samples import processor_time_s, read_process
from deltalight.protocol.codecs import encode_color
from deltalight.protocol.messages import ControlReply
from deltalight.protocol.payloads import encode_control
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.render_server.server.process import ServerSettings
from deltalight.services import ports
from deltalight.services.demo import RECORDING
from deltalight.services.rooms.directory import DirectoryServer
from deltalight.services.rooms.keeper import RoomKeeper, RoomPlan
from deltalight.services.rooms.placer import Placement, PlacementEvent, RoomOrder, Slot
from deltalight.services.rooms.rooms_file import MAX_ROOMS
from deltalight.services.rooms.status import RoomNode

ROOMS = (10, 100, 300, 1000)
TIMES = 20
WEB_S = 10.0  # that a web process is watched


class UnlimitedPlacer:
    """A placer with a slot for every room, which starts nothing (a `Placer`)."""

    def __init__(self) -> None:
        self._slots: list[Slot] = []

    def slots(self) -> Sequence[Slot]:
        """Returns the slots in use."""
        return self._slots

    def place(self, order: RoomOrder, slot: str | None = None) -> Placement:
        """Invents a placement."""
        name = slot or f"slot-{len(self._slots) + 1}"
        self._slots.append(Slot(name, "EGL 0", order.room))
        endpoint = ports.endpoint(ports.PRIVATE_PORTS.start + len(self._slots))
        return Placement(order.room, order.epoch, name, endpoint, endpoint)

    def release(self, placement: Placement) -> None:
        """Does nothing."""

    def watch(self) -> Sequence[PlacementEvent]:
        """Nothing happens."""
        return []

    def close(self) -> None:
        """Does nothing."""


def kept(rooms: int) -> RoomKeeper:
    """Returns a keeper of so many rooms, all of them placed."""
    node = RoomNode(name="camera", endpoint=ports.endpoint(ports.NODE_PORT))
    plans = [RoomPlan(f"room-{number}", "", (node,), Path("unused")) for number in range(rooms)]
    keeper = RoomKeeper(plans, UnlimitedPlacer())
    keeper.poll()
    return keeper


def answer(keeper: RoomKeeper) -> list[bytes]:
    """Returns an answer about all rooms as it is sent."""
    payload = keeper.status().model_dump(mode="json")
    return encode_control(ControlReply(node="rooms", id="fleet", ok=True, payload=payload))


def seconds_of(work: Callable[[], object]) -> float:
    """Returns the median processor time of a call, s."""
    taken_s = []
    for _ in range(TIMES):
        began_s = time.thread_time()
        work()
        taken_s.append(time.thread_time() - began_s)
    return median(taken_s)


def web_process(rooms: int) -> dict[str, float]:
    """Returns what a web process of so many rooms takes that show nothing: threads, files, and fraction of a core."""
    page, number = ports.private_ports(2)
    directory = ports.endpoint(number)
    words = ["api", "--config", os.devnull, "--port", str(page), "--rooms", directory]
    command = [sys.executable, "-m", "deltalight.services.cli", *words]
    with closing(DirectoryServer(directory, kept(rooms))), TemporaryDirectory() as folder:
        child = subprocess.Popen([*command, "--data", folder], stderr=subprocess.DEVNULL)
        try:
            while not ports.answers(page):
                time.sleep(0.2)
            _wait_until_started(child.pid)
            before_s, began_s = processor_time_s(child.pid), time.monotonic()
            time.sleep(WEB_S)
            used_s, elapsed_s = processor_time_s(child.pid) - before_s, time.monotonic() - began_s
            files = read_process(child.pid).handles
            return {"threads": _threads(child.pid), "files": files, "share": used_s / elapsed_s}
        finally:
            child.kill()
            child.wait()


def _wait_until_started(process_id: int) -> None:
    """Waits until a process starts no more threads."""
    before, threads = -1, _threads(process_id)
    while threads != before:
        time.sleep(WEB_S)
        before, threads = threads, _threads(process_id)


def _threads(process_id: int) -> int:
    return sum(1 for _ in Path(f"/proc/{process_id}/task").iterdir())


def measure_web() -> dict[str, float]:
    """Returns what a room costs a web process that follows it, without pictures."""
    one, most = web_process(1), web_process(MAX_ROOMS)
    return {f"web_{key}_per_room": (most[key] - one[key]) / (MAX_ROOMS - 1) for key in one}


def measure() -> dict[str, float]:
    """Measures and returns the costs."""
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
    figures = {**measure(), **measure_web(), **measure_ray()}
    path.write_text(json.dumps({**machine, **figures}, indent=1) + "\n")
    print(path.read_text())
