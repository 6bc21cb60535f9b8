"""`deltalight replay`: publishes a recording or dataset folder like a sensor node."""

from pathlib import Path
from typing import Annotated

import typer

from deltalight.services.commands.options import ConfigFile


def replay(
    source: Annotated[Path, typer.Argument(help="Dataset folder or .mcap recording.")],
    *,
    publish: Annotated[
        str | None, typer.Option(help="Endpoint for the streams. Default: tcp://127.0.0.1:5601.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the node. Default: camera.")] = None,
    clock: Annotated[
        str | None,
        typer.Option(help="Control endpoint of the render server whose clock the timestamps follow."),
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Start again when the recording ends.")] = False,
    rate: Annotated[
        float | None, typer.Option(help="Playback speed: 2 is twice as fast. Default: 1.")
    ] = None,
    start: Annotated[
        float | None, typer.Option(min=0, help="Where to start, in seconds from the first frame.")
    ] = None,
    paused: Annotated[bool, typer.Option("--paused", help="Start paused; needs --control.")] = False,
    control: Annotated[
        str | None,
        typer.Option(
            help="Endpoint for pause, seek and speed; the replay then waits at its end instead of exiting."
        ),
    ] = None,
    fast: Annotated[
        bool,
        typer.Option("--fast", help="Send frames as fast as possible instead of at their recorded times."),
    ] = False,
    config_file: ConfigFile = None,
) -> None:
    """Publish a recording or dataset folder as its node did, until it ends or Ctrl-C."""
    from deltalight.protocol.errors import DeltalightError
    from deltalight.protocol.source import open_source
    from deltalight.sensor_node.cameras.playback import PlaybackCamera
    from deltalight.services.node_process import run_configured_node

    frames = open_source(source)  # refuses here what a node would take for a live camera
    if fast and (rate is not None or start is not None or control is not None):
        raise DeltalightError("--fast ignores recorded times; leave out --rate, --start and --control.")
    if paused and control is None:
        raise DeltalightError("--paused needs --control, the endpoint at which it is resumed.")
    length_s = (frames.timestamps_ns[-1] - frames.timestamps_ns[0]) / 1e9
    if start is not None and start > length_s:
        raise DeltalightError(f"{source} is {length_s:.1f} s long; start it before that.")
    camera: PlaybackCamera | None = None
    if not fast:
        camera = PlaybackCamera(
            frames,
            loop=loop,
            rate=1.0 if rate is None else rate,
            start_s=start or 0.0,
            playing=not paused,
            stays=control is not None,
        )
    given = {"source": str(source), "endpoint": publish, "name": name, "clock_endpoint": clock}
    settings: dict[str, object] = {key: value for key, value in given.items() if value is not None}
    # The light is what was recorded, whatever camera the configuration file names for it.
    settings |= {"loop": loop, "realtime": not fast, "fisheye": None}
    run_configured_node(settings, config_file, camera, control)
