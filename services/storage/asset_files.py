"""Where the files of assets are: in a folder, or in a store of objects with copies in the folder.

Each asset has a folder of its own, FOLDER/<sha256>/asset.<format>, so that a file that refers to others finds none. A
store of objects has the same names.
"""

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import structlog

from deltalight.protocol.cached_files import cache_limit_bytes, mark_used, prune
from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.services.storage.data_folder import sync_folder
from deltalight.services.storage.faults import StorageFaultError

INCOMING = ".incoming"
# botocore waits for minutes otherwise.
S3_OPTIONS = {"config_kwargs": {"connect_timeout": 3, "read_timeout": 20, "retries": {"max_attempts": 2}}}

log = structlog.get_logger()


class FolderFiles:
    """The files of assets in a folder; `name` is that within an asset's own folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.incoming = folder / INCOMING
        with disk_faults():
            self.incoming.mkdir(parents=True, exist_ok=True)

    def path(self, digest: str, name: str) -> Path:
        """Returns the path of a file on this host, which may be missing."""
        return (self.folder / digest / name).absolute()

    def fetched(self, digest: str, name: str) -> Path:
        """Returns the path of a file on this host, brought here if it is elsewhere; still missing if it is nowhere.

        Raises:
            StorageFaultError: it cannot be brought here.
        """
        return self.path(digest, name)

    def upload(self, digest: str, name: str, file: Path) -> None:
        """Brings a file where it takes long, before it is placed."""

    def place(self, digest: str, name: str, file: Path) -> None:
        """Moves a file to its place, durably.

        Raises:
            StorageFaultError: the disk or the store of objects refuses.
        """
        place = self.path(digest, name)
        with disk_faults():
            place.parent.mkdir(exist_ok=True)
            file.replace(place)
            sync_folder(place.parent)
            sync_folder(self.folder)

    def remove(self, digest: str, name: str) -> None:
        """Removes an asset's folder."""
        del name
        shutil.rmtree(self.folder / digest, ignore_errors=True)


class ObjectFiles(FolderFiles):
    """The files of assets in a store of objects at an address that fsspec knows, such as s3://BUCKET/FOLDER.

    The folder holds copies of those used last, as many as a cache may (`cached_files`).

    Raises:
        DeltalightError: the address is wrong, or a package for it is missing.
    """

    def __init__(self, folder: Path, address: str) -> None:
        super().__init__(folder)
        self._address = address
        self._objects, self._root = _file_system(address)

    def fetched(self, digest: str, name: str) -> Path:
        """Returns the path of a copy on this host, whose content is checked when it comes."""
        place = self.path(digest, name)
        if place.is_file():
            mark_used(place.parent)
            return place
        arriving = self.incoming / uuid4().hex
        try:
            with self._explained():
                try:
                    self._objects.get_file(self._object(digest, name), str(arriving))
                except FileNotFoundError:
                    return place
            with disk_faults():
                self._check(arriving, digest)
                super().place(digest, name, arriving)
        finally:
            arriving.unlink(missing_ok=True)
        prune(self.folder, cache_limit_bytes(), place.parent)
        return place

    def upload(self, digest: str, name: str, file: Path) -> None:
        """Sends a file to the store of objects, unless it is there."""
        with self._explained():
            if not self._objects.exists(self._object(digest, name)):
                self._objects.put_file(str(file), self._object(digest, name))

    def place(self, digest: str, name: str, file: Path) -> None:
        """Moves a file to its place here; sends it again if it was removed from the store of objects meanwhile."""
        self.upload(digest, name, file)
        super().place(digest, name, file)
        prune(self.folder, cache_limit_bytes(), self.path(digest, name).parent)

    def remove(self, digest: str, name: str) -> None:
        """Removes a file here and in the store of objects; one that stays there is in nobody's way."""
        super().remove(digest, name)
        try:
            with self._explained(), suppress(FileNotFoundError):
                self._objects.rm_file(self._object(digest, name))
        except StorageFaultError as fault:
            log.warning(
                "the file of a deleted asset stays in the store of assets", digest=digest, fault=str(fault)
            )

    def _object(self, digest: str, name: str) -> str:
        return f"{self._root}/{digest}/{name}"

    def _check(self, file: Path, digest: str) -> None:
        with file.open("rb") as opened:
            if hashlib.file_digest(opened, "sha256").hexdigest() == digest:
                os.fsync(opened.fileno())
                return
        raise StorageFaultError(
            f"The file sha256:{digest} in {self._address} is damaged; upload the asset again."
        )

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Turns faults of the store of objects into sentences; each kind of store has exceptions of its own."""
        try:
            yield
        except Exception as fault:
            cause = str(fault).strip().partition("\n")[0][:200] or type(fault).__name__
            raise StorageFaultError(
                f"The store of assets does not respond as expected ({cause}); check {self._address}."
            ) from fault


def asset_files(folder: Path, address: str | None) -> FolderFiles:
    """Returns the files of assets: in the folder, or in the store of objects at an address.

    Raises:
        DeltalightError: the folder cannot be written, the address is wrong, or a package for it is missing.
    """
    return FolderFiles(folder) if address is None else ObjectFiles(folder, address)


def _file_system(address: str) -> tuple[Any, str]:
    try:
        from fsspec.core import url_to_fs

        options: dict[str, Any] = S3_OPTIONS if address.startswith("s3://") else {}
        objects, root = url_to_fs(address, use_listings_cache=False, skip_instance_cache=True, **options)
    except ImportError as fault:
        raise DeltalightError(
            f"{address} needs more packages: {install_command('deltalight[s3]')}."
        ) from fault
    except ValueError as fault:
        raise DeltalightError(
            f"{address} is not the address of an asset store ({fault}); write one such as s3://BUCKET/FOLDER."
        ) from fault
    return objects, str(root).rstrip("/")


@contextmanager
def disk_faults() -> Iterator[None]:
    """Turns what the disk refuses into a fault of the storage."""
    try:
        yield
    except OSError as fault:
        raise StorageFaultError(f"The file cannot be kept ({fault.strerror}); free some space.") from fault
