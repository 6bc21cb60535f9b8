"""Uploaded files, stored by the hash of their content."""

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from threading import BoundedSemaphore
from typing import BinaryIO
from uuid import uuid4

from sqlalchemy import select
from sqlalchemy.orm import Session

from deltalight.protocol.cached_files import read_cached, write_cached
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import DIGEST_PREFIX, SceneDocument
from deltalight.services.storage.asset_files import FolderFiles, disk_faults
from deltalight.services.storage.asset_kinds import (
    BY_NAME,
    HEAD_BYTES,
    AssetFormat,
    AssetKind,
    Facts,
    clean_name,
    is_archive,
    recognise,
)
from deltalight.services.storage.asset_sandbox import Task, probe, run_limited
from deltalight.services.storage.database import Database, remembered
from deltalight.services.storage.faults import ConflictError, NotFoundError, StorageFaultError, TooLargeError
from deltalight.services.storage.shelf import shelf_item
from deltalight.services.storage.tables import AssetNameRow, AssetRow, AssetUseRow, SceneRow

Probe = Callable[[Path, AssetKind, str], Facts]
LEFT_OVER_AFTER_S = 24 * 3600  # no upload takes a day: older files were left by a killed process
CONCURRENT_CHILDREN = 2  # each may use memory up to the limit of a child
THUMBNAIL = "thumbnail.png"
THUMBNAIL_TASKS: dict[AssetKind, Task] = {
    "mesh": "mesh-thumbnail",
    "map": "map-thumbnail",
    "material": "material-thumbnail",
}
THUMBNAIL_BYTES = 1 << 20  # more than 256 x 256 pixels without any compression
CHUNK_BYTES = 1 << 20
MOST_SHELF_BYTES = 1 << 22  # of an object's file; the tests hold them below 1 MB
# Of the demo's assets, by digest (benchmarks/make_demo.py): to find them out would delay the first picture.
SHIPPED_FACTS = Path(__file__).parents[1] / "demo_assets" / "facts.json"


@dataclass(frozen=True)
class Asset:
    """An uploaded file; `facts` are those of `asset_facts`."""

    digest: str
    names: tuple[str, ...]
    format: AssetFormat
    size_bytes: int
    facts: Facts
    uploaded_ns: int

    @property
    def reference(self) -> str:
        """Its name in scene documents."""
        return DIGEST_PREFIX + self.digest


@dataclass
class Incoming:
    """A file being received."""

    path: Path
    file: BinaryIO
    limit_bytes: int
    advice: str = "simplify it"
    size_bytes: int = 0
    head: bytes = b""
    digest: "hashlib._Hash" = field(default_factory=hashlib.sha256)

    def write(self, chunk: bytes) -> None:
        """Appends bytes.

        Raises:
            TooLargeError: the file exceeds the limit.
            StorageFaultError: the disk is full.
        """
        self._note(chunk)
        with disk_faults():
            self.file.write(chunk)

    def take_over(self) -> None:
        """Takes what another process wrote to the file.

        Raises:
            TooLargeError: the file exceeds the limit.
            StorageFaultError: the disk refuses.
        """
        with disk_faults(), self.path.open("rb") as file:
            while chunk := file.read(CHUNK_BYTES):
                self._note(chunk)

    def _note(self, chunk: bytes) -> None:
        self.size_bytes += len(chunk)
        if self.size_bytes > self.limit_bytes:
            raise TooLargeError(f"the file is larger than {self.limit_bytes >> 20} MB; {self.advice}.")
        self.head = (self.head + chunk)[:HEAD_BYTES] if len(self.head) < HEAD_BYTES else self.head
        self.digest.update(chunk)


class AssetStore:
    """The assets of a store; tests about something else replace `probe`."""

    def __init__(self, database: Database, files: FolderFiles, probe: Probe = probe) -> None:
        self._database = database
        self._files = files
        self._incoming = files.incoming
        self._probe = probe
        self._children = BoundedSemaphore(CONCURRENT_CHILDREN)
        with disk_faults():
            self._remove_left_over()

    @contextmanager
    def receiving(self, limit_bytes: int) -> Iterator[Incoming]:
        """Yields a place for an upload; it is removed at the end unless `keep` took it."""
        path = self._incoming / uuid4().hex
        try:
            with disk_faults():
                file = path.open("xb")
            with file:
                yield Incoming(path, file, limit_bytes)
        finally:
            path.unlink(missing_ok=True)

    def keep(self, incoming: Incoming, name: str) -> tuple[Asset, bool]:
        """Checks a received file and stores it; returns the asset and whether it is new.

        A .zip with one glTF and its files is stored as the .glb made of it.

        Raises:
            RejectedAssetError: the file is invalid.
        """
        shown = clean_name(name)
        if not is_archive(incoming.head):
            return self._keep(incoming, shown)
        with self.receiving(incoming.limit_bytes) as unpacked:
            self._unpack(incoming, unpacked, shown)
            return self._keep(unpacked, Path(shown).stem + ".glb")

    def take_from_shelf(self, name: str) -> tuple[Asset, bool]:
        """Stores an object of the shelf; returns the asset and whether it is new.

        The worker makes it: the packages for that would take 127 MB of this process for good.

        Raises:
            NotFoundError: there is none of this name.
        """
        item = shelf_item(name)
        with self.receiving(MOST_SHELF_BYTES) as incoming:
            with self._children:
                facts = run_limited(
                    "shelf", incoming.path, item.file_name, name, output_bytes=MOST_SHELF_BYTES
                )
            incoming.take_over()
            return self._keep(incoming, item.file_name, facts)

    def _unpack(self, incoming: Incoming, unpacked: Incoming, name: str) -> None:
        with disk_faults():
            incoming.file.flush()
        limit = incoming.limit_bytes
        with self._children:
            run_limited("unzip", incoming.path, name, str(unpacked.path), str(limit), output_bytes=limit)
        unpacked.take_over()

    def _keep(self, incoming: Incoming, shown: str, known: Facts | None = None) -> tuple[Asset, bool]:
        found = recognise(incoming.head, incoming.size_bytes, shown)
        digest = incoming.digest.hexdigest()
        checked = incoming.path.with_suffix(found.suffix)
        try:
            with disk_faults():
                incoming.file.flush()
                os.fsync(incoming.file.fileno())
                incoming.path.rename(checked)
            facts = known or self._facts(digest, checked, found, shown)
            return self._placed(
                checked, AssetRow(**_columns(digest, found, incoming.size_bytes, facts)), shown
            )
        finally:
            checked.unlink(missing_ok=True)

    @remembered
    def get(self, digest: str) -> Asset:
        """Returns an asset.

        Raises:
            NotFoundError: there is none of this digest.
        """
        with self._database.reading() as session:
            return _asset(session, _row(session, digest))

    @remembered
    def all(self) -> list[Asset]:
        """Returns all assets, the newest first."""
        with self._database.reading() as session:
            rows = session.scalars(select(AssetRow).order_by(AssetRow.uploaded_ns.desc(), AssetRow.digest))
            return [_asset(session, row) for row in rows]

    def path(self, asset: Asset) -> Path:
        """Returns the path of an asset's file, brought to this host if it is elsewhere.

        Raises:
            StorageFaultError: it cannot be brought here.
        """
        return self._files.fetched(asset.digest, _file_name(asset.format.name))

    def thumbnail(self, digest: str) -> Path:
        """Returns the file of an asset's thumbnail, drawn on first request.

        Raises:
            NotFoundError: there is no asset of this digest.
            RejectedAssetError: it cannot be drawn within the limits.
        """
        asset = self.get(digest)
        path = self.path(asset)
        place = path.with_name(THUMBNAIL)
        if read_cached(place) is not None:
            return place
        with self._children:
            if read_cached(place) is None:
                self._draw(THUMBNAIL_TASKS[asset.format.kind], path, place, asset.names[0])
        return place

    def _draw(self, task: Task, path: Path, place: Path, name: str) -> None:
        drawn = self._incoming / uuid4().hex
        try:
            run_limited(task, path, name, str(drawn), output_bytes=THUMBNAIL_BYTES)
            with disk_faults():
                write_cached(place, drawn.read_bytes())
        finally:
            drawn.unlink(missing_ok=True)

    def remove(self, digest: str) -> None:
        """Deletes an asset that no scene uses, now or in an earlier revision.

        Raises:
            NotFoundError: there is none of this digest.
            ConflictError: a scene uses it.
        """
        with self._database.writing() as session:
            row = _row(session, digest)
            format_name = row.format
            _require_unused(session, digest)
            for each in session.scalars(select(AssetNameRow).where(AssetNameRow.digest == digest)):
                session.delete(each)
            session.flush()
            session.delete(row)
        with self._database.writing() as session:  # the lock excludes simultaneous uploads of the same file
            if session.get(AssetRow, digest) is None:
                self._files.remove(digest, _file_name(format_name))

    def localised(self, document: SceneDocument) -> SceneDocument:
        """Returns a stored document with the paths of its assets' files, for the render server.

        Raises:
            StorageFaultError: a file was removed from the data folder.
        """
        return document.with_assets(lambda _place, reference: str(self._existing(reference)))

    def without_paths(self, sentence: str) -> str:
        """Returns a sentence of the render server for clients: digests in place of files."""
        return sentence.replace(f"{self._files.folder.absolute()}{os.sep}", DIGEST_PREFIX)

    def _existing(self, reference: str) -> Path:
        asset = self.get(reference.removeprefix(DIGEST_PREFIX))
        path = self.path(asset)
        if not path.is_file():
            raise StorageFaultError(
                f"the file of {asset.names[0]} ({reference}) is gone from the data folder; upload it again, or stop "
                "the service and run `deltalight restore BACKUP`."
            )
        return path

    def _facts(self, digest: str, path: Path, found: AssetFormat, name: str) -> Facts:
        with self._database.reading() as session:
            known = session.get(AssetRow, digest)
            if known is not None:
                return dict(json.loads(known.facts))
        shipped = _shipped_facts().get(digest)
        if shipped is not None:
            return shipped
        with self._children:
            return self._probe(path, found.kind, name)

    def _placed(self, checked: Path, row: AssetRow, name: str) -> tuple[Asset, bool]:
        """Moves the file into place, then adds its row: a row without a file never exists."""
        self._files.upload(row.digest, _file_name(row.format), checked)
        with self._database.writing() as session:
            known = session.get(AssetRow, row.digest)
            self._files.place(row.digest, _file_name(row.format), checked)
            if known is None:
                session.add(row)
                session.flush()
            session.merge(AssetNameRow(digest=row.digest, name=name))
            session.flush()
            return _asset(session, known or row), known is None

    def _remove_left_over(self) -> None:
        for path in self._incoming.iterdir():
            with suppress(FileNotFoundError):  # another process has finished its upload meanwhile
                if path.stat().st_mtime < time.time() - LEFT_OVER_AFTER_S:
                    path.unlink()


@cache
def _shipped_facts() -> dict[str, Facts]:
    return dict(json.loads(SHIPPED_FACTS.read_bytes()))


class AssetNames:
    """Resolves a document's names of assets to `sha256:<hex>`; queries the database once for each."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._rows: dict[str, AssetRow | None] = {}

    def resolved(self, place: str, asset: str) -> str:
        """Returns the reference of the asset that a document names at `place`, by digest or by uploaded name.

        Raises:
            DeltalightError: there is no such asset, several have this name, or its kind does not fit `place`.
        """
        if asset not in self._rows:
            self._rows[asset] = self._session.get(AssetRow, _digest_of(self._session, place, asset))
        row = self._rows[asset]
        if row is None:
            raise DeltalightError(
                f"`{place}` names {asset!r:.200}, which is not an uploaded asset; upload the file, then name it as "
                "sha256:..."
            )
        if row.kind != _needed_kind(place):
            raise DeltalightError(
                f"`{place}` needs a {_needed_kind(place)} and {asset!r:.200} is a {row.kind}; name another asset."
            )
        return DIGEST_PREFIX + row.digest


def _needed_kind(place: str) -> str:
    if place == "lights.environment.map":
        return "map"
    return "material" if place.endswith(".precomputed") else "mesh"


def _digest_of(session: Session, place: str, asset: str) -> str:
    if asset.startswith(DIGEST_PREFIX):
        return asset.removeprefix(DIGEST_PREFIX).lower()
    query = select(AssetNameRow.digest).where(AssetNameRow.name == asset).limit(2)
    digests = list(session.scalars(query))
    if len(digests) > 1:
        raise DeltalightError(
            f"`{place}` names {asset!r:.200} but several assets have this name; name one as {DIGEST_PREFIX}..."
        )
    return digests[0] if digests else ""


def _require_unused(session: Session, digest: str) -> None:
    query = (
        select(AssetUseRow)
        .join(SceneRow, SceneRow.id == AssetUseRow.scene_id)
        .where(AssetUseRow.digest == digest, SceneRow.deleted_ns.is_(None))
    )
    use = session.scalars(query.limit(1)).first()
    if use is not None:
        raise ConflictError(
            f"the asset is used by scene {use.scene_id} since revision {use.number}; delete that scene first "
            "(undo needs the assets of all revisions)."
        )


def _row(session: Session, digest: str) -> AssetRow:
    row = session.get(AssetRow, digest)
    if row is None:
        raise NotFoundError(f"there is no asset sha256:{digest:.64}; list the assets for their digests.")
    return row


def _asset(session: Session, row: AssetRow) -> Asset:
    query = select(AssetNameRow.name).where(AssetNameRow.digest == row.digest).order_by(AssetNameRow.name)
    names = tuple(session.scalars(query))
    return Asset(
        row.digest, names, BY_NAME[row.format], row.size_bytes, json.loads(row.facts), row.uploaded_ns
    )


def _columns(digest: str, found: AssetFormat, size_bytes: int, facts: Facts) -> dict[str, object]:
    return {
        "digest": digest,
        "kind": found.kind,
        "format": found.name,
        "size_bytes": size_bytes,
        "facts": json.dumps(facts),
        "uploaded_ns": time.time_ns(),
    }


def _file_name(format_name: str) -> str:
    return f"asset{BY_NAME[format_name].suffix}"
