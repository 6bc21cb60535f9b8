"""A fleet of rooms on paper: placement, failures, start storms and the load of the control plane, by discrete events.

`python -m deltalight.benchmarks.fleet` simulates 1 000 rooms on 200 GPUs and prints what it finds, and which resource
is exhausted first when the fleet grows. Each keeper has a directory, web processes and a Ray cluster of its own: two
keepers of one cluster would hand out the same slots. What a start, a picture, an answer of the directory and an actor
of Ray cost was measured (`Costs`); how often hardware fails is from the literature, everything else of `Fleet` an
assumption, to be changed.
"""

import heapq
import itertools
import json
import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from statistics import mean, quantiles
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from deltalight.services.rooms.rooms_file import MAX_ROOMS

RESULTS = Path(__file__).parent / "results"
DAY_S, HOUR_S = 86_400.0, 3600.0
FOLLOWER_POLL_S = 0.2  # of a web process, `follower.POLL_INTERVAL_S`


@dataclass(frozen=True)
class Costs:
    """What was measured: starts (seconds, all that were seen), picture and answer sizes (bytes), answers (seconds).

    An answer of the directory about n rooms takes `answer_s + n * answer_s_per_room`. A web process takes
    `web_share_per_room` of a core for each room that it follows, without pictures. Ray's control process (GCS) takes
    `gcs_s_per_actor` seconds for each actor, and of a core `gcs_idle_share` and `gcs_share_per_host`.
    """

    warm_starts_s: tuple[float, ...]
    cold_starts_s: tuple[float, ...]
    node_frame_bytes: float
    picture_bytes: float
    answer_s: float
    answer_s_per_room: float
    answer_bytes_per_room: float
    web_share_per_room: float
    gcs_s_per_actor: float
    gcs_idle_share: float
    gcs_share_per_host: float

    @classmethod
    def measured(cls, results: Path = RESULTS) -> "Costs":
        """Reads the reports in `results`: starts of the soak under kills, the others of the fleet's own."""
        soak = json.loads((results / "soak-kills-llvmpipe-2cores.json").read_text())
        kills = [each["outcome"] for each in soak["faults"] if each["name"] == "kill-server"]
        warm = tuple(each["back_s"] for each in kills if each["by_spare"])
        cold = tuple(each["back_s"] for each in kills if not each["by_spare"])
        own = json.loads((results / "fleet-costs-2cores.json").read_text())
        return cls(warm, cold, **{each.name: own[each.name] for each in fields(cls)[2:]})

    def answer_for(self, rooms: int) -> float:
        """Returns the time of an answer about so many rooms, s."""
        return self.answer_s + rooms * self.answer_s_per_room


@dataclass(frozen=True)
class Fleet:
    """A fleet. Rates are per day.

    `gpu_failures` and `host_failures` (per GPU and per host): 419 unexpected interruptions of 16 384 GPUs in 54 days,
    58.7 % of them by GPUs (Grattafiori et al. 2024, The Llama 3 Herd of Models, 3.3.4); the rest is counted to hosts
    of eight. `crashes` (per room), repairs, detection and the network are assumptions.
    """

    rooms: int = 1000
    gpus: int = 200
    gpus_per_host: int = 8
    hosts_per_rack: int = 4
    slots_per_gpu: int = 6
    starts_at_once: int = 8  # of a host: each takes the better part of two cores
    crashes: float = 1 / 30
    gpu_failures: float = 419 * 0.587 / 16_384 / 54
    host_failures: float = 419 * 0.413 / (16_384 / 8) / 54
    repair_h: float = 24.0
    crash_detection_s: float = 0.1
    host_detection_s: float = 5.0
    frames_per_s: float = 30.0
    viewers_per_room: float = 3.0
    rooms_per_web_process: int = 40
    rooms_per_keeper: int = MAX_ROOMS
    rack_uplink_gbit_s: float = 200.0

    @property
    def hosts(self) -> int:
        """The number of hosts; the last may have fewer GPUs."""
        return -(-self.gpus // self.gpus_per_host)

    @property
    def slots(self) -> int:
        """The number of rooms that run at once."""
        return self.gpus * self.slots_per_gpu

    @property
    def keepers(self) -> int:
        """The number of keepers; rooms and hosts are dealt out to them in turn."""
        return -(-self.rooms // self.rooms_per_keeper)

    @property
    def rooms_of_keeper(self) -> int:
        """The number of rooms of the keeper with the most."""
        return -(-self.rooms // self.keepers)

    @property
    def slots_of_keeper(self) -> int:
        """The number of slots of the keeper with the fewest: those of its hosts."""
        gpus = [0] * self.keepers
        for gpu in range(self.gpus):
            gpus[gpu // self.gpus_per_host % self.keepers] += 1
        return min(gpus) * self.slots_per_gpu


class Events:
    """Actions at times, in their order; `now_s` is that of the action being done."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._order = itertools.count()  # of actions at one time
        self._waiting: list[tuple[float, int, Callable[[], None]]] = []

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        """Does `action` after a delay."""
        heapq.heappush(self._waiting, (self.now_s + delay_s, next(self._order), action))

    def run(self, until_s: float) -> None:
        """Does everything up to a time."""
        while self._waiting and self._waiting[0][0] <= until_s:
            self.now_s, _, action = heapq.heappop(self._waiting)
            action()
        self.now_s = until_s


@dataclass(eq=False)
class Servers:
    """`count` servers with one queue, first come, first served; `waits_s` end with service, `sojourns_s` after it."""

    events: Events
    count: int
    busy: int = 0
    waits_s: list[float] = field(default_factory=list)
    sojourns_s: list[float] = field(default_factory=list)
    _queue: deque[tuple[float, float, Callable[[], None]]] = field(default_factory=deque)

    def ask(self, service_s: float, done: Callable[[], None] = lambda: None) -> None:
        """Asks for a service of this length; `done` is called at its end."""
        self._queue.append((self.events.now_s, service_s, done))
        self._serve()

    def _serve(self) -> None:
        while self._queue and self.busy < self.count:
            came_s, service_s, done = self._queue.popleft()
            self.busy += 1
            self.waits_s.append(self.events.now_s - came_s)
            self.events.after(service_s, lambda came_s=came_s, done=done: self._end(came_s, done))  # type: ignore[misc]

    def _end(self, came_s: float, done: Callable[[], None]) -> None:
        self.busy -= 1
        self.sojourns_s.append(self.events.now_s - came_s)
        done()
        self._serve()


@dataclass(eq=False)
class _Gpu:
    host: int
    broken: int = 0  # by itself, by its host
    rooms: set[int] = field(default_factory=set)


@dataclass(frozen=True)
class Outcome:
    """What became of a fleet: lost rooms by cause, gaps (s) from loss to picture, and waits for a slot."""

    days: float
    losses: dict[str, int]
    gaps_s: tuple[float, ...]
    waits_for_slot_s: tuple[float, ...]
    most_waiting: int
    first_start_s: float
    downtime_share: float

    def gap_s(self, percent: int) -> float:
        """Returns a percentile of the gaps, s; 0 without any."""
        return quantiles(self.gaps_s, n=100)[percent - 1] if len(self.gaps_s) > 1 else sum(self.gaps_s)


class FleetSimulation:
    """All rooms of a fleet for some days, beginning with all of them starting at once."""

    def __init__(self, fleet: Fleet, costs: Costs, seed: int = 1) -> None:
        self._fleet, self._costs = fleet, costs
        self._random = random.Random(seed)
        self._events = Events()
        self._gpus = [_Gpu(number // fleet.gpus_per_host) for number in range(fleet.gpus)]
        self._starts = [Servers(self._events, fleet.starts_at_once) for _ in range(fleet.hosts)]
        self._controls = [Servers(self._events, 1) for _ in range(fleet.keepers)]
        self._gpus_of = [
            [number for number, gpu in enumerate(self._gpus) if gpu.host % fleet.keepers == keeper]
            for keeper in range(fleet.keepers)
        ]
        self._warm = [True] * fleet.hosts
        self._place: dict[int, int] = {}
        self._placed = [0] * fleet.rooms  # how often: what happens to an earlier start of a room is void
        self._lost_s: dict[int, float] = dict.fromkeys(range(fleet.rooms), 0.0)
        self._waiting: list[deque[tuple[int, float]]] = [deque() for _ in range(fleet.keepers)]
        self._losses = {"crash": 0, "gpu": 0, "host": 0}
        self._gaps_s: list[float] = []
        self._waits_s: list[float] = []
        self._most_waiting = 0
        self._down_s = 0.0
        self._first_start_s = 0.0

    def run(self, days: float) -> Outcome:
        """Simulates and returns what happened."""
        for room in range(self._fleet.rooms):
            self._want(room)
        self._fail_again("crash", self._fleet.crashes * self._fleet.rooms, self._crash)
        self._fail_again("gpu", self._fleet.gpu_failures * self._fleet.gpus, self._lose_gpu)
        self._fail_again("host", self._fleet.host_failures * self._fleet.hosts, self._lose_host)
        self._events.run(days * DAY_S)
        down_s = self._down_s + sum(self._events.now_s - since_s for since_s in self._lost_s.values())
        return Outcome(
            days,
            self._losses,
            tuple(self._gaps_s),
            tuple(self._waits_s),
            self._most_waiting,
            self._first_start_s,
            down_s / (self._fleet.rooms * days * DAY_S),
        )

    def _fail_again(self, kind: str, per_day: float, fail: Callable[[], int]) -> None:
        """Has failures come as a Poisson process."""
        if per_day <= 0:
            return

        def failed() -> None:
            self._losses[kind] += fail()
            self._events.after(self._random.expovariate(per_day) * DAY_S, failed)

        self._events.after(self._random.expovariate(per_day) * DAY_S, failed)

    def _crash(self) -> int:
        room = self._random.randrange(self._fleet.rooms)
        if room not in self._place:
            return 0
        self._lose(room, self._fleet.crash_detection_s)
        return 1

    def _lose_gpu(self) -> int:
        return self._break([self._random.randrange(self._fleet.gpus)], self._fleet.crash_detection_s)

    def _lose_host(self) -> int:
        host = self._random.randrange(self._fleet.hosts)
        gpus = [number for number, gpu in enumerate(self._gpus) if gpu.host == host]
        return self._break(gpus, self._fleet.host_detection_s)

    def _break(self, gpus: Sequence[int], detection_s: float) -> int:
        rooms = sorted(room for number in gpus for room in self._gpus[number].rooms)
        for number in gpus:
            self._gpus[number].broken += 1
        for room in rooms:
            self._lose(room, detection_s)

        def repair() -> None:
            for number in gpus:
                self._gpus[number].broken -= 1
            self._place_waiting(self._gpus[gpus[0]].host % self._fleet.keepers)

        self._events.after(self._fleet.repair_h * HOUR_S, repair)
        return len(rooms)

    def _lose(self, room: int, detection_s: float) -> None:
        self._gpus[self._place.pop(room)].rooms.discard(room)
        self._lost_s.setdefault(room, self._events.now_s)
        self._placed[room] += 1
        self._events.after(detection_s, lambda: self._want(room))

    def _want(self, room: int) -> None:
        keeper = room % self._fleet.keepers
        self._waiting[keeper].append((room, self._events.now_s))
        self._place_waiting(keeper)

    def _place_waiting(self, keeper: int) -> None:
        """Places a keeper's rooms on its GPUs with the fewest, as long as there are slots."""
        waiting = self._waiting[keeper]
        while waiting:
            number = min(self._gpus_of[keeper], key=self._load, default=None)
            if number is None or self._load(number) >= self._fleet.slots_per_gpu:
                break
            room, since_s = waiting.popleft()
            self._waits_s.append(self._events.now_s - since_s)
            self._start(room, number)
        self._most_waiting = max(self._most_waiting, sum(map(len, self._waiting)))

    def _load(self, number: int) -> float:
        gpu = self._gpus[number]
        return float("inf") if gpu.broken else len(gpu.rooms)

    def _start(self, room: int, number: int) -> None:
        gpu = self._gpus[number]
        gpu.rooms.add(room)
        self._place[room] = number
        self._placed[room] += 1
        placed, is_first = self._placed[room], self._events.now_s == 0
        is_warm = self._warm[gpu.host] and not is_first
        seconds = self._random.choice(self._costs.warm_starts_s if is_warm else self._costs.cold_starts_s)
        if is_warm:  # its spare is gone, and the next one starts beside the rooms
            self._warm[gpu.host] = False
            spare_s = self._random.choice(self._costs.cold_starts_s)
            self._starts[gpu.host].ask(spare_s, lambda: self._have_spare(gpu.host))
        control = self._controls[room % self._fleet.keepers]
        control.ask(
            self._costs.gcs_s_per_actor,
            lambda: self._starts[gpu.host].ask(seconds, lambda: self._shown(room, placed)),
        )

    def _have_spare(self, host: int) -> None:
        self._warm[host] = True

    def _shown(self, room: int, placed: int) -> None:
        if self._placed[room] != placed:  # it was lost again while it started
            return
        since_s = self._lost_s.pop(room)
        gap_s = self._events.now_s - since_s
        self._down_s += gap_s
        if since_s == 0:
            self._first_start_s = max(self._first_start_s, self._events.now_s)
        else:
            self._gaps_s.append(gap_s)


def directory_load(fleet: Fleet, costs: Costs) -> float:
    """Returns the fraction of a directory's one thread that web processes take which each ask five times a second."""
    processes = -(-fleet.rooms_of_keeper // fleet.rooms_per_web_process)
    return processes / FOLLOWER_POLL_S * costs.answer_for(fleet.rooms_of_keeper)


def web_traffic_gbit_s(fleet: Fleet, costs: Costs) -> float:
    """Returns what a web process receives (the pictures of all rooms of its keeper) and sends, Gbit/s."""
    pictures = fleet.rooms_of_keeper + fleet.rooms_per_web_process * fleet.viewers_per_room
    return pictures * fleet.frames_per_s * costs.picture_bytes * 8 / 1e9


def gcs_load(fleet: Fleet, costs: Costs) -> float:
    """Returns the fraction of a core that the control process of a keeper's Ray cluster takes while idle."""
    return costs.gcs_idle_share + -(-fleet.hosts // fleet.keepers) * costs.gcs_share_per_host


def rack_traffic_gbit_s(fleet: Fleet, costs: Costs) -> float:
    """Returns what goes through the uplink of a rack whose slots are full, both ways, Gbit/s."""
    rooms = fleet.hosts_per_rack * fleet.gpus_per_host * fleet.slots_per_gpu
    per_room = costs.node_frame_bytes + (1 + fleet.viewers_per_room) * costs.picture_bytes
    return rooms * fleet.frames_per_s * per_room * 8 / 1e9


def loads(fleet: Fleet, costs: Costs) -> dict[str, float]:
    """Returns how much of each resource a fleet takes; above 1 it is exhausted."""
    directory_bits = directory_load(fleet, costs) / costs.answer_for(fleet.rooms_of_keeper)
    directory_bits *= fleet.rooms_of_keeper * costs.answer_bytes_per_room * 8
    return {
        "slots": fleet.rooms / fleet.slots,
        "slots of the keeper with the fewest": fleet.rooms_of_keeper / max(1, fleet.slots_of_keeper),
        "slots with one rack lost": fleet.rooms
        / max(1, fleet.slots - fleet.hosts_per_rack * fleet.gpus_per_host * fleet.slots_per_gpu),
        "directory, its thread": directory_load(fleet, costs),
        "directory, a 10 Gbit/s port": directory_bits / 10e9,
        "web process, a core for following rooms": fleet.rooms_of_keeper * costs.web_share_per_room,
        "web process, a 10 Gbit/s port": web_traffic_gbit_s(fleet, costs) / 10,
        "Ray's control process, a core": gcs_load(fleet, costs),
        "uplink of a rack": rack_traffic_gbit_s(fleet, costs) / fleet.rack_uplink_gbit_s,
    }


def simulate(
    rooms: Annotated[int, typer.Option(min=1)] = Fleet.rooms,
    gpus: Annotated[int, typer.Option(min=1)] = Fleet.gpus,
    *,
    slots_per_gpu: Annotated[int, typer.Option(min=1)] = Fleet.slots_per_gpu,
    rooms_per_keeper: Annotated[int, typer.Option(min=1)] = Fleet.rooms_per_keeper,
    days: Annotated[float, typer.Option(min=0.01)] = 365.0,
    seed: int = 1,
    out: Annotated[Path | None, typer.Option(help="File for the figures as JSON.")] = None,
) -> None:
    """Simulate a fleet and print what is lost, for how long, and what is exhausted first."""
    fleet = Fleet(rooms=rooms, gpus=gpus, slots_per_gpu=slots_per_gpu, rooms_per_keeper=rooms_per_keeper)
    costs = Costs.measured()
    outcome = FleetSimulation(fleet, costs, seed).run(days)
    taken = loads(fleet, costs)
    if out is not None:
        found = {"fleet": asdict(fleet), "seed": seed, "days": days, "loads": taken}
        out.write_text(json.dumps({**found, "figures": figures(outcome)}, indent=1) + "\n")
    title = f"{rooms} rooms of {fleet.keepers} keepers on {gpus} GPUs, {days:g} days, seed {seed}"
    table = Table("What", title, box=None)
    for name, value in figures(outcome).items():
        table.add_row(name, value)
    for name, fraction in taken.items():
        table.add_row(f"taken: {name}", f"{100 * fraction:.1f} %")
    Console(soft_wrap=True).print(table)


def figures(outcome: Outcome) -> dict[str, str]:
    """Returns the figures of an outcome, for people."""
    waits_s = [each for each in outcome.waits_for_slot_s if each > 0]
    return {
        "start of all at once": f"{outcome.first_start_s:.1f} s",
        **{f"rooms lost a day by {kind}": f"{n / outcome.days:.2f}" for kind, n in outcome.losses.items()},
        **{f"gap, {percent} of 100": f"{outcome.gap_s(percent):.1f} s" for percent in (50, 95, 99)},
        "longest gap": f"{max(outcome.gaps_s, default=0):.1f} s",
        "most rooms that waited for a slot": str(outcome.most_waiting),
        "mean wait of those": f"{mean(waits_s) if waits_s else 0:.0f} s",
        "a room is away": f"{outcome.downtime_share * DAY_S:.2f} s a day",
    }


if __name__ == "__main__":
    typer.run(simulate)
