"""`deltalight api`: the web process, and its tokens."""

import json
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from deltalight.services.commands.options import ConfigFile, Data, DatabaseAddress, NodeName, data_folder
from deltalight.services.garbage_collection import no_garbage_collection
from deltalight.services.ports import COMPOSITE_PORT, endpoint

if TYPE_CHECKING:
    from deltalight.protocol.keys import KeySettings
    from deltalight.services.storage.store import Store

api = typer.Typer(
    invoke_without_command=True, help="Serve the dashboard, REST API and live video, or manage access tokens."
)


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
        typer.Option(
            help="Address to listen on; any other than loopback requires tokens. Default: 127.0.0.1."
        ),
    ] = None,
    allowed_host: Annotated[
        list[str] | None,
        typer.Option(
            help="Name under which other hosts open the page, such as that of a proxy, beside this host's own names; "
            "may be given more than once."
        ),
    ] = None,
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="Port. Default: 8000.")] = None,
    data: Data = None,
    database: DatabaseAddress = None,
    scene: Annotated[
        Path | None, typer.Option(help="Scene document to import, with its files, and show.")
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(help="File with an additional token of role control, such as a container's secret."),
    ] = None,
    view_token_file: Annotated[
        Path | None, typer.Option(help="The same for a token of role view, such as a monitor's.")
    ] = None,
    control: Annotated[
        str | None,
        typer.Option(help="Endpoint of the render server's commands. Default: tcp://127.0.0.1:5603."),
    ] = None,
    subscribe: Annotated[
        list[str] | None,
        typer.Option(
            help="Endpoint of pictures and reports; may be given more than once. Default: ports 5602 and 5601."
        ),
    ] = None,
    node: NodeName = None,
    playback: Annotated[
        str | None,
        typer.Option(
            help="Control endpoint of the recording that the node plays, for a timeline on the page."
        ),
    ] = None,
    rooms: Annotated[
        str | None, typer.Option(help="Endpoint of the directory of rooms, for several rooms.")
    ] = None,
    config_file: ConfigFile = None,
) -> None:
    """Serve the dashboard at /, and scenes, assets, live video and state at /api/v1, until Ctrl-C."""
    if context.invoked_subcommand is not None:
        return
    with no_garbage_collection():
        from deltalight.protocol.keys import KeySettings
        from deltalight.services.api.serve import run_api
        from deltalight.services.api.settings import ApiSettings
        from deltalight.services.settings import load_configuration

    given: dict[str, Any] = {
        "host": host,
        "allowed_hosts": allowed_host or None,
        "port": port,
        "data": data,
        "database": database,
        "token_file": token_file,
        "view_token_file": view_token_file,
        "control": control,
        "playback": playback,
        "rooms": rooms,
    }
    configuration = load_configuration(config_file)
    key_settings = configuration.section("keys", KeySettings)
    given["subscribe"] = _subscriptions(subscribe, node, key_settings)
    settings = configuration.section("api", ApiSettings, {k: v for k, v in given.items() if v is not None})
    playback_endpoints = [] if settings.playback is None else [settings.playback]
    endpoints = [settings.rooms or settings.control, *playback_endpoints, *settings.subscribe]
    run_api(settings, key_settings.load(endpoints), scene)


@api.command()
def token(
    name: Annotated[str, typer.Argument(help="Name of the token, for example of its user.")],
    role: Annotated[
        TokenRole, typer.Option(help="view: look only; control: change everything.")
    ] = TokenRole.VIEW,
    data: Data = None,
    database: DatabaseAddress = None,
) -> None:
    """Create a token and print it; it cannot be shown again."""
    with _store(data, database) as store:
        typer.echo(store.tokens.create(name, role.value))


@api.command()
def tokens(
    data: Data = None,
    database: DatabaseAddress = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False,
) -> None:
    """List the tokens with their roles and dates."""
    with _store(data, database) as store:
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
    name: Annotated[str, typer.Argument(help="Name of the token to revoke.")],
    data: Data = None,
    database: DatabaseAddress = None,
) -> None:
    """Revoke a token; it is refused from the next request on, without a restart."""
    with _store(data, database) as store:
        store.tokens.revoke(name)
    typer.echo(f"The token `{name}` is no longer accepted.")


def _subscriptions(subscribe: list[str] | None, node: str | None, keys: "KeySettings") -> list[str] | None:
    """Returns the given endpoints, or the one of the node to be found beside the render server."""
    if node is None:
        return subscribe or None
    from deltalight.services.discovery import node_endpoint

    return [*(subscribe or [endpoint(COMPOSITE_PORT)]), node_endpoint(node, keys)]


def _store(data: Path | None, database: str | None) -> "Store":
    from deltalight.services.host_store import open_store

    return open_store(data_folder(data), database=database)
