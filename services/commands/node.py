"""`deltalight node`: a sensor node process."""

from typing import Annotated

import typer

from services.ports import NODE_PORT, endpoint


def node(
    source: Annotated[str, typer.Option(help="Dataset folder, .mcap recording, or `synthetic`.")],
    publish: Annotated[str, typer.Option(help="Endpoint for the streams.")] = endpoint(NODE_PORT),
    loop: Annotated[bool, typer.Option("--loop", help="Start again at the end of the source.")] = False,
    fast: Annotated[
        bool, typer.Option("--fast", help="Do not wait for the source's own times between frames.")
    ] = False,
) -> None:
    """Publish colour, depth and pose of a camera or a recording, until Ctrl-C or its end."""
