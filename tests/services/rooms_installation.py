"""`deltalight up --rooms` as a process, for tests that kill what it runs.

Pictures are 96x72, of a take that repeats one frame, so that equal scenes give equal bytes. The camera's are larger:
in 96x72 pixels no marker is found, and nothing is relit.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import psutil
import pytest

from deltalight.benchmarks.soak.profiles import choose_profile
from deltalight.benchmarks.soak.station import soaked_scene, write_take
from deltalight.protocol.scene import SceneDocument
from deltalight.services import ports
from deltalight.services.rooms.directory import DirectoryClient
from deltalight.services.rooms.status import RoomStatus
from tests.services.conftest import ROOT

PATIENCE_S = 150.0
POLL_S = 0.05  # each look is a request, whose answer takes what it waits for from the processor
ROOMS = """
slots: 2
nodes: {desk: {source: take.mcap}}
rooms:
  hall: {nodes: [desk], scene: scene.json}
  door: {nodes: [desk], scene: scene.json}
  attic: {nodes: [desk], scene: scene.json}
"""


def wait_for(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        with suppress(httpx.TransportError):
            if condition():
                return
        time.sleep(POLL_S)
    pytest.fail("it never came")


class Installation:
    """`deltalight up --rooms` as a process, with its directory and its REST API."""

    def __init__(self, process: subprocess.Popen[bytes], page_port: int, rooms_port: int) -> None:
        self.process = psutil.Process(process.pid)
        self.hosts: list[psutil.Process] = []  # that run render servers beside it
        self.directory = DirectoryClient(ports.endpoint(rooms_port))
        self.client = httpx.Client(base_url=f"http://{ports.LOOPBACK}:{page_port}/api/v1", timeout=30)

    def close(self) -> None:
        self.directory.close()
        self.client.close()

    def room(self, name: str) -> RoomStatus:
        return next(room for room in self.directory.rooms().rooms if room.name == name)

    def answered(self, name: str) -> dict[str, object]:
        return dict(self.client.get(f"/rooms/{name}").json())

    def picture(self, name: str) -> bytes:
        answer = self.client.get(f"/rooms/{name}/live.jpg")
        return answer.content if answer.status_code == 200 else b""

    def is_shown(self, name: str) -> bool:
        """Whether pictures of the room's present render server come."""
        room = self.answered(name)
        since_s = room.get("last_frame_s")
        return room.get("state") == "running" and isinstance(since_s, float) and since_s < 1

    def frames(self, name: str) -> int:
        text = self.client.get(f"/rooms/{name}/metrics").text
        lines = (
            line for line in text.splitlines() if line.startswith("deltalight_live_frames_received_total")
        )
        return int(float(next(lines).split()[1]))

    def server(self, name: str) -> psutil.Process:
        """The process that listens at the room's control endpoint."""
        endpoints = self.room(name).endpoints
        assert endpoints is not None
        port = int(endpoints.control.rpartition(":")[2])
        for child in self.processes():
            if any(each.laddr.port == port and each.status == "LISTEN" for each in connections(child)):
                return child
        pytest.fail(f"nobody listens at {endpoints.control}")

    def processes(self) -> list[psutil.Process]:
        """All that it runs, on its hosts too."""
        found = self.process.children(recursive=True)
        for host in self.hosts:
            with suppress(psutil.NoSuchProcess):
                found += host.children(recursive=True)
        return found

    def count_of(self, command: str) -> int:
        """How many processes of its own run this command; all of them for an empty one."""
        children = self.process.children(recursive=True)
        return sum(not command or command in child.cmdline() for child in children)

    def wait_for_spare(self) -> None:
        """Wait until two rooms run and a spare has prepared itself: it takes no processor time any more."""
        wait_for(lambda: self.count_of("server") == 3)
        spare = max(self.process.children(recursive=True), key=lambda child: child.create_time())
        wait_until_idle(spare)

    def kill(self, name: str) -> str:
        """Kill the room's render server; return the seconds until a viewer has a picture of the next, and by whom."""
        room = self.room(name)
        assert room.endpoints is not None
        epoch = room.endpoints.epoch
        server, present = self.server(name), self.processes()
        os.kill(server.pid, signal.SIGKILL)
        killed_s = time.monotonic()
        wait_for(lambda: is_gone(server))
        gap_s = self.shown_after(name, epoch) - killed_s
        return f"{gap_s:.2f} s by {'the spare' if self.server(name) in present else 'a new process'}"

    def shown_after(self, name: str, epoch: int) -> float:
        """Wait for a picture of a newer epoch; return when it came, by the monotonic clock, in seconds."""
        wait_for(lambda: (self.answered(name)["epoch"] or 0) > epoch)  # type: ignore[operator]
        before = self.frames(name)
        wait_for(lambda: self.frames(name) > before)
        return time.monotonic()


def is_gone(process: psutil.Process) -> bool:
    """Whether a process has ended, whoever has still to be told."""
    with suppress(psutil.NoSuchProcess):
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    return True


def wait_until_idle(process: psutil.Process) -> None:
    """Wait until a process has done what it had to do: all its threads sleep, and it takes no processor time."""
    tasks = Path(f"/proc/{process.pid}/task")
    used_s = [-1.0]

    def is_idle() -> bool:
        time.sleep(0.3)
        used_s.append(sum(process.cpu_times()[:2]))
        states = {state_of(thread) for thread in tasks.iterdir()}
        return used_s[-1] == used_s[-2] and states <= {"S", ""}

    wait_for(is_idle)


def state_of(thread: Path) -> str:
    """The letter of a thread's state in /proc; "" where it has ended."""
    with suppress(OSError):
        return (thread / "stat").read_text().rpartition(") ")[2][0]
    return ""


def connections(process: psutil.Process) -> list[object]:
    with suppress(psutil.Error):
        return list(process.net_connections("tcp"))
    return []


@contextmanager
def started(folder: Path, *options: str) -> Iterator[Installation]:
    """Run three rooms of one node in two slots; nothing of it is left afterwards."""
    profile = choose_profile("small")
    write_take(folder / "take.mcap", profile.size, profile.frames_per_s, frames=(0,) * 10)
    (folder / "scene.json").write_text(_without_memory(soaked_scene(profile)).model_dump_json())
    (folder / "rooms.yaml").write_text(ROOMS)
    with installed(folder, *options) as found:
        wait_for(lambda: found.is_shown("hall") and found.is_shown("door"))
        yield found


def _without_memory(scene: SceneDocument) -> SceneDocument:
    """A scene whose picture does not depend on what it was before.

    Light from out of sight is estimated once, with objects where they stand then, and kept while they are moved.
    """
    return scene.replaced(lights=scene.lights.model_dump(mode="json") | {"surroundings": "none"})


@contextmanager
def installed(folder: Path, *options: str) -> Iterator[Installation]:
    """Run the rooms of `folder`/rooms.yaml; nothing of it is left afterwards."""
    page_port, rooms_port = ports.private_ports(2)
    command = [sys.executable, "-m", "deltalight.services.cli", "up", "--rooms", str(folder / "rooms.yaml")]
    command += ["--allow-software", "--data", str(folder / "data"), *options]
    command += ["--port", str(page_port), "--rooms-port", str(rooms_port)]
    process = subprocess.Popen(command, cwd=ROOT)
    found = Installation(process, page_port, rooms_port)
    try:
        yield found
        children = found.process.children(recursive=True)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 130
        assert psutil.wait_procs(children, timeout=PATIENCE_S)[1] == []
    finally:
        process.kill()
        process.wait()
        found.close()


def settled(installation: Installation, name: str) -> bytes:
    """The room's picture of its scene's newest revision, once it is the same three times in a row."""
    wait_for(lambda: installation.client.get(f"/rooms/{name}/state").json()["picture"]["state"] == "shown")
    seen: list[bytes] = []

    def is_settled() -> bool:
        before = installation.frames(name)
        wait_for(lambda: installation.frames(name) > before)
        seen.append(installation.picture(name))
        # The first may have been on its way before the revision was shown.
        return len(seen) > 3 and seen[-1] != b"" and len(set(seen[-3:])) == 1

    wait_for(is_settled)
    return seen[-1]
