"""The render server of a placement, as a child of this process: its reports, its end, and what it said last."""

import time
from collections.abc import Callable
from dataclasses import replace

from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import StatsMessage
from deltalight.services.child import STOP_TIMEOUT_S, Child, ChildSpec
from deltalight.services.process import Process
from deltalight.services.rooms.placer import Placement, PlacementEvent
from deltalight.services.supervisor import WRONG_INPUT_EXIT_CODE
from deltalight.services.watchdog import Watchdog


class RenderProcess:
    """Starts the render server of a placement by its command line, or lets a `spare` that waits become it."""

    def __init__(
        self,
        placement: Placement,
        spec: ChildSpec,
        keys: Keys | None,
        forward: Callable[[str], None],
        spare: Process | None = None,
    ) -> None:
        self.placement = placement
        self.is_gone = False
        self._keys = keys
        self._watchdog: Watchdog | None = None
        self._reported: StatsMessage | None = None
        self._ends_s: float | None = None  # it was told to end, and is killed then
        self._child = Child(replace(spec, watch=self._watched), forward)
        self._child.start(spare)

    @property
    def words(self) -> tuple[str, ...]:
        """Its command line (`ChildSpec.words`)."""
        return self._child.spec.words

    @property
    def process(self) -> Process:
        """Its process."""
        assert self._child.process is not None
        return self._child.process

    def news(self) -> list[PlacementEvent]:
        """Returns what happened since the last call; kills it if it hangs, or does not end although told to."""
        if self.is_gone:
            return []
        self._child.end_if_hanging()
        if self._ends_s is not None and time.monotonic() >= self._ends_s:
            self.process.kill()
        code = self.process.poll()
        if code is not None:
            return self._ended(code)
        newest = None if self._watchdog is None else self._watchdog.newest
        if self._ends_s is not None or newest is None or newest is self._reported:
            return []
        self._reported = newest
        shows = newest.state in ("running", "degraded")
        return [PlacementEvent(self.placement.epoch, "reported", newest.detail, shows)]

    def end(self) -> None:
        """Tells it to end, without waiting for it; that is no loss."""
        if self._ends_s is None:
            self._ends_s = time.monotonic() + STOP_TIMEOUT_S
            self.process.terminate()

    def close(self) -> None:
        """Stops listening to a process that has ended."""
        self._child.end_watching()
        self._child.end_reading()

    def _watched(self, process_id: int) -> Watchdog:
        """Watches a process; its reports tell how the room is doing."""
        endpoints = self.placement.publish, self.placement.control
        self._watchdog = Watchdog(process_id, *endpoints, self._keys)
        return self._watchdog

    def _ended(self, code: int) -> list[PlacementEvent]:
        self.is_gone = True
        self._child.end_watching()
        if self._ends_s is not None:
            return []
        said = self._child.last_sentence()
        refused = code == WRONG_INPUT_EXIT_CODE
        detail = (
            said if refused else f"Its render server died with exit code {code}; its last line was: {said}"
        )
        return [PlacementEvent(self.placement.epoch, "lost", detail, refused=refused)]
