"""Hosts of a Ray cluster on this machine: each is a raylet with one slot, and can be killed."""

import itertools
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import psutil

from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.services.ports import LOOPBACK
from deltalight.services.rooms.ray_cluster import (
    FULL_PRIORITY,
    LOOPBACK_ONLY,
    NO_STATISTICS,
    OBJECT_STORE_BYTES,
    SLOT_RESOURCE,
    own_sigterm,
)

# A host that is silent for a second and a half is dead (Ray's default is 15 s).
HEALTH_CHECKS = {
    "health_check_initial_delay_ms": 1000,
    "health_check_period_ms": 500,
    "health_check_timeout_ms": 500,
    "health_check_failure_threshold": 3,
}


class Hosts:
    """A Ray cluster whose hosts have a slot each; the first process of the cluster has none.

    `networks` are the labels of the hosts that live, by name; `raylets` are theirs and those of killed ones.

    Raises:
        DeltalightError: Ray is not installed.
    """

    def __init__(self) -> None:
        os.environ.update(LOOPBACK_ONLY | NO_STATISTICS | FULL_PRIORITY)
        try:
            from ray.cluster_utils import Cluster
        except ImportError as fault:
            command = install_command("deltalight[cluster]")
            raise DeltalightError(f"rooms on a cluster need Ray: {command}.") from fault
        self.cluster = Cluster()
        self.networks: dict[str, str | None] = {}
        self.raylets: list[psutil.Process] = []
        self._raylets: dict[str, psutil.Process] = {}
        self._numbers = itertools.count(1)
        self._add(include_dashboard=False, _system_config=HEALTH_CHECKS)

    def add(self, name: str = "", **labels: str) -> str:
        """Starts a host; returns its name, which no host has had before."""
        name = name or f"host{next(self._numbers)}"
        node = self._add(node_name=name, resources={SLOT_RESOURCE: 1}, labels=labels)
        self.networks[name] = labels.get("network")
        self._raylets[name] = psutil.Process(node.all_processes["raylet"][0].process.pid)
        self.raylets.append(self._raylets[name])
        return name

    def raylet(self, name: str) -> psutil.Process:
        """Returns the process by whose life Ray knows that a host lives."""
        return self._raylets[name]

    def kill(self, name: str) -> None:
        """Kills a host's raylet at once (SIGKILL)."""
        os.kill(self.raylet(name).pid, signal.SIGKILL)
        del self.networks[name]

    def _add(self, **more: object) -> Any:  # noqa: ANN401 (Ray's)
        common = {"num_cpus": 0, "node_ip_address": LOOPBACK, "object_store_memory": OBJECT_STORE_BYTES}
        with own_sigterm():
            return self.cluster.add_node(**common, **more)


@contextmanager
def running_hosts(*labels: dict[str, str]) -> Iterator[Hosts]:
    """Starts a cluster with a host for each of these labels; it ends with the block."""
    hosts = Hosts()
    try:
        for each in labels:
            hosts.add(**each)
        yield hosts
    finally:
        hosts.cluster.shutdown()
