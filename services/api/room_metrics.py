"""Measurements of all rooms for Prometheus: where they run, why they wait, and how long their pictures were away."""

import threading
import time
from collections import Counter as Counts
from collections.abc import Callable, Iterable

from prometheus_client import CollectorRegistry, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from deltalight.services.rooms.status import RoomList, RoomStatus, SlotStatus

STATES = ("waiting", "starting", "running", "failed")
_GAP_SECONDS = (0.25, 0.5, 1, 2, 3, 5, 8, 15, 30, 60, 300)
_FRAME_SECONDS = (0.005, 0.01, 0.02, 0.033, 0.05, 0.1, 0.2, 0.5, 1, 2)


class RoomMetrics:
    """The measurements of a web process's rooms; `rooms` tells how they are. Any thread may note something."""

    def __init__(self, rooms: Callable[[], RoomList], refused: Callable[[], int] = lambda: 0) -> None:
        self._registry = CollectorRegistry()
        self._registry.register(_Placed(rooms, refused))
        self._gaps = Histogram(
            "deltalight_room_gap_seconds",
            "Time without a picture while a room's render server was replaced, seconds.",
            ("room",),
            buckets=_GAP_SECONDS,
            registry=self._registry,
        )
        self._frames = Histogram(
            "deltalight_room_frame_seconds",
            "Time from a frame's arrival at the render server to its picture, seconds.",
            ("room",),
            buckets=_FRAME_SECONDS,
            registry=self._registry,
        )
        self._newest_s: dict[str, float] = {}  # when the newest picture of each room came
        self._replaced: set[str] = set()  # rooms whose next picture ends a gap
        self._lock = threading.Lock()

    def note_replaced(self, room: str) -> None:
        """Notes that a room's render server is another from now on, or is gone."""
        with self._lock:
            if room in self._newest_s:
                self._replaced.add(room)

    def note_frame(self, room: str, rendering_s: float) -> None:
        """Notes a picture, and how long it took the render server."""
        now_s = time.monotonic()
        with self._lock:
            before_s, self._newest_s[room] = self._newest_s.get(room, now_s), now_s
            ends_gap = room in self._replaced
            self._replaced.discard(room)
        self._frames.labels(room).observe(rendering_s)
        gaps = self._gaps.labels(
            room
        )  # there from the first picture on, so that the first gap is an increase
        if ends_gap:
            gaps.observe(now_s - before_s)

    def text(self) -> bytes:
        """Returns all measurements in the text format of Prometheus."""
        return generate_latest(self._registry)


class _Placed(Collector):
    """Collects what the directory says."""

    def __init__(self, rooms: Callable[[], RoomList], refused: Callable[[], int]) -> None:
        self._rooms, self._refused = rooms, refused

    def collect(self) -> Iterable[Metric]:
        """Returns all metric families."""
        found = self._rooms()
        yield from _rooms(found.rooms)
        yield _slots(found.slots)
        text = "Outdated endpoints received from the directory."
        yield CounterMetricFamily("deltalight_rooms_stale_endpoints", text, value=self._refused())


def _rooms(rooms: Iterable[RoomStatus]) -> Iterable[Metric]:
    state = GaugeMetricFamily(
        "deltalight_room_state", "1 = the room is in this state.", labels=["room", "state"]
    )
    waits = GaugeMetricFamily(
        "deltalight_room_waits",
        "1 = the room is waiting: for a slot, or to be started after it was drained or failed.",
        labels=["room", "reason"],
    )
    restarts = CounterMetricFamily(
        "deltalight_room_restarts", "How often a room's render server was lost.", labels=["room"]
    )
    for room in rooms:
        for each in STATES:
            state.add_metric([room.name, each], float(room.state == each))
        for reason in ("slot", "drained", "failed"):
            waits.add_metric([room.name, reason], float(room.waits_for == reason))
        restarts.add_metric([room.name], room.restarts)
    return state, waits, restarts


def _slots(slots: Iterable[SlotStatus]) -> Metric:
    found = GaugeMetricFamily("deltalight_slots", "Slots of a host, by use.", labels=["host", "use"])
    uses = Counts((slot.host, _use(slot)) for slot in slots)
    for host in sorted({host for host, _ in uses}):
        for use in ("used", "free", "drained"):
            found.add_metric([host, use], uses[host, use])
    return found


def _use(slot: SlotStatus) -> str:
    if slot.room is not None:
        return "used"
    return "drained" if slot.drained else "free"
