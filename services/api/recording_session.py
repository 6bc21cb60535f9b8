"""Recordings in progress: each runs `deltalight record` as a child process."""

import json
import os
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from tempfile import NamedTemporaryFile
from threading import Lock
from typing import Any

from deltalight.protocol.scene import SceneDocument
from deltalight.services.api.child_process import ChildProcess
from deltalight.services.api.recording_store import RecordingStore
from deltalight.services.storage.faults import ConflictError, NotFoundError, StorageFaultError

# The writer flushes, syncs the disk and closes: seconds on a slow one.
STOP_TIMEOUT_S = 20.0
END_TIMEOUT_S = 5.0
ENDED_WELL = (0, 128 + signal.SIGINT, 128 + signal.SIGTERM)
NODE_ANY = ""


@dataclass
class RecordingSession:
    """A recording in progress; `figures` are those of `recorder.RecordStatus`, None before the first frame.

    `has_failed`: it ended because the disk refused, as `detail` explains.
    """

    id: str
    node: str
    started: datetime
    figures: Mapping[str, Any] | None = None
    detail: str = ""
    has_failed: bool = False
    child: ChildProcess | None = field(default=None, repr=False)


class RecordingSessions:
    """Starts and stops recordings: one per node at a time, or one of whichever node is heard first.

    Calls `publish(session, is_growing)` at the start of each, once a second from then on, and once at its end, and
    `notice(sentence)` when the disk refuses and when it takes data again. Relit pictures are those of the `room`
    (directory, name), whichever render server it has; None: of the one at the first endpoint.
    """

    def __init__(
        self,
        store: RecordingStore,
        endpoints: Sequence[str],
        publish: Callable[[RecordingSession, bool], None],
        notice: Callable[[str], None],
        room: tuple[str, str] | None = None,
    ) -> None:
        self._store, self._endpoints, self._publish = store, tuple(endpoints), publish
        self._notice, self._room = notice, room
        self._running: dict[str, RecordingSession] = {}
        self._lock = Lock()

    def use_endpoints(self, endpoints: Sequence[str]) -> None:
        """Records from these endpoints, in recordings that start from now on."""
        self._endpoints = tuple(endpoints)

    def running(self) -> list[RecordingSession]:
        """Returns the recordings in progress."""
        with self._lock:
            return list(self._running.values())

    def start(
        self,
        name: str | None,
        node: str | None,
        duration_s: float | None,
        scene: SceneDocument | None,
        *,
        composites: bool = False,
    ) -> RecordingSession:
        """Starts a recording with this scene attached, and the relit pictures beside the frames if `composites`.

        Raises:
            ConflictError: the name is taken, or this node is being recorded.
            DeltalightError: the name is not valid, or the recorder cannot be started.
        """
        session = RecordingSession(_name_now() if name is None else name, node or NODE_ANY, datetime.now(UTC))
        with self._lock:
            for other in self._running.values():
                if other.node == session.node or NODE_ANY in (other.node, session.node):
                    raise ConflictError(
                        f"{session.node or 'a node'} is being recorded already, as {other.id}; stop that first."
                    )
            path = self._store.new_path(session.id)
            self._running[session.id] = session
        try:
            session.child = self._child(session, path, duration_s, scene, composites=composites)
        except BaseException:
            self._forget(session)
            raise
        self._publish(session, True)
        return session

    def stop(self, name: str) -> RecordingSession:
        """Stops a recording, waits until its file is complete and returns what it was.

        Raises:
            NotFoundError: no recording of this name is in progress.
            ConflictError: no frame arrived, so there is no recording.
            StorageFaultError: the disk refuses; the frames so far are kept.
        """
        session = next((each for each in self.running() if each.id == name), None)
        if session is None or session.child is None:
            raise NotFoundError(f"no recording {name!r:.80} is running; list the recordings for their names.")
        session.child.interrupt()
        if not session.child.wait(STOP_TIMEOUT_S):
            session.child.end(END_TIMEOUT_S)
        if not (session.figures or {}).get("frames"):
            raise ConflictError(session.detail or "No frame had come, so that nothing was recorded.")
        if session.has_failed:
            raise StorageFaultError(session.detail)
        return session

    def close(self) -> None:
        """Stops all recordings and completes their files."""
        sessions = self.running()
        for session in sessions:
            if session.child is not None:
                session.child.interrupt()
        for session in sessions:
            if session.child is not None and not session.child.wait(END_TIMEOUT_S):
                session.child.end(END_TIMEOUT_S)

    def _child(
        self,
        session: RecordingSession,
        path: Path,
        duration_s: float | None,
        scene: SceneDocument | None,
        *,
        composites: bool,
    ) -> ChildProcess:
        words = [word for endpoint in self._endpoints for word in ("--subscribe", endpoint)]
        # One of these endpoints is the render server's, and the recorder takes such pictures from all of them.
        words += self._of_composites() if composites else []
        words += [] if session.node == NODE_ANY else ["--name", session.node]
        words += [] if duration_s is None else ["--duration", str(duration_s)]
        attached = None if scene is None else _scene_file(scene)
        words += [] if attached is None else ["--scene", str(attached)]

        def end(child: ChildProcess, code: int) -> None:
            if attached is not None:
                attached.unlink(missing_ok=True)
            self._end(session, child, code)

        command = ("record", "--out", str(path), "--progress", "--json", *words)
        return ChildProcess(
            *command, on_line=lambda child, line: self._note(session, child, line), on_end=end
        )

    def _of_composites(self) -> list[str]:
        if self._room is None:
            return ["--composites", self._endpoints[0]]
        directory, name = self._room
        return ["--rooms", directory, "--room", name]

    def _note(self, session: RecordingSession, child: ChildProcess, line: str) -> None:
        """Parses the recorder's output, one line a second; its standard error explains why no frame arrives."""
        with suppress(ValueError):
            figures, before = json.loads(line), session.figures or {}
            session.figures = figures if figures["frames"] else None
            if figures["disk"] != before.get("disk", ""):
                self._notice(self._named(figures["disk"]))
        session.detail = self._named(child.last_sentence)
        self._publish(session, True)

    def _end(self, session: RecordingSession, child: ChildProcess, code: int) -> None:
        figures = session.figures or {}
        session.has_failed = code not in ENDED_WELL or not figures
        session.detail = self._named(child.last_sentence if session.has_failed else figures["disk"])
        self._forget(session)
        self._publish(session, False)

    def _named(self, sentence: str) -> str:
        """Returns a sentence with the recordings' names in place of their paths."""
        return sentence.replace(f"{self._store.folder}{os.sep}", "")

    def _forget(self, session: RecordingSession) -> None:
        with self._lock:
            self._running.pop(session.id, None)


def _name_now() -> str:
    return time.strftime("take-%Y%m%d-%H%M%S")


def _scene_file(scene: SceneDocument) -> Path:
    with NamedTemporaryFile(
        "w", prefix="deltalight-", suffix=".json", delete=False, encoding="utf-8"
    ) as file:
        file.write(scene.model_dump_json())
    return Path(file.name)
