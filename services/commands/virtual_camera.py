"""`deltalight virtual-camera`: the relit picture as a webcam of this machine."""

from pathlib import Path
from typing import Annotated

import typer

from deltalight.services.commands.options import ConfigFile, OneCamera, parse_size
from deltalight.services.commands.room_options import Composites, Room, Rooms, relit_pictures

PERIOD_S = 1 / 25  # programs take a camera for frozen that gives less


def virtual_camera(
    *,
    device: Annotated[Path, typer.Option(help="Device of v4l2loopback, such as /dev/video10.")],
    composites: Composites = None,
    rooms: Rooms = None,
    room: Room = None,
    camera: OneCamera = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", help="Size of the camera, such as 1280x720; default: that of the first picture."
        ),
    ] = None,
    config_file: ConfigFile = None,
) -> None:
    """Show relit pictures as a webcam, for OBS and calls, until Ctrl-C."""
    from deltalight.protocol.keys import KeySettings
    from deltalight.services.settings import load_configuration
    from deltalight.services.virtual_camera import VirtualCamera

    size_px = None if size is None else parse_size(size)
    keys = load_configuration(config_file).section("keys", KeySettings)
    with (
        VirtualCamera(device) as webcam,
        relit_pictures(composites, rooms, room, camera, keys) as (source, place),
    ):
        typer.echo(f"Waiting for the first picture of {place}.", err=True)
        while (picture := source.newest(PERIOD_S)) is None:
            pass
        webcam.begin(size_px or (picture.shape[1], picture.shape[0]))
        typer.echo(
            f"{device} shows the relit picture, {webcam.size[0]}x{webcam.size[1]}; press Ctrl-C to stop."
        )
        while True:
            webcam.show(picture)
            newer = source.newest(PERIOD_S)
            picture = picture if newer is None else newer
