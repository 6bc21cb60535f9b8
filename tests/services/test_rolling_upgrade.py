"""Hosts are upgraded one after another: processes that speak the oldest schema version run beside those of today."""

from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from deltalight.benchmarks.rooms.processes import wait_for
from deltalight.benchmarks.soak.profiles import choose_profile
from deltalight.benchmarks.soak.station import soaked_scene, write_take
from deltalight.services import ports
from tests.services.older_version import running


class Station:
    """A node, a render server and a web process, each in the version that a test says."""

    def __init__(self, folder: Path) -> None:
        write_take(folder / "take.mcap", (96, 72), 5.0, frames=(0,) * 5)
        scene = folder / "scene.json"
        scene.write_text(soaked_scene(choose_profile("small")).model_dump_json())
        page, *others = ports.private_ports(4)
        node, control, publish = map(ports.endpoint, others)
        self.node = (
            "node",
            "--source",
            folder / "take.mcap",
            "--loop",
            "--publish",
            node,
            "--clock",
            control,
        )
        self.server = ["server", "--control", control, "--publish", publish, "--subscribe", node]
        self.server += ["--allow-software"]
        self.web: list[object] = ["api", "--port", page, "--data", folder / "data", "--scene", scene]
        self.web += ["--control", control, "--subscribe", publish, "--subscribe", node]
        self.client = httpx.Client(base_url=f"http://{ports.LOOPBACK}:{page}/api/v1", timeout=60)

    def is_shown(self) -> bool:
        """Whether live pictures of the scene come."""
        state = self.client.get("/state").json()
        return bool(
            (state["picture"] or {}).get("state") == "shown"
            and self.client.get("/live.jpg").status_code == 200
        )

    def move(self, x_m: float) -> object:
        """Moves the object; returns the state of its change in the picture."""
        scene = self.client.get("/active-scene").json()
        item = scene["document"]["objects"][0]["id"]
        answer = self.client.patch(
            f"/scenes/{scene['id']}/objects/{item}", json={"pose": {"translation_m": [x_m, 0, 0.1]}}
        )
        return answer.json()["picture"]["state"]

    def node_is_compared(self) -> bool:
        """Whether the node has compared its clock with the render server's."""
        nodes = self.client.get("/nodes").json()
        return any(each["name"] == "camera" and each["age_s"] < 2 for each in nodes)


@pytest.mark.slow
def test_web_process_then_render_server_then_node_are_upgraded_while_pictures_go_on(tmp_path: Path) -> None:
    station = Station(tmp_path)
    with running(*station.web), ExitStack() as node:
        node.enter_context(running(*station.node, is_older=True))
        with running(*station.server, is_older=True):
            wait_for(station.is_shown)
            assert station.move(0.02) == "shown"
        with running(*station.server):
            wait_for(lambda: station.move(0.04) == "shown")
            wait_for(station.is_shown)
            node.close()
            with running(*station.node):
                wait_for(station.node_is_compared)
                assert station.move(0.06) == "shown"
    station.client.close()
