"""`deltalight virtual-camera`: the relit picture as a webcam of this machine."""

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deltalight.services.commands.options import ConfigFile, parse_size
from deltalight.services.ports import COMPOSITE_PORT, endpoint

if TYPE_CHECKING:
    import numpy as np

    from deltalight.protocol.receiver import Receiver

PERIOD_S = 1 / 25  # programs take a camera for frozen that gives less


def virtual_camera(
    *,
    device: Annotated[Path, typer.Option(help="Device of v4l2loopback, such as /dev/video10.")],
    composites: Annotated[
        str, typer.Option(help="Endpoint at which the render server publishes relit pictures.")
    ] = endpoint(COMPOSITE_PORT),
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
    from deltalight.services.settings import load_configuration
    from deltalight.services.virtual_camera import VirtualCamera

    size_px = None if size is None else parse_size(size)
    keys = load_configuration(config_file).section("keys", KeySettings).load([composites])
    with (
        VirtualCamera(device) as camera,
        closing(Receiver([composites], ["composite"], keys=keys)) as receiver,
    ):
        typer.echo(f"Waiting for the first picture of {composites}.", err=True)
        while (picture := _newest(receiver)) is None:
            pass
        camera.begin(size_px or (picture.shape[1], picture.shape[0]))
        typer.echo(f"{device} shows the relit picture, {camera.size[0]}x{camera.size[1]}; Ctrl-C ends it.")
        while True:
            camera.show(picture)
            newer = _newest(receiver)
            picture = picture if newer is None else newer


def _newest(receiver: "Receiver") -> "np.ndarray | None":
    """Return the newest relit picture that comes within the camera's period."""
    from deltalight.protocol.envelope import decode
    from deltalight.protocol.messages import CompositeMessage
    from deltalight.protocol.pictures import decode_rgb
    from deltalight.services.relit_pictures import relit_picture

    for multipart in (receiver.latest(PERIOD_S) or {}).values():
        message, parts = decode(multipart)
        if isinstance(message, CompositeMessage) and (coded := relit_picture(message, parts)) is not None:
            return decode_rgb(coded, "of the render server")
    return None
