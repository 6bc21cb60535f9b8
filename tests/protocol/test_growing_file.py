"""A file whose disk refuses at any point holds what was committed, and in the end everything."""

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from deltalight.protocol.growing_file import GrowingFile


class Disk:
    """Refuses, while `error` is set: writes after some more bytes, and synchronisation, which loses the cache."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path, self.error, self.room = path, 0, 0
        self.loses_from: int | None = None
        self._pwrite: Callable[[int, bytes, int], int] = os.pwrite
        monkeypatch.setattr(os, "pwrite", self.pwrite)
        monkeypatch.setattr(os, "fsync", self.fsync)

    def pwrite(self, handle: int, data: bytes, position: int) -> int:
        if not self.error:
            return self._pwrite(handle, data, position)
        if not self.room:
            raise OSError(self.error, os.strerror(self.error))
        written = self._pwrite(handle, data[: self.room], position)
        self.room -= written
        return written

    def fsync(self, _handle: int) -> None:
        if self.error:
            if self.loses_from is not None:
                os.truncate(self.path, self.loses_from)
            raise OSError(self.error, os.strerror(self.error))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "grown"


@pytest.fixture
def disk(path: Path, monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(path, monkeypatch)


@pytest.fixture
def file(path: Path, disk: Disk) -> Iterator[GrowingFile]:
    assert not disk.error
    with closing(GrowingFile(path)) as grown:
        grown.write(b"first")
        grown.commit()
        yield grown


def test_a_refused_commit_leaves_nothing_of_it_and_the_next_one_everything(
    file: GrowingFile, disk: Disk, path: Path
) -> None:
    disk.error, disk.room = errno.ENOSPC, 3
    file.write(b"second")
    for _ in range(2):
        with pytest.raises(OSError, match="No space left"):
            file.commit()
        assert path.read_bytes() == b"first"
        assert file.tell() == len("firstsecond")
    disk.error = 0
    file.commit()
    assert path.read_bytes() == b"firstsecond"


def test_what_a_failed_synchronisation_lost_is_written_again(
    file: GrowingFile, disk: Disk, path: Path
) -> None:
    file.sync()
    file.write(b"second")
    file.commit()
    disk.error, disk.room, disk.loses_from = errno.EDQUOT, 100, len("fir")
    with pytest.raises(OSError, match="quota"):
        file.sync()
    disk.loses_from = None
    path.write_bytes(b"first\0\0")  # whatever it left of what was not synchronised
    with pytest.raises(OSError, match="quota"):  # the disk takes the bytes, but cannot keep them
        file.commit()
    disk.error = 0
    file.write(b"third")
    file.commit()
    assert path.read_bytes() == b"firstsecondthird"


def test_it_goes_on_in_a_file_that_keeps_what_was_synchronised_only(
    file: GrowingFile, disk: Disk, path: Path
) -> None:
    file.sync()
    disk.error = errno.EROFS
    file.write(b"second")
    with pytest.raises(OSError, match="Read-only"):
        file.commit()
    disk.error = 0
    path.write_bytes(b"fir")
    with pytest.raises(OSError, match="shorter than it was"):
        file.commit()
    path.unlink()
    with pytest.raises(FileNotFoundError):
        file.commit()


def test_what_is_synchronised_is_not_kept_in_memory(file: GrowingFile, path: Path) -> None:
    file.write(b"second")
    file.sync()
    assert bytes(file._unsynced) == b"second"
    file.commit()
    file.sync()
    assert not file._unsynced
    file.write(b"third")
    file.commit()
    assert path.read_bytes() == b"firstsecondthird"
