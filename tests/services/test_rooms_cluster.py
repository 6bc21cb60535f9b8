"""Rooms on a Ray cluster of several hosts: raylets are killed, and their rooms return elsewhere.

Each host is a raylet of this machine; render servers, sockets and pictures are real.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import psutil
import pytest

from deltalight.services.rooms.follower import RoomFollower
from deltalight.services.rooms.ray_cluster import LOOPBACK_ONLY, NO_STATISTICS, OBJECT_STORE_BYTES, RayCluster
from tests.services.rooms_installation import Installation, is_gone, settled, started, wait_for

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("ray") is None, reason="the extra `cluster` is not installed"),
]
# A host that is silent for a second and a half is dead (Ray's default is 15 s).
HEALTH_CHECKS = {
    "health_check_initial_delay_ms": 1000,
    "health_check_period_ms": 500,
    "health_check_timeout_ms": 500,
    "health_check_failure_threshold": 3,
}


class Hosts:
    """A Ray cluster whose hosts have a slot each; the first process of the cluster has none."""

    def __init__(self) -> None:
        os.environ.update(LOOPBACK_ONLY | NO_STATISTICS)
        from ray.cluster_utils import Cluster

        self.cluster = Cluster()
        self._nodes: dict[str, Any] = {}
        self._add(include_dashboard=False, _system_config=HEALTH_CHECKS)

    def add(self, name: str, **more: object) -> psutil.Process:
        """Start a host, and return its raylet."""
        self._nodes[name] = self._add(node_name=name, resources={"render_slot": 1}, **more)
        return self.raylet(name)

    def raylet(self, name: str) -> psutil.Process:
        return psutil.Process(self._nodes[name].all_processes["raylet"][0].process.pid)

    def _add(self, **more: object) -> Any:  # noqa: ANN401 (Ray's)
        common = {"num_cpus": 0, "node_ip_address": "127.0.0.1", "object_store_memory": OBJECT_STORE_BYTES}
        return self.cluster.add_node(**common, **more)


@pytest.fixture(scope="module")
def hosts() -> Iterator[Hosts]:
    hosts = Hosts()
    hosts.add("alpha", labels={"network": "east"})
    hosts.add("beta")
    yield hosts
    hosts.cluster.shutdown()


@pytest.fixture(scope="module")
def installation(hosts: Hosts, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    options = ("--placer", "ray", "--ray-address", hosts.cluster.address)
    with started(tmp_path_factory.mktemp("rooms"), *options) as found:
        found.hosts = [hosts.raylet("alpha"), hosts.raylet("beta")]
        yield found
        running = [process for host in found.hosts for process in rendering(host)]
    assert [process for process in running if not is_gone(process)] == []
    assert hosts.raylet("gamma").is_running()  # a cluster that others started goes on


def rendering(host: psutil.Process) -> list[psutil.Process]:
    """The render servers of a host, and the actors that hold them."""
    if is_gone(host):
        return []
    found = host.children(recursive=True)
    return [process for process in found if "RenderActor" in process.name() or "server" in process.cmdline()]


def epoch(installation: Installation, room: str) -> int:
    endpoints = installation.room(room).endpoints
    assert endpoints is not None
    return endpoints.epoch


def kill_host(hosts: Hosts, installation: Installation, room: str) -> float:
    """Kill the raylet of a room's host; return the seconds until a viewer has a picture from another."""
    before = installation.room(room)
    assert before.slot is not None
    assert before.endpoints is not None
    server, raylet = installation.server(room), hosts.raylet(before.slot.partition("/")[0])
    os.kill(raylet.pid, signal.SIGKILL)
    killed_s = time.monotonic()
    shown_s = installation.shown_after(room, before.endpoints.epoch)
    wait_for(lambda: is_gone(server))
    return shown_s - killed_s


def test_two_rooms_run_on_two_hosts_and_the_third_waits_and_says_why(
    hosts: Hosts, installation: Installation
) -> None:
    slots = {installation.room(name).slot for name in ("hall", "door")}
    assert slots == {"alpha/1", "beta/1"}
    waits = installation.room("attic")
    assert (waits.state, "all 2 slots are in use" in waits.why) == ("waiting", True)
    joined = RayCluster(hosts.cluster.address, 0)
    found = {host.name: (host.slots, host.labels.get("network")) for host in joined.hosts()}
    joined.close()
    assert found == {"alpha": (1, "east"), "beta": (1, None)}


def test_a_killed_render_server_is_replaced_by_the_spare_of_its_host(
    hosts: Hosts, installation: Installation, capsys: pytest.CaptureFixture[str]
) -> None:
    slot, before = installation.room("hall").slot, settled(installation, "hall")
    assert slot is not None
    host = slot.partition("/")[0]
    wait_for(lambda: sum("server" in each.cmdline() for each in rendering(hosts.raylet(host))) == 2)
    time.sleep(3)  # it prepares itself
    said = installation.kill("hall")
    with capsys.disabled():
        print(f"\na render server of a host that lives was replaced after {said}")
    assert "by the spare" in said
    assert (installation.room("hall").slot, settled(installation, "hall")) == (slot, before)


def test_rooms_of_killed_hosts_return_on_others_with_equal_pictures(
    hosts: Hosts, installation: Installation, capsys: pytest.CaptureFixture[str]
) -> None:
    follower = RoomFollower(installation.directory, lambda _room, _endpoints: None)
    stale = installation.directory.rooms()
    for name in ("attic", "door"):
        installation.directory.command("drain", name)
    wait_for(lambda: sum(slot.room is None for slot in installation.directory.rooms().slots) == 1)
    before, gaps_s = settled(installation, "hall"), []
    for name in ("gamma", "delta"):
        gaps_s.append(kill_host(hosts, installation, "hall"))
        installation.hosts.append(hosts.add(name))
        assert settled(installation, "hall") == before
    with capsys.disabled():
        print(f"\nrooms of killed hosts were away for {', '.join(f'{gap_s:.2f} s' for gap_s in gaps_s)}")
    follower.take(installation.directory.rooms())
    follower.take(stale)
    assert follower.refused >= 1


def test_a_room_of_a_killed_host_waits_for_a_slot_and_says_so(
    hosts: Hosts, installation: Installation
) -> None:
    installation.directory.command("start", "door")
    wait_for(lambda: installation.is_shown("door"))
    other, picture = epoch(installation, "hall"), settled(installation, "hall")
    slot = installation.room("door").slot
    assert slot is not None
    server = installation.server("door")
    os.kill(hosts.raylet(slot.partition("/")[0]).pid, signal.SIGKILL)
    wait_for(lambda: installation.room("door").state == "waiting")
    wait_for(lambda: "all 1 slots are in use" in installation.room("door").why)
    wait_for(lambda: is_gone(server))
    assert (epoch(installation, "hall"), settled(installation, "hall")) == (other, picture)
    hosts.add("liar", labels={"gpu": "NVIDIA-H100-80GB-HBM3"})
    wait_for(
        lambda: "The host liar is refused: it claims the device NVIDIA-H100" in installation.room("door").why
    )
    assert "liar" not in {slot.host for slot in installation.directory.rooms().slots}
    installation.hosts.append(hosts.add("epsilon"))
    wait_for(lambda: installation.is_shown("door"))


def test_a_drained_host_is_emptied(installation: Installation) -> None:
    installation.directory.command("drain", "door")
    wait_for(lambda: any(slot.room is None for slot in installation.directory.rooms().slots))
    leaves, picture = installation.room("hall").slot, settled(installation, "hall")
    assert leaves is not None
    host = leaves.partition("/")[0]
    installation.directory.host_command("drain-host", host)
    wait_for(lambda: installation.room("hall").slot not in (None, leaves))
    wait_for(lambda: installation.is_shown("hall"))
    assert settled(installation, "hall") == picture
    slots = installation.directory.host_command("undrain-host", host).slots
    assert not any(slot.drained for slot in slots)


ALONE = """
import sys
from deltalight.services.rooms.ray_cluster import RayCluster
cluster = RayCluster(None, 3)
print([(host.address, host.slots) for host in cluster.hosts()], flush=True)
sys.stdin.readline()
cluster.close()
"""


@pytest.mark.parametrize("is_killed", [False, True])
def test_a_cluster_of_its_own_is_on_loopback_and_ends_with_its_process(*, is_killed: bool) -> None:
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    process = psutil.Popen([sys.executable, "-c", ALONE], text=True, **pipes)
    with process.stdin as told, process.stdout as answer:
        assert answer.readline() == "[('127.0.0.1', 3)]\n"
        daemons = process.children(recursive=True)
        sockets = [each for daemon in daemons for each in daemon.net_connections("tcp")]
        assert {each.laddr.ip.removeprefix("::ffff:") for each in sockets} == {"127.0.0.1"}
        assert {"raylet", "gcs_server"} <= {daemon.name() for daemon in daemons}
        if is_killed:  # then Ray's agents go on looking for the others for a minute
            daemons = [daemon for daemon in daemons if "Agent" not in daemon.name()]
            process.kill()
        else:
            told.write("end\n")
            told.flush()
        process.wait(20)
    wait_for(lambda: all(map(is_gone, daemons)))


def test_an_actor_without_keeper_ends_its_render_server(tmp_path: Path) -> None:
    program = (
        "import sys, time\n"
        "from deltalight.services.child import ChildSpec\n"
        "from deltalight.services.host import HostCommands\n"
        "from deltalight.services.rooms import render_actor\n"
        "from deltalight.services.rooms.placer import Placement\n"
        "from deltalight.services.rooms.ray_cluster import ClusterHost\n"
        "from deltalight.services import ports\n"
        "render_actor.LEASE_S = 1.0\n"
        "publish, control = map(ports.endpoint, ports.private_ports(2))\n"
        "spec = ChildSpec('room', ('-c', 'import time; time.sleep(100)'))\n"
        "placement = Placement('hall', 1, 'a/1', publish, control)\n"
        "host = ClusterHost('a', 'id', '127.0.0.1', 1, {})\n"
        "task = render_actor.RenderTask(placement, spec, '', HostCommands(), 0, host)\n"
        "actor = render_actor.RenderActor(task)\n"
        "print(actor.process_id(), flush=True)\n"
        "time.sleep(60)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    assert process.stdout is not None
    server = psutil.Process(int(process.stdout.readline()))
    assert process.wait(20) == 1
    wait_for(lambda: is_gone(server))
    assert list(tmp_path.iterdir()) == []
    process.stdout.close()
