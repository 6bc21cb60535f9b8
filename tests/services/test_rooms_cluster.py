"""Rooms on a Ray cluster of several hosts: raylets are killed, and their rooms return elsewhere.

Each host is a raylet of this machine; render servers, sockets and pictures are real.
"""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import psutil
import pytest
from playwright.sync_api import Locator, expect

from deltalight.benchmarks.rooms.hosts import Hosts, running_hosts
from deltalight.benchmarks.rooms.installation import Installation, settled, started
from deltalight.benchmarks.rooms.processes import (
    PATIENCE_S,
    children_of,
    is_gone,
    wait_for,
)
from deltalight.services.rooms.ray_cluster import RayCluster
from tests.services.dashboard_samples import SIZE, USES_BROWSER, chromium, complaints_of, photograph
from tests.services.room_samples import WITHOUT_RAY, is_rendering

pytestmark = [
    pytest.mark.slow(seconds=25),
    WITHOUT_RAY,
]


@pytest.fixture(scope="module")
def hosts() -> Iterator[Hosts]:
    with running_hosts({"network": "east"}, {}) as found:
        yield found


@pytest.fixture(scope="module")
def installation(hosts: Hosts, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    options = ("--placer", "ray", "--ray-address", hosts.cluster.address)
    with started(tmp_path_factory.mktemp("rooms"), *options) as found:
        found.hosts = hosts.raylets
        yield found
        living = [hosts.raylet(name) for name in hosts.networks]
        running = [process for host in hosts.raylets for process in rendering(host)]
    assert [process for process in running if not is_gone(process)] == []
    assert living
    assert [host for host in living if is_gone(host)] == []  # a cluster that others started goes on


def arrange(hosts: Hosts, installation: Installation, *rooms: str) -> None:
    """Brings it about that two hosts take rooms, that these rooms run there, and that the others are drained."""
    directory = installation.directory
    for host in {slot.host for slot in directory.rooms().slots if slot.drained}:
        directory.host_command("undrain-host", host)
    for room in directory.rooms().rooms:
        if room.name not in rooms:
            directory.command("drain", room.name)
    for name in hosts.networks.keys() - slots(installation).keys():  # refused
        hosts.kill(name)
    while len(hosts.networks) < 2:
        hosts.add()
    wait_for(lambda: slots(installation).keys() == hosts.networks.keys())
    for name in rooms:
        directory.command("start", name)
        wait_for(partial(installation.is_shown, name))
    wait_for(lambda: set(slots(installation).values()) - {None} == set(rooms))


def slots(installation: Installation) -> dict[str, str | None]:
    """The room of each host."""
    return {slot.host: slot.room for slot in installation.directory.rooms().slots}


def host_of(installation: Installation, room: str) -> str:
    slot = installation.room(room).slot
    assert slot is not None
    return slot.partition("/")[0]


def rendering(host: psutil.Process) -> list[psutil.Process]:
    """The render servers of a host, and the actors that hold them."""
    return [process for process in children_of(host) if is_rendering(process)]


def kill_host(hosts: Hosts, installation: Installation, room: str) -> float:
    """Kills the raylet of a room's host; returns the seconds until a viewer has a picture from another."""
    before, server = installation.epoch(room), installation.server(room)
    hosts.kill(host_of(installation, room))
    killed_s = time.monotonic()
    shown_s = installation.shown_after(room, before)
    wait_for(lambda: is_gone(server))
    return shown_s - killed_s


def test_rooms_run_on_all_hosts_with_the_priority_of_other_processes(
    hosts: Hosts, installation: Installation
) -> None:
    arrange(hosts, installation, "hall", "door")
    used = {installation.room(name).slot for name in ("hall", "door")}
    assert used == {f"{name}/1" for name in hosts.networks}
    running = [process for name in hosts.networks for process in rendering(hosts.raylet(name))]
    assert max(process.nice() for process in running) <= psutil.Process().nice()
    joined = RayCluster(hosts.cluster.address, 0)
    found = {host.name: (host.slots, host.labels.get("network")) for host in joined.hosts()}
    joined.close()
    assert found == {name: (1, network) for name, network in hosts.networks.items()}


def test_rooms_of_killed_hosts_return_on_others_with_equal_pictures(
    hosts: Hosts, installation: Installation, capsys: pytest.CaptureFixture[str]
) -> None:
    arrange(hosts, installation, "hall")
    before, gaps_s = settled(installation, "hall"), []
    for _ in range(2):
        gaps_s.append(kill_host(hosts, installation, "hall"))
        hosts.add()
        assert settled(installation, "hall") == before
    with capsys.disabled():
        print(f"\nrooms of killed hosts were away for {', '.join(f'{gap_s:.2f} s' for gap_s in gaps_s)}")


def test_a_room_of_a_killed_host_waits_for_a_slot_and_says_so(
    hosts: Hosts, installation: Installation
) -> None:
    arrange(hosts, installation, "hall", "door")
    other, picture = installation.epoch("hall"), settled(installation, "hall")
    server = installation.server("door")
    hosts.kill(host_of(installation, "door"))
    wait_for(lambda: installation.room("door").state == "waiting")
    wait_for(lambda: "the only usable slot is in use" in installation.room("door").why)
    wait_for(lambda: is_gone(server))
    assert (installation.epoch("hall"), settled(installation, "hall")) == (other, picture)
    liar = hosts.add("liar", gpu="NVIDIA-H100-80GB-HBM3")
    wait_for(
        lambda: "The host liar is refused: it claims the device NVIDIA-H100" in installation.room("door").why
    )
    assert liar not in slots(installation)
    hosts.add()
    wait_for(lambda: installation.is_shown("door"))


def test_a_drained_host_is_emptied(hosts: Hosts, installation: Installation) -> None:
    arrange(hosts, installation, "hall")
    leaves, picture = installation.room("hall").slot, settled(installation, "hall")
    host = host_of(installation, "hall")
    installation.directory.host_command("drain-host", host)
    wait_for(lambda: installation.room("hall").slot not in (None, leaves))
    wait_for(lambda: installation.is_shown("hall"))
    assert settled(installation, "hall") == picture
    after = installation.directory.host_command("undrain-host", host).slots
    assert not any(slot.drained for slot in after)


THUMBNAIL_PIXELS = """async (image) => {
    await image.decode();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
    canvas.getContext("2d").drawImage(image, 0, 0);
    return canvas.toDataURL();
}"""


@USES_BROWSER
def test_a_room_is_moved_to_another_host_in_the_page(hosts: Hosts, installation: Installation) -> None:
    arrange(hosts, installation, "hall")
    settled(installation, "hall")
    server, left = installation.server("hall"), host_of(installation, "hall")
    (free,) = hosts.networks.keys() - {left}
    with chromium() as browser:
        page = browser.new_page(viewport=SIZE)  # type: ignore[arg-type]
        complaints = complaints_of(page)
        page.goto(f"http://127.0.0.1:{installation.client.base_url.port}/")
        rooms = page.get_by_role("dialog", name="Rooms")
        hall, attic = (rooms.get_by_role("article", name=name, exact=True) for name in ("hall", "attic"))
        where = hall.get_by_role("button", name="Where hall runs")
        expect(where).to_contain_text(f"{left}/1")
        before = next_thumbnail(installation, hall)
        where.click()
        hall.get_by_role("menuitem", name=f"Move to {free}/1").click()
        expect(where).to_contain_text(f"moving to {free}/1")
        photograph(page, "room_moves")
        expect(where).to_have_text(re.compile(rf"^\s*{free}/1$"))
        wait_for(lambda: is_gone(server))
        assert next_thumbnail(installation, hall) == before
        assert host_of(installation, "hall") == free
        hosts_listed = rooms.get_by_role("list", name="Hosts").get_by_role("listitem")
        expect(hosts_listed.filter(has_text=free)).to_contain_text("1 of 1 slots in use")
        hosts_listed.filter(has_text=left).get_by_role("button", name="Drain").click()
        attic.get_by_role("button", name="Where attic runs").click()
        attic.get_by_role("menuitem", name="Start").click()
        expect(attic).to_contain_text("It starts when a slot is free: the only usable slot is in use")
        photograph(page, "room_moved")
        rooms.get_by_role("button", name="Open hall").click()
        expect(page.get_by_role("img", name="Live picture", exact=True)).to_be_visible()
        assert complaints == []


def next_thumbnail(installation: Installation, card: Locator) -> str:
    """The picture that a room's card shows next, of a frame that is rendered from now on."""
    frames = installation.frames("hall")
    wait_for(lambda: installation.frames("hall") > frames)
    image = card.locator("img")
    expect(image).to_be_visible()
    for _ in range(2):  # the first may have been on its way before
        expect(image).not_to_have_attribute("src", str(image.get_attribute("src")))
    return str(image.evaluate(THUMBNAIL_PIXELS))


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
        process.wait(PATIENCE_S)
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
    assert process.wait(PATIENCE_S) == 1
    wait_for(lambda: is_gone(server))
    assert list(tmp_path.iterdir()) == []
    process.stdout.close()
