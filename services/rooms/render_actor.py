"""A room on a host of a Ray cluster: the actor that starts its render server there and tells what becomes of it."""

import ctypes
import math
import os
import shutil
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from deltalight.protocol.errors import DeltalightError
from deltalight.services import ports
from deltalight.services.child import ChildSpec, end_all, open_spare, take_spare
from deltalight.services.host import HostCommands
from deltalight.services.process import Process
from deltalight.services.rooms.capacity import (
    FalseClaimError,
    RoomFigures,
    check_claim,
    find_device_apart,
    is_claim,
)
from deltalight.services.rooms.placer import Placement, PlacementEvent
from deltalight.services.rooms.ray_cluster import ClusterHost
from deltalight.services.rooms.render_process import RenderProcess

SESSION = Path("session.json")  # in the actor's folder
NEWS_WAIT_S = 1.0
LOOK_INTERVAL_S = 0.1
LEASE_S = 15.0  # longer than a keeper that lives is silent
END_TIMEOUT_S = 5.0

_MAXIMUM_DEVICES = 64
_EGL_EXTENSIONS = 0x3055
_SOFTWARE = b"EGL_MESA_device_software"


@dataclass(frozen=True)
class News:
    """What happened to a placement, and what its render server wrote."""

    events: tuple[PlacementEvent, ...]
    lines: tuple[str, ...]


@dataclass(frozen=True)
class RenderTask:
    """What an actor starts.

    `rank` is the slot's number on its host, from 0, and `session` the text of the scene document, if there is one.
    What the `host` claims by its labels and slots is checked, by the `figures` of a room if they are known.
    """

    placement: Placement
    spec: ChildSpec
    session: str
    commands: HostCommands
    rank: int
    host: ClusterHost
    figures: RoomFigures | None = None


class RenderActor:
    """Holds one render slot, and runs the render server of a room in it.

    Without a task it is the spare of its host: a process that has prepared itself (`ChildSpec.warm`) waits in it,
    takes no slot, and becomes the render server of the task that it is told to `begin` with.

    Ends with it when Ray's raylet, its parent, is gone, or when no keeper has asked for `LEASE_S`: a host that was
    cut off must not go on, because the room runs elsewhere by then.
    """

    def __init__(self, task: RenderTask | None, spare: ChildSpec | None = None) -> None:
        self._lines: deque[str] = deque()
        self._asked_s = time.monotonic()
        self._epoch = 0
        self._fault: DeltalightError | None = None
        self._lock = threading.Lock()
        self._render: RenderProcess | None = None
        self._folder = tempfile.mkdtemp(prefix="deltalight-")
        os.chdir(self._folder)
        self._spare = None if spare is None else open_spare(spare.arguments, spare.warm)
        if task is not None:
            self._start(task)
        threading.Thread(target=self._end_without_keeper, args=(os.getppid(),), daemon=True).start()

    def begin(self, task: RenderTask) -> News:
        """Starts the render server of a task by the spare; returns the first news."""
        self._start(task)
        return self.news()

    def waits(self) -> bool:
        """Returns after a second whether the spare still lives."""
        time.sleep(NEWS_WAIT_S)
        self._asked_s = time.monotonic()
        return self._spare is not None and self._spare.poll() is None

    def news(self) -> News:
        """Returns what happened since the last call; waits a second for it."""
        deadline_s = time.monotonic() + NEWS_WAIT_S
        events = self._events()
        while not events and not self._is_gone and time.monotonic() < deadline_s:
            time.sleep(LOOK_INTERVAL_S)
            events = self._events()
        self._asked_s = time.monotonic()
        lines = [self._lines.popleft() for _ in range(len(self._lines))]
        return News(tuple(events), tuple(lines))

    def end(self) -> None:
        """Ends the render server or the spare, and returns when it is gone."""
        if self._spare is not None:
            end_all([self._spare])
        if self._render is not None:
            self._render.end()
            deadline_s = time.monotonic() + END_TIMEOUT_S
            while not self._is_gone and time.monotonic() < deadline_s:
                self._events()
                time.sleep(LOOK_INTERVAL_S)

    def process_id(self) -> int:
        """Returns the process id of the render server; 0 = it was not started."""
        with self._lock:
            return 0 if self._render is None else self._render.process.pid

    def _start(self, task: RenderTask) -> None:
        with self._lock:
            spare, self._spare, self._epoch = self._spare, None, task.placement.epoch
            try:
                self._render = _started(task, self._lines.append, spare)
            except DeltalightError as fault:
                self._fault = fault

    @property
    def _is_gone(self) -> bool:
        return self._render is None or self._render.is_gone

    def _events(self) -> list[PlacementEvent]:
        if self._render is None:
            is_false = isinstance(self._fault, FalseClaimError)
            return [PlacementEvent(self._epoch, "lost", str(self._fault), host_refused=is_false)]
        with self._lock:
            events = self._render.news()
        if self._render.is_gone:
            shutil.rmtree(self._folder, ignore_errors=True)
        return events

    def _end_without_keeper(self, raylet: int) -> None:
        while os.getppid() == raylet and time.monotonic() - self._asked_s < LEASE_S:
            time.sleep(LOOK_INTERVAL_S)
        if self._render is not None:
            self._render.process.kill()
        shutil.rmtree(self._folder, ignore_errors=True)
        os._exit(1)


def _started(task: RenderTask, forward: Callable[[str], None], spare: Process | None) -> RenderProcess:
    placement = task.placement
    endpoints = placement.publish, placement.control
    for endpoint in endpoints:
        if not ports.is_free(int(endpoint.rpartition(":")[2])):
            raise DeltalightError(f"another program listens at {endpoint}; trying other ports.")
    if task.session:
        SESSION.write_text(task.session)
    devices = hardware_devices()
    device = devices[task.rank % len(devices)] if devices else None
    _check_host(task.host, device, max(1, len(devices)), task.figures)
    options = () if device is None else ("--device", str(device))
    spec = replace(task.spec, arguments=(*task.spec.arguments, *options))
    keys = task.commands.keys(endpoints)
    return RenderProcess(placement, spec, keys, forward, take_spare(spare, spec))


def _check_host(host: ClusterHost, device: int | None, devices: int, figures: RoomFigures | None) -> None:
    """Compares what a host claims with what is found on one of its devices; without a claim nothing is asked."""
    if figures is not None or is_claim(host.labels):
        slots = math.ceil(host.slots / devices)
        check_claim(host.name, host.labels, slots, find_device_apart(device), figures)


def hardware_devices() -> list[int]:
    """Returns the numbers of this host's EGL devices that are no software renderers (EGL_EXT_device_enumeration).

    Empty where there is none, or no EGL.
    """
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return []
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    query_devices = _function(egl, b"eglQueryDevicesEXT", ctypes.c_uint)
    query_string = _function(egl, b"eglQueryDeviceStringEXT", ctypes.c_char_p)
    if query_devices is None or query_string is None:
        return []
    devices, count = (ctypes.c_void_p * _MAXIMUM_DEVICES)(), ctypes.c_int()
    if not query_devices(_MAXIMUM_DEVICES, devices, ctypes.byref(count)):
        return []
    texts = [query_string(ctypes.c_void_p(device), _EGL_EXTENSIONS) for device in devices[: count.value]]
    return [number for number, text in enumerate(texts) if _SOFTWARE not in (text or b"").split()]


def _function(egl: ctypes.CDLL, name: bytes, result: type) -> Callable[..., Any] | None:
    address = egl.eglGetProcAddress(name)
    return None if not address else ctypes.CFUNCTYPE(result)(address)
