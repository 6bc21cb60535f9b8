"""The processes of one host and their connections: node -> render server -> web process, on loopback."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument, load_scene
from deltalight.protocol.source import Source
from deltalight.services import ports
from deltalight.services.supervisor import ChildSpec, Watch

PREPARED = {  # by spares of a command
    "node": ("deltalight.services.node_process", "pydantic_settings"),
    "server": ("deltalight.render_server.server.process:warm_up", "pydantic_settings"),
    "api": ("deltalight.services.api.serve", "pydantic_settings"),
}


@dataclass(frozen=True)
class HostPlan:
    """The processes of this host; `session_file` holds the scene document, which survives a server's restart.

    `source` is what the node of this host captures; None = there is no node, and the server looks for the one called
    `remote_node` on the network. `config` is the configuration file of all processes; None = the one they find, which
    overrides the defaults here. `data` is the folder of scenes of the web process, which runs only if it is given.
    With `spares`, a process that dies is replaced by one that has imported what it needs (some 100 MB each).
    """

    source: str | None
    session_file: Path
    remote_node: str = ""
    config: Path | None = Path(os.devnull)
    node_port: int = ports.NODE_PORT
    composite_port: int = ports.COMPOSITE_PORT
    control_port: int = ports.CONTROL_PORT
    data: Path | None = None
    page_port: int = ports.PAGE_PORT
    device: int | None = None
    allow_software: bool = False
    loop: bool = True
    log_level: str = "info"
    spares: bool = False

    def specs(self) -> list[ChildSpec]:
        """Return the children to supervise, in the order of the stream."""
        specs = [self._server()] if self.source is None else [self._node(self.source), self._server()]
        return specs if self.data is None else [*specs, self._web(self.data)]

    def require_free_ports(self) -> None:
        """Check every port before a child is started.

        Raises:
            DeltalightError: another program listens on one of them.
        """
        if self.source is not None:
            ports.require_free(self.node_port, "sensor node", "--node-port")
        ports.require_free(self.composite_port, "composite of the render server", "--composite-port")
        ports.require_free(self.control_port, "control of the render server", "--control-port")
        if self.data is not None:
            ports.require_free(self.page_port, "dashboard", "--port")

    def _child(self, name: str, command: str, *options: str) -> ChildSpec:
        spec = ChildSpec.deltalight(name, "--log-level", self.log_level, command, *options)
        return replace(spec, warm=PREPARED[command]) if self.spares else spec

    @property
    def _config(self) -> list[str]:
        return [] if self.config is None else ["--config", str(self.config.absolute())]

    def _node(self, source: str) -> ChildSpec:
        options = [
            *self._config,
            *("--source", source),
            *("--publish", ports.endpoint(self.node_port)),
            *("--clock", ports.endpoint(self.control_port)),
        ]
        return self._child("sensor node", "node", *options, *(["--loop"] if self.loop else []))

    def _server(self) -> ChildSpec:
        has_node = self.source is not None
        options = [
            *self._config,
            *("--session", str(self.session_file)),
            *(("--subscribe", ports.endpoint(self.node_port)) if has_node else ("--node", self.remote_node)),
            *("--publish", ports.endpoint(self.composite_port)),
            *("--control", ports.endpoint(self.control_port)),
        ]
        if self.device is not None:
            options += ["--device", str(self.device)]
        if self.allow_software:
            options += ["--allow-software"]
        return replace(self._child("render server", "server", *options), watch=self._watchdog)

    def _watchdog(self, process_id: int) -> Watch:
        from deltalight.protocol.keys import KeySettings
        from deltalight.services.settings import load_configuration
        from deltalight.services.watchdog import Watchdog

        endpoints = ports.endpoint(self.composite_port), ports.endpoint(self.control_port)
        keys = load_configuration(self.config).section("keys", KeySettings).load(endpoints)
        return Watchdog(process_id, *endpoints, keys)

    def _web(self, data: Path) -> ChildSpec:
        node = (
            ("--subscribe", ports.endpoint(self.node_port)) if self.source else ("--node", self.remote_node)
        )
        return self._child(
            "web process",
            "api",
            *self._config,
            *("--data", str(data.absolute())),
            *("--control", ports.endpoint(self.control_port)),
            *("--subscribe", ports.endpoint(self.composite_port)),
            *node,
            *("--port", str(self.page_port)),
        )


def choose_scene(source: Source | None, path: Path | None) -> SceneDocument:
    """Return the scene document at `path`, else the one that the recording carries.

    Raises:
        DeltalightError: there is neither, or the document is wrong.
    """
    if path is not None:
        return load_scene(path)
    if source is None or source.scene is None:
        raise DeltalightError("The source carries no scene document; name one with --scene.")
    return source.scene
