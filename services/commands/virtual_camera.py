"""`deltalight virtual-camera`: the relit picture as a webcam of this machine."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from deltalight.services.commands.options import ConfigFile, OneCamera, parse_size
from deltalight.services.ports import COMPOSITE_PORT, endpoint

PERIOD_S = 1 / 25  # programs take a camera for frozen that gives less


def virtual_camera(
    *,
    device: Annotated[Path, typer.Option(help="Device of v4l2loopback, such as /dev/video10.")],
    composites: Annotated[
        str, typer.Option(help="Endpoint at which the render server publishes relit pictures.")
    ] = endpoint(COMPOSITE_PORT),
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
    from deltalight.protocol.receiver import Receiver
    from deltalight.services.relit_pictures import composite_topic, newest_picture
    from deltalight.services.settings import load_configuration
    from deltalight.services.virtual_camera import VirtualCamera

    size_px = None if size is None else parse_size(size)
    keys = load_configuration(config_file).section("keys", KeySettings).load([composites])
    with (
        VirtualCamera(device) as webcam,
        closing(Receiver([composites], [composite_topic(camera)], keys=keys)) as receiver,
    ):
        typer.echo(f"Waiting for the first picture of {composites}.", err=True)
        while (picture := newest_picture(receiver, PERIOD_S)) is None:
            pass
        webcam.begin(size_px or (picture.shape[1], picture.shape[0]))
        typer.echo(
            f"{device} shows the relit picture, {webcam.size[0]}x{webcam.size[1]}; press Ctrl-C to stop."
        )
        while True:
            webcam.show(picture)
            newer = newest_picture(receiver, PERIOD_S)
            picture = picture if newer is None else newer
