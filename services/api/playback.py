"""Shows a recording in place of the live nodes: a `replay` child publishes it, the render server reads from there."""

import threading
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import structlog

from protocol.errors import DeltalightError
from protocol.keys import Keys
from protocol.messages import ControlRequest
from protocol.transport import RequestClient
from services.api.owned_child import OwnedChild
from services.api.render_link import RenderLink, UnansweredError
from services.api.replay_places import ReplayPlaces
from services.storage.faults import ConflictError

# A child's imports and its first frame take two seconds on a slow machine, five with two busy cores.
START_TIMEOUT_S = 20.0
ASK_TIMEOUT_S, LOOK_PERIOD_S = 2.0, 0.5
START_ASK_TIMEOUT_S = 0.5  # so soon it is seen that a child ended instead of answering
END_TIMEOUT_S = 3.0
NODE = "replay"

log = structlog.get_logger()


@dataclass(frozen=True)
class Position:
    """Where a replay is; seconds from the recording's first frame."""

    recording: str
    position_s: float
    duration_s: float
    playing: bool
    rate: float
    loop: bool


@dataclass(frozen=True)
class ReplayOrder:
    """Which recording to show, from where and how."""

    recording: str
    path: Path
    position_s: float = 0.0
    playing: bool = True
    rate: float = 1.0
    loop: bool = True


class Playback:
    """At most one replay, watched by a thread; when it ends for any reason the live nodes are shown again.

    `server` is the endpoint of the render server's commands. `publish` is told the position twice a second while it
    moves, and None when live is back; `notice` sentences.
    """

    def __init__(
        self,
        link: RenderLink,
        server: str,
        publish: Callable[[Position | None], None],
        notice: Callable[[str], None],
        keys: Keys | None = None,
    ) -> None:
        self._link, self._server, self._keys = link, server, keys
        self._publish, self._notice = publish, notice
        self._changing = threading.Lock()
        self._shown: _Shown | None = None

    @property
    def recording(self) -> str | None:
        """The recording that is shown; None = live."""
        shown = self._shown
        return None if shown is None else shown.order.recording

    def position(self) -> Position | None:
        """Where the replay is; None = live."""
        shown = self._shown
        if shown is None:
            return None
        with suppress(UnansweredError):  # it is slow, or ends just now
            return shown.ask("position")
        return shown.last if self._shown is shown else None

    def start(self, order: ReplayOrder) -> Position:
        """Show a recording.

        Raises:
            ConflictError: the render server is on another host.
            DeltalightError: it cannot be replayed.
        """
        with self._changing:
            places = ReplayPlaces.beside(self._server)
            self._end()
            shown = _Shown(order, places, self._server, self._keys, self._ended)
            try:
                position = shown.first_position()
                self._shown = shown
                self._use((places.streams,))
            except BaseException:
                if self._shown is shown:  # a server that refused may have read from there before it did
                    with suppress(DeltalightError):
                        self._use(None)
                self._shown = None
                shown.close()
                raise
            threading.Thread(target=self._watch, args=(shown,), name="playback", daemon=True).start()
        self._publish(position)
        return position

    def change(
        self, position_s: float | None = None, playing: bool | None = None, rate: float | None = None
    ) -> Position:
        """Seek, pause, go on, or play at another rate.

        Raises:
            ConflictError: nothing is replayed.
            DeltalightError: the rate is out of range.
        """
        with self._changing:
            shown = self._shown
            if shown is None:
                raise ConflictError("no recording is replayed; begin one with PUT.")
            if rate is not None:
                shown.ask("rate", {"rate": rate})
            if playing is False:
                shown.ask("pause")
            if position_s is not None:
                shown.ask("seek", {"position_s": position_s})
            position = shown.ask("play" if playing else "position")
        self._publish(position)
        return position

    def stop(self) -> None:
        """Show the live nodes again."""
        with self._changing:
            was_shown = self._end()
        if was_shown:
            self._publish(None)

    def close(self) -> None:
        """As `stop`, at the end of the service."""
        with self._changing:
            self._end()

    def _end(self) -> bool:
        shown, self._shown = self._shown, None
        if shown is None:
            return False
        try:
            self._use(None)
        finally:
            shown.close()
        return True

    def _use(self, endpoints: tuple[str, ...] | None) -> None:
        try:
            self._link.use_source(endpoints)
        except UnansweredError:  # it is told when it answers
            log.info("the render server reads from elsewhere as soon as it answers")

    def _ended(self, shown: "_Shown", sentence: str) -> None:
        """The child died (its own thread); unless it was told to, live comes back."""
        with self._changing:
            if self._shown is not shown:
                return
            self._end()
        self._notice(f"The replay of {shown.order.recording} ended, and live is back: {sentence}")
        self._publish(None)

    def _watch(self, shown: "_Shown") -> None:
        last = None
        while self._shown is shown:
            try:
                position = shown.ask("position")
            except DeltalightError:  # it ends, or is slow; its end is told elsewhere
                position = None
            if position is not None and position != last and self._shown is shown:
                self._publish(position)
                last = position
            time.sleep(LOOK_PERIOD_S)


class _Shown:
    """A replay's child process and the client that controls it; `last` is where it was last."""

    def __init__(
        self,
        order: ReplayOrder,
        places: ReplayPlaces,
        server: str,
        keys: Keys | None,
        ended: Callable[["_Shown", str], None],
    ) -> None:
        self.order = order
        self.last: Position | None = None
        self._places = places
        self._client = RequestClient(places.control, keys=keys)
        words = ["replay", str(order.path), "--publish", places.streams, "--control", places.control]
        words += ["--name", NODE, "--clock", server]
        words += ["--rate", str(order.rate), "--start", str(order.position_s)]
        words += (["--loop"] if order.loop else []) + ([] if order.playing else ["--paused"])
        self._is_closing = self._has_answered = False

        def end(child: OwnedChild, _code: int) -> None:
            if self._has_answered and not self._is_closing:
                ended(self, child.last_sentence or "it said nothing.")

        self._child = OwnedChild(*words, on_end=end)

    def first_position(self) -> Position:
        """Wait until it runs.

        Raises:
            DeltalightError: it ended, or does not answer.
        """
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline_s and self._child.is_running:
            with suppress(UnansweredError):
                position = self.ask("position", timeout_s=START_ASK_TIMEOUT_S)
                self._has_answered = True
                if self._child.is_running:  # else nobody would hear of its end
                    return position
        self._child.wait(START_ASK_TIMEOUT_S)  # for its last words
        sentence = self._child.last_sentence.replace(str(self.order.path), self.order.recording)
        raise DeltalightError(sentence or f"The replay of {self.order.recording} does not start; try again.")

    def ask(
        self, op: str, payload: dict[str, object] | None = None, timeout_s: float = ASK_TIMEOUT_S
    ) -> Position:
        """Carry out a command; gives the position after it.

        Raises:
            UnansweredError: it does not answer.
            DeltalightError: it refuses.
        """
        request = ControlRequest(
            node="api", capture_ns=time.time_ns(), id=uuid.uuid4().hex, op=op, payload=payload or {}
        )
        try:
            reply = self._client.request(request, timeout_s)
        except DeltalightError as fault:
            raise UnansweredError(f"The replay does not answer ({fault}).") from fault
        if reply.error is not None:
            raise DeltalightError(reply.error)
        self.last = Position(recording=self.order.recording, **reply.payload)  # type: ignore[arg-type]
        return self.last

    def close(self) -> None:
        """End the child."""
        self._is_closing = True
        self._child.end(END_TIMEOUT_S)
        self._client.close()
        self._places.clear()
