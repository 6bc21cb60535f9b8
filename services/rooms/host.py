"""What `deltalight up --rooms` runs on one host: nodes, a render server per room with a slot, the web process."""

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import KeySettings
from deltalight.protocol.scene import SceneDocument, load_scene
from deltalight.protocol.source import Source
from deltalight.services import ports
from deltalight.services.child import ChildSpec
from deltalight.services.discovery import node_endpoint
from deltalight.services.host import HostCommands, recording_of
from deltalight.services.host_store import activate_document, open_store
from deltalight.services.rooms.capacity import load_figures
from deltalight.services.rooms.directory import DirectoryServer
from deltalight.services.rooms.keeper import RoomKeeper, RoomPlan
from deltalight.services.rooms.local_placer import LocalPlacer
from deltalight.services.rooms.placer import Placement, RoomOrder
from deltalight.services.rooms.ray_cluster import RayCluster
from deltalight.services.rooms.ray_placer import RayPlacer, reachable_endpoint
from deltalight.services.rooms.rooms_file import RoomEntry, RoomsFile
from deltalight.services.rooms.status import RoomNode
from deltalight.services.session_file import write_scene
from deltalight.services.settings import load_configuration
from deltalight.services.storage.store import Store
from deltalight.services.supervisor import POLL_INTERVAL_S, Supervisor
from deltalight.services.warm_spare import PREPARED

NODE_RETRY_S = 10.0


@dataclass(frozen=True)
class RoomsHost:
    """The rooms of a file on this host; `data` is the folder of scenes, `sessions` holds the session files.

    `on_cluster`: their render servers run on the Ray cluster at `ray_address`; None = one of this host alone. The
    directory of rooms answers at `rooms_address`.
    """

    rooms: RoomsFile
    commands: HostCommands
    data: Path
    sessions: Path
    page_port: int = ports.PAGE_PORT
    rooms_port: int = ports.ROOMS_PORT
    on_cluster: bool = False
    ray_address: str | None = None
    rooms_address: str = ports.LOOPBACK

    def require_free_ports(self) -> None:
        """Checks the ports that have been chosen, before a child is started.

        Raises:
            DeltalightError: another program listens on one of them, or they are the same.
        """
        page = ports.ChosenPort(self.page_port, "dashboard", "--port")
        directory = ports.ChosenPort(self.rooms_port, "directory of rooms", "--rooms-port")
        ports.require_all_free([page, directory])

    @cached_property
    def node_ports(self) -> dict[str, int]:
        """The port of each node of this host."""
        here = [name for name, node in self.rooms.nodes.items() if node.source is not None]
        return dict(zip(here, ports.private_ports(len(here)), strict=True))

    def run(self, forward: Callable[[str], None], until: Callable[[], bool] = lambda: False) -> None:
        """Keeps everything running until `until` returns true.

        Raises:
            DeltalightError: a source, a scene, a key or a port cannot be used, or the web process keeps dying.
        """
        with ExitStack() as stack:
            cluster = self._cluster(stack)
            address = ports.LOOPBACK if cluster is None else cluster.own_address
            endpoints = self._node_endpoints(address)
            store = stack.enter_context(open_store(self.data, self.commands.config))
            plans = self._plans(store, endpoints)
            placer = self._local_placer(forward) if cluster is None else self._ray_placer(cluster, forward)
            stack.callback(placer.close)
            keeper = RoomKeeper(plans, placer, forward, store.drained)
            directory = DirectoryServer(self.directory, keeper, self.commands.keys([self.directory]))
            stack.callback(directory.close)
            nodes = [NodeSupervisor(spec, forward) for spec in self._nodes(address)]
            for node in nodes:
                stack.callback(node.stop)
            supervisor = stack.enter_context(Supervisor([self._web(endpoints.values())], forward=forward))
            while not until():
                supervisor.poll()
                keeper.note_nodes({node.name: node.fault for node in nodes if node.poll()})
                keeper.poll()
                time.sleep(POLL_INTERVAL_S)

    @cached_property
    def directory(self) -> str:
        """The endpoint of the directory of rooms, with the name of its key where it leaves the host."""
        if self.rooms_address == ports.LOOPBACK:
            return ports.endpoint(self.rooms_port)
        return reachable_endpoint(self.commands, self.rooms_address, self.rooms_port)

    def _cluster(self, stack: ExitStack) -> RayCluster | None:
        if not self.on_cluster:
            return None
        cluster = RayCluster(self.ray_address, len(self.rooms.devices))
        stack.callback(cluster.close)
        return cluster

    def _ray_placer(self, cluster: RayCluster, forward: Callable[[str], None]) -> RayPlacer:
        config = None if self.commands.config is None else self.commands.config.absolute()
        commands = replace(self.commands, config=config)
        figures = None if self.rooms.figures is None else load_figures(self.rooms.figures)
        spare = _spare(commands)
        return RayPlacer(cluster, self._server, commands, figures=figures, spare=spare, forward=forward)

    def _local_placer(self, forward: Callable[[str], None]) -> LocalPlacer:
        return LocalPlacer(
            self.rooms.devices,
            self._server,
            spare=_spare(self.commands),
            keys=self.commands.keys([self.directory]),
            forward=forward,
        )

    def _server(self, order: RoomOrder, placement: Placement, device: int | None) -> ChildSpec:
        sources = [word for source in order.sources for word in ("--subscribe", source)]
        identity = ("--name", order.room, "--epoch", str(order.epoch))
        endpoints = placement.publish, placement.control
        label = f"room {order.room}"
        spec = self.commands.server(label, order.session_file, *endpoints, device, *identity, *sources)
        return replace(spec, warm=())  # the placer has one spare for all rooms

    def _nodes(self, address: str) -> list[ChildSpec]:
        specs = []
        for name, node in self.rooms.nodes.items():
            if node.source is not None:
                publish = reachable_endpoint(self.commands, address, self.node_ports[name])
                more = ("--name", name, "--loop")
                specs.append(self.commands.node(f"node {name}", node.source, publish, self.directory, *more))
        return specs

    def _web(self, nodes: Iterable[str]) -> ChildSpec:
        """Returns the web process; it is told where `nodes` are, so that it loads keys if one is elsewhere."""
        sources = [word for node in nodes for word in ("--subscribe", node)]
        return self.commands.web(self.data, self.page_port, "--rooms", self.directory, *sources)

    def _node_endpoints(self, address: str) -> dict[str, str]:
        settings = load_configuration(self.commands.config).section("keys", KeySettings)
        found = {}
        for name, node in self.rooms.nodes.items():
            if node.endpoint is not None:
                found[name] = node.endpoint
            elif node.found is not None:
                found[name] = node_endpoint(node.found, settings)
            else:
                found[name] = reachable_endpoint(self.commands, address, self.node_ports[name])
        return found

    def _plans(self, store: Store, endpoints: Mapping[str, str]) -> list[RoomPlan]:
        plans = []
        for name, room in self.rooms.rooms.items():
            source = recording_of(self.rooms.nodes[room.nodes[0]].source)
            document = room_scene(store.of_room(name, tuple(self.rooms.rooms)), name, room, source)
            path = self.sessions / f"{name}.json"
            write_scene(path, document)
            nodes = tuple(RoomNode(name=node, endpoint=endpoints[node]) for node in room.nodes)
            plans.append(RoomPlan(name, room.title, nodes, path, room.labels))
        return plans


def _spare(commands: HostCommands) -> ChildSpec | None:
    """Returns what waits to become a render server, None if there shall be no spares."""
    return replace(commands.child("spare", "server"), warm=PREPARED["server"]) if commands.spares else None


class NodeSupervisor:
    """Keeps a node running; one that is given up is tried again every ten seconds, and stops no other process."""

    def __init__(self, spec: ChildSpec, forward: Callable[[str], None]) -> None:
        self.name = spec.name.removeprefix("node ")
        self.fault = ""
        self._spec, self._forward = spec, forward
        self._supervisor = Supervisor([spec], forward=forward).__enter__()
        self._again_s = 0.0

    def poll(self) -> bool:
        """Looks after it; returns whether it does not run, for the reason `fault`."""
        try:
            if not self.fault:
                self._supervisor.poll()
            elif time.monotonic() >= self._again_s:
                self._supervisor, self.fault = Supervisor([self._spec], forward=self._forward).__enter__(), ""
        except DeltalightError as fault:
            self._supervisor.stop()
            self.fault, self._again_s = str(fault), time.monotonic() + NODE_RETRY_S
            self._forward(f"{self._spec.name}: {fault} It is tried again in {NODE_RETRY_S:.0f} s.")
        return bool(self.fault)

    def stop(self) -> None:
        """Ends it."""
        self._supervisor.stop()


def room_scene(store: Store, name: str, room: RoomEntry, source: Source | None) -> SceneDocument:
    """Returns the document that a room shows first: its active one, else a copy of its file's or its recording's.

    Raises:
        DeltalightError: the document or one of its files is wrong.
    """
    active = store.scenes.active()
    if active is not None:
        return store.assets.localised(active.document)
    brought = None if source is None else source.scene
    document = brought or SceneDocument() if room.scene is None else load_scene(room.scene)
    return activate_document(store, document.replaced(name=room.title or name))
