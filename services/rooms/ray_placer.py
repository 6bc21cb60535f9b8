"""Places rooms on the hosts of a Ray cluster: each is a detached actor, which holds a slot and its render server."""

import random
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from deltalight.services import ports
from deltalight.services.child import SPARE_AFTER_S, ChildSpec
from deltalight.services.host import HostCommands
from deltalight.services.rooms.capacity import RoomFigures
from deltalight.services.rooms.local_placer import Command
from deltalight.services.rooms.placer import (
    NoSlotError,
    Placement,
    PlacementEvent,
    RoomOrder,
    Slot,
    choose_slot,
)
from deltalight.services.rooms.ray_cluster import SLOT_RESOURCE, ClusterHost, RayCluster
from deltalight.services.rooms.render_actor import END_TIMEOUT_S, SESSION, News, RenderActor, RenderTask
from deltalight.services.rooms.slot_holder import SlotHolder

START_TIMEOUT_S = 60.0  # until an actor answers for the first time
CALLS_AT_ONCE = 3  # of an actor: news, end and process_id
HOSTS_INTERVAL_S = 1.0  # between looks for hosts that lack a spare


@dataclass
class _Placed:
    placement: Placement
    host: ClusterHost
    actor: Any
    news: Any  # the answer that is awaited
    late_s: float | None  # when an actor that has not answered yet is given up
    holder: Any = None  # of the slot, where a spare became the actor
    ending: Any = None  # the answer of `end`


@dataclass
class _Spare:
    actor: Any
    waits: Any  # the answer that is awaited


class RayPlacer:
    """Places each render server by an actor on a host of the cluster (a `Placer`), in a slot that the host offers.

    A slot is a whole `render_slot`, never a part of a GPU: the actor chooses the EGL device itself. With `commands`
    the actor finds the keys of its host; all hosts of a fleet have the same. A host that does not have what it
    claims, by the `figures` of a room if they are known, is refused: it has no slots until Ray starts there anew.

    With a `spare`, a command line that prepares and waits (`ChildSpec.warm`), each host has one, without a room too:
    that is where rooms go whose host is lost.
    """

    def __init__(
        self,
        cluster: RayCluster,
        command: Command,
        commands: HostCommands,
        *,
        figures: RoomFigures | None = None,
        spare: ChildSpec | None = None,
        forward: Callable[[str], None] = lambda line: print(line, file=sys.stderr, flush=True),
    ) -> None:
        self._figures, self._spare_spec = figures, spare
        self._spares: dict[str, _Spare] = {}  # by Ray's id of the host, as the next
        self._spare_due_s: dict[str, float] = {}
        self._hosts_due_s = 0.0
        self._refused: dict[str, str] = {}  # why, by Ray's id of the host
        self._cluster = cluster
        self._command = command
        self._commands = commands
        self._forward = forward
        self._placed: dict[str, _Placed] = {}  # by slot
        self._used: dict[str, deque[int]] = {}  # ports, by address

    def slots(self) -> list[Slot]:
        """Returns the slots of all hosts that live and are not refused."""
        return [slot for host in self._hosts() for slot in self._slots_of(host)]

    def place(self, order: RoomOrder, slot: str | None = None) -> Placement:
        """Starts the render server of a room (`Placer.place`)."""
        hosts = self._hosts()
        try:
            chosen = choose_slot([each for host in hosts for each in self._slots_of(host)], order, slot)
        except NoSlotError as fault:
            raise NoSlotError(" ".join([str(fault), *self._refusals()])) from None
        host = next(host for host in hosts if host.name == chosen.host)
        placement = Placement(
            order.room, order.epoch, chosen.name, self._fresh_endpoint(host), self._fresh_endpoint(host)
        )
        spec = self._command(replace(order, session_file=SESSION), placement, None)
        rank = int(chosen.name.rpartition("/")[2]) - 1
        task = RenderTask(placement, spec, _text(order), self._commands, rank, host, self._figures)
        self._placed[chosen.name] = self._start(task, f"{order.room}-{order.epoch}")
        self._spare_due_s[host.node_id] = time.monotonic() + SPARE_AFTER_S
        return placement

    def _start(self, task: RenderTask, name: str) -> _Placed:
        late_s, host = time.monotonic() + START_TIMEOUT_S, task.host
        spare = self._spares.pop(host.node_id, None)
        if spare is None:
            actor = self._remote(RenderActor, host, 1, name=name, lifetime="detached").remote(task)
            return _Placed(task.placement, host, actor, actor.news.remote(), late_s)
        holder = self._remote(SlotHolder, host, 1).remote()
        return _Placed(task.placement, host, spare.actor, spare.actor.begin.remote(task), late_s, holder)

    def release(self, placement: Placement) -> None:
        """Ends a render server; its slot is free once it is gone."""
        placed = self._placed.get(placement.slot)
        if placed is not None and placed.placement == placement and placed.ending is None:
            placed.ending = placed.actor.end.remote()
            placed.late_s = time.monotonic() + END_TIMEOUT_S

    def watch(self) -> list[PlacementEvent]:
        """Returns what happened since the last call; starts spares where it is time."""
        self._keep_spares()
        ray = self._cluster.ray
        awaited = [placed.ending or placed.news for placed in self._placed.values()]
        if not awaited:
            return []
        ready = set(ray.wait(awaited, num_returns=len(awaited), timeout=0)[0])
        return [event for slot in list(self._placed) for event in self._look_at(slot, ready)]

    def process_ids(self) -> dict[str, int]:
        """Returns the process id, on its host, of the render server in each slot that has one."""
        ray = self._cluster.ray
        return {slot: ray.get(placed.actor.process_id.remote()) for slot, placed in self._placed.items()}

    def close(self) -> None:
        """Ends all render servers and spares; the cluster stays."""
        spares = list(self._spares.values())
        for placed in list(self._placed.values()):
            self.release(placed.placement)
        endings = [placed.ending for placed in self._placed.values()]
        endings += [spare.actor.end.remote() for spare in spares]
        if endings:
            self._cluster.ray.wait(endings, num_returns=len(endings), timeout=END_TIMEOUT_S)
        for slot in list(self._placed):
            self._forget(slot)
        for spare in spares:
            self._cluster.ray.kill(spare.actor)
        self._spares = {}

    def _hosts(self) -> list[ClusterHost]:
        return [host for host in self._cluster.hosts() if host.node_id not in self._refused]

    def _refusals(self) -> list[str]:
        """Says why hosts that live are refused."""
        hosts = (self._refused.get(host.node_id) for host in self._cluster.hosts())
        return [f"{why[:1].upper()}{why[1:]}" for why in hosts if why is not None]

    def _slots_of(self, host: ClusterHost) -> list[Slot]:
        return [self._slot_of(host, number) for number in range(1, host.slots + 1)]

    def _slot_of(self, host: ClusterHost, number: int) -> Slot:
        """Describes a slot; its device, which its number chooses among those there, may be another one's, too."""
        name = f"{host.name}/{number}"
        return Slot(name, f"chosen there for slot {number}", self._room_in(name), host.name, host.labels)

    def _room_in(self, slot: str) -> str | None:
        placed = self._placed.get(slot)
        return None if placed is None else placed.placement.room

    def _keep_spares(self) -> None:
        """Starts the spare of each host whose rooms have had the time to start, and forgets those that died.

        A host that has just come may be about to get a room that waits: its spare is started at the second look.
        """
        now_s = time.monotonic()
        for node_id in [each for each, spare in self._spares.items() if not self._waits(spare)]:
            self._end_spare(node_id)
            self._spare_due_s[node_id] = now_s + SPARE_AFTER_S
        if self._spare_spec is None or now_s < self._hosts_due_s:
            return
        self._hosts_due_s = now_s + HOSTS_INTERVAL_S
        for host in self._hosts():
            due_s = self._spare_due_s.setdefault(host.node_id, self._hosts_due_s)
            if host.node_id not in self._spares and now_s >= due_s:
                self._spares[host.node_id] = self._started_spare(self._spare_spec, host)

    def _started_spare(self, spec: ChildSpec, host: ClusterHost) -> _Spare:
        name = f"spare-{host.node_id[:12]}-{time.monotonic():.3f}"
        actor = self._remote(RenderActor, host, 0, name=name, lifetime="detached").remote(None, spec)
        return _Spare(actor, actor.waits.remote())

    def _end_spare(self, node_id: str) -> None:
        spare = self._spares.pop(node_id, None)
        if spare is not None:
            self._cluster.ray.kill(spare.actor)

    def _waits(self, spare: _Spare) -> bool:
        ray = self._cluster.ray
        if not ray.wait([spare.waits], timeout=0)[0]:
            return True
        try:
            lives = bool(ray.get(spare.waits))
        except ray.exceptions.RayError:
            return False
        spare.waits = spare.actor.waits.remote()
        return lives

    def _remote(self, kind: type, host: ClusterHost, slots: int, **more: str) -> Any:  # noqa: ANN401 (Ray's)
        ray = self._cluster.ray
        there = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(host.node_id, soft=False)
        return ray.remote(kind).options(
            num_cpus=0,
            resources={SLOT_RESOURCE: slots} if slots else {},
            max_restarts=0,  # who runs where is the keeper's: a new placement has a new epoch
            max_concurrency=CALLS_AT_ONCE,
            scheduling_strategy=there,
            **more,
        )

    def _fresh_endpoint(self, host: ClusterHost) -> str:
        """Chooses a port that no late placement on the host had; its actor sees whether it is free there."""
        used = self._used.setdefault(host.address, ports.used_ports())
        while (port := random.choice(ports.PRIVATE_PORTS)) in used:
            pass
        used.append(port)
        return reachable_endpoint(self._commands, host.address, port)

    def _look_at(self, slot: str, ready: set[Any]) -> list[PlacementEvent]:
        placed = self._placed[slot]
        is_late = placed.late_s is not None and time.monotonic() >= placed.late_s
        if placed.ending is not None:
            if placed.ending in ready or is_late:
                self._forget(slot)
            return []
        if placed.news not in ready:
            return self._lost(slot, f"Its host {placed.host.name} does not start it.") if is_late else []
        return self._hear(slot)

    def _hear(self, slot: str) -> list[PlacementEvent]:
        placed, ray = self._placed[slot], self._cluster.ray
        try:
            news: News = ray.get(placed.news)
        except ray.exceptions.RayError as fault:
            lives = placed.host.node_id in {host.node_id for host in self._cluster.hosts()}
            what = f"its actor there ended ({type(fault).__name__})" if lives else "that is gone"
            return self._lost(slot, f"It ran on {placed.host.name}, and {what}.")
        for line in news.lines:
            self._forward(line)
        for event in news.events:
            if event.host_refused:
                self._refused[placed.host.node_id] = event.detail
                self._end_spare(placed.host.node_id)
        if any(event.kind == "lost" for event in news.events):
            self._forget(slot)
        else:
            placed.news, placed.late_s = placed.actor.news.remote(), None
        return list(news.events)

    def _lost(self, slot: str, why: str) -> list[PlacementEvent]:
        epoch = self._placed[slot].placement.epoch
        self._forget(slot)
        return [PlacementEvent(epoch, "lost", why)]

    def _forget(self, slot: str) -> None:
        """Ends the actor, which takes its render server with it, and frees its slot."""
        placed = self._placed.pop(slot)
        for actor in (placed.actor, placed.holder):
            if actor is not None:
                self._cluster.ray.kill(actor)


def reachable_endpoint(commands: HostCommands, address: str, port: int) -> str:
    """Returns the endpoint of a port, with the name of the key that the fleet's hosts share where it leaves the host.

    Raises:
        DeltalightError: it leaves the host, and there is no key.
    """
    endpoint = f"tcp://{address}:{port}"
    keys = commands.keys([endpoint])
    return endpoint if keys is None else f"tcp://{keys.name}@{address}:{port}"


def _text(order: RoomOrder) -> str:
    return order.session_file.read_text() if order.session_file.exists() else ""
