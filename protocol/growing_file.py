"""A file that grows, and that a disk which refuses for a while does not spoil."""

import errno
import os
from contextlib import suppress
from io import FileIO
from pathlib import Path
from threading import Lock

# A full disk, a quota, a limit of file sizes, a disk that became read-only: all may be lifted.
PASSING_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS})
PIECE_BYTES = 1 << 20


class GrowingFile:
    """A new file, to be appended to by one thread; another may call `sync`.

    What is written stays in memory until `sync` has brought it to the disk. A refusal leaves the file as it was
    committed last and closes it, so that its disk can be mounted anew. The next `commit` opens it again and repeats
    what may be missing.

    Raises:
        OSError: the file exists already, or the disk refuses.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: FileIO | None = path.open("xb", buffering=0)
        self._unsynced = bytearray()  # what follows the first `_synced` bytes
        self._synced = self._committed = 0
        self._lock = Lock()

    def write(self, data: bytes) -> int:
        """Appends to what the next `commit` hands to the system."""
        with self._lock:
            self._unsynced += data
        return len(data)

    def tell(self) -> int:
        """Returns the size with all that was written, in bytes."""
        return self._synced + len(self._unsynced)

    def flush(self) -> None:
        """Does nothing: only the caller knows what belongs together, and commits it."""

    def commit(self) -> None:
        """Hands all that was written to the system; if this fails, nothing of it, and the next call tries it again.

        Raises:
            OSError: the disk refuses.
        """
        with self._lock:
            is_closed, end = self._file is None, self.tell()
            file = self._file = self._opened_again() if self._file is None else self._file
            try:
                self._write_from(file, self._synced if is_closed else self._committed)
                if is_closed:  # perhaps because `sync` failed, which it must not do again
                    os.fsync(file.fileno())
            except OSError:
                self._withdraw(file)
                raise
            self._committed = end
            if is_closed:
                self._forget_until(end)

    def sync(self) -> None:
        """Brings what was committed to the disk, while the other thread goes on writing.

        Raises:
            OSError: the disk refuses; the next `commit` repeats what may be lost.
        """
        with self._lock:
            file, end = self._file, self._committed
            if file is None:
                return
            copy = os.dup(file.fileno())
        try:
            os.fsync(copy)
        except OSError:
            with self._lock:
                if self._file is file:
                    self._withdraw(file)
            raise
        finally:
            os.close(copy)
        with self._lock:
            self._forget_until(end)

    def close(self) -> None:
        """Closes the file; idempotent."""
        with self._lock:
            if self._file is not None:
                self._file.close()
                self._file = None

    def _opened_again(self) -> FileIO:
        file = self._path.open("r+b", buffering=0)
        if os.fstat(file.fileno()).st_size >= self._synced:
            return file
        file.close()
        raise OSError(errno.ESTALE, "it is shorter than it was", str(self._path))

    def _write_from(self, file: FileIO, start: int) -> None:
        position, end = start, self.tell()
        while position < end:
            offset = position - self._synced
            piece = self._unsynced[offset : offset + PIECE_BYTES]
            position += os.pwrite(file.fileno(), piece, position)  # a limit may cut a piece short

    def _withdraw(self, file: FileIO) -> None:
        """Leaves only what was committed, and closes the file; a read-only disk keeps the piece of a chunk."""
        with suppress(OSError):
            os.ftruncate(file.fileno(), min(self._committed, os.fstat(file.fileno()).st_size))
        with suppress(OSError):
            file.close()
        self._file = None

    def _forget_until(self, end: int) -> None:
        if end > self._synced:
            del self._unsynced[: end - self._synced]
            self._synced = end
