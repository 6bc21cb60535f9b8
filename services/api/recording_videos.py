"""Videos of recordings, made in the background one at a time, which can be followed and stopped."""

import os
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Lock
from typing import Literal

from pydantic import Field

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.errors import DeltalightError
from deltalight.services.api.recording_store import RecordingStore
from deltalight.services.storage.faults import ConflictError

NICENESS = 10  # the live picture comes first: an encoder takes all cores


class VideoAnswer(StrictModel):
    """Whether a recording's video is there."""

    state: Literal["absent", "making", "ready", "failed"]
    progress: float = Field(ge=0, le=1, description="Fraction of the frames encoded so far.")
    detail: str = Field(default="", description="Why it failed; else empty.")


@dataclass
class _Job:
    """A video that is being made, waits for another, or could not be made (`future` tells)."""

    name: str
    progress: float = 0.0
    stopped: Event = field(default_factory=Event)
    future: "Future[Path]" = field(default_factory=Future)

    def tracked(self, numbers: range) -> Iterator[int]:
        """Yields the numbers of frames, and notes how far it is."""
        for number in numbers:
            if self.stopped.is_set():
                raise was_stopped(self.name)
            self.progress = number / len(numbers)
            yield number


class RecordingVideos:
    """Makes videos of the recordings in a store, in a thread that gives way to others."""

    def __init__(self, store: RecordingStore) -> None:
        self._store = store
        self._jobs: dict[str, _Job] = {}
        self._lock = Lock()
        self._executor = ThreadPoolExecutor(1, "videos", initializer=_give_way)

    def begin(self, name: str) -> "Future[Path]":
        """Has a video made unless it is there or being made; the path comes once it is (cancelled: `was_stopped`).

        Raises:
            NotFoundError: there is no such recording.
            ConflictError: it was interrupted, or has no relit pictures.
            DeltalightError: PyAV is missing.
        """
        made = self._store.made_video(name)
        with self._lock:
            job = self._jobs.get(name)
            if job is not None and not job.future.done():
                return job.future
            self._jobs.pop(name, None)
            if made is not None:
                known: Future[Path] = Future()
                known.set_result(made)
                return known
            job = self._jobs[name] = _Job(name)
            job.future = self._executor.submit(self._store.make_video, name, job.tracked)
            return job.future

    def state(self, name: str) -> VideoAnswer:
        """Returns how far a video is.

        Raises:
            DeltalightError: as `begin`.
        """
        job = self._jobs.get(name)
        if job is not None and not job.future.done():
            return VideoAnswer(state="making", progress=job.progress)
        if self._store.made_video(name) is not None:
            return VideoAnswer(state="ready", progress=1.0)
        fault = None if job is None else job.future.exception()
        if fault is None or isinstance(fault, ConflictError):
            return VideoAnswer(state="absent", progress=0.0)
        detail = str(fault) if isinstance(fault, DeltalightError) else type(fault).__name__
        return VideoAnswer(state="failed", progress=0.0, detail=detail)

    def stop(self, name: str) -> None:
        """Stops the making of a video, and waits until nothing is left of it."""
        with self._lock:
            job = self._jobs.pop(name, None)
        if job is not None:
            job.stopped.set()
            if not job.future.cancel():
                job.future.exception()

    def close(self) -> None:
        """Stops all."""
        for name in list(self._jobs):
            self.stop(name)
        self._executor.shutdown()


def was_stopped(name: str) -> ConflictError:
    """Returns the refusal of a video whose making was stopped."""
    return ConflictError(f"The video of {name} was stopped; ask for it again.")


def _give_way() -> None:
    """Lowers the priority of the calling thread, and of the encoder's threads that it starts."""
    if sys.platform == "linux":  # elsewhere this would be the whole process
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
