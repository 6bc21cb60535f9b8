"""Entry to the storage: one folder with a database and a folder of assets."""

import copy
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from sqlalchemy import select

from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.services.storage.asset_files import asset_files
from deltalight.services.storage.asset_sandbox import probe as probe_asset
from deltalight.services.storage.assets import AssetStore, Probe
from deltalight.services.storage.data_folder import ASSETS, DATABASE, use_folder
from deltalight.services.storage.database import Database
from deltalight.services.storage.drained import DrainedStore
from deltalight.services.storage.faults import StorageFaultError
from deltalight.services.storage.feed import Feed
from deltalight.services.storage.scenes import SceneStore
from deltalight.services.storage.sqlite import SqliteDatabase
from deltalight.services.storage.tables import ChoiceRow
from deltalight.services.storage.tickets import TicketStore
from deltalight.services.storage.tokens import TokenStore


class Store:
    """Scenes, assets and tokens of one `folder`; usable by several threads and processes. A context manager.

    They are in the folder and its SQLite file, unless a PostgreSQL `database` and a store of objects for the files of
    `assets` are given by their addresses. What a call has stored is durable when it returns. `probe` loads an upload
    once, with limits.

    Raises:
        DeltalightError: the folder cannot be written, has other contents or damaged ones, or is being restored; or
            the database cannot be used.
    """

    def __init__(
        self,
        folder: Path,
        *,
        database: str | None = None,
        assets: str | None = None,
        probe: Probe = probe_asset,
    ) -> None:
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as fault:
            raise DeltalightError(
                f"{folder} cannot be written ({fault.strerror}); name another folder with --data."
            ) from fault
        self.folder = folder
        with use_folder(folder) as opening:
            self._database = _open_database(folder, database)
            opening.callback(self._database.close)
            self.assets = AssetStore(self._database, asset_files(folder / ASSETS, assets), probe)
            self.scenes = SceneStore(self._database)
            self.tokens = TokenStore(self._database)
            self.tickets = TicketStore(self._database)
            self.drained = DrainedStore(self._database)
            self._opened = opening.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_fault: object) -> None:
        self.close()

    def of_room(self, room: str, rooms: Sequence[str]) -> Self:
        """Returns this store with the active scene of one of the `rooms`; it is closed with this one."""
        own = copy.copy(self)
        own.scenes = SceneStore(self._database, room, rooms)
        return own

    def answers(self) -> bool:
        """Whether the database can be read now."""
        try:
            with self._database.reading() as session:
                session.execute(select(ChoiceRow.key).limit(1))
        except StorageFaultError:
            return False
        return True

    def feed(self) -> Feed:
        """Returns a feed to and from the other processes that use this database; the caller closes it.

        Who has one has the lists and the active scene at hand, if the database goes.
        """
        self._database.keep_known(self.scenes.all, self.scenes.active, self.assets.all)
        return self._database.feed()

    @property
    def poster(self) -> Path:
        """The still that the dashboard shows until the first live picture comes; such a file may be missing."""
        return self.folder / "poster.jpg"

    @property
    def poster_before(self) -> Path:
        """The camera's own picture of the poster's frame; such a file may be missing."""
        return self.folder / "poster_before.jpg"

    @property
    def recordings(self) -> Path:
        """The folder of recordings; it may be missing."""
        return self.folder / "recordings"

    def close(self) -> None:
        """Closes the database, and lets others replace the folder's contents."""
        self._opened.close()


def _open_database(folder: Path, address: str | None) -> Database:
    if address is None:
        return SqliteDatabase(folder / DATABASE)
    try:
        from deltalight.services.storage.postgres import PostgresDatabase
    except ModuleNotFoundError as fault:
        command = install_command("deltalight[postgres]")
        raise DeltalightError(f"PostgreSQL needs {fault.name}: {command}.") from fault
    return PostgresDatabase(address)


def default_folder() -> Path:
    """Returns the default data folder (XDG base directory specification)."""
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "deltalight"
