"""Atomic file writes, and the lossless picture format."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.array_checks import kind_of
from deltalight.protocol.errors import DeltalightError, unreachable

ACTIVE_SUFFIX = ".active"  # of a recording that is not finished
PNG_COMPRESSION = 1  # zlib level; higher levels cost more time than a frame takes to render


def require_path(value: object, what: str) -> Path:
    """Returns a program's argument as a path; `what` says in a sentence which one is needed.

    Raises:
        DeltalightError: it is no path.
    """
    if not isinstance(value, str | os.PathLike):
        raise DeltalightError(
            f"{what} is needed and {kind_of(value)} was given; give its path as text or a `Path`."
        )
    return Path(value)


def is_file(path: Path) -> bool:
    """Whether there is such a file; not for a name that no file system takes, which documents of others may hold."""
    try:
        return path.is_file()
    except OSError:
        return False


def exists(path: Path) -> bool:
    """Whether there is such a file or folder.

    Raises:
        DeltalightError: the system does not say: a folder above may not be entered, or the name is too long.
    """
    try:
        return path.exists()
    except OSError as fault:
        raise unreachable(path, fault.strerror) from fault


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`; moves it into place at the end, removes it on an error.

    The suffix stays, because encoders choose their format by it.

    Raises:
        DeltalightError: the file cannot be written (disk full, no permission).
    """
    if not path.name:
        raise unwritable(path, "it names no file")
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as fault:
        raise unwritable(path, fault.strerror) from fault
    finally:
        with suppress(OSError):  # the error above says what is wrong
            temporary.unlink()


def unwritable(path: Path, reason: str | None) -> DeltalightError:
    """Returns the fault that a file cannot be written, to be raised."""
    return DeltalightError(
        f"'{path}' cannot be written ({reason}); free some space or choose another folder."
    )


def append_whole(file: FileIO, content: bytes) -> None:
    """Appends `content` to an unbuffered file; all of it, or nothing where the disk refuses.

    Raises:
        DeltalightError: the disk refuses.
    """
    end, left = file.tell(), memoryview(content)
    try:
        while left:
            left = left[file.write(left) :]
    except OSError as fault:
        with suppress(OSError):
            file.seek(end)
            file.truncate()
        raise unwritable(Path(str(file.name)), fault.strerror) from fault


def write_bytes(path: Path, content: bytes) -> None:
    """Writes `content` to `path` atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_secret(path: Path, content: bytes) -> None:
    """Writes `content` to `path` atomically; nobody but the owner can read it at any time."""
    with replacing(path) as temporary:
        temporary.touch(mode=0o600, exist_ok=False)
        temporary.write_bytes(content)


def write_png(path: Path, color: UInt8[np.ndarray, "h w 3"]) -> None:
    """Writes an RGB picture losslessly, at a low compression level."""
    bgr = cv2.cvtColor(color, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])
    write_bytes(path, encoded.tobytes())
