"""`deltalight node`: a sensor node process."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from deltalight.services.commands.options import ConfigFile
from deltalight.services.garbage_collection import no_garbage_collection

if TYPE_CHECKING:
    from deltalight.sensor_node.cameras.driver import Discovery


def node(
    *,
    source: Annotated[
        str | None,
        typer.Option(
            help="Camera (`uvc:0`, `oak`), dataset folder, .mcap recording, or `synthetic` (default)."
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the node. Default: camera.")] = None,
    publish: Annotated[
        str | None, typer.Option(help="Endpoint for the streams. Default: tcp://127.0.0.1:5601.")
    ] = None,
    clock: Annotated[
        str | None,
        typer.Option(help="Control endpoint of the render server whose clock the timestamps follow."),
    ] = None,
    fisheye: Annotated[
        str | None,
        typer.Option(help="Fish-eye camera that sees the light, as for --source; default: the source's own."),
    ] = None,
    tracking: Annotated[
        bool,
        typer.Option(
            "--tracking",
            help="Take the camera's pose from OpenTrackIO packets, as configured in `node.tracking`.",
        ),
    ] = False,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration folder of a live camera (rgb.yaml, board.yaml, ...).")
    ] = None,
    loop: Annotated[
        bool | None, typer.Option("--loop/--no-loop", help="Start again when the source ends.")
    ] = None,
    fast: Annotated[
        bool | None,
        typer.Option("--fast", help="Send frames as fast as possible instead of at their recorded times."),
    ] = None,
    config_file: ConfigFile = None,
    list_cameras: Annotated[
        bool, typer.Option("--list", help="List the cameras of this machine and exit.")
    ] = False,
    discover: Annotated[
        bool,
        typer.Option("--discover", help="List the nodes found on the network and exit."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False,
) -> None:
    """Publish colour, depth, light and pose from a camera or a recording, until it ends or Ctrl-C."""
    if list_cameras or discover:
        _print_lists(cameras=list_cameras, nodes=discover, as_json=as_json)
        return
    given = {
        "source": source,
        "name": name,
        "endpoint": publish,
        "clock_endpoint": clock,
        "loop": loop,
        "realtime": None if fast is None else not fast,
        "camera": None if calibration is None else {"calibration": calibration},
        "tracking": {} if tracking else None,
        "fisheye": None if fisheye is None else {"source": fisheye},
    }
    with no_garbage_collection():
        from deltalight.services.node_process import run_configured_node

    run_configured_node({key: value for key, value in given.items() if value is not None}, config_file)


def _print_lists(*, cameras: bool, nodes: bool, as_json: bool) -> None:
    data: dict[str, Any] = {}
    if cameras:
        from deltalight.sensor_node.cameras.discovery import discover

        found = discover()
        data["cameras"] = [camera.as_dict() for camera in found.cameras]
        data["missing"] = [asdict(missing) for missing in found.missing]
        if not as_json:
            _print_cameras(found)
    if nodes:
        from deltalight.services.discovery import find_nodes

        data["nodes"] = [each.as_dict() for each in find_nodes()]
        if not as_json:
            _print_nodes(data["nodes"])
    if as_json:
        typer.echo(json.dumps(data, indent=2))


def _print_cameras(found: "Discovery") -> None:
    _print_table(
        ("Source", "Camera", "Found", "What to do"),
        [(each.source, each.name, each.details, each.hint) for each in found.cameras],
        "no camera was found",
    )
    for missing in found.missing:
        typer.echo(f"{missing.kind}: {missing.details}; {missing.hint}")


def _print_nodes(nodes: Sequence[dict[str, Any]]) -> None:
    _print_table(
        ("Node", "Endpoint", "Keys", "Streams"),
        [
            (each["name"], each["endpoint"], "yes" if each["curve"] else "no", " ".join(each["streams"]))
            for each in nodes
        ],
        "no node announces itself on this network",
    )


def _print_table(headings: Sequence[str], rows: Sequence[Sequence[str]], otherwise: str) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    if not rows:
        typer.echo(otherwise)
        return
    table = Table(*headings, box=None)
    for row in rows:
        table.add_row(*map(escape, row))
    Console().print(table)
