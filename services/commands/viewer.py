"""`deltalight viewer`: the page with the live picture."""

from typing import Annotated

import typer

from services.ports import COMPOSITE_PORT, CONTROL_PORT, PAGE_PORT, endpoint


def viewer(
    subscribe: Annotated[str, typer.Option(help="Endpoint of the render server's composites.")] = endpoint(
        COMPOSITE_PORT
    ),
    control: Annotated[str, typer.Option(help="Endpoint of the render server's commands.")] = endpoint(
        CONTROL_PORT
    ),
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page, on loopback.")] = PAGE_PORT,
) -> None:
    """Serve the page with the live picture and the time of each pass, until Ctrl-C."""
    from services.viewer import ViewerSettings, run_viewer

    run_viewer(ViewerSettings(subscribe=subscribe, control=control, port=port))
