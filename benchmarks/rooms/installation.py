"""`deltalight up --rooms` as a process, whose render servers are killed, moved and drained.

Pictures are 96x72, of a take that repeats one frame, so that equal scenes give equal bytes. The camera's are larger:
in 96x72 pixels no marker is found, and nothing is relit.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import httpx
import psutil

from deltalight.benchmarks.rooms.processes import (
    PATIENCE_S,
    children_of,
    is_gone,
    is_render_server,
    listens_at,
    wait_for,
    wait_until_idle,
)
from deltalight.benchmarks.soak.profiles import choose_profile
from deltalight.benchmarks.soak.station import soaked_scene, write_take
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument
from deltalight.services import ports
from deltalight.services.child import ChildSpec
from deltalight.services.parent_death_signal import SUPERVISOR_VARIABLE
from deltalight.services.rooms.directory import DirectoryClient
from deltalight.services.rooms.status import RoomStatus

NODE = "desk"
ROOMS = ("hall", "door", "attic")
TERMINATED = 143  # exit code after SIGTERM


class Installation:
    """`deltalight up --rooms` as a process, with its directory and its REST API.

    `hosts` are the processes below which render servers run: itself, or the raylets of a cluster, dead ones too.
    """

    def __init__(self, process: subprocess.Popen[bytes], page_port: int, rooms_port: int) -> None:
        self.process = psutil.Process(process.pid)
        self.page_port = page_port
        self.hosts: list[psutil.Process] = [self.process]
        self.directory = DirectoryClient(ports.endpoint(rooms_port))
        self.client = httpx.Client(base_url=f"http://{ports.LOOPBACK}:{page_port}/api/v1", timeout=30)

    def close(self) -> None:
        """Closes the connections."""
        self.directory.close()
        self.client.close()

    def room(self, name: str) -> RoomStatus:
        """Returns what the directory says of a room."""
        return next(room for room in self.directory.rooms().rooms if room.name == name)

    def epoch(self, name: str) -> int:
        """Returns the epoch of a room that has a render server."""
        endpoints = self.room(name).endpoints
        assert endpoints is not None
        return endpoints.epoch

    def answered(self, name: str) -> dict[str, object]:
        """Returns what the web process says of a room."""
        return dict(self.client.get(f"/rooms/{name}").json())

    def picture(self, name: str) -> bytes:
        """Returns the newest picture of a room, as JPEG; empty if there is none."""
        answer = self.client.get(f"/rooms/{name}/live.jpg")
        return answer.content if answer.status_code == httpx.codes.OK else b""

    def is_shown(self, name: str) -> bool:
        """Whether pictures of the room's present render server come."""
        room = self.answered(name)
        since_s = room.get("last_frame_s")
        return room.get("state") == "running" and isinstance(since_s, float) and since_s < 1

    def frames(self, name: str) -> int:
        """Returns how many pictures of a room the web process has received."""
        text = self.client.get(f"/rooms/{name}/metrics").text
        lines = (
            line for line in text.splitlines() if line.startswith("deltalight_live_frames_received_total")
        )
        return int(float(next(lines).split()[1]))

    def server(self, name: str) -> psutil.Process:
        """Returns the process that listens at the room's control endpoint.

        Raises:
            DeltalightError: none does.
        """
        endpoints = self.room(name).endpoints
        port = 0 if endpoints is None else int(endpoints.control.rpartition(":")[2])
        for child in self.processes():
            if listens_at(child, port):
                return child
        raise DeltalightError(f"nobody listens at the control endpoint of {name}; see whether it runs.")

    def processes(self) -> list[psutil.Process]:
        """Returns all that it runs, on its hosts too."""
        return [child for host in {self.process, *self.hosts} for child in children_of(host)]

    def spares(self) -> list[psutil.Process]:
        """Returns the render servers that are no room's."""
        running = [room.name for room in self.directory.rooms().rooms if room.endpoints is not None]
        taken = {self.server(name).pid for name in running}
        return [each for each in self.processes() if is_render_server(each) and each.pid not in taken]

    def wait_for_spares(self, **rest: float) -> None:
        """Waits until each host has a spare that has prepared itself (`wait_until_idle`), and that is all they run.

        Raises:
            DeltalightError: they never have.
        """
        found: list[psutil.Process] = []

        def are_there() -> bool:
            with suppress(DeltalightError, psutil.NoSuchProcess):  # a room that starts, a spare that ends
                found[:] = self.spares()
                return len(found) == sum(not is_gone(host) for host in self.hosts)
            return False

        wait_for(are_there, "A spare of each host")
        for spare in found:
            wait_until_idle(spare, **rest)

    def kill(self, name: str) -> str:
        """Kills the room's render server; returns the seconds until a viewer has the next picture, and by whom."""
        epoch, server, present = self.epoch(name), self.server(name), self.processes()
        os.kill(server.pid, signal.SIGKILL)
        killed_s = time.monotonic()
        wait_for(lambda: is_gone(server))
        gap_s = self.shown_after(name, epoch) - killed_s
        return f"{gap_s:.2f} s by {'the spare' if self.server(name) in present else 'a new process'}"

    def shown_after(self, name: str, epoch: int) -> float:
        """Waits for a picture of a newer epoch; returns when it came, by the monotonic clock, in seconds."""
        wait_for(lambda: (self.answered(name)["epoch"] or 0) > epoch)  # type: ignore[operator]
        before = self.frames(name)
        wait_for(lambda: self.frames(name) > before)
        return time.monotonic()


@contextmanager
def started(
    folder: Path, *options: str, rooms: Sequence[str] = ROOMS, slots: int = 2, log: Path | None = None
) -> Iterator[Installation]:
    """Runs rooms of one node in so many slots, until the first two show pictures; nothing of it is left afterwards.

    Raises:
        DeltalightError: no picture comes, or a process outlives it.
    """
    profile = choose_profile("small")
    write_take(folder / "take.mcap", profile.size, profile.frames_per_s, frames=(0,) * 10)
    (folder / "scene.json").write_text(_without_memory(soaked_scene(profile)).model_dump_json())
    entries = [f"  {name}: {{nodes: [{NODE}], scene: scene.json}}" for name in rooms]
    lines = [f"slots: {slots}", f"nodes: {{{NODE}: {{source: take.mcap}}}}", "rooms:", *entries]
    (folder / "rooms.yaml").write_text("\n".join(lines))
    with installed(folder, *options, log=log) as found:
        wait_for(lambda: all(found.is_shown(name) for name in rooms[:2]), "The first picture of each room")
        yield found


def _without_memory(scene: SceneDocument) -> SceneDocument:
    """A scene whose picture does not depend on what it was before.

    Light from out of sight is estimated once, with objects where they stand then, and kept while they are moved.
    """
    return scene.replaced(lights=scene.lights.model_dump(mode="json") | {"surroundings": "none"})


@contextmanager
def installed(folder: Path, *options: str, log: Path | None = None) -> Iterator[Installation]:
    """Runs the rooms of `folder`/rooms.yaml; nothing is left afterwards. What they write goes to `log`, if given.

    Raises:
        DeltalightError: a process outlives it, or it ends otherwise than told to.
    """
    page_port, rooms_port = ports.private_ports(2)
    words = ("up", "--rooms", str(folder / "rooms.yaml"), "--allow-software", "--data", str(folder / "data"))
    where = ("--port", str(page_port), "--rooms-port", str(rooms_port))
    command = [sys.executable, *ChildSpec.deltalight("up", *words, *options, *where).arguments]
    environment = {**os.environ, SUPERVISOR_VARIABLE: str(os.getpid())}
    with _written_to(log) as lines:
        process = subprocess.Popen(command, stdout=lines, stderr=lines, env=environment)
    found = Installation(process, page_port, rooms_port)
    try:
        yield found
        _end(process, found)
    finally:
        process.kill()
        process.wait()
        found.close()


@contextmanager
def _written_to(log: Path | None) -> Iterator[BinaryIO | None]:
    if log is None:
        yield None
    else:
        with log.open("ab") as lines:
            yield lines


def _end(process: subprocess.Popen[bytes], found: Installation) -> None:
    children = children_of(found.process)
    process.terminate()  # SIGINT is ignored where a shell started all this in the background
    code = process.wait(PATIENCE_S)
    left = psutil.wait_procs(children, timeout=PATIENCE_S)[1]
    if code != TERMINATED or left:
        raise DeltalightError(
            f"the rooms ended with exit code {code} and left {len(left)} processes; end these and see the log."
        )


def settled(installation: Installation, name: str) -> bytes:
    """Returns the room's picture of its scene's newest revision, once it is the same three times in a row.

    Raises:
        DeltalightError: it never is.
    """
    state = f"/rooms/{name}/state"
    wait_for(
        lambda: installation.client.get(state).json()["picture"]["state"] == "shown", f"A picture of {name}"
    )
    seen: list[bytes] = []

    def is_settled() -> bool:
        before = installation.frames(name)
        wait_for(lambda: installation.frames(name) > before, f"Another picture of {name}")
        seen.append(installation.picture(name))
        # The first may have been on its way before the revision was shown.
        return len(seen) > 3 and seen[-1] != b"" and len(set(seen[-3:])) == 1

    wait_for(is_settled, f"A picture of {name} that stays the same")
    return seen[-1]
