"""`deltalight node`: a sensor node process."""

from typing import Annotated

import typer

from services.ports import NODE_PORT, endpoint


def node(
    *,
    source: Annotated[
        str, typer.Option(help="Dataset folder, .mcap recording, or `synthetic`.")
    ] = "synthetic",
    name: Annotated[str, typer.Option(help="Name of the node; topics end with it.")] = "camera",
    publish: Annotated[str, typer.Option(help="Endpoint for the streams.")] = endpoint(NODE_PORT),
    clock: Annotated[
        str | None, typer.Option(help="Control endpoint of the render server whose clock stamps refer to.")
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end of the source.")] = False,
    fast: Annotated[
        bool, typer.Option("--fast", help="Do not wait for the source's own times between frames.")
    ] = False,
) -> None:
    """Publish colour, depth and pose of a camera or a recording, until Ctrl-C or its end."""
    from concurrent.futures import ThreadPoolExecutor
    from threading import Event

    from protocol.documents import validate
    from sensor_node.node import NodeConfig, run_node

    settings = {
        "source": source,
        "name": name,
        "endpoint": publish,
        "clock_endpoint": clock,
        "loop": loop,
        "realtime": not fast,
    }
    stop = Event()
    config = validate(NodeConfig, settings, "the node's settings")
    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(run_node, config, stop)
        try:
            running.result()  # signals interrupt this wait, not the node's work
        finally:
            stop.set()
