"""Backups: scenes, tokens and assets of a data folder in one file, made while services use it.

A .zip without compression: `manifest.json` with size and SHA-256 of each other file, `store.sqlite3` as of one moment
(SQLite's online backup), and the file of each asset that this database names.
"""

import hashlib
import json
import os
import re
import shutil
import sqlite3
import time
import zipfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from deltalight.protocol.errors import DeltalightError
from deltalight.services.files import appearing
from deltalight.services.storage.archive import DAMAGE
from deltalight.services.storage.asset_kinds import BY_NAME
from deltalight.services.storage.data_folder import (
    ASSETS,
    DATABASE,
    finish_replacing,
    staging_folder,
    sync_folder,
    use_folder,
    use_folder_alone,
)
from deltalight.services.storage.tables import SCHEMA_VERSION

MANIFEST, FORMAT = "manifest.json", 1
ATTEMPTS = 5
CHUNK_BYTES = 1 << 20
LARGEST_MANIFEST_BYTES = 64 << 20
_UNPACKING = ".unpacking-"
_SHA256 = re.compile(r"[0-9a-f]{64}")
RESTORE_HINT = "stop the service and run `deltalight restore BACKUP`"


@dataclass(frozen=True)
class Contents:
    """What a backup holds; `aside` is where a restore moved what was there before."""

    scenes: int
    revisions: int
    assets: int
    size_bytes: int
    aside: Path | None = None


@dataclass(frozen=True)
class _Entry:
    name: str
    size: int
    sha256: str


class _GoneError(Exception):
    """A file of an asset that the copied database names does not exist."""


def write_backup(folder: Path, path: Path) -> Contents:
    """Writes a backup of a data folder to a new file, which its owner alone can read.

    Services may go on writing: the backup has every revision that was stored when it began.

    Raises:
        DeltalightError: `path` exists or cannot be written, there is no store, or a part of it is damaged or missing.
    """
    if not (folder / DATABASE).is_file():
        raise DeltalightError(f"{folder} holds no {DATABASE}; name the data folder with --data.")
    with use_folder(folder), appearing(path) as temporary:
        for attempt in range(1, ATTEMPTS + 1):
            temporary.unlink(missing_ok=True)
            try:
                contents = _write(folder, temporary)
                break
            except _GoneError as gone:  # it may have been deleted after the database was copied
                if attempt == ATTEMPTS:
                    raise DeltalightError(f"{gone}; upload the file again, or {RESTORE_HINT}.") from gone
        sync_folder(path.parent)
    return contents


def restore_backup(path: Path, folder: Path) -> Contents:
    """Replaces scenes, tokens and assets of a data folder by those of a backup, and moves the former aside.

    All of the backup is checked first. A restore that is cut off leaves the old or the new state; the next user of
    the folder finishes it.

    Raises:
        DeltalightError: the file is not a complete backup, is of another version, or the folder is in use.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with use_folder_alone(folder):
            finish_replacing(folder)
            for left in folder.glob(f"{_UNPACKING}*"):  # by a killed process
                shutil.rmtree(left)
            with TemporaryDirectory(dir=folder, prefix=_UNPACKING) as unpacked:
                content = Path(unpacked) / "content"
                contents = _unpack(path, content)
                content.rename(staging_folder(folder))
            return replace(contents, aside=finish_replacing(folder))
    except OSError as fault:
        raise DeltalightError(
            f"{folder} cannot be written ({fault.strerror}); free some space or name another --data folder."
        ) from fault


def _write(folder: Path, out: Path) -> Contents:
    with (
        TemporaryDirectory(dir=out.parent, prefix=".backup-") as workshop,
        _private(out) as file,
        zipfile.ZipFile(file, "w") as archive,
    ):
        database = Path(workshop) / DATABASE
        _copy_database(folder / DATABASE, database)
        contents, digests = _examined(database, folder / DATABASE)
        entries = [_add(archive, DATABASE, database)]
        for digest, name in sorted(digests.items()):
            entry = _add(archive, f"{ASSETS}/{digest}/{name}", folder / ASSETS / digest / name)
            if entry.sha256 != digest:
                raise DeltalightError(
                    f"{folder / entry.name} is damaged; upload the file again, or {RESTORE_HINT}."
                )
            entries.append(entry)
        about = {"format": FORMAT, "made_ns": time.time_ns(), "files": [asdict(entry) for entry in entries]}
        archive.writestr(MANIFEST, json.dumps(about))
    return replace(contents, size_bytes=out.stat().st_size)


@contextmanager
def _private(path: Path) -> Iterator[BinaryIO]:
    """Opens a new file that its owner alone can read, because it holds the hashes of tokens; durable at the end."""
    with os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600), "w+b") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


def _copy_database(source: Path, target: Path) -> None:
    """Copies a database as of one moment; writers go on meanwhile (https://sqlite.org/backup.html)."""
    with (
        _explained(source),
        closing(sqlite3.connect(f"{source.absolute().as_uri()}?mode=rw", uri=True)) as live,
        closing(sqlite3.connect(target)) as copy,
    ):
        live.backup(copy)
        copy.execute("PRAGMA journal_mode=DELETE")  # one file, without a log


def _examined(database: Path, shown: Path) -> tuple[Contents, dict[str, str]]:
    """Checks a database without a log; returns what it holds and the file names of its assets by digest."""
    with _explained(shown), closing(sqlite3.connect(database)) as connection:
        (found,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
        if found != "ok":
            raise sqlite3.DatabaseError(found.splitlines()[-1])
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if not 0 < version <= SCHEMA_VERSION:
            raise DeltalightError(
                f"{shown} has the layout {version} and this version of Deltalight reads {SCHEMA_VERSION}; use the "
                "version that wrote it."
            )
        scenes, revisions, assets = (
            connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0]
            for table in ("scenes", "revisions", "assets")
        )
        rows = connection.execute("SELECT digest, format FROM assets").fetchall()
    return Contents(scenes, revisions, assets, 0), {
        digest: f"asset{BY_NAME[form].suffix}" for digest, form in rows
    }


@contextmanager
def _explained(database: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.OperationalError as fault:
        raise DeltalightError(
            f"{database} cannot be used now ({fault}); free some space, or stop other programs that use it."
        ) from fault
    except sqlite3.DatabaseError as fault:
        raise DeltalightError(f"{database} is damaged ({fault}); {RESTORE_HINT}.") from fault


def _add(archive: zipfile.ZipFile, name: str, path: Path) -> _Entry:
    digest, size = hashlib.sha256(), 0
    info = zipfile.ZipInfo(name, time.gmtime()[:6])
    try:
        file = path.open("rb")
    except FileNotFoundError as fault:
        raise _GoneError(f"{path} is gone") from fault
    with file, archive.open(info, "w", force_zip64=True) as packed:
        while chunk := file.read(CHUNK_BYTES):
            packed.write(chunk)
            digest.update(chunk)
            size += len(chunk)
    return _Entry(name, size, digest.hexdigest())


def _unpack(path: Path, to: Path) -> Contents:
    """Unpacks a backup into a new folder, durably, and checks everything in it."""
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            for entry in _entries(archive, path):
                _extract(archive, entry, to / entry.name, path)
    except OSError as fault:
        raise DeltalightError(
            f"{path} cannot be restored ({fault.strerror or fault}); check the file and the disk."
        ) from fault
    except (*DAMAGE, KeyError, ValueError, TypeError, RuntimeError) as fault:
        raise DeltalightError(f"{path} is not a complete backup ({fault}); give another one.") from fault
    contents, digests = _examined(to / DATABASE, path)
    for digest, name in digests.items():
        if not (to / ASSETS / digest / name).is_file():
            raise DeltalightError(f"{path} lacks the asset sha256:{digest}; give another backup.")
    (to / ASSETS).mkdir(exist_ok=True)
    for folder in (*(to / ASSETS).iterdir(), to / ASSETS, to):
        sync_folder(folder)
    return replace(contents, size_bytes=path.stat().st_size)


def _entries(archive: zipfile.ZipFile, path: Path) -> list[_Entry]:
    """Returns the files that the manifest lists; their names can only be those that a backup has."""
    if archive.getinfo(MANIFEST).file_size > LARGEST_MANIFEST_BYTES:
        raise ValueError("its list of files is too long")
    about = json.loads(archive.read(MANIFEST))
    if about["format"] != FORMAT:
        raise DeltalightError(
            f"{path} was written by another version of Deltalight; restore it with that one."
        )
    entries = [_Entry(**each) for each in about["files"]]
    for entry in entries:
        digest = entry.sha256 if _SHA256.fullmatch(entry.sha256) else ""
        allowed = {f"{ASSETS}/{digest}/asset{form.suffix}" for form in BY_NAME.values()}
        if not digest or entry.name not in {DATABASE, *allowed}:
            raise ValueError(f"it lists {entry.name!r:.200}")
    if DATABASE not in {entry.name for entry in entries}:
        raise ValueError(f"it has no {DATABASE}")
    return entries


def _extract(archive: zipfile.ZipFile, entry: _Entry, to: Path, path: Path) -> None:
    to.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    digest, size = hashlib.sha256(), 0
    with archive.open(entry.name) as packed, to.open("xb") as file:
        while size <= entry.size and (chunk := packed.read(CHUNK_BYTES)):
            digest.update(chunk)
            size += len(chunk)
            file.write(chunk)
        file.flush()
        os.fsync(file.fileno())
    if (size, digest.hexdigest()) != (entry.size, entry.sha256):
        raise DeltalightError(f"{path} is damaged: {entry.name} has changed; give another backup.")
