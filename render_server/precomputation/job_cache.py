"""Precomputed data of objects: read from a cache on disk by content, or computed before or beside rendering."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import ClassVar, Generic, TypeVar
from zipfile import BadZipFile

import numpy as np
import structlog
from rich.console import Console
from rich.progress import Progress

from deltalight.protocol.cached_files import (
    cache_folder,
    cache_limit_bytes,
    mark_used,
    prune,
    read_cached,
    write_cached,
)
from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.geometry_state import PlacedObject
from deltalight.render_server.scene.occlusion_field import ProgressCallback
from deltalight.render_server.scene.triangle_mesh import TriangleMesh

Settings = TypeVar("Settings", bound=Hashable)
Data = TypeVar("Data")
log = structlog.get_logger()


class _CancelledError(Exception):
    """Nobody needs the data any more."""


def load_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """Returns the arrays of a cached .npz file; None if there is none, or it is damaged and must be replaced."""
    content = read_cached(path)
    if content is None:
        return None
    mark_used(path)
    try:
        with np.load(BytesIO(content), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, BadZipFile, EOFError, NotImplementedError):
        return None


def store_arrays(path: Path, **arrays: np.ndarray) -> None:
    """Writes a cached .npz file; evicts the least recently used ones beyond the limit of its folder.

    Raises:
        DeltalightError: the folder cannot be written.
    """
    stream = BytesIO()
    np.savez(stream, allow_pickle=False, **arrays)
    write_cached(path, stream.getvalue())
    prune(path.parent, cache_limit_bytes(), keep=path)


class Checkpoint:
    """Finished parts of a long computation, kept so that it resumes there after it was killed.

    They are in the cache of what is computed, and count towards its limit. A part that cannot be written is computed
    again.
    """

    def __init__(self, folder: Path, digest: str) -> None:
        self._folder, self._digest = folder, digest

    def count(self) -> int:
        """Returns the number of finished parts."""
        return len(list(self._folder.glob(f"{self._digest}-*.npz")))

    def part(self, name: str, compute: Callable[[], np.ndarray]) -> np.ndarray:
        """Returns a part as it was kept, or computes and keeps it (a `PartKeeper`)."""
        path = self._folder / f"{self._digest}-{name}.npz"
        found = load_arrays(path)
        if found is not None and "part" in found:
            return found["part"]
        made = compute()
        with suppress(DeltalightError):
            store_arrays(path, part=made)
        return made

    def remove(self) -> None:
        """Removes all parts, because the computation is complete."""
        for path in self._folder.glob(f"{self._digest}-*"):
            path.unlink(missing_ok=True)


@dataclass(frozen=True)
class Job(Generic[Data]):
    """How to get the data of one object: `load` them from the cache (None: not there), or `compute` and `store` them.

    `checkpoint` holds the parts that `compute` finished so far, if it keeps any.
    """

    load: Callable[[], Data | None]
    compute: Callable[[ProgressCallback], Data]
    store: Callable[[Data], None]
    checkpoint: Checkpoint | None = None


@dataclass(eq=False)
class _Entry(Generic[Data]):
    """One asset's data with one set of settings. Its key has the ids of `meshes`, which it keeps alive therefore."""

    meshes: tuple[TriangleMesh, ...]
    name: str
    data: Data | None = None
    fault: str | None = None
    thread: threading.Thread | None = None
    cancelled: threading.Event = field(default_factory=threading.Event)


class Precomputations(ABC, Generic[Settings, Data]):
    """Precomputed data of one kind, held for the lifetime of a renderer; `notify` receives sentences for the user.

    With `waits`, `find` blocks until the data are ready and shows a progress bar on a terminal. Without, it returns
    None while a thread computes them (Embree and matrix products release the interpreter lock).
    """

    cache: ClassVar[str]
    kind: ClassVar[str]
    meanwhile: ClassVar[str]
    """What the user is told about the time until the data are ready."""

    def __init__(
        self, notify: Callable[[str], None], folder: Path | None = None, *, waits: bool = True
    ) -> None:
        self.waits = waits
        self._notify = notify
        self._folder = folder or cache_folder(self.cache)
        self._entries: dict[tuple[tuple[Hashable, ...], Settings], _Entry[Data]] = {}
        self._one_at_a_time = threading.Lock()

    @abstractmethod
    def _surface_key(self, item: PlacedObject) -> Hashable:
        """Returns a key of everything besides meshes and settings that the data depend on."""

    @abstractmethod
    def _job(self, item: PlacedObject, settings: Settings) -> Job[Data]:
        """Returns how to get the data."""

    def find(self, item: PlacedObject, settings: Settings) -> Data | None:
        """Returns the data of an object's asset; None while they are being computed.

        Raises:
            DeltalightError: they cannot be computed.
        """
        key = (*(id(mesh) for mesh in item.meshes), self._surface_key(item))
        entry = self._entries.get((key, settings))
        if entry is None:
            self._cancel_earlier(item.id, settings)
            entry = self._entries[key, settings] = _Entry(item.meshes, item.id)
            self._begin(entry, self._job(item, settings))
        if entry.thread is not None and self.waits:
            entry.thread.join()
        if entry.fault is not None:
            self._notify(entry.fault)
        return entry.data

    def _cancel_earlier(self, name: str, settings: Settings) -> None:
        """Cancels jobs for earlier states of the object, so that none queue up while a user picks a colour."""
        for key in [key for key in self._entries if key[1] == settings and self._entries[key].name == name]:
            self._entries.pop(key).cancelled.set()

    def _begin(self, entry: _Entry[Data], job: Job[Data]) -> None:
        entry.data = job.load()
        if entry.data is not None:
            return

        def make(step: ProgressCallback) -> None:
            made = job.compute(step)
            try:
                job.store(made)
                if job.checkpoint is not None:
                    job.checkpoint.remove()
            except DeltalightError as error:
                entry.fault = f"object `{entry.name}`: its {self.kind} is not kept: {error}"
            entry.data = made

        if self.waits:
            parts = 0 if job.checkpoint is None else job.checkpoint.count()
            if parts:
                self._notify(
                    f"object `{entry.name}`: {parts} parts of its {self.kind} are from a run that was cut off."
                )
            with Progress(console=Console(stderr=True), transient=True) as progress:
                task = progress.add_task(f"{self.kind} of `{entry.name}`", total=1.0)
                make(lambda fraction: progress.update(task, completed=fraction))
            return
        self._notify(
            f"object `{entry.name}`: its {self.kind} is being computed, once; until then {self.meanwhile}."
        )
        entry.thread = threading.Thread(target=self._in_background, args=(entry, make), daemon=True)
        entry.thread.start()

    def _in_background(self, entry: _Entry[Data], make: Callable[[ProgressCallback], None]) -> None:
        def step(_fraction: float) -> None:
            if entry.cancelled.is_set():
                raise _CancelledError

        try:
            with self._one_at_a_time:
                step(0.0)
                make(step)
        except _CancelledError:
            pass
        except Exception as error:  # rendering goes on without the data
            entry.fault = f"object `{entry.name}`: its {self.kind} cannot be computed ({error})."
            log.debug(self.kind, exc_info=error)

    def release(self) -> None:
        """Cancels all jobs; threads end at their next step."""
        for entry in self._entries.values():
            entry.cancelled.set()
