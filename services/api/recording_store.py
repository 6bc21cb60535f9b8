"""The recordings in the data folder: their contents, posters, recovery and deletion."""

import json
import os
import re
import shutil
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

from deltalight.protocol.cached_files import read_cached, write_cached
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import ACTIVE_SUFFIX, write_bytes
from deltalight.services.files import SUFFIX, make_output_folder
from deltalight.services.storage.asset_files import disk_faults
from deltalight.services.storage.asset_kinds import clean_name
from deltalight.services.storage.asset_sandbox import MEMORY_LIMIT_BYTES, run_limited
from deltalight.services.storage.assets import Incoming
from deltalight.services.storage.faults import ConflictError, NotFoundError, TooLargeError

if TYPE_CHECKING:  # readers of recordings take 0.1 s
    from deltalight.services.recording_copies import Track

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")  # no dots: nothing that ends like a suffix
POSTER_EDGE = 640
POSTER_QUALITY = 85
UPLOAD_LEFT_OVER_AFTER_S = 24 * 3600.0  # no upload takes a day
CHECK_TIME_S = 600  # of an upload; a zipped folder is made into a recording meanwhile
LEFT_OVER_AFTER_S = 3600.0  # recovery writes continuously: an older file was left by a killed process

Facts = dict[str, Any]


@dataclass(frozen=True)
class StoredRecording:
    """A recording on the disk; `facts` are those of `recording_info`, None if unreadable, as `detail` explains.

    An `interrupted` recording was never finished, because its recorder was killed; it can be recovered.
    """

    id: str
    path: Path
    state: Literal["finished", "interrupted"]
    size_bytes: int
    changed_ns: int
    facts: Facts | None
    detail: str


class RecordingStore:
    """Recordings by name, `FOLDER/NAME.mcap`; what was read from them is cached in `FOLDER/.cache`.

    Raises:
        DeltalightError: the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = make_output_folder(folder)
        self._cache = make_output_folder(folder / ".cache")
        self._incoming = make_output_folder(folder / ".incoming")
        for left in self._incoming.iterdir():
            if left.stat().st_mtime < time.time() - UPLOAD_LEFT_OVER_AFTER_S:
                shutil.rmtree(left, ignore_errors=True)
        self._naming_new = Lock()
        self._reading = Lock()  # recordings are read one at a time, because reading occupies the disk
        for path in folder.glob(f".*.tmp{SUFFIX}*"):
            if path.stat().st_mtime < time.time() - LEFT_OVER_AFTER_S:
                path.unlink(missing_ok=True)

    def all(self, growing: Collection[str] = ()) -> list[StoredRecording]:
        """Returns all recordings, the newest first, except growing ones, which would be reread each time."""
        found = []
        for name in {path.name.split(".")[0] for path in self._paths()}.difference(growing):
            with suppress(NotFoundError):  # deleted meanwhile
                found.append(self.get(name))
        return sorted(found, key=lambda each: (-each.changed_ns, each.id))

    def get(self, name: str) -> StoredRecording:
        """Returns one recording.

        Raises:
            NotFoundError: there is none of this name.
        """
        return self._described(self._path(name))

    def new_path(self, name: str) -> Path:
        """Returns the path for a new recording of this name.

        Raises:
            DeltalightError: it is not a valid name.
            ConflictError: it is taken.
        """
        if not NAME.fullmatch(name):
            raise DeltalightError(
                f"{name!r:.80} is not a valid recording name; use up to 64 letters, digits, dashes and underscores."
            )
        path = self.folder / (name + SUFFIX)
        if path.exists() or path.with_name(path.name + ACTIVE_SUFFIX).exists():
            raise ConflictError(f"there is a recording called {name}; choose another name.")
        return path

    @contextmanager
    def receiving(self, limit_bytes: int, quota_bytes: int) -> Iterator[Incoming]:
        """Yields a place for an upload; it is removed at the end unless `keep` took it.

        `quota_bytes` is what all recordings, and what is received, may take together.

        Raises:
            TooLargeError: there is no room for one more.
            StorageFaultError: the disk refuses.
        """
        used = self._used_bytes()
        if used >= quota_bytes:
            raise TooLargeError(
                f"the recordings take {used >> 20} MB and may take {quota_bytes >> 20} MB; delete some."
            )
        folder = self._incoming / uuid4().hex
        limit = min(limit_bytes, quota_bytes - used)
        try:
            with disk_faults():
                folder.mkdir()
                file = (folder / f"upload{SUFFIX}").open("xb")
            with file:
                yield Incoming(
                    Path(file.name), file, limit, advice="cut it into shorter ones, or delete some"
                )
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def keep(self, incoming: Incoming, name: str) -> StoredRecording:
        """Checks a received file in a limited process, and stores it under the name of the file, or one like it.

        A .zip of a dataset folder is stored as the recording made of it.

        Raises:
            RejectedAssetError: it is no recording, or a broken one.
        """
        made = incoming.path.with_name(f"made{SUFFIX}")
        with disk_faults():
            incoming.file.flush()
        checked = run_limited(
            "recording",
            incoming.path,
            clean_name(name),
            str(made),
            str(incoming.limit_bytes),
            memory_bytes=MEMORY_LIMIT_BYTES + 2 * incoming.size_bytes,  # files are mapped
            output_bytes=incoming.limit_bytes,
            time_s=CHECK_TIME_S,
        )
        with disk_faults(), self._naming_new:
            path = self._free_path(Path(clean_name(name)).stem)
            (made if checked["is_made"] else incoming.path).rename(path)
        return self._described(path)

    def _used_bytes(self) -> int:
        """Returns what all files take, those being received included."""
        used = 0
        for path in self.folder.rglob("*"):
            with suppress(FileNotFoundError):  # deleted meanwhile
                used += path.stat().st_size
        return used

    def _free_path(self, stem: str) -> Path:
        """Returns the path of a new recording, its name as like `stem` as may be."""
        plain = re.sub(r"[^A-Za-z0-9_-]+", "-", stem).strip("-_")[:56] or "upload"
        for number in count(1):
            with suppress(ConflictError):
                return self.new_path(plain if number == 1 else f"{plain}-{number}")
        raise AssertionError  # count never ends

    def poster(self, name: str) -> Path:
        """Returns the JPEG file of a recording's first colour picture, created on first request.

        Raises:
            NotFoundError: there is no such recording.
            DeltalightError: it cannot be read.
        """
        path = self._path(name)
        cached = self._cache / f"{name}.jpg"
        with self._reading, _naming(path):
            made_ns = cached.stat().st_mtime_ns if cached.is_file() else 0
            if made_ns < _status(path).st_mtime_ns or read_cached(cached) is None:
                write_cached(cached, _first_picture(path))
        return cached

    def made_video(self, name: str) -> Path | None:
        """Returns the video of a recording's relit pictures; None if none was made since it changed.

        Raises:
            NotFoundError: there is no such recording.
            ConflictError: it was interrupted, or has no relit pictures.
            DeltalightError: PyAV is missing.
        """
        from deltalight.services.video_file import require_video_support

        recording = self.get(name)
        if recording.state == "interrupted":
            raise ConflictError(f"{name} was interrupted; recover it, then download it.")
        require_video_support("Or download the .mcap file, which has the pictures too.")
        if not (recording.facts or {}).get("composites"):
            raise ConflictError(
                f"{name} has no relit pictures; record with `composites`, or render it by `deltalight render`."
            )
        path = self._video_path(name)
        is_made = path.is_file() and path.stat().st_mtime_ns >= recording.changed_ns
        return path if is_made else None

    def make_video(self, name: str, track: "Track") -> Path:
        """Makes the video of a recording's relit pictures, one at a time; what `track` raises leaves nothing.

        Raises:
            NotFoundError: there is no such recording.
            DeltalightError: the recording cannot be read, or the disk refuses.
        """
        from deltalight.protocol.source import open_source
        from deltalight.services.exports.video import export_video

        recording, path = self._path(name), self._video_path(name)
        with _naming(recording):
            for left in (
                path,
                *self._cache.glob(f".{name}.*.tmp{path.suffix}"),
            ):  # of an earlier, killed process
                left.unlink(missing_ok=True)
            export_video(open_source(recording), path, track)
        return path

    def remove_video(self, name: str) -> None:
        """Deletes a video, if there is one."""
        self._video_path(name).unlink(missing_ok=True)

    def _video_path(self, name: str) -> Path:
        return self._cache / f"{name}.mp4"

    def recover(self, name: str) -> StoredRecording:
        """Recovers an interrupted recording; the result replaces its remains.

        Raises:
            NotFoundError: there is no such recording.
            ConflictError: it is complete.
            DeltalightError: nothing in it can be read, or the disk refuses.
        """
        from deltalight.services.recording_copies import recover_recording  # readers of recordings take 0.1 s

        path = self._path(name)
        out = self.folder / (name + SUFFIX)
        if path == out:
            raise ConflictError(f"{name} was finished; there is nothing to recover.")
        with self._reading, _naming(path):
            recover_recording(path, out, lambda numbers: numbers)
            path.unlink()
        return self._described(out)

    def remove(self, name: str) -> None:
        """Deletes a recording.

        Raises:
            NotFoundError: there is none of this name.
        """
        path = self._path(name)
        # An unfinished file may also exist beside the one just recovered from it.
        unfinished = path.with_name(name + SUFFIX + ACTIVE_SUFFIX)
        for each in (path, unfinished, *self._cache.glob(f"{name}.*")):
            each.unlink(missing_ok=True)

    def _paths(self) -> Iterator[Path]:
        """Yields the paths of all recordings, unfinished ones too."""
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

    def _described(self, path: Path) -> StoredRecording:
        status, name = _status(path), path.name.split(".")[0]
        facts, detail = self._facts(path, [status.st_size, status.st_mtime_ns])
        state: Literal["finished", "interrupted"] = "finished" if path.suffix == SUFFIX else "interrupted"
        return StoredRecording(name, path, state, status.st_size, status.st_mtime_ns, facts, detail)

    def _facts(self, path: Path, key: list[int]) -> tuple[Facts | None, str]:
        """Returns the facts of a recording, or why it cannot be read; cached, because the whole file is read."""
        cached = self._cache / f"{path.name.split('.')[0]}.json"
        known = _cached_facts(cached, key)
        if known is not None:
            return known
        with self._reading:
            facts, detail = _read_facts(path)
            with suppress(DeltalightError):  # a full disk: it will be read again
                write_bytes(cached, json.dumps({"key": key, "facts": facts, "detail": detail}).encode())
            return facts, detail


def _absent(name: str) -> NotFoundError:
    return NotFoundError(f"there is no recording {name!r:.80}; list the recordings for their names.")


def _status(path: Path) -> os.stat_result:
    """Returns size and time of a recording, which may be deleted or finished after it was found."""
    try:
        return path.stat()
    except FileNotFoundError as fault:
        raise _absent(path.name.split(".")[0]) from fault


def _cached_facts(path: Path, key: list[int]) -> tuple[Facts | None, str] | None:
    try:
        cached = json.loads(path.read_text())
        return (cached["facts"], cached["detail"]) if cached["key"] == key else None
    except (OSError, ValueError, KeyError, TypeError):
        return None  # there is none yet, or a full disk truncated it


def _read_facts(path: Path) -> tuple[Facts | None, str]:
    from deltalight.services.recording_info import describe_recording

    try:
        with _naming(path):
            return describe_recording(path), ""
    except NotFoundError:
        raise
    except DeltalightError as fault:
        return None, str(fault)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Names recordings instead of paths in errors, because clients know no paths."""
    try:
        yield
    except (NotFoundError, ConflictError):
        raise
    except FileNotFoundError as fault:  # deleted while being read
        raise _absent(path.name.split(".")[0]) from fault
    except DeltalightError as fault:
        raise DeltalightError(str(fault).replace(f"{path.parent}{os.sep}", "")) from fault


def _first_picture(path: Path) -> bytes:
    import cv2

    from deltalight.protocol.source import open_source

    frame = open_source(path)[0]
    height, width = frame.color.shape[:2]
    scale = min(1.0, POSTER_EDGE / max(width, height))
    size = round(width * scale), round(height * scale)
    small = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, POSTER_QUALITY])
    return jpeg.tobytes()
