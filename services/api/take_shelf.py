"""The recordings in the data folder: what each holds, its poster, mending and removing."""

import json
import os
import re
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import cv2

from protocol.errors import DeltalightError
from protocol.recording_format import ACTIVE_SUFFIX
from protocol.source import open_source
from services.files import make_output_folder, write_bytes
from services.new_files import SUFFIX
from services.recording_copies import recover_recording
from services.recording_info import describe_recording
from services.storage.faults import ConflictError, NotFoundError

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")  # no dots: nothing that ends like a suffix
POSTER_EDGE = 640
POSTER_QUALITY = 85
LEFT_OVER_AFTER_S = 3600.0  # mending writes all the time: what is older, a killed process left

Facts = dict[str, Any]


@dataclass(frozen=True)
class Take:
    """A recording on the disk; `facts` are of `recording_info`; None where it cannot be read, as `detail` says.

    `finished` was ended; `interrupted` was not, because its recorder was killed, and can be mended.
    """

    id: str
    path: Path
    state: Literal["finished", "interrupted"]
    size_bytes: int
    changed_ns: int
    facts: Facts | None
    detail: str


class TakeShelf:
    """Recordings under their names, `FOLDER/NAME.mcap`; what was found in them is kept in `FOLDER/.cache`.

    Raises:
        DeltalightError: the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = make_output_folder(folder)
        self._cache = make_output_folder(folder / ".cache")
        self._reading = Lock()  # one recording is read at a time: it takes the disk
        for path in folder.glob(f".*.tmp{SUFFIX}*"):
            if path.stat().st_mtime < time.time() - LEFT_OVER_AFTER_S:
                path.unlink(missing_ok=True)

    def all(self, growing: Collection[str] = ()) -> list[Take]:
        """Return all recordings except those that grow, which would be read whole each time; the newest first."""
        takes = []
        for name in {path.name.split(".")[0] for path in self._paths()}.difference(growing):
            with suppress(NotFoundError):  # deleted meanwhile
                takes.append(self.get(name))
        return sorted(takes, key=lambda take: (-take.changed_ns, take.id))

    def get(self, name: str) -> Take:
        """Return one recording.

        Raises:
            NotFoundError: there is none of this name.
        """
        return self._take(self._path(name))

    def new_path(self, name: str) -> Path:
        """Where a recording of this name is to grow.

        Raises:
            DeltalightError: it is no name for a recording.
            ConflictError: it is taken.
        """
        if not NAME.fullmatch(name):
            raise DeltalightError(
                f"{name!r:.80} is no name for a recording; use up to 64 letters, digits, dashes and underscores."
            )
        path = self.folder / (name + SUFFIX)
        if path.exists() or path.with_name(path.name + ACTIVE_SUFFIX).exists():
            raise ConflictError(f"there is a recording called {name}; choose another name.")
        return path

    def poster(self, name: str) -> Path:
        """Return the JPEG file of a recording's first colour picture; it is made when it is first asked for.

        Raises:
            NotFoundError: there is no such recording.
            DeltalightError: it cannot be read.
        """
        path = self._path(name)
        place = self._cache / f"{name}.jpg"
        with self._reading, _naming(path):
            if not place.is_file() or place.stat().st_mtime_ns < _status(path).st_mtime_ns:
                write_bytes(place, _first_picture(path))
        return place

    def recover(self, name: str) -> Take:
        """Mend an interrupted recording; it takes the place of what was left.

        Raises:
            NotFoundError: there is no such recording.
            ConflictError: it is whole.
            DeltalightError: nothing in it can be read, or the disk refuses.
        """
        path = self._path(name)
        out = self.folder / (name + SUFFIX)
        if path == out:
            raise ConflictError(f"{name} was finished; there is nothing to mend.")
        with self._reading, _naming(path):
            recover_recording(path, out, lambda numbers: numbers)
            path.unlink()
        return self._take(out)

    def remove(self, name: str) -> None:
        """Delete a recording.

        Raises:
            NotFoundError: there is none of this name.
        """
        path = self._path(name)
        torn = path.with_name(name + SUFFIX + ACTIVE_SUFFIX)  # also beside one that was just mended from it
        for each in (path, torn, self._cache / f"{name}.jpg", self._cache / f"{name}.json"):
            each.unlink(missing_ok=True)

    def _paths(self) -> Iterator[Path]:
        """All recordings, unfinished ones too."""
        for suffix in (SUFFIX + ACTIVE_SUFFIX, SUFFIX):
            for path in self.folder.glob(f"*{suffix}"):
                if NAME.fullmatch(path.name.removesuffix(suffix)):
                    yield path

    def _path(self, name: str) -> Path:
        for suffix in (SUFFIX, SUFFIX + ACTIVE_SUFFIX):
            path = self.folder / (name + suffix)
            if NAME.fullmatch(name) and path.is_file():
                return path
        raise _absent(name)

    def _take(self, path: Path) -> Take:
        status, name = _status(path), path.name.split(".")[0]
        facts, detail = self._facts(path, [status.st_size, status.st_mtime_ns])
        state: Literal["finished", "interrupted"] = "finished" if path.suffix == SUFFIX else "interrupted"
        return Take(name, path, state, status.st_size, status.st_mtime_ns, facts, detail)

    def _facts(self, path: Path, key: list[int]) -> tuple[Facts | None, str]:
        """What a recording holds, or why it cannot be read; kept, because it takes reading the whole file."""
        place = self._cache / f"{path.name.split('.')[0]}.json"
        known = _kept_facts(place, key)
        if known is not None:
            return known
        with self._reading:
            facts, detail = _described(path)
            write_bytes(place, json.dumps({"key": key, "facts": facts, "detail": detail}).encode())
            return facts, detail


def _absent(name: str) -> NotFoundError:
    return NotFoundError(f"there is no recording {name!r:.80}; list the recordings for their names.")


def _status(path: Path) -> os.stat_result:
    """Size and time of a recording, which somebody may delete, or finish, after it was found."""
    try:
        return path.stat()
    except FileNotFoundError as fault:
        raise _absent(path.name.split(".")[0]) from fault


def _kept_facts(place: Path, key: list[int]) -> tuple[Facts | None, str] | None:
    try:
        kept = json.loads(place.read_text())
        return (kept["facts"], kept["detail"]) if kept["key"] == key else None
    except (OSError, ValueError, KeyError, TypeError):
        return None  # there is none yet, or one that a full disk cut short


def _described(path: Path) -> tuple[Facts | None, str]:
    try:
        with _naming(path):
            return describe_recording(path), ""
    except NotFoundError:
        raise
    except DeltalightError as fault:
        return None, str(fault)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Tell faults of a recording by its name: clients know no paths."""
    try:
        yield
    except NotFoundError:
        raise
    except FileNotFoundError as fault:  # deleted while it was read
        raise _absent(path.name.split(".")[0]) from fault
    except DeltalightError as fault:
        raise DeltalightError(str(fault).replace(f"{path.parent}{os.sep}", "")) from fault


def _first_picture(path: Path) -> bytes:
    frame = open_source(path)[0]
    height, width = frame.color.shape[:2]
    scale = min(1.0, POSTER_EDGE / max(width, height))
    size = round(width * scale), round(height * scale)
    small = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, POSTER_QUALITY])
    return jpeg.tobytes()
