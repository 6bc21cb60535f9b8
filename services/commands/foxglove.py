"""`deltalight foxglove`: live viewing in Foxglove."""

from pathlib import Path
from typing import Annotated

import typer

from deltalight.services.commands.options import ConfigFile, NodeName, NodeStreams, node_endpoints
from deltalight.services.ports import COMPOSITE_PORT, CONTROL_PORT, LOOPBACK, endpoint

FOXGLOVE_PORT = 8765  # which Foxglove suggests


def foxglove(
    *,
    subscribe: NodeStreams = None,
    node: NodeName = None,
    name: Annotated[str | None, typer.Option(help="Name of the node, if several publish there.")] = None,
    composites: Annotated[
        str, typer.Option(help="Endpoint at which the render server publishes relit pictures.")
    ] = endpoint(COMPOSITE_PORT),
    control: Annotated[
        str, typer.Option(help="Control endpoint of the render server whose scene is shown.")
    ] = endpoint(CONTROL_PORT),
    extrinsics: Annotated[
        Path | None, typer.Option(help="calibration/extrinsics.yaml: transforms between the sensors.")
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; beyond loopback anybody can watch.")
    ] = LOOPBACK,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port to listen on; 0 = a free one.")
    ] = FOXGLOVE_PORT,
    config_file: ConfigFile = None,
) -> None:
    """Show a node's streams, relit pictures and the scene live in Foxglove, until Ctrl-C."""
    from threading import Event

    from deltalight.protocol.calibration import load_extrinsics_yaml
    from deltalight.protocol.keys import KeySettings
    from deltalight.services.foxglove_bridge import BridgeJob, FoxgloveBridge
    from deltalight.services.settings import load_configuration

    settings = load_configuration(config_file).section("keys", KeySettings)
    places = [*node_endpoints(subscribe, node, settings), composites]
    job = BridgeJob(
        tuple(places),
        host,
        port,
        node=name,
        control=control,
        extrinsics=None if extrinsics is None else load_extrinsics_yaml(extrinsics),
        keys=settings.load([*places, control]),
    )
    bridge = FoxgloveBridge(job, lambda sentence: typer.echo(sentence, err=True))
    typer.echo(f"In Foxglove: Open connection, Foxglove WebSocket, ws://{host}:{bridge.server.port}")
    bridge.run(Event())
