"""Entry to the storage: one folder with a database and a folder of assets."""

import copy
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.asset_sandbox import probe as probe_asset
from deltalight.services.storage.assets import AssetStore, Probe
from deltalight.services.storage.data_folder import ASSETS, DATABASE, use_folder
from deltalight.services.storage.database import Database
from deltalight.services.storage.scenes import SceneStore
from deltalight.services.storage.tokens import TokenStore


class Store:
    """Scenes, assets and tokens of one `folder`; usable by several threads and processes. A context manager.

    What a call has stored is durable when it returns. `probe` loads an upload once, with limits.

    Raises:
        DeltalightError: the folder cannot be written, has other contents or damaged ones, or is being restored.
    """

    def __init__(self, folder: Path, *, probe: Probe = probe_asset) -> None:
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as fault:
            raise DeltalightError(
                f"{folder} cannot be written ({fault.strerror}); name another folder with --data."
            ) from fault
        self.folder = folder
        with use_folder(folder) as opening:
            self._database = Database(folder / DATABASE)
            opening.callback(self._database.close)
            self.assets = AssetStore(self._database, folder / ASSETS, probe)
            self.scenes = SceneStore(self._database)
            self.tokens = TokenStore(self._database)
            self._opened = opening.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_fault: object) -> None:
        self.close()

    def of_room(self, room: str, rooms: Sequence[str]) -> Self:
        """Return this store with the active scene of one of the `rooms`; it is closed with this one."""
        own = copy.copy(self)
        own.scenes = SceneStore(self._database, room, rooms)
        return own

    @property
    def poster(self) -> Path:
        """The still that the dashboard shows until the first live picture comes; such a file may be missing."""
        return self.folder / "poster.jpg"

    def close(self) -> None:
        """Close the database, and let others replace the folder's contents."""
        self._opened.close()


def default_folder() -> Path:
    """Return the default data folder (XDG base directory specification)."""
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "deltalight"
