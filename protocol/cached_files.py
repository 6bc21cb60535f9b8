"""Files that can be made again: checked by their hash, and bounded in size by removal of the least recently used.

Beside a file NAME lies NAME.sha256. A killed process or a damaged disk leaves a pair that does not match, which is
as good as no file.
"""

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import structlog

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_bytes

FOLDER_VARIABLE, LIMIT_VARIABLE = "DELTALIGHT_CACHE", "DELTALIGHT_CACHE_MB"
DEFAULT_LIMIT_MB = 8192  # of each kind: some 700 occlusion fields, or 2500 truths of 320 x 240
_SUM = ".sha256"
_log = structlog.get_logger(__name__)


def cache_folder(kind: str) -> Path:
    """Returns the folder of one kind of cached files, in DELTALIGHT_CACHE, else in the user's cache folder."""
    given = os.environ.get(FOLDER_VARIABLE)
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return (Path(given) if given else user / "deltalight") / kind


def cache_limit_bytes() -> int:
    """Returns what the cached files of one kind may take: DELTALIGHT_CACHE_MB.

    Raises:
        DeltalightError: it is no number above zero.
    """
    text = os.environ.get(LIMIT_VARIABLE) or str(DEFAULT_LIMIT_MB)
    if not text.isdecimal() or int(text) < 1:
        raise DeltalightError(f"{LIMIT_VARIABLE} is '{text:.40}'; give what a cache may take as whole MB.")
    return int(text) << 20


def write_cached(path: Path, content: bytes) -> None:
    """Writes a file and its hash, each atomically; makes their folder.

    Raises:
        DeltalightError: the disk refuses.
    """
    with suppress(OSError):  # writing says what is wrong
        path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(_sum_path(path), hashlib.sha256(content).hexdigest().encode())
    write_bytes(path, content)


def read_cached(path: Path) -> bytes | None:
    """Returns the content of a file that was written so; None if there is none or it is damaged."""
    try:
        content, told = path.read_bytes(), _sum_path(path).read_bytes()
    except OSError:
        return None
    if hashlib.sha256(content).hexdigest().encode() != told:
        _log.warning("a cached file is damaged and is made again", file=str(path))
        return None
    return content


def mark_used(path: Path) -> None:
    """Has `prune` take a file or folder for the most recently used one."""
    with suppress(OSError):  # a cache that only others may write
        os.utime(path)


def prune(folder: Path, limit_bytes: int, keep: Path) -> None:
    """Removes the least recently used files and folders in a folder until all fit into the limit, never `keep`."""
    found = []
    for path in _entries(folder):
        with suppress(OSError):  # another process removed it
            found.append((path.stat().st_mtime_ns, _size(path), path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= limit_bytes:
            return
        if path != keep:
            total -= size
            _remove(path)


def _entries(folder: Path) -> Iterator[Path]:
    """Yields what may be removed by itself: no hash, and nothing that is being made."""
    for path in folder.iterdir():
        if path.suffix != _SUM and not path.name.startswith("."):
            yield path


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
        return
    for each in (path, _sum_path(path)):
        with suppress(OSError):
            each.unlink()


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(each.stat().st_size for each in files)


def _sum_path(path: Path) -> Path:
    return path.with_name(path.name + _SUM)
