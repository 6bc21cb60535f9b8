"""Discovery of the sensor nodes that announce themselves on the local network."""

import re
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from deltalight.protocol.documents import NAME_PATTERN, nearest
from deltalight.protocol.envelope import is_readable_version
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import TRUST_HINT, KeySettings, key_folder, trusted_keys
from deltalight.protocol.messages import MESSAGE_TYPES, OLDEST_SCHEMA_VERSION, SCHEMA_VERSION
from deltalight.sensor_node.announce import SERVICE_TYPE

if TYPE_CHECKING:
    from zeroconf import ServiceInfo, ServiceStateChange, Zeroconf

# Answers come within 0.12 s (RFC 6762, section 6); the first question is repeated after one second.
LISTEN_S = 2.5
ANSWER_MS = 1000
ONLY_NODE = "auto"


@dataclass(frozen=True)
class FoundNode:
    """A node as announced; `key` is its public key (Z85), empty without keys."""

    name: str
    address: str
    port: int
    streams: tuple[str, ...]
    schema_version: int
    key: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Returns the node as plain data."""
        return {**asdict(self), "endpoint": f"tcp://{self.address}:{self.port}", "curve": bool(self.key)}

    def endpoint(self, trusted: Mapping[str, bytes]) -> str:
        """Returns the endpoint to subscribe to, with the name under which the node's key is trusted.

        Raises:
            DeltalightError: the node uses another version, has no keys, or its key is not trusted.
        """
        if not is_readable_version(self.schema_version):
            raise DeltalightError(
                f"node {self.name} speaks version {self.schema_version} and this program reads versions "
                f"{OLDEST_SCHEMA_VERSION} to {SCHEMA_VERSION}: upgrade the older one."
            )
        if not self.key:
            raise DeltalightError(
                f"node {self.name} has no keys: run `deltalight keys create NAME` on its host."
            )
        peer = next((name for name, key in trusted.items() if key.decode() == self.key), None)
        if peer is None:
            raise DeltalightError(f"the key of node {self.name} is not trusted: {TRUST_HINT}.")
        host = f"[{self.address}]" if ":" in self.address else self.address
        return f"tcp://{peer}@{host}:{self.port}"


def find_nodes(
    *, name: str | None = None, listen_s: float = LISTEN_S, interfaces: Sequence[str] | None = None
) -> list[FoundNode]:
    """Returns the nodes that announce themselves, by name.

    Args:
        name: stop as soon as this one is found; None = wait for all.
        listen_s: how long to listen.
        interfaces: addresses of this host to listen on; None = all but loopback.

    Raises:
        DeltalightError: this host has no network to listen on.
    """
    from zeroconf import InterfaceChoice, ServiceBrowser, Zeroconf

    found: dict[str, FoundNode] = {}
    is_found = threading.Event()

    def changed(
        zeroconf: "Zeroconf", service_type: str, name: str, state_change: "ServiceStateChange"
    ) -> None:
        info = zeroconf.get_service_info(service_type, name, ANSWER_MS)
        node = None if info is None else _node(info)
        if node is None or state_change.name == "Removed":
            return
        found[name] = node
        if node.name == wanted:
            is_found.set()

    wanted = name
    try:
        zeroconf = Zeroconf(interfaces=InterfaceChoice.All if interfaces is None else list(interfaces))
    except OSError as error:
        raise DeltalightError(
            f"there is no network to look for nodes on ({error.strerror}); name the node's endpoint."
        ) from error
    try:
        ServiceBrowser(zeroconf, SERVICE_TYPE, handlers=[changed])
        is_found.wait(listen_s)
    finally:
        zeroconf.close()
    return sorted(found.values(), key=lambda node: (node.name, node.address))


def _node(info: "ServiceInfo") -> FoundNode | None:
    """Parses an announcement; returns None if it is none of a node's: anybody on the network can send one."""
    texts = {key: value or "" for key, value in info.decoded_properties.items()}
    addresses = info.parsed_addresses()
    if not addresses or info.port is None or not texts.get("schema", "").isdecimal():
        return None
    if not re.fullmatch(NAME_PATTERN, texts.get("name", "")):
        return None
    key = texts.get("key", "")
    return FoundNode(
        name=texts["name"],
        address=addresses[0],
        port=info.port,
        streams=tuple(each for each in texts.get("streams", "").split(",") if each in MESSAGE_TYPES),
        schema_version=int(texts["schema"]),
        key=key if texts.get("curve") == "1" and key.isprintable() else "",
    )


def choose(nodes: Sequence[FoundNode], name: str) -> FoundNode:
    """Returns the node called `name`, or for `auto` the only one.

    Raises:
        DeltalightError: it was not found, or `auto` and there are several.
    """
    names = ", ".join(node.name for node in nodes)
    if not nodes:
        raise DeltalightError(
            "no node announces itself on this network; check that it runs with an endpoint that other hosts can"
            " reach, or name that endpoint with --subscribe (`server` and `api` in place of `up`)."
        )
    if name == ONLY_NODE and len(nodes) == 1:
        return nodes[0]
    if name == ONLY_NODE:
        raise DeltalightError(f"{len(nodes)} nodes announce themselves; say which with --node: {names}.")
    chosen = next((node for node in nodes if node.name == name), None)
    if chosen is None:
        hint = nearest(name, [node.name for node in nodes])
        advice = f"the nearest is {hint} of" if hint else "there are"
        raise DeltalightError(f"no node called {name} announces itself; {advice} {names}.")
    return chosen


def node_endpoint(name: str, settings: KeySettings, *, interfaces: Sequence[str] | None = None) -> str:
    """Returns the endpoint of the node called `name` (`auto`: of the only one), found on the network.

    Raises:
        DeltalightError: there is no such node, or it is not trusted.
    """
    nodes = find_nodes(name=name, interfaces=interfaces)
    return choose(nodes, name).endpoint(trusted_keys(settings.folder or key_folder()))
