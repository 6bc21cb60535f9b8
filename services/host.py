"""The processes of one host and their connections: node -> render server -> web process, on loopback."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys, KeySettings
from deltalight.protocol.scene import SceneDocument, load_scene
from deltalight.protocol.source import Source
from deltalight.services import ports
from deltalight.services.child import NODE, SERVER, WEB, ChildSpec, Watch
from deltalight.services.warm_spare import PREPARED


@dataclass(frozen=True)
class HostCommands:
    """Command lines of processes of this host, which talk over loopback.

    `config` is the configuration file of all; None = the one they find, which overrides the defaults here. With
    `spares`, a process that dies is replaced by one that has imported what it needs (some 100 MB each);
    a render server's has also built the scene, with as much memory as that takes.
    """

    config: Path | None = Path(os.devnull)
    log_level: str = "info"
    spares: bool = False
    allow_software: bool = False

    def child(self, label: str, command: str, *options: str) -> ChildSpec:
        """Returns a process that runs a command, with the configuration of all."""
        config = [] if self.config is None else ["--config", str(self.config.absolute())]
        spec = ChildSpec.deltalight(label, "--log-level", self.log_level, command, *config, *options)
        return replace(spec, warm=PREPARED[command]) if self.spares else spec

    def node(self, label: str, source: str, publish: str, clock: str, *more: str) -> ChildSpec:
        """Returns a sensor node."""
        return self.child(label, "node", "--source", source, "--publish", publish, "--clock", clock, *more)

    def player(
        self, label: str, source: str, publish: str, clock: str, control: str, *more: str
    ) -> ChildSpec:
        """Returns a node that plays a recording, paused at its start until it is told otherwise at `control`."""
        options = ["--publish", publish, "--clock", clock, "--control", control, "--paused", *more]
        return self.child(label, "replay", source, *options)

    def server(
        self, label: str, session: Path, publish: str, control: str, device: int | None, *more: str
    ) -> ChildSpec:
        """Returns a render server; `more` says where its frames come from."""
        options = ["--session", str(session), *more, "--publish", publish, "--control", control]
        if device is not None:
            options += ["--device", str(device)]
        if self.allow_software:
            options += ["--allow-software"]
        return replace(self.child(label, "server", *options), rehearsed=True)

    def web(self, data: Path, page_port: int, *more: str) -> ChildSpec:
        """Returns a web process."""
        options = ("--data", str(data.absolute()), *more, "--port", str(page_port))
        return self.child(WEB, "api", *options)

    def keys(self, endpoints: Sequence[str]) -> Keys | None:
        """Returns the keys that connections to these endpoints take.

        Raises:
            DeltalightError: they are missing.
        """
        from deltalight.services.settings import load_configuration

        return load_configuration(self.config).section("keys", KeySettings).load(endpoints)


@dataclass(frozen=True)
class HostPlan:
    """The processes of this host; `session_file` holds the scene document, which survives a server's restart.

    It is None until there is one: only `specs` needs it.

    `source` is what the node of this host captures; None = there is no node, and the server looks for the one called
    `remote_node` on the network. `config` is the configuration file of all processes; None = the one they find, which
    overrides the defaults here. `data` is the folder of scenes of the web process, which runs only if it is given.
    With `spares`, a process that dies is replaced by one that has imported what it needs (some 100 MB each);
    a render server's has also built the scene, with as much memory as that takes.
    With `playback_port` the source is a recording that waits at its first frame, to be played and moved along there.
    """

    source: str | None
    session_file: Path | None
    remote_node: str = ""
    config: Path | None = Path(os.devnull)
    node_port: int = ports.NODE_PORT
    composite_port: int = ports.COMPOSITE_PORT
    control_port: int = ports.CONTROL_PORT
    playback_port: int | None = None
    data: Path | None = None
    page_port: int = ports.PAGE_PORT
    device: int | None = None
    allow_software: bool = False
    loop: bool = True
    log_level: str = "info"
    spares: bool = False

    @property
    def commands(self) -> dict[str, str]:
        """The commands that the processes run, by their names; the one that takes longest to start comes first."""
        node = {} if self.source is None else {NODE: "node" if self.playback_port is None else "replay"}
        return {SERVER: "server", **node, **({} if self.data is None else {WEB: "api"})}

    def specs(self) -> list[ChildSpec]:
        """Returns the children to supervise, in the order of the stream."""
        specs = [self._server()] if self.source is None else [self._node(self.source), self._server()]
        return specs if self.data is None else [*specs, self._web(self.data)]

    def require_free_ports(self) -> None:
        """Checks every port before a child is started.

        Raises:
            DeltalightError: another program listens on one of them, or two are the same.
        """
        chosen = [
            ports.ChosenPort(self.composite_port, "composite of the render server", "--composite-port"),
            ports.ChosenPort(self.control_port, "control of the render server", "--control-port"),
        ]
        if self.source is not None:
            chosen.append(ports.ChosenPort(self.node_port, "sensor node", "--node-port"))
        if self.data is not None:
            chosen.append(ports.ChosenPort(self.page_port, "dashboard", "--port"))
        ports.require_all_free(chosen)

    @property
    def _commands(self) -> HostCommands:
        return HostCommands(self.config, self.log_level, self.spares, self.allow_software)

    def _node(self, source: str) -> ChildSpec:
        publish, clock = ports.endpoint(self.node_port), ports.endpoint(self.control_port)
        loop = ["--loop"] if self.loop else []
        if self.playback_port is not None:
            control = ports.endpoint(self.playback_port)
            return self._commands.player(NODE, source, publish, clock, control, *loop)
        return self._commands.node(NODE, source, publish, clock, *loop)

    def _server(self) -> ChildSpec:
        assert self.session_file is not None
        publish, control = ports.endpoint(self.composite_port), ports.endpoint(self.control_port)
        spec = self._commands.server(SERVER, self.session_file, publish, control, self.device, *self._frames)
        return replace(spec, watch=self._watchdog)

    @property
    def _frames(self) -> tuple[str, str]:
        if self.source is None:
            return "--node", self.remote_node
        return "--subscribe", ports.endpoint(self.node_port)

    def _watchdog(self, process_id: int) -> Watch:
        from deltalight.services.watchdog import Watchdog

        endpoints = ports.endpoint(self.composite_port), ports.endpoint(self.control_port)
        return Watchdog(process_id, *endpoints, self._commands.keys(endpoints))

    def _web(self, data: Path) -> ChildSpec:
        return self._commands.web(
            data,
            self.page_port,
            *("--control", ports.endpoint(self.control_port)),
            *("--subscribe", ports.endpoint(self.composite_port)),
            *self._frames,
            *([] if self.playback_port is None else ["--playback", ports.endpoint(self.playback_port)]),
        )


def choose_scene(source: Source | None, path: Path | None) -> SceneDocument:
    """Returns the scene document at `path`, else the one that the recording carries.

    Raises:
        DeltalightError: there is neither, or the document is wrong.
    """
    if path is not None:
        return load_scene(path)
    if source is None or source.scene is None:
        raise DeltalightError("The source has no scene document; name one with --scene.")
    return source.scene


def recording_of(source: str | None) -> Source | None:
    """Returns the recording that a source names, None if it is a camera, or another host's.

    Raises:
        DeltalightError: it is not there, or cannot be read.
    """
    from deltalight.protocol.source import open_source
    from deltalight.sensor_node.cameras.drivers import SYNTHETIC
    from deltalight.sensor_node.cameras.open import is_live

    return None if source is None or source == SYNTHETIC or is_live(source) else open_source(Path(source))
