"""`deltalight server`: a render server process."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from deltalight.services.commands.options import ConfigFile, Device, NodeName
from deltalight.services.garbage_collection import no_garbage_collection
from deltalight.services.warm_spare import this_spare

if TYPE_CHECKING:
    from deltalight.protocol.keys import KeySettings


def server(
    *,
    scene: Annotated[Path | None, typer.Option(help="Scene document to start with.")] = None,
    session: Annotated[
        Path | None,
        typer.Option(help="File that keeps the current scene, so that a restart continues with it."),
    ] = None,
    subscribe: Annotated[
        list[str] | None,
        typer.Option(
            help="Endpoint of a sensor node; may be given more than once. Default: tcp://127.0.0.1:5601."
        ),
    ] = None,
    node: NodeName = None,
    publish: Annotated[
        str | None, typer.Option(help="Endpoint for the relit pictures. Default: tcp://127.0.0.1:5602.")
    ] = None,
    control: Annotated[
        str | None, typer.Option(help="Endpoint for commands. Default: tcp://127.0.0.1:5603.")
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the render server in its messages. Default: render-server.")
    ] = None,
    epoch: Annotated[
        int | None, typer.Option(min=1, help="Number of this start among those of its room's render server.")
    ] = None,
    device: Device = None,
    allow_software: Annotated[
        bool | None, typer.Option("--allow-software", help="Render without a GPU if there is none.")
    ] = None,
    config_file: ConfigFile = None,
) -> None:
    """Render the frames of sensor nodes and publish the pictures, until Ctrl-C."""
    with no_garbage_collection():
        from deltalight.protocol.keys import KeySettings
        from deltalight.render_server.server.process import ServerSettings, run_server
        from deltalight.render_server.server.standby import StandbyRenderer
        from deltalight.services.settings import load_configuration

    configuration = load_configuration(config_file)
    key_settings = configuration.section("keys", KeySettings)
    given: dict[str, Any] = {
        "scene": scene,
        "session": session,
        "subscribe": _subscriptions(subscribe, node, key_settings),
        "publish": publish,
        "control": control,
        "name": name,
        "epoch": epoch,
        "device": device,
        "allow_software": allow_software,
    }
    given = {key: value for key, value in given.items() if value is not None}
    settings = configuration.section("server", ServerSettings, given)
    keys = key_settings.load([*settings.subscribe, settings.publish, settings.control])
    spare = this_spare()
    if spare is not None and spare.is_rehearsing:
        spare.prepared = StandbyRenderer(settings, keys, spare.is_called)
        spare.prepared.keep()
    else:
        run_server(settings, keys, None if spare is None else spare.prepared)


def _subscriptions(subscribe: list[str] | None, node: str | None, keys: "KeySettings") -> list[str] | None:
    """Returns the given endpoints, or the one of the node to be found."""
    if node is None:
        return subscribe or None
    from deltalight.services.discovery import node_endpoint

    return [*(subscribe or []), node_endpoint(node, keys)]
