"""Records a take of a node in a child process, so that neither outlives the other badly."""

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

from protocol.errors import DeltalightError
from protocol.scene import SceneDocument
from services.api.owned_child import OwnedChild
from services.api.take_shelf import TakeShelf
from services.storage.faults import ConflictError, NotFoundError

# The writer hands over what it has, syncs the disk and closes: seconds on a slow one.
STOP_TIMEOUT_S = 20.0
END_TIMEOUT_S = 5.0
ENDED_WELL = (0, 128 + signal.SIGINT, 128 + signal.SIGTERM)
NODE_ANY = ""


@dataclass
class RunningTake:
    """A recording that grows; `figures` are those of `recorder.RecordStatus`, None before the first frame."""

    id: str
    node: str
    started: datetime
    figures: Mapping[str, Any] | None = None
    detail: str = ""
    child: OwnedChild | None = field(default=None, repr=False)


class TakeRecorder:
    """Starts and ends takes: one at a time of each node, and one of whichever node comes first.

    `publish` is told of each once a second, and at its end with `figures` as they are then.
    """

    def __init__(
        self,
        shelf: TakeShelf,
        endpoints: Sequence[str],
        publish: Callable[[RunningTake, bool], None],
    ) -> None:
        self._shelf, self._endpoints, self._publish = shelf, tuple(endpoints), publish
        self._running: dict[str, RunningTake] = {}
        self._lock = Lock()

    def running(self) -> list[RunningTake]:
        """Return the takes that grow now."""
        with self._lock:
            return list(self._running.values())

    def start(
        self, name: str | None, node: str | None, duration_s: float | None, scene: SceneDocument | None
    ) -> RunningTake:
        """Begin to record; the scene goes into the recording.

        Raises:
            ConflictError: the name is taken, or this node is being recorded.
            DeltalightError: the name is none, or the recorder cannot be started.
        """
        take = RunningTake(_name_now() if name is None else name, node or NODE_ANY, datetime.now(UTC))
        with self._lock:
            for other in self._running.values():
                if other.node == take.node or NODE_ANY in (other.node, take.node):
                    raise ConflictError(
                        f"{take.node or 'a node'} is being recorded already, as {other.id}; stop that first."
                    )
            path = self._shelf.new_path(take.id)
            self._running[take.id] = take
        try:
            take.child = self._child(take, path, duration_s, scene)
        except BaseException:
            self._forget(take)
            raise
        return take

    def stop(self, name: str) -> None:
        """End a recording and wait until its file is whole.

        Raises:
            NotFoundError: nothing of this name is being recorded.
            ConflictError: no frame had come, so that there is no recording.
            DeltalightError: the disk refused.
        """
        take = next((each for each in self.running() if each.id == name), None)
        if take is None or take.child is None:
            raise NotFoundError(f"no recording {name!r:.80} is running; list the recordings for their names.")
        take.child.interrupt()
        if not take.child.wait(STOP_TIMEOUT_S):
            take.child.end(END_TIMEOUT_S)
        if not (take.figures or {}).get("frames"):
            raise ConflictError(take.detail or "No frame had come, so that nothing was recorded.")
        if take.detail:
            raise DeltalightError(take.detail)

    def close(self) -> None:
        """End all, each with a whole file."""
        takes = self.running()
        for take in takes:
            if take.child is not None:
                take.child.interrupt()
        for take in takes:
            if take.child is not None and not take.child.wait(END_TIMEOUT_S):
                take.child.end(END_TIMEOUT_S)

    def _child(
        self, take: RunningTake, path: Path, duration_s: float | None, scene: SceneDocument | None
    ) -> OwnedChild:
        words = [word for endpoint in self._endpoints for word in ("--subscribe", endpoint)]
        words += [] if take.node == NODE_ANY else ["--name", take.node]
        words += [] if duration_s is None else ["--duration", str(duration_s)]
        attached = None if scene is None else _scene_file(scene)
        words += [] if attached is None else ["--scene", str(attached)]

        def end(child: OwnedChild, code: int) -> None:
            if attached is not None:
                attached.unlink(missing_ok=True)
            self._end(take, child, code)

        command = ("record", "--out", str(path), "--progress", "--json", *words)
        return OwnedChild(*command, on_line=lambda child, line: self._note(take, child, line), on_end=end)

    def _note(self, take: RunningTake, child: OwnedChild, line: str) -> None:
        """Take what the recorder prints once a second; where no frame comes it says why beside that."""
        with suppress(ValueError):
            figures = json.loads(line)
            take.figures = figures if figures["frames"] else None
        take.detail = self._said(child)
        self._publish(take, True)

    def _end(self, take: RunningTake, child: OwnedChild, code: int) -> None:
        take.detail = "" if code in ENDED_WELL and take.figures else self._said(child)
        self._forget(take)
        self._publish(take, False)

    def _said(self, child: OwnedChild) -> str:
        return child.last_sentence.replace(f"{self._shelf.folder}{os.sep}", "")

    def _forget(self, take: RunningTake) -> None:
        with self._lock:
            self._running.pop(take.id, None)


def _name_now() -> str:
    return time.strftime("take-%Y%m%d-%H%M%S")


def _scene_file(scene: SceneDocument) -> Path:
    with NamedTemporaryFile(
        "w", prefix="deltalight-", suffix=".json", delete=False, encoding="utf-8"
    ) as file:
        file.write(scene.model_dump_json())
    return Path(file.name)
