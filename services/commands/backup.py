"""`deltalight backup` and `deltalight restore`: scenes, tokens and assets in one file."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deltalight.protocol.counts import counted
from deltalight.protocol.errors import DeltalightError
from deltalight.services.commands.options import ConfigFile, Data, data_folder

if TYPE_CHECKING:
    from deltalight.services.storage.backup import Contents

AsJson = Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")]


def backup(
    path: Annotated[Path, typer.Argument(help="File to write, such as station.zip; it must not exist.")],
    *,
    data: Data = None,
    config_file: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Copy scenes, tokens and assets into one file, even while the service runs.

    Recordings and snapshots are files of their own and are not in it.
    """
    from deltalight.services.storage.backup import write_backup

    contents = write_backup(_whole_folder(data, config_file), path)
    _print(contents, f"are in {path}", as_json=as_json)


def restore(
    path: Annotated[Path, typer.Argument(help="File that `deltalight backup` wrote.")],
    *,
    data: Data = None,
    config_file: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Restore scenes, tokens and assets from a backup; stop the service first.

    What was there before is moved aside within the data folder, never deleted. Recordings and snapshots stay.
    """
    from deltalight.services.storage.backup import restore_backup

    folder = _whole_folder(data, config_file)
    contents = restore_backup(path, folder)
    _print(contents, f"are in {folder}", as_json=as_json)


def _whole_folder(data: Path | None, config_file: Path | None) -> Path:
    """Returns the data folder.

    Raises:
        DeltalightError: a part of what it usually holds is elsewhere.
    """
    from deltalight.services.api.settings import ApiSettings
    from deltalight.services.settings import load_configuration

    settings = load_configuration(config_file).section("api", ApiSettings)
    if settings.database is not None or settings.assets is not None:
        raise DeltalightError(
            "the configuration names a `database` or a store of `assets` outside of the data folder; use pg_dump and "
            "pg_restore for the database, and copy the files of assets by the tools of their store."
        )
    return data_folder(data, config_file)


def _print(contents: "Contents", place: str, *, as_json: bool) -> None:
    aside = None if contents.aside is None else str(contents.aside)
    if as_json:
        figures = {name: getattr(contents, name) for name in ("scenes", "revisions", "assets", "size_bytes")}
        typer.echo(json.dumps({**figures, "aside": aside}))
        return
    size = f"{contents.size_bytes / 1e6:.2f} MB"
    typer.echo(
        f"{counted(contents.scenes, 'scene')} with {counted(contents.revisions, 'revision')} and"
        f" {counted(contents.assets, 'asset')} ({size}) {place}"
    )
    if aside is not None:
        typer.echo(f"The previous data is in {aside}; delete it when you no longer need it.")
