"""`deltalight rooms`: the rooms of an installation, and which of them run where."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deltalight.services.commands.options import ConfigFile
from deltalight.services.ports import ROOMS_PORT, endpoint

if TYPE_CHECKING:
    from deltalight.services.rooms.directory import DirectoryClient
    from deltalight.services.rooms.status import RoomList

rooms = typer.Typer(
    no_args_is_help=True,
    help="List, move, drain and start the rooms of `deltalight up --rooms`, and drain its hosts.",
)

Room = Annotated[str, typer.Argument(help="Name of the room, as in the rooms file.")]
Host = Annotated[str, typer.Argument(help="Name of a host, as `rooms list` prints it beside its slots.")]
Directory = Annotated[str, typer.Option(help="Endpoint of the directory of rooms.")]
HERE = endpoint(ROOMS_PORT)


@rooms.command("list")
def list_rooms(
    *,
    directory: Directory = HERE,
    as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False,
    config_file: ConfigFile = None,
) -> None:
    """List rooms and slots: which rooms run, which wait, and why."""
    found = _directory(directory, config_file).rooms()
    if as_json:
        typer.echo(found.model_dump_json(indent=2))
    else:
        _print_rooms(found)


@rooms.command()
def drain(room: Room, *, directory: Directory = HERE, config_file: ConfigFile = None) -> None:
    """Stop a room's render server until it is started again; waiting rooms can use its slot."""
    _print_rooms(_directory(directory, config_file).command("drain", room))


@rooms.command()
def start(room: Room, *, directory: Directory = HERE, config_file: ConfigFile = None) -> None:
    """Start a room that was drained or has failed."""
    _print_rooms(_directory(directory, config_file).command("start", room))


@rooms.command()
def move(
    room: Room,
    slot: Annotated[str | None, typer.Argument(help="Name of a free slot; default: any.")] = None,
    *,
    directory: Directory = HERE,
    config_file: ConfigFile = None,
) -> None:
    """Move a room to another slot; the old one shows it until the new one has pictures."""
    _print_rooms(_directory(directory, config_file).command("move", room, slot))


@rooms.command("drain-host")
def drain_host(host: Host, *, directory: Directory = HERE, config_file: ConfigFile = None) -> None:
    """Move the rooms of a host to other hosts, one after another; rooms without a slot there stop and wait."""
    _print_rooms(_directory(directory, config_file).host_command("drain-host", host))


@rooms.command("undrain-host")
def undrain_host(host: Host, *, directory: Directory = HERE, config_file: ConfigFile = None) -> None:
    """Allow rooms to start on a drained host again."""
    _print_rooms(_directory(directory, config_file).host_command("undrain-host", host))


@rooms.command()
def claim(
    figures: Annotated[
        Path, typer.Argument(help="report.json of `deltalight gpu-check --steps memory,speed` on this host.")
    ],
    *,
    frames_per_s: Annotated[
        float, typer.Option(min=0.1, max=240, help="Frame rate that each room should reach.")
    ] = 30.0,
) -> None:
    """Print the `ray start` options for this host, from the memory and time that a room needs."""
    from deltalight.services.rooms.capacity import find_device_apart, labels_of, load_figures, slots_of
    from deltalight.services.rooms.ray_cluster import SLOT_RESOURCE
    from deltalight.services.rooms.render_actor import hardware_devices

    room = load_figures(figures)
    devices: Sequence[int | None] = hardware_devices() or (None,)
    found = [find_device_apart(device) for device in devices]
    slots = sum(slots_of(room, each, frames_per_s) for each in found)
    labels = ",".join(f"{key}={value}" for key, value in labels_of(found[0]).items())
    typer.echo(f"--resources='{json.dumps({SLOT_RESOURCE: slots})}' --labels={labels}")


def _directory(address: str, config_file: ConfigFile) -> "DirectoryClient":
    from deltalight.protocol.keys import KeySettings
    from deltalight.services.rooms.directory import DirectoryClient
    from deltalight.services.settings import load_configuration

    settings = load_configuration(config_file).section("keys", KeySettings)
    return DirectoryClient(address, settings.load([address]))


def _print_rooms(found: "RoomList") -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table("Room", "State", "Slot", "Nodes", "Restarts", "Why", box=None)
    for room in found.rooms:
        slot = (room.slot or "") + (f" -> {room.moving_to}" if room.moving_to else "")
        nodes = " ".join(node.name for node in room.nodes)
        table.add_row(*map(escape, (room.name, room.state, slot, nodes, str(room.restarts), room.why)))
    console = Console(soft_wrap=True)
    console.print(table)
    for place in found.slots:
        drained = ", drained" if place.drained else ""
        console.print(
            escape(f"{place.name} ({place.device}, host {place.host}{drained}): {place.room or 'free'}")
        )
