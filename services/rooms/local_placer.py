"""Places rooms on this host: each render server is a child process, and one warm spare waits for any of them."""

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import StatsMessage
from deltalight.services import ports
from deltalight.services.child import SPARE_AFTER_S, STOP_TIMEOUT_S, Child, ChildSpec, end_all, open_spare
from deltalight.services.rooms.placer import NoSlotError, Placement, PlacementEvent, RoomOrder, Slot
from deltalight.services.supervisor import WRONG_INPUT_EXIT_CODE
from deltalight.services.warm_spare import use_spare
from deltalight.services.watchdog import Watchdog

# The command line of a placement's render server on a device (None = the driver's first).
Command = Callable[[RoomOrder, Placement, int | None], ChildSpec]


@dataclass
class _Placed:
    placement: Placement
    child: Child
    watchdog: Watchdog | None = None
    reported: StatsMessage | None = None
    ends_s: float | None = None  # it was told to end, and is killed then

    @property
    def process(self) -> subprocess.Popen[str]:
        assert self.child.process is not None
        return self.child.process


class LocalPlacer:
    """Places each render server as a child of this process, in a slot per entry of `devices` (a `Placer`).

    With a `spare`, a command line that prepares and waits (`ChildSpec.warm`), a placement takes half of a start.
    """

    def __init__(
        self,
        devices: Sequence[int | None],
        command: Command,
        *,
        spare: ChildSpec | None = None,
        keys: Keys | None = None,
        forward: Callable[[str], None] = lambda line: print(line, file=sys.stderr, flush=True),
    ) -> None:
        self._devices = {f"slot-{number}": device for number, device in enumerate(devices, 1)}
        self._command = command
        self._spare_spec = spare
        self._keys = keys
        self._spare: subprocess.Popen[str] | None = None
        self._spare_due_s = 0.0
        self._forward = forward
        self._placed: dict[str, _Placed] = {}  # by slot
        self._used_ports: set[int] = set()

    def slots(self) -> list[Slot]:
        """Return all slots."""
        return [
            Slot(name, "default" if device is None else f"EGL {device}", self._room_in(name))
            for name, device in self._devices.items()
        ]

    def place(self, order: RoomOrder, slot: str | None = None) -> Placement:
        """Start the render server of a room (`Placer.place`)."""
        chosen = self._free_slot(slot)
        publish, control = self._fresh_ports()
        placement = Placement(
            order.room, order.epoch, chosen, ports.endpoint(publish), ports.endpoint(control)
        )
        placed = _Placed(
            placement, Child(self._command(order, placement, self._devices[chosen]), self._forward)
        )
        placed.child.spec = replace(placed.child.spec, watch=partial(self._watched, placed))
        placed.child.start(self._take_spare(placed.child.spec))
        self._placed[chosen] = placed
        self._spare_due_s = time.monotonic() + SPARE_AFTER_S
        return placement

    def release(self, placement: Placement) -> None:
        """End a render server; its slot is free once it is gone."""
        placed = self._placed.get(placement.slot)
        if placed is not None and placed.placement == placement and placed.ends_s is None:
            placed.ends_s = time.monotonic() + STOP_TIMEOUT_S
            placed.process.terminate()

    def watch(self) -> list[PlacementEvent]:
        """Return what happened since the last call; start a spare if it is time."""
        found = [event for slot in list(self._placed) for event in self._look_at(slot)]
        self._start_spare_if_due()
        return found

    def process_ids(self) -> dict[str, int]:
        """Return the process id of the render server in each slot that has one."""
        return {slot: placed.process.pid for slot, placed in self._placed.items()}

    @property
    def spare_id(self) -> int | None:
        """The process id of the spare that waits; None = there is none."""
        return None if self._spare is None else self._spare.pid

    def close(self) -> None:
        """End all render servers and the spare."""
        processes = [placed.process for placed in self._placed.values()]
        end_all([*processes, *([] if self._spare is None else [self._spare])])
        for placed in self._placed.values():
            placed.child.end_watching()
            placed.child.end_reading()
        self._placed, self._spare = {}, None

    def _room_in(self, slot: str) -> str | None:
        placed = self._placed.get(slot)
        return None if placed is None else placed.placement.room

    def _free_slot(self, wanted: str | None) -> str:
        free = [name for name in self._devices if name not in self._placed]
        if wanted is None:
            if not free:
                raise NoSlotError(f"all {len(self._devices)} slots are in use; free one or add slots.")
            return free[0]
        if wanted not in self._devices:
            raise NoSlotError(f"there is no slot {wanted}; the slots are {', '.join(self._devices)}.")
        if wanted not in free:
            raise NoSlotError(f"{wanted} is in use by {self._room_in(wanted)}; choose a free one.")
        return wanted

    def _fresh_ports(self) -> list[int]:
        """Choose ports that no placement has had, so that who still talks to a lost one reaches nobody else."""
        while True:
            found = ports.private_ports(2)
            if self._used_ports.isdisjoint(found):
                self._used_ports.update(found)
                return found

    def _watched(self, placed: _Placed, process_id: int) -> Watchdog:
        """Watch a process; its reports tell how the room is doing."""
        endpoints = placed.placement.publish, placed.placement.control
        placed.watchdog = Watchdog(process_id, *endpoints, self._keys)
        return placed.watchdog

    def _look_at(self, slot: str) -> list[PlacementEvent]:
        placed = self._placed[slot]
        placed.child.end_if_hanging()
        if placed.ends_s is not None and time.monotonic() >= placed.ends_s:
            placed.process.kill()
        code = placed.process.poll()
        if code is not None:
            return self._ended(slot, placed, code)
        newest = None if placed.watchdog is None else placed.watchdog.newest
        if placed.ends_s is not None or newest is None or newest is placed.reported:
            return []
        placed.reported = newest
        shows = newest.state in ("running", "degraded")
        return [PlacementEvent(placed.placement.epoch, "reported", newest.detail, shows)]

    def _ended(self, slot: str, placed: _Placed, code: int) -> list[PlacementEvent]:
        del self._placed[slot]
        placed.child.end_watching()
        if placed.ends_s is not None:
            return []
        said = placed.child.last_sentence()
        refused = code == WRONG_INPUT_EXIT_CODE
        detail = (
            said if refused else f"Its render server died with exit code {code}; its last line was: {said}"
        )
        return [PlacementEvent(placed.placement.epoch, "lost", detail, refused=refused)]

    def _take_spare(self, spec: ChildSpec) -> subprocess.Popen[str] | None:
        spare, self._spare = self._spare, None
        words = spec.arguments[len(ChildSpec.deltalight("").arguments) :]
        return spare if spare is not None and use_spare(spare, words) else None

    def _start_spare_if_due(self) -> None:
        """Start a spare once those that were placed have had the time to start."""
        if self._spare is not None and self._spare.poll() is not None:
            self._spare = None
            self._spare_due_s = time.monotonic() + SPARE_AFTER_S
        is_due = self._placed and time.monotonic() >= self._spare_due_s
        if self._spare_spec is not None and self._spare is None and is_due:
            self._spare = open_spare(self._spare_spec.arguments, self._spare_spec.warm)
