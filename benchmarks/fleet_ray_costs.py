"""What Ray's control plane (its process `gcs_server`) costs: actors that do nothing, and hosts that do nothing.

All hosts are raylets of this machine. Its processor time is taken, so that other work hardly matters, and the bytes
of its connections as the kernel counts them.
"""

import os
import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from deltalight.benchmarks.soak.samples import processor_time_s
from deltalight.services.ports import LOOPBACK
from deltalight.services.rooms.ray_cluster import LOOPBACK_ONLY, NO_STATISTICS, OBJECT_STORE_BYTES

ACTORS = 12
MORE_HOSTS = 3
IDLE_S = 20.0
SETTLING_S = 10.0
HOST = {"num_cpus": 0, "node_ip_address": LOOPBACK, "object_store_memory": OBJECT_STORE_BYTES}
COUNTERS = re.compile(r"bytes_(?:sent|received):(\d+)")


class ControlPlane:
    """A cluster of hosts on this machine, and the process that controls it."""

    def __init__(self, ray: Any, cluster: Any) -> None:  # noqa: ANN401 (modules without types)
        self._ray, self._cluster = ray, cluster
        self._process_id = cluster.head_node.all_processes["gcs_server"][0].process.pid
        self._port = cluster.address.rpartition(":")[2]

    def cpu_s(self) -> float:
        """Returns the processor time that it has taken, s."""
        return processor_time_s(self._process_id)

    def traffic_bytes(self) -> int:
        """Returns what its open connections have sent and received."""
        command = ["ss", "-tinH", f"sport = :{self._port}"]
        shown = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        return sum(int(count) for count in COUNTERS.findall(shown))

    def add_hosts(self, count: int) -> None:
        """Starts more hosts that do nothing."""
        for _ in range(count):
            self._cluster.add_node(**HOST)
        self._cluster.wait_for_nodes()

    def idle(self) -> tuple[float, float]:
        """Returns the fraction of a core, and the bytes a second, while nothing happens."""
        time.sleep(SETTLING_S)
        began_s, before_s, before_bytes = time.monotonic(), self.cpu_s(), self.traffic_bytes()
        time.sleep(IDLE_S)
        elapsed_s = time.monotonic() - began_s
        return (self.cpu_s() - before_s) / elapsed_s, (self.traffic_bytes() - before_bytes) / elapsed_s

    def per_actor_s(self) -> tuple[float, float]:
        """Returns its processor time for a detached actor that does nothing, s, and the time until it answers, s."""
        remote = self._ray.remote(num_cpus=0, lifetime="detached")(IdleActor).remote
        began_s, before_s = time.monotonic(), self.cpu_s()
        actors = [remote() for _ in range(ACTORS)]
        self._ray.get([actor.answer.remote() for actor in actors])
        elapsed_s, used_s = time.monotonic() - began_s, self.cpu_s() - before_s
        for actor in actors:
            self._ray.kill(actor)
        return used_s / ACTORS, elapsed_s / ACTORS


class IdleActor:
    """An actor that does nothing."""

    def answer(self) -> None:
        """Does nothing."""


@contextmanager
def control_plane() -> Iterator[ControlPlane]:
    """Runs a cluster of one host."""
    os.environ.update(LOOPBACK_ONLY | NO_STATISTICS)
    import ray
    from ray.cluster_utils import Cluster

    cluster = Cluster()
    try:
        cluster.add_node(**HOST, include_dashboard=False)
        ray.init(cluster.address, log_to_driver=False, configure_logging=False)
        yield ControlPlane(ray, cluster)
    finally:
        ray.shutdown()
        cluster.shutdown()


def measure_ray() -> dict[str, float]:
    """Measures and returns the costs of Ray's control plane."""
    with control_plane() as plane:
        alone_load, alone_bytes = plane.idle()
        plane.add_hosts(MORE_HOSTS)
        load, sent_bytes = plane.idle()
        gcs_s, answered_s = plane.per_actor_s()  # last, because the end of actors is work too
    return {
        "gcs_s_per_actor": gcs_s,
        "actor_answers_s": answered_s,
        "gcs_idle_share": alone_load,
        "gcs_share_per_host": max(0.0, load - alone_load) / MORE_HOSTS,
        "gcs_bytes_per_s_per_host": max(0.0, sent_bytes - alone_bytes) / MORE_HOSTS,
    }
