"""`deltalight viewer`: the page with the live picture."""

from typing import Annotated

import typer

from services.commands.options import ConfigFile
from services.ports import COMPOSITE_PORT, CONTROL_PORT, PAGE_PORT, endpoint


def viewer(
    subscribe: Annotated[str, typer.Option(help="Endpoint of the render server's composites.")] = endpoint(
        COMPOSITE_PORT
    ),
    control: Annotated[str, typer.Option(help="Endpoint of the render server's commands.")] = endpoint(
        CONTROL_PORT
    ),
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page, on loopback.")] = PAGE_PORT,
    config_file: ConfigFile = None,
) -> None:
    """Serve the page with the live picture and the time of each pass, until Ctrl-C."""
    from protocol.keys import KeySettings
    from services.settings import load_configuration
    from services.viewer import ViewerSettings, run_viewer

    keys = load_configuration(config_file).section("keys", KeySettings).load([subscribe, control])
    run_viewer(ViewerSettings(subscribe=subscribe, control=control, port=port), keys)
