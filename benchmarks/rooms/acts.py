"""What is done to a room that is watched, and for how long it is away then."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass

from deltalight.benchmarks.rooms.hosts import Hosts
from deltalight.benchmarks.rooms.installation import Installation, settled
from deltalight.benchmarks.rooms.processes import SHORT_S, is_gone, wait_for
from deltalight.benchmarks.soak.crowd import Crowd
from deltalight.protocol.documents import StrictModel

ROOM = "hall"  # the one that is watched
LONGEST_REST_S = 3.0  # of a spare that builds ahead: longer than between its looks at the document
HERE_S, OVER_HOSTS_S = 5.0, 15.0  # bars


@dataclass(frozen=True)
class Run:
    """What acts are done to, and who watches; `hosts` are those of a cluster."""

    placer: str
    installation: Installation
    viewer: Crowd
    hosts: Hosts | None = None

    @property
    def host(self) -> str:
        """The name of the host on which the room runs."""
        room = self.installation.room(ROOM)
        slots = self.installation.directory.rooms().slots
        return next(slot.host for slot in slots if slot.name == room.slot)


@dataclass(frozen=True)
class Act:
    """One kind of act: `prepare` what it needs beside ready spares, `do` it, and `undo` what the next one would miss.

    While an act `goes_on`, the room still shows pictures, and the longest gap between these counts. Else that from
    the act to the first picture of a later frame does, which has to be at most `bar_s`, in seconds, in either case.
    `is_warm`: a spare is expected to take the room over.
    """

    what: str
    bar_s: float
    do: Callable[[Run], None]
    undo: Callable[[Run], None] = lambda _run: None
    prepare: Callable[[Run], None] = lambda _run: None
    goes_on: bool = False
    is_warm: bool = True

    @property
    def how(self) -> str:
        """What is measured."""
        if self.goes_on:
            return "longest gap between pictures"
        return "from then to the first picture of a later frame"


class ActRecord(StrictModel):
    """One act: how long the room was away, in seconds, and what was the same after it.

    `by_spare`: its new render server was there before as a spare. `load` is the load average before.
    """

    placer: str
    act: str
    gap_s: float
    by_spare: bool
    same_picture: bool
    epoch_before: int
    epoch_after: int
    load: float


def measure(run: Run, name: str, act: Act) -> ActRecord:
    """Waits until all spares are ready, does it, and compares what is shown before and after.

    Raises:
        DeltalightError: the room does not come back, or a spare is never ready.
    """
    installation = run.installation
    installation.wait_for_spares(quiet_s=LONGEST_REST_S if run.hosts is None else SHORT_S)
    picture, epoch, server = settled(installation, ROOM), installation.epoch(ROOM), installation.server(ROOM)
    present, load = installation.processes(), os.getloadavg()[0]
    act.prepare(run)
    began_s = time.monotonic()
    act.do(run)
    wait_for(lambda: is_gone(server), "The end of a render server")
    gone_ns = time.time_ns()
    wait_for(lambda: _back_s(run, began_s, gone_ns) is not None, "A picture of the next render server")
    back_s = _back_s(run, began_s, gone_ns)
    assert back_s is not None
    flow = run.viewer.flow(began_s, back_s + 1e-6)
    record = ActRecord(
        placer=run.placer,
        act=name,
        gap_s=flow.longest_gap_s if act.goes_on else back_s - began_s,
        by_spare=installation.server(ROOM) in present,
        same_picture=settled(installation, ROOM) == picture,
        epoch_before=epoch,
        epoch_after=installation.epoch(ROOM),
        load=load,
    )
    act.undo(run)
    return record


def _back_s(run: Run, began_s: float, gone_ns: int) -> float | None:
    """When the first picture came of a frame that was captured after the old render server's end."""
    seen = run.viewer.between(began_s, float("inf"))
    return next((each.at_s for each in seen if each.capture_ns > gone_ns), None)


def _kill_server(run: Run) -> None:
    os.kill(run.installation.server(ROOM).pid, signal.SIGKILL)


def _kill_host(run: Run) -> None:
    assert run.hosts is not None
    run.hosts.kill(run.host)


def _add_host(run: Run) -> None:
    assert run.hosts is not None
    run.hosts.add()
    names = run.hosts.networks.keys()
    wait_for(lambda: {each.host for each in run.installation.directory.rooms().slots} == names, "A new host")


def _replace_free_host(run: Run) -> None:
    """Kills the host without a room and starts another, which has no spare yet."""
    assert run.hosts is not None
    slots = run.installation.directory.rooms().slots
    run.hosts.kill(next(slot.host for slot in slots if slot.room is None))
    _add_host(run)


def _move(run: Run) -> None:
    run.installation.directory.command("move", ROOM)


def _drain_and_start(run: Run) -> None:
    directory, server = run.installation.directory, run.installation.server(ROOM)
    directory.command("drain", ROOM)
    wait_for(lambda: is_gone(server), "The end of a drained room")
    directory.command("start", ROOM)


def _drain_host(run: Run) -> None:
    run.installation.directory.host_command("drain-host", run.host)


def _undrain_hosts(run: Run) -> None:
    directory = run.installation.directory
    for host in {slot.host for slot in directory.rooms().slots if slot.drained}:
        directory.host_command("undrain-host", host)


LOCAL_ACTS = {
    "kill-server": Act("kill -9 of the render server", HERE_S, _kill_server),
    "move": Act("move to a free slot", HERE_S, _move, goes_on=True),
    "drain-start": Act("drain, and start once it is gone", HERE_S, _drain_and_start),
}
RAY_ACTS = {
    "kill-server": Act("kill -9 of the render server", HERE_S, _kill_server),
    "kill-host": Act("kill -9 of its host's raylet", OVER_HOSTS_S, _kill_host, _add_host),
    "kill-host-cold": Act(
        "kill -9 of its host's raylet, as soon as another host has started",
        OVER_HOSTS_S,
        _kill_host,
        _add_host,
        _replace_free_host,
        is_warm=False,
    ),
    "move": Act("move to another host", OVER_HOSTS_S, _move, goes_on=True),
    "drain-host": Act("drain its host", OVER_HOSTS_S, _drain_host, _undrain_hosts, goes_on=True),
}
ACTS = {"local": LOCAL_ACTS, "ray": RAY_ACTS}
