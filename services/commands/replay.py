"""`deltalight replay`: a recording or dataset folder, published as a sensor node does."""

from pathlib import Path
from typing import Annotated

import typer

from services.commands.options import ConfigFile


def replay(
    source: Annotated[Path, typer.Argument(help="Dataset folder or .mcap recording.")],
    *,
    publish: Annotated[
        str | None, typer.Option(help="Endpoint for the streams. Default: tcp://127.0.0.1:5601.")
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the node; topics end with it. Default: camera.")
    ] = None,
    clock: Annotated[
        str | None, typer.Option(help="Control endpoint of the render server whose clock stamps refer to.")
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end.")] = False,
    fast: Annotated[
        bool, typer.Option("--fast", help="As fast as frames can be made ready, not at the recorded times.")
    ] = False,
    config_file: ConfigFile = None,
) -> None:
    """Publish a recording or dataset folder as its node did, until its end or Ctrl-C."""
    from protocol.source import open_source
    from services.node_process import run_configured_node

    open_source(source)  # refuses here what a node would take for a live camera
    given = {"source": str(source), "endpoint": publish, "name": name, "clock_endpoint": clock}
    settings: dict[str, object] = {key: value for key, value in given.items() if value is not None}
    # The light is what was recorded, whatever camera the configuration file names for it.
    settings |= {"loop": loop, "realtime": not fast, "fisheye": None}
    run_configured_node(settings, config_file)
