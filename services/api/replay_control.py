"""Replays a recording in place of the live nodes: a `replay` child publishes it for the render server.

Where the node itself plays a recording, that is moved along in the same way while it is shown.
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import structlog

from deltalight.protocol.endpoints import parse_endpoint
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.services import ports
from deltalight.services.api.child_process import ChildProcess
from deltalight.services.api.playback_client import PlaybackClient, Position
from deltalight.services.api.render_link import RenderLink, UnansweredError
from deltalight.services.storage.faults import ConflictError

# A child takes two seconds for imports and its first frame on a slow machine, five with two busy cores.
START_TIMEOUT_S = 20.0
POLL_PERIOD_S = 0.5
REPEAT_PERIOD_S = 2.0
START_ASK_TIMEOUT_S = 0.5  # short, to notice soon that a child ended instead of answering
END_TIMEOUT_S = 3.0
NODE = "replay"
IPC = "ipc://"

log = structlog.get_logger()


@dataclass(frozen=True)
class ReplayOrder:
    """Which recording to replay, and its initial position and state."""

    recording: str
    path: Path
    position_s: float = 0.0
    playing: bool = True
    rate: float = 1.0
    loop: bool = True


@dataclass(frozen=True)
class ReplayEndpoints:
    """Endpoints of one replay's streams and control, reachable by the render server."""

    streams: str
    control: str

    @classmethod
    def beside(cls, server: str) -> Self:
        """Chooses endpoints that the render server reaches: sockets beside its own, else loopback ports.

        Its sockets may be in a folder shared with another container. The names are constant, so that a replay takes
        over what a killed service left.

        Args:
            server: endpoint of the render server's commands.

        Raises:
            ConflictError: the render server is on another host.
        """
        if server.startswith(IPC):
            return cls(f"{server}-replay", f"{server}-replay-control")
        if parse_endpoint(server).leaves_host:
            raise ConflictError(
                "the render server is on another host and cannot read a replay of this one; run"
                " `deltalight replay` there."
            )
        streams, control = ports.private_ports(2)
        return cls(ports.endpoint(streams), ports.endpoint(control))

    def clear(self) -> None:
        """Removes the files that closed sockets leave behind."""
        for endpoint in (self.streams, self.control):
            if endpoint.startswith(IPC):
                Path(endpoint.removeprefix(IPC)).unlink(missing_ok=True)


class ReplayControl:
    """Runs at most one replay, watched by a thread; when it ends for any reason the live nodes are shown again.

    `server` is the endpoint of the render server's commands, `playback` that at which the recording that the node
    plays is controlled (None: it is a camera). Calls `publish` with the position of what is shown twice a second
    while it moves, every two seconds while it is paused, and with None when a camera is shown again; and `notice`
    with sentences for the user.
    """

    def __init__(
        self,
        link: RenderLink,
        server: str,
        publish: Callable[[Position | None], None],
        notice: Callable[[str], None],
        *,
        keys: Keys | None = None,
        playback: str | None = None,
    ) -> None:
        self._link, self._server, self._keys = link, server, keys
        self._publish, self._notice = publish, notice
        self._changing = threading.Lock()
        self._replay: _Replay | None = None
        self._source = None if playback is None else PlaybackClient(None, playback, keys)
        if self._source is not None:
            self._start_watching(self._source)

    @property
    def recording(self) -> str | None:
        """The recording being replayed; None = live."""
        replay = self._replay
        return None if replay is None else replay.order.recording

    def position(self) -> Position | None:
        """Returns the position of what is shown; None = a camera is."""
        shown = self._shown
        if shown is None:
            return None
        with suppress(UnansweredError):  # it is slow, or is just ending
            return shown.ask("position")
        return shown.last if self._shown is shown else None

    @property
    def _shown(self) -> PlaybackClient | None:
        replay = self._replay
        return self._source if replay is None else replay.playback

    def start(self, order: ReplayOrder) -> Position:
        """Replays a recording.

        Raises:
            ConflictError: the render server is on another host.
            DeltalightError: it cannot be replayed.
        """
        with self._changing:
            endpoints = ReplayEndpoints.beside(self._server)
            self._end()
            replay = _Replay(order, endpoints, self._server, self._keys, self._ended)
            try:
                position = replay.first_position()
                self._replay = replay
                self._use((endpoints.streams,))
            except BaseException:
                if self._replay is replay:  # a server that refused may already have read from there
                    with suppress(DeltalightError):
                        self._use(None)
                self._replay = None
                replay.close()
                raise
            self._start_watching(replay.playback)
        self._publish(position)
        return position

    def change(
        self,
        position_s: float | None = None,
        step_frames: int | None = None,
        playing: bool | None = None,
        rate: float | None = None,
    ) -> Position:
        """Seeks, then step, pauses, resumes, or changes the rate.

        Raises:
            ConflictError: no recording is shown.
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
            if step_frames is not None:
                shown.ask("step", {"frames": step_frames})
            position = shown.ask("play" if playing else "position")
        self._publish(position)
        return position

    def stop(self) -> None:
        """Shows the live nodes again."""
        with self._changing:
            was_replayed = self._end()
        if was_replayed:
            self._publish(self.position())

    def close(self) -> None:
        """Stops the replay at the end of the service, without publishing."""
        with self._changing:
            self._end()
            source, self._source = self._source, None
            if source is not None:
                source.close()

    def _end(self) -> bool:
        replay, self._replay = self._replay, None
        if replay is None:
            return False
        try:
            self._use(None)
        finally:
            replay.close()
        return True

    def _use(self, endpoints: tuple[str, ...] | None) -> None:
        try:
            self._link.use_source(endpoints)
        except UnansweredError:  # the server is told once it answers
            log.info("the render server reads from elsewhere as soon as it answers")

    def _ended(self, replay: "_Replay", sentence: str) -> None:
        """Returns to live after a child that ended by itself (called by its thread)."""
        with self._changing:
            if self._replay is not replay:
                return
            self._end()
        self._notice(f"The replay of {replay.order.recording} ended, and live is back: {sentence}")
        self._publish(self.position())

    def _start_watching(self, playback: PlaybackClient) -> None:
        threading.Thread(target=self._watch, args=(playback,), name="replay-control", daemon=True).start()

    def _watch(self, playback: PlaybackClient) -> None:
        """Publishes how a position changes while it is shown, until that is over for good."""
        last, due_s = None, 0.0
        while playback in (self._shown, self._source):
            position = self._moved(playback) if playback is self._shown else None
            is_new = position != last or time.monotonic() >= due_s
            if position is not None and is_new and playback is self._shown:
                self._publish(position)
                last, due_s = position, time.monotonic() + REPEAT_PERIOD_S
            time.sleep(POLL_PERIOD_S)

    @staticmethod
    def _moved(playback: PlaybackClient) -> Position | None:
        with suppress(DeltalightError):  # it is ending, or slow; its end is handled elsewhere
            return playback.ask("position")
        return None


class _Replay:
    """A replay's child process, and the client that controls it."""

    def __init__(
        self,
        order: ReplayOrder,
        endpoints: ReplayEndpoints,
        server: str,
        keys: Keys | None,
        ended: Callable[["_Replay", str], None],
    ) -> None:
        self.order = order
        self.playback = PlaybackClient(order.recording, endpoints.control, keys)
        self._endpoints = endpoints
        words = ["replay", str(order.path), "--publish", endpoints.streams, "--control", endpoints.control]
        words += ["--name", NODE, "--clock", server]
        words += ["--rate", str(order.rate), "--start", str(order.position_s)]
        words += (["--loop"] if order.loop else []) + ([] if order.playing else ["--paused"])
        self._is_closing = self._has_answered = False

        def end(child: ChildProcess, _code: int) -> None:
            if self._has_answered and not self._is_closing:
                ended(self, child.last_sentence or "it said nothing.")

        self._child = ChildProcess(*words, on_end=end)

    def first_position(self) -> Position:
        """Waits until the child runs, and returns its position.

        Raises:
            DeltalightError: the child ended, or does not answer.
        """
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline_s and self._child.is_running:
            with suppress(UnansweredError):
                position = self.playback.ask("position", timeout_s=START_ASK_TIMEOUT_S)
                self._has_answered = True
                if self._child.is_running:  # otherwise nobody would notice its end
                    return position
        self._child.wait(START_ASK_TIMEOUT_S)  # for its last words
        sentence = self._child.last_sentence.replace(str(self.order.path), self.order.recording)
        raise DeltalightError(sentence or f"The replay of {self.order.recording} does not start; try again.")

    def close(self) -> None:
        """Ends the child process."""
        self._is_closing = True
        self._child.end(END_TIMEOUT_S)
        self.playback.close()
        self._endpoints.clear()
