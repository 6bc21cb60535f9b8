"""Rooms are upgraded process by process: keeper, web process, render server and node of different versions."""

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path

import httpx
import pytest

from deltalight.benchmarks.rooms.processes import wait_for
from deltalight.benchmarks.soak.profiles import choose_profile
from deltalight.benchmarks.soak.station import soaked_scene, write_take
from deltalight.protocol.receiver import Receiver
from deltalight.services import ports
from deltalight.services.child import ChildSpec
from deltalight.services.host import HostCommands
from deltalight.services.rooms.directory import DirectoryClient, DirectoryServer
from deltalight.services.rooms.keeper import RoomKeeper, RoomPlan
from deltalight.services.rooms.local_placer import LocalPlacer
from deltalight.services.rooms.placer import Placement, RoomOrder
from deltalight.services.rooms.status import RoomNode
from tests.services.older_version import OLDER, running

pytestmark = pytest.mark.slow(seconds=20)
SIZE, FRAMES_PER_S = (96, 72), 5.0
ROOMS = """
slots: 2
nodes: {{desk: {{endpoint: "{node}"}}}}
rooms:
  hall: {{nodes: [desk], scene: scene.json}}
"""


def written(folder: Path) -> tuple[Path, Path]:
    """A take and a scene."""
    write_take(folder / "take.mcap", SIZE, FRAMES_PER_S, frames=(0,) * 5)
    (folder / "scene.json").write_text(soaked_scene(choose_profile("small")).model_dump_json())
    return folder / "take.mcap", folder / "scene.json"


class Page:
    """REST of a web process."""

    def __init__(self, port: int) -> None:
        self._client = httpx.Client(base_url=f"http://{ports.LOOPBACK}:{port}/api/v1", timeout=60)

    def close(self) -> None:
        self._client.close()

    def epoch(self) -> int:
        return int(self._client.get("/rooms/hall").json()["epoch"] or 0)

    def is_shown(self) -> bool:
        """Whether pictures of the room's present render server come."""
        room = self._client.get("/rooms/hall").json()
        since_s = room.get("last_frame_s")
        return room.get("state") == "running" and isinstance(since_s, float) and since_s < 1

    def rename(self, name: str) -> object:
        """Changes the scene; returns the state of the change in the picture."""
        scene = self._client.get("/active-scene").json()["id"]
        return self._client.patch(f"/scenes/{scene}", json={"name": name}).json()["picture"]["state"]


class UpgradedPlacer(LocalPlacer):
    """Places render servers of the version before until it `is_upgraded`, and watches whose pictures come."""

    def __init__(self) -> None:
        self.is_upgraded = False
        self.receivers: dict[int, Receiver] = {}  # by epoch
        self.came_before_release = False
        super().__init__([None, None], self._server_of)

    def place(self, order: RoomOrder, slot: str | None = None) -> Placement:
        placement = super().place(order, slot)
        self.receivers[order.epoch] = Receiver([placement.publish], ["composite"])
        return placement

    def release(self, placement: Placement) -> None:
        newest = self.receivers[max(self.receivers)]
        self.came_before_release = newest.latest(0) is not None
        super().release(placement)

    def close(self) -> None:
        super().close()
        for each in self.receivers.values():
            each.close()

    def _server_of(self, order: RoomOrder, placement: Placement, device: int | None) -> ChildSpec:
        more = ("--name", order.room, "--epoch", str(order.epoch), "--subscribe", *order.sources)
        commands = HostCommands(allow_software=True)
        spec = commands.server(
            "room", order.session_file, placement.publish, placement.control, device, *more
        )
        return spec if self.is_upgraded else replace(spec, arguments=("-c", OLDER, *spec.words))


@contextmanager
def kept(folder: Path, placer: UpgradedPlacer, node: str, directory: str) -> Iterator[RoomKeeper]:
    plan = RoomPlan("hall", "Hall", (RoomNode(name="camera", endpoint=node),), folder / "scene.json")
    keeper = RoomKeeper([plan], placer)
    with closing(placer), closing(DirectoryServer(directory, keeper)):
        yield keeper


def test_a_new_keeper_moves_a_room_from_an_old_render_server_to_a_new_one(tmp_path: Path) -> None:
    """Node and web process are old to the end."""
    take, _ = written(tmp_path)
    page_port, *others = ports.private_ports(3)
    node, directory = map(ports.endpoint, others)
    placer = UpgradedPlacer()
    with ExitStack() as parts:
        keeper = parts.enter_context(kept(tmp_path, placer, node, directory))
        source = ("node", "--source", take, "--loop", "--publish", node, "--clock", directory)
        parts.enter_context(running(*source, is_older=True))
        web = ("api", "--port", page_port, "--data", tmp_path / "data", "--rooms", directory)
        parts.enter_context(running(*web, is_older=True))
        page = parts.enter_context(closing(Page(page_port)))

        def polled(condition: object) -> None:
            def is_met() -> bool:
                keeper.poll()
                return bool(condition())  # type: ignore[operator]

            wait_for(is_met)

        polled(page.is_shown)
        assert page.rename("before") == "shown"
        before, placer.is_upgraded = page.epoch(), True
        keeper.move("hall")
        polled(lambda: page.epoch() > before and page.is_shown())
        assert placer.came_before_release
        assert page.rename("after") == "shown"


def test_a_new_web_process_follows_an_old_keeper_beside_the_old_one(tmp_path: Path) -> None:
    """Node and render servers are old too: whoever reads is upgraded first."""
    take, _ = written(tmp_path)
    old_port, new_port, rooms_port, node_port = ports.private_ports(4)
    node, directory = ports.endpoint(node_port), ports.endpoint(rooms_port)
    (tmp_path / "rooms.yaml").write_text(ROOMS.format(node=node))
    source = ("node", "--source", take, "--loop", "--publish", node, "--clock", directory, "--name", "desk")
    data = ("--data", tmp_path / "data")
    up: list[object] = ["up", "--rooms", tmp_path / "rooms.yaml", "--allow-software", "--no-spares"]
    up += [*data, "--port", old_port, "--rooms-port", rooms_port]
    with ExitStack() as parts:
        for words in (source, up):
            parts.enter_context(running(*words, is_older=True))
        old, new = (parts.enter_context(closing(Page(port))) for port in (old_port, new_port))
        client = parts.enter_context(closing(DirectoryClient(directory)))
        wait_for(old.is_shown)
        parts.enter_context(running("api", "--port", new_port, *data, "--rooms", directory))
        wait_for(new.is_shown)
        assert new.rename("before") == "shown"
        before = new.epoch()
        client.command("move", "hall")
        for page in (old, new):
            wait_for(lambda: page.epoch() > before and page.is_shown())  # noqa: B023
            assert page.rename("moved") == "shown"
