"""`deltalight stream`: the relit picture to a media server."""

import time
from typing import TYPE_CHECKING, Annotated

import typer

from deltalight.protocol.counts import counted
from deltalight.services.commands.options import ConfigFile, OneCamera
from deltalight.services.commands.room_options import Composites, Room, Rooms, relit_pictures

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from deltalight.services.picture_source import PictureSource
    from deltalight.services.stream_out import StreamOut, StreamStatus

SHOW_PERIOD_S = 0.5


def stream(
    *,
    to: Annotated[
        str,
        typer.Option(
            envvar="DELTALIGHT_STREAM_TO",
            show_envvar=True,
            help="Address of the media server: rtsp://HOST:8554/NAME, rtmp://HOST/live/NAME, or srt://HOST:8890?streamid=ID.",
        ),
    ],
    composites: Composites = None,
    rooms: Rooms = None,
    room: Room = None,
    camera: OneCamera = None,
    config_file: ConfigFile = None,
) -> None:
    """Send the relit picture to a media server (H.264), for many viewers, until Ctrl-C."""
    from rich.console import Console
    from rich.live import Live

    from deltalight.protocol.errors import DeltalightError
    from deltalight.protocol.keys import KeySettings
    from deltalight.services.h264 import why_unavailable
    from deltalight.services.settings import load_configuration
    from deltalight.services.srt import why_unavailable as why_no_srt
    from deltalight.services.stream_out import StreamOut, Target

    target = Target.parse(to)
    reason = why_unavailable() or (why_no_srt() if target.container == "mpegts" else None)
    if reason is not None:
        raise DeltalightError(reason)
    keys = load_configuration(config_file).section("keys", KeySettings)
    console = Console(stderr=True, soft_wrap=True)

    def tell(sentence: str) -> None:
        console.print(sentence, markup=False, highlight=False)

    with (
        relit_pictures(composites, rooms, room, camera, keys) as (source, place),
        StreamOut(target, tell) as out,
    ):
        tell(f"Waiting for the first picture of {place}.")
        with Live(console=console, transient=True, auto_refresh=False) as live:
            _send_all(source, out, lambda status: live.update(_line(status), refresh=True))


def _send_all(source: "PictureSource", out: "StreamOut", show: "Callable[[StreamStatus], None]") -> None:
    """Sends each picture, and the last one again while none comes."""
    from deltalight.services.stream_out import REPEAT_AFTER_S

    picture: np.ndarray | None = None
    shown_s = 0.0
    while True:
        newer = source.newest(REPEAT_AFTER_S)
        picture = picture if newer is None else newer
        if picture is not None:
            out.show(picture)
        if time.monotonic() - shown_s >= SHOW_PERIOD_S:
            shown_s = time.monotonic()
            show(out.status)


def _line(status: "StreamStatus") -> str:
    state = "connected" if status.is_connected else "not connected"
    return f"{state}: {counted(status.pictures, 'picture')}, {status.bytes / 1e6:.1f} MB sent"
