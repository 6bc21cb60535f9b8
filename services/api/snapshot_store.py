"""The snapshots in the data folder: pictures of one frame and their description."""

import os
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.methods import Method
from deltalight.services.files import make_output_folder
from deltalight.services.storage.faults import NotFoundError, StorageFaultError

FACTS = "snapshot.json"
ID = re.compile(r"\d{8}-\d{6}-[0-9a-f]{6}")
FILE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,70}\.(png|exr)")
LEFT_OVER_AFTER_S = 3600.0  # no snapshot takes an hour: an older folder was left by a killed process


class SnapshotPicture(StrictModel):
    """One picture of a snapshot; `method` null = the scene's own."""

    name: str
    view: str
    method: Method | None = None
    file: str | None = Field(description="Name of its file; null if it could not be rendered.")
    detail: str = Field(default="", description="Why it could not be rendered; else empty.")


class SnapshotFacts(StrictModel):
    """What is known of a snapshot."""

    id: str = Field(description="Its name in URLs.", examples=["20261121-101500-3fa2c1"])
    taken: datetime
    frame_id: int
    capture_ns: int = Field(description="When the frame was captured, ns since 1970 by the node's clock.")
    scene_id: str | None = Field(description="The active scene; null = none.")
    scene_revision: int | None
    recording: str | None = Field(description="The recording on display; null = live.")
    pictures: list[SnapshotPicture]
    files: list[str]


class SnapshotStore:
    """Snapshots, each a folder `FOLDER/ID/` with its pictures and snapshot.json; incomplete ones are hidden.

    Raises:
        DeltalightError: the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = make_output_folder(folder)
        for path in folder.glob(".*.part"):
            if path.stat().st_mtime < time.time() - LEFT_OVER_AFTER_S:
                shutil.rmtree(path, ignore_errors=True)

    def all(self) -> list[SnapshotFacts]:
        """Returns all snapshots, the newest first."""
        names = sorted((path.name for path in self._folder.iterdir()), reverse=True)
        read = (_facts(self._folder / name) for name in names if ID.fullmatch(name))
        return [facts for facts in read if facts is not None]

    def get(self, name: str) -> SnapshotFacts:
        """Returns one snapshot.

        Raises:
            NotFoundError: there is none of this name.
        """
        facts = _facts(self._folder / name) if ID.fullmatch(name) else None
        if facts is None:
            raise _absent(name)
        return facts

    def file(self, name: str, file: str) -> Path:
        """Returns the path of a snapshot's file.

        Raises:
            NotFoundError: there is no such snapshot, or no such file in it.
        """
        if file not in self.get(name).files:
            raise NotFoundError(f"the snapshot has no file {file!r:.80}; get the snapshot for its files.")
        return self._folder / name / file

    def remove(self, name: str) -> None:
        """Deletes a snapshot.

        Raises:
            NotFoundError: there is none of this name.
        """
        self.get(name)
        hidden = self._folder / f".{name}.part"
        try:
            (self._folder / name).rename(hidden)
        except FileNotFoundError as fault:  # another request was faster
            raise _absent(name) from fault
        shutil.rmtree(hidden, ignore_errors=True)

    def add(self, take: Callable[[str, Path], SnapshotFacts]) -> SnapshotFacts:
        """Adds a snapshot: `take(name, folder)` writes the pictures; it is listed once it is synced to the disk.

        Raises:
            StorageFaultError: the disk refuses.
        """
        name = time.strftime("%Y%m%d-%H%M%S-", time.gmtime()) + secrets.token_hex(3)
        with _explained(), self._growing(name) as folder:
            facts = take(name, folder)
            (folder / FACTS).write_text(facts.model_dump_json(indent=1), encoding="utf-8")
            for path in folder.iterdir():
                _sync(path)
            folder.rename(self._folder / name)
            _sync(self._folder)
        return facts

    @contextmanager
    def _growing(self, name: str) -> Iterator[Path]:
        folder = (self._folder / f".{name}.part").absolute()
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def files_of(answer: dict[str, Any], folder: Path) -> tuple[list[str], dict[str, str]]:
    """Returns the files that a render server reports and that exist, and its errors by picture."""
    written = [str(each) for each in answer.get("files", []) if FILE.fullmatch(str(each))]
    faults = {str(name): str(fault) for name, fault in answer.get("errors", {}).items()}
    return [each for each in written if (folder / each).is_file()], faults


def _absent(name: str) -> NotFoundError:
    return NotFoundError(f"there is no snapshot {name!r:.60}; list the snapshots for their names.")


def now() -> datetime:
    """Returns the timestamp of a snapshot taken now."""
    return datetime.now(UTC)


def _facts(folder: Path) -> SnapshotFacts | None:
    try:
        return SnapshotFacts.model_validate_json((folder / FACTS).read_bytes())
    except (OSError, ValidationError):
        return None


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _explained() -> Iterator[None]:
    try:
        yield
    except OSError as fault:
        raise StorageFaultError(
            f"The snapshot cannot be kept ({fault.strerror}); free some space."
        ) from fault
