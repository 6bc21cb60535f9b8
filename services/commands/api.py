"""`deltalight api`: the REST API, and its tokens."""

import json
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.commands.options import ConfigFile

if TYPE_CHECKING:
    from services.storage.store import Store

api = typer.Typer(invoke_without_command=True, help="Serve the REST API, or manage its tokens.")
Data = Annotated[
    Path | None, typer.Option(help="Folder of scenes and assets; default: the user's data folder.")
]


class TokenRole(StrEnum):
    """What a token allows."""

    VIEW = "view"
    CONTROL = "control"


@api.callback()
def serve(
    context: typer.Context,
    *,
    host: Annotated[
        str | None,
        typer.Option(help="Address to listen on; others than loopback need tokens. Default: 127.0.0.1."),
    ] = None,
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="Port. Default: 8001.")] = None,
    data: Data = None,
    scene: Annotated[
        Path | None, typer.Option(help="Scene document to import with its files, and to render.")
    ] = None,
    control: Annotated[
        str | None,
        typer.Option(help="Endpoint of the render server's commands. Default: tcp://127.0.0.1:5603."),
    ] = None,
    subscribe: Annotated[
        list[str] | None,
        typer.Option(
            help="Endpoint that reports come from; may be given several times. Default: 5602 and 5601."
        ),
    ] = None,
    config_file: ConfigFile = None,
) -> None:
    """Serve scenes, assets and state over HTTP at /api/v1, until Ctrl-C."""
    if context.invoked_subcommand is not None:
        return
    from protocol.keys import KeySettings
    from services.api.serve import run_api
    from services.api.settings import ApiSettings
    from services.settings import load_configuration

    given: dict[str, Any] = {
        "host": host,
        "port": port,
        "data": data,
        "control": control,
        "subscribe": subscribe or None,
    }
    configuration = load_configuration(config_file)
    settings = configuration.section("api", ApiSettings, {k: v for k, v in given.items() if v is not None})
    keys = configuration.section("keys", KeySettings).load([settings.control, *settings.subscribe])
    run_api(settings, keys, scene)


@api.command()
def token(
    name: Annotated[str, typer.Argument(help="Name of the token, for example of its user.")],
    role: Annotated[
        TokenRole, typer.Option(help="view = look only, control = change everything.")
    ] = TokenRole.VIEW,
    data: Data = None,
) -> None:
    """Make a token and print it; it cannot be shown again."""
    with _store(data) as store:
        typer.echo(store.tokens.create(name, role.value))


@api.command()
def tokens(
    data: Data = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False,
) -> None:
    """List the tokens by name, role and day."""
    with _store(data) as store:
        found = store.tokens.all()
    days = [datetime.fromtimestamp(each.created_ns / 1e9, UTC).date().isoformat() for each in found]
    if as_json:
        rows = [
            {"name": each.name, "role": each.role, "created": day}
            for each, day in zip(found, days, strict=True)
        ]
        typer.echo(json.dumps(rows, indent=2))
        return
    for each, day in zip(found, days, strict=True):
        typer.echo(f"{each.name:<24} {each.role:<8} {day}")
    if not found:
        typer.echo("There are no tokens; make one with: deltalight api token NAME")


@api.command()
def revoke(
    name: Annotated[str, typer.Argument(help="Name of the token that is to end.")], data: Data = None
) -> None:
    """End a token; it is refused from the next request on, without a restart."""
    with _store(data) as store:
        store.tokens.revoke(name)
    typer.echo(f"The token `{name}` is no longer taken.")


def _store(data: Path | None) -> "Store":
    from services.api.settings import ApiSettings
    from services.settings import load_configuration
    from services.storage.store import Store, default_folder

    configured = load_configuration().section("api", ApiSettings).data
    return Store(data or configured or default_folder())
