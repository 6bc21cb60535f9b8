"""`deltalight up`: all processes of one host, supervised."""

from pathlib import Path
from typing import Annotated

import typer

from services.ports import COMPOSITE_PORT, CONTROL_PORT, LOOPBACK, NODE_PORT, PAGE_PORT


def up(
    *,
    source: Annotated[str, typer.Option(help="Dataset folder, .mcap recording, or `synthetic`.")],
    scene: Annotated[
        Path | None, typer.Option(help="Scene document; default: the one that the recording carries.")
    ] = None,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the viewer page.")] = PAGE_PORT,
    node_port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the node's streams.")] = NODE_PORT,
    composite_port: Annotated[
        int, typer.Option(min=1, max=65535, help="Port of the composites.")
    ] = COMPOSITE_PORT,
    control_port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the commands.")] = CONTROL_PORT,
    device: Annotated[
        int | None, typer.Option(min=0, help="EGL device; `deltalight doctor` lists them.")
    ] = None,
    allow_software: Annotated[
        bool, typer.Option("--allow-software", help="Accept a renderer without a GPU.")
    ] = False,
) -> None:
    """Run node, render server and viewer on this host and restart what dies, until Ctrl-C."""
    from protocol.source import open_source
    from sensor_node.node import SYNTHETIC
    from services.host import HostPlan, choose_scene, session_file
    from services.supervisor import Supervisor

    recording = None if source == SYNTHETIC else open_source(Path(source))
    with session_file(choose_scene(recording, scene)) as session:
        plan = HostPlan(
            source,
            session,
            node_port=node_port,
            composite_port=composite_port,
            control_port=control_port,
            page_port=port,
            device=device,
            allow_software=allow_software,
        )
        plan.require_free_ports()
        with Supervisor(plan.specs()) as supervisor:
            typer.echo(f"The live picture is at http://{LOOPBACK}:{port} (Ctrl-C ends everything).")
            supervisor.run()
