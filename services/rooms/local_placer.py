"""Places rooms on this host: each render server is a child process, and one warm spare waits for any of them."""

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from deltalight.protocol.keys import Keys
from deltalight.services import ports
from deltalight.services.child import SPARE_AFTER_S, ChildSpec, end_all, open_spare, take_spare
from deltalight.services.process import Process
from deltalight.services.rooms.placer import Placement, PlacementEvent, RoomOrder, Slot, choose_slot
from deltalight.services.rooms.render_process import RenderProcess
from deltalight.services.warm_spare import rehearse_spare

# The command line of a placement's render server on a device (None = the driver's first).
Command = Callable[[RoomOrder, Placement, int | None], ChildSpec]


class LocalPlacer:
    """Places each render server as a child of this process, in a slot per entry of `devices` (a `Placer`).

    With a `spare`, a command line that prepares and waits (`ChildSpec.warm`), a placement takes half of a start, and
    one of the room that it rehearses (the one that has been placed for longest) a fraction.
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
        self._spare: Process | None = None
        self._spare_due_s = 0.0
        self._forward = forward
        self._placed: dict[str, RenderProcess] = {}  # by slot
        self._used_ports = ports.used_ports()

    def slots(self) -> list[Slot]:
        """Returns all slots."""
        return [
            Slot(name, "default" if device is None else f"EGL {device}", self._room_in(name))
            for name, device in self._devices.items()
        ]

    def place(self, order: RoomOrder, slot: str | None = None) -> Placement:
        """Starts the render server of a room (`Placer.place`)."""
        chosen = choose_slot(self.slots(), order, slot).name
        publish, control = self._fresh_ports()
        placement = Placement(
            order.room, order.epoch, chosen, ports.endpoint(publish), ports.endpoint(control)
        )
        spec = self._command(order, placement, self._devices[chosen])
        self._placed[chosen] = RenderProcess(
            placement, spec, self._keys, self._forward, self._take_spare(spec)
        )
        self._spare_due_s = time.monotonic() + SPARE_AFTER_S
        return placement

    def release(self, placement: Placement) -> None:
        """Ends a render server; its slot is free once it is gone."""
        placed = self._placed.get(placement.slot)
        if placed is not None and placed.placement == placement:
            placed.end()

    def watch(self) -> list[PlacementEvent]:
        """Returns what happened since the last call; starts a spare if it is time."""
        found = [event for slot in list(self._placed) for event in self._look_at(slot)]
        self._start_spare_if_due()
        return found

    def process_ids(self) -> dict[str, int]:
        """Returns the process id of the render server in each slot that has one."""
        return {slot: placed.process.pid for slot, placed in self._placed.items()}

    @property
    def spare_id(self) -> int | None:
        """The process id of the spare that waits; None = there is none."""
        return None if self._spare is None else self._spare.pid

    def close(self) -> None:
        """Ends all render servers and the spare."""
        processes = [placed.process for placed in self._placed.values()]
        end_all([*processes, *([] if self._spare is None else [self._spare])])
        for placed in self._placed.values():
            placed.close()
        self._placed, self._spare = {}, None

    def _room_in(self, slot: str) -> str | None:
        placed = self._placed.get(slot)
        return None if placed is None else placed.placement.room

    def _fresh_ports(self) -> list[int]:
        """Chooses ports that no late placement had, so that who still talks to a lost one reaches nobody else."""
        found = ports.private_ports(2, avoid=self._used_ports)
        self._used_ports.extend(found)
        return found

    def _look_at(self, slot: str) -> list[PlacementEvent]:
        placed = self._placed[slot]
        found = placed.news()
        if placed.is_gone:
            del self._placed[slot]
        return found

    def _take_spare(self, spec: ChildSpec) -> Process | None:
        spare, self._spare = self._spare, None
        return take_spare(spare, spec)

    def _start_spare_if_due(self) -> None:
        """Starts a spare once those that were placed have had the time to start."""
        if self._spare is not None and self._spare.poll() is not None:
            self._spare = None
            self._spare_due_s = time.monotonic() + SPARE_AFTER_S
        is_due = self._placed and time.monotonic() >= self._spare_due_s
        if self._spare_spec is not None and self._spare is None and is_due:
            self._spare_due_s = time.monotonic() + SPARE_AFTER_S
            with suppress(OSError):  # no more open files or processes: rooms do without one
                self._spare = open_spare(self._spare_spec.arguments, self._spare_spec.warm)
                rehearse_spare(self._spare, next(iter(self._placed.values())).words)
