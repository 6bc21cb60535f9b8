"""Uploaded .zip archives: what they hold is checked before anything is unpacked."""

import lzma
import posixpath
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from deltalight.protocol.errors import DeltalightError

# What damaged archives raise; a name that is no UTF-8 is a UnicodeDecodeError.
DAMAGE = (
    zipfile.BadZipFile,
    NotImplementedError,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    UnicodeDecodeError,
    EOFError,
    OSError,
)
_ENCRYPTED = 1  # general purpose flag, bit 0 (APPNOTE 4.4.4)


@contextmanager
def unpacking(path: Path) -> Iterator[None]:
    """Turns what damaged archives raise into a sentence.

    Raises:
        DeltalightError: the archive is damaged.
    """
    try:
        yield
    except DAMAGE as error:
        raise DeltalightError(
            f"{path} is a damaged or unusual .zip ({error!s:.300}); pack it again."
        ) from error


class Archive:
    """The files of an archive by their paths; checked before anything is unpacked.

    Args:
        archive: opened for reading.
        path: its own, for sentences.
        limit_bytes: greatest size of all files together, unpacked.
        most_files: greatest number of files.
        contents: what it should hold, for sentences.

    Raises:
        DeltalightError: it is larger, holds links, encrypted files, or names outside its own folder.
    """

    def __init__(
        self, archive: zipfile.ZipFile, path: Path, limit_bytes: int, most_files: int, contents: str
    ) -> None:
        self.path = path
        self._archive = archive
        listed = [each for each in archive.infolist() if not each.filename.endswith("/")]
        if len(listed) > most_files:
            raise DeltalightError(f"{path} holds more than {most_files} files; pack {contents}.")
        for entry in listed:
            self._check(entry)
        if sum(entry.file_size for entry in listed) > limit_bytes:
            raise DeltalightError(f"{path} holds more than {limit_bytes >> 20} MB unpacked; simplify it.")
        self.entries = {entry.filename: entry for entry in listed if not _is_litter(entry.filename)}
        if len(self.entries) < len([entry for entry in listed if not _is_litter(entry.filename)]):
            raise DeltalightError(f"{path} holds two files of the same name; pack it again.")

    def unpack(self, name: str, to: Path) -> None:
        """Writes a file of the archive."""
        to.parent.mkdir(parents=True, exist_ok=True)
        with self._archive.open(self.entries[name]) as packed, to.open("xb") as file:
            shutil.copyfileobj(packed, file)

    def read(self, name: str) -> bytes:
        """Returns the content of a file.

        Raises:
            DeltalightError: there is none of this name.
        """
        if name not in self.entries:
            raise DeltalightError(
                f"{self.path} does not hold {name!r:.200}, which its glTF names; pack it too."
            )
        return self._archive.read(self.entries[name])  # never more than the size that was checked

    def _check(self, entry: zipfile.ZipInfo) -> None:
        name = entry.filename
        steps = name.split("/")
        if not name or name.startswith("/") or "\\" in name or ":" in steps[0] or ".." in steps:
            raise DeltalightError(
                f"{self.path} holds the name {name!r:.200}, outside its own folder; pack it again."
            )
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise DeltalightError(f"{self.path} holds the link {name!r:.200}; pack the file itself.")
        if entry.flag_bits & _ENCRYPTED:
            raise DeltalightError(f"{self.path} is encrypted; pack it without a password.")


def _is_litter(name: str) -> bool:
    """Whether a file manager added the file, which may even end in .gltf."""
    return name.startswith("__MACOSX/") or posixpath.basename(name).startswith(".")
