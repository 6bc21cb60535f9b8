"""A Ray cluster as a placer sees it: hosts with render slots. It is joined, or started on this host alone.

Ray runs actors and knows who lives (its control plane); nothing of a frame passes through it.
"""

import os
import re
import signal
import socket
import uuid
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.services.ports import LOOPBACK
from deltalight.services.rooms.rooms_file import MAX_ROOMS
from deltalight.services.rooms.status import HOST_PATTERN

SLOT_RESOURCE = "render_slot"
AUTO = "auto"
OBJECT_STORE_BYTES = 80 << 20  # near Ray's least: a scene document is the largest thing in it
CONNECT_TIMEOUT_S = 5.0
DISTINGUISHING = 6  # digits of a node's id
NO_STATISTICS = {"RAY_USAGE_STATS_ENABLED": "0"}  # read by Ray when it is imported, as the next
# Makes Ray use the loopback address in place of the host's own; named after where it is the default.
LOOPBACK_ONLY = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
# Of hosts that are started here. Ray would give render servers the priority of background work (nice 15).
FULL_PRIORITY = {"RAY_worker_niceness": "0"}


@dataclass(frozen=True)
class ClusterHost:
    """A host that lives: its name, Ray's id of it, its address, how many slots it offers, and its labels."""

    name: str
    node_id: str
    address: str
    slots: int
    labels: dict[str, str]


class RayCluster:
    """Joins the cluster at `address` (HOST:PORT, or `auto` for that of this host), else starts one with `slots`.

    Raises:
        DeltalightError: Ray is not installed, or nobody answers there.
    """

    def __init__(self, address: str | None, slots: int) -> None:
        if address is not None:
            _require_answer(address)
        self.ray = _import_ray(is_alone=address is None)
        namespace = f"deltalight-{uuid.uuid4().hex}"  # no other installation's actors have these names
        common = {"namespace": namespace, "log_to_driver": False, "configure_logging": False}
        try:
            with own_sigterm():
                if address is None:
                    self.ray.init("local", **common, **_alone(slots))
                else:
                    self.ray.init(address, **common)
        except (ConnectionError, RuntimeError, ValueError) as fault:
            raise DeltalightError(
                f"the Ray cluster {address or 'of this host'} cannot be used"
                f" ({str(fault).strip().partition(chr(10))[0].rstrip('.')}); see `ray status` on this host, which"
                " must belong to it, and that its Ray and Python have the versions of this host's."
            ) from fault

    @property
    def own_address(self) -> str:
        """The address of this host in the cluster."""
        return str(self.ray.util.get_node_ip_address())

    def hosts(self) -> list[ClusterHost]:
        """Returns the hosts with slots that live, by name."""
        nodes = [node for node in self.ray.nodes() if node["Alive"] and _slots(node) > 0]
        names = Counter(_name(node) for node in nodes)
        return sorted(
            (_host(node, is_unique=names[_name(node)] == 1) for node in nodes), key=lambda host: host.name
        )

    def close(self) -> None:
        """Leaves the cluster, or ends it if it was started here."""
        self.ray.shutdown()


@contextmanager
def own_sigterm() -> Iterator[None]:
    """Lets SIGTERM end this process as before the block, in which Ray takes it over (main thread)."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, handler)


def _import_ray(*, is_alone: bool) -> Any:  # noqa: ANN401 (a module)
    os.environ.update(NO_STATISTICS | FULL_PRIORITY)
    if is_alone:
        os.environ.update(LOOPBACK_ONLY)
    try:
        import ray
        import ray.util.scheduling_strategies
    except ImportError as fault:
        command = install_command("deltalight[cluster]")
        raise DeltalightError(f"rooms on a cluster need Ray: {command}.") from fault
    return ray


def _alone(slots: int) -> dict[str, object]:
    return {
        "num_cpus": 0,
        "num_gpus": 0,
        "resources": {SLOT_RESOURCE: slots},
        "include_dashboard": False,
        "object_store_memory": OBJECT_STORE_BYTES,
        "_node_ip_address": LOOPBACK,
    }


def _require_answer(address: str) -> None:
    """Checks that somebody listens, because Ray would wait for minutes."""
    if address == AUTO:
        return
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=CONNECT_TIMEOUT_S).close()
    except (OSError, ValueError, OverflowError) as fault:
        raise DeltalightError(
            f"nobody answers at {address} ({fault}); give the HOST:PORT that `ray start --head` printed, or `auto`."
        ) from fault


def _slots(node: dict[str, Any]) -> int:
    """Returns how many slots a host offers: whole ones, and as many as there may be rooms at most."""
    return int(min(MAX_ROOMS, node["Resources"].get(SLOT_RESOURCE, 0)))


def _name(node: dict[str, Any]) -> str:
    """Returns the name that a host was given, that which it has otherwise, or Ray's id where both write anything."""
    named, own = str(node["NodeName"]), str(node["NodeManagerHostname"])
    chosen = own if named == node["NodeManagerAddress"] else named
    return chosen if re.fullmatch(HOST_PATTERN, chosen) else f"host-{node['NodeID']}"


def _host(node: dict[str, Any], *, is_unique: bool) -> ClusterHost:
    name, node_id = _name(node), str(node["NodeID"])
    labels = {key: str(value) for key, value in node["Labels"].items()}
    return ClusterHost(
        name if is_unique else f"{name}-{node_id[:DISTINGUISHING]}",
        node_id,
        str(node["NodeManagerAddress"]),
        _slots(node),
        labels,
    )
