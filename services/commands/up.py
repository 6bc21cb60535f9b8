"""`deltalight up`: all processes of one host, supervised."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import typer

from deltalight.protocol.errors import DeltalightError
from deltalight.services.child import ending_spares, fork_spares
from deltalight.services.commands.options import ConfigFile, Data, Device, NodeName, data_folder
from deltalight.services.commands.up_options import (
    AllowSoftware,
    CompositePort,
    ControlPort,
    NodePort,
    PagePort,
    Placer,
    PlacerKind,
    RayAddress,
    RoomsFile,
    RoomsHostAddress,
    RoomsPort,
    ShownScene,
    SourceOfNode,
    Spares,
)
from deltalight.services.garbage_collection import no_garbage_collection
from deltalight.services.ports import (
    COMPOSITE_PORT,
    CONTROL_PORT,
    LOOPBACK,
    NODE_PORT,
    PAGE_PORT,
    ROOMS_PORT,
    answers,
)
from deltalight.services.process import Process
from deltalight.services.warm_spare import SHARED, prepare

if TYPE_CHECKING:
    from deltalight.protocol.scene import SceneDocument
    from deltalight.services.host import HostCommands, HostPlan


def up(
    *,
    source: SourceOfNode = None,
    node: NodeName = None,
    scene: ShownScene = None,
    data: Data = None,
    port: PagePort = PAGE_PORT,
    node_port: NodePort = NODE_PORT,
    composite_port: CompositePort = COMPOSITE_PORT,
    control_port: ControlPort = CONTROL_PORT,
    device: Device = None,
    allow_software: AllowSoftware = False,
    spares: Spares = True,
    rooms: RoomsFile = None,
    rooms_port: RoomsPort = ROOMS_PORT,
    rooms_host: RoomsHostAddress = LOOPBACK,
    placer: Placer = PlacerKind.LOCAL,
    ray_address: RayAddress = None,
    config_file: ConfigFile = None,
) -> None:
    """Run node, render server and dashboard on this machine until Ctrl-C, and restart what fails.

    With --node, no node is started: the render server uses one that is found on the network. With --rooms, a file
    says which nodes and render servers there are.
    """
    prepare(SHARED)
    with no_garbage_collection():
        from deltalight.services.host import HostCommands, HostPlan, recording_of
        from deltalight.services.host_store import open_store, scene_to_show

    on_cluster = placer is PlacerKind.RAY
    _require_fitting(rooms, ray_address, rooms_host, on_cluster=on_cluster)
    if rooms is not None:
        _require_none(source, node, scene, device)
        commands = HostCommands(config_file, "info", spares, allow_software)
        _run_rooms(
            rooms,
            commands,
            data_folder(data, config_file),
            port=port,
            rooms_port=rooms_port,
            rooms_host=rooms_host,
            on_cluster=on_cluster,
            ray_address=ray_address,
        )
        return
    source = _source_of_node(source, node, config_file)
    folder = data_folder(data, config_file)
    with open_store(folder, config_file) as store:
        shown = scene_to_show(store, recording_of(source), scene)
    plan = HostPlan(
        source,
        None,
        remote_node=node or "",
        config=config_file,
        node_port=node_port,
        composite_port=composite_port,
        control_port=control_port,
        data=folder,
        page_port=port,
        device=device,
        allow_software=allow_software,
        spares=spares,
    )
    plan.require_free_ports()
    with ending_spares(fork_spares(plan.commands)) as early:
        _run_plan(plan, shown, early)


def _run_plan(plan: "HostPlan", scene: "SceneDocument", early: Mapping[str, Process]) -> None:
    """Runs the processes of a plan until Ctrl-C; `early` ones are those of their names."""
    from deltalight.services.session_file import session_file
    from deltalight.services.supervisor import Supervisor

    with (
        session_file(scene) as session,
        Supervisor(replace(plan, session_file=session).specs(), spares=early) as supervisor,
    ):
        supervisor.run(until=lambda: answers(plan.page_port))
        typer.echo(f"The dashboard is at http://{LOOPBACK}:{plan.page_port} (press Ctrl-C to stop).")
        supervisor.run()


def _require_fitting(
    rooms: Path | None, ray_address: str | None, rooms_host: str, *, on_cluster: bool
) -> None:
    """Checks that options of a cluster come with `--placer ray`, and that with rooms.

    Raises:
        DeltalightError: they do not.
    """
    if ray_address is not None and not on_cluster:
        raise DeltalightError("--ray-address names the cluster of --placer ray; give both, or neither.")
    if rooms_host != LOOPBACK and not on_cluster:
        raise DeltalightError(
            "--rooms-host is for web processes on other hosts, which can only reach render servers of --placer"
            " ray; leave it out, or give both."
        )
    if on_cluster and rooms is None:
        raise DeltalightError("--placer ray runs the rooms of a rooms file; name one with --rooms.")


def _require_none(*options: object) -> None:
    """Checks that options of a single room are not given with `--rooms`.

    Raises:
        DeltalightError: one is.
    """
    if any(option is not None for option in options):
        raise DeltalightError(
            "the rooms file says which sources, scenes and devices there are; leave out --source, --node,"
            " --scene and --device."
        )


def _source_of_node(source: str | None, node: str | None, config_file: Path | None) -> str | None:
    """Returns the source of the node to start: given, or of the configuration; None where `node` is used.

    Raises:
        DeltalightError: both are given, or there is no source.
    """
    if node is None:
        return source or _configured_source(config_file)
    if source is not None:
        raise DeltalightError(
            "--source starts a node here and --node uses one elsewhere; give only one of them."
        )
    return None


def _run_rooms(
    path: Path,
    commands: "HostCommands",
    data: Path,
    *,
    port: int,
    rooms_port: int,
    rooms_host: str,
    on_cluster: bool,
    ray_address: str | None,
) -> None:
    from deltalight.services.rooms.capacity import with_slots
    from deltalight.services.rooms.host import RoomsHost
    from deltalight.services.rooms.render_actor import hardware_devices
    from deltalight.services.rooms.rooms_file import load_rooms, require_cluster_form, require_local_form

    rooms = load_rooms(path)
    (require_cluster_form if on_cluster else require_local_form)(rooms)
    if on_cluster and ray_address is not None:
        rooms = rooms.replaced(slots=1)  # its hosts say how many they offer
    else:
        rooms = with_slots(rooms, hardware_devices())
    with TemporaryDirectory(prefix="deltalight-") as folder:
        host = RoomsHost(
            rooms, commands, data, Path(folder), port, rooms_port, on_cluster, ray_address, rooms_host
        )
        host.require_free_ports()
        typer.echo(f"The dashboard is at http://{LOOPBACK}:{port} (press Ctrl-C to stop).")
        host.run(lambda line: typer.echo(line, err=True))


def _configured_source(config_file: Path | None) -> str:
    """Returns the node's source of the configuration.

    Raises:
        DeltalightError: it names none.
    """
    from deltalight.sensor_node.node import NodeConfig
    from deltalight.services.settings import DEFAULT, load_configuration

    config, origins = load_configuration(config_file).explained("node", NodeConfig)
    if origins["source"] == DEFAULT:
        raise DeltalightError(
            "up needs a source; name it with --source, or a node on the network with --node."
        )
    return config.source
