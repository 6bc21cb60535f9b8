"""`deltalight server`: a render server process."""

from pathlib import Path
from typing import Annotated

import typer

from services.ports import COMPOSITE_PORT, CONTROL_PORT, NODE_PORT, endpoint


def server(
    *,
    scene: Annotated[Path | None, typer.Option(help="Scene document to start with.")] = None,
    session: Annotated[
        Path | None,
        typer.Option(help="File that keeps the current scene, so that a restart goes on with it."),
    ] = None,
    subscribe: Annotated[
        list[str] | None, typer.Option(help="Endpoint of a sensor node; may be given several times.")
    ] = None,
    publish: Annotated[str, typer.Option(help="Endpoint for composites.")] = endpoint(COMPOSITE_PORT),
    control: Annotated[str, typer.Option(help="Endpoint for commands.")] = endpoint(CONTROL_PORT),
    device: Annotated[
        int | None, typer.Option(min=0, help="EGL device; `deltalight doctor` lists them.")
    ] = None,
    allow_software: Annotated[
        bool, typer.Option("--allow-software", help="Accept a renderer without a GPU.")
    ] = False,
) -> None:
    """Render what sensor nodes send and publish the composites, until Ctrl-C."""
    from render_server.server import ServerSettings, run_server

    run_server(
        ServerSettings(
            scene=scene,
            session=session,
            subscribe=tuple(subscribe or [endpoint(NODE_PORT)]),
            publish=publish,
            control=control,
            device=device,
            allow_software=allow_software,
        )
    )
