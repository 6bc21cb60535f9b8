"""The commands of the chart's pods run as they stand there, as processes of this host: keeper, render host, web."""

import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from deltalight.protocol.keys import create_keys
from deltalight.services import ports
from tests.deploy.chart_samples import SOFTWARE, of_kind, pods, rendered
from tests.deploy.test_deploy import DEPLOY, check_names

pytestmark = [
    pytest.mark.slow(seconds=40),
    pytest.mark.skipif(find_spec("helm_python") is None, reason="Helm's library is not installed"),
    pytest.mark.skipif(find_spec("ray") is None, reason="the extra `cluster` is not installed"),
]
FLEET_BOARD = DEPLOY / "grafana" / "boards" / "fleet.json"
KEEPER, RENDER, WEB = "127.0.0.2", "127.0.0.3", "127.0.0.4"  # addresses of the pods
PATIENCE_S = 120.0
ONE_ROOM = {"nodes": {"desk": {"source": "synthetic"}}, "rooms": {"hall": {"nodes": ["desk"]}}}


@contextmanager
def closed_folder() -> Iterator[Path]:
    """A folder with a path short enough for Ray's sockets; what names it in its command line ends with it."""
    folder = Path(tempfile.mkdtemp(prefix="dl-"))
    try:
        yield folder
    finally:
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                if any(
                    str(folder) in word for word in (*process.cmdline(), process.environ().get("HOME", ""))
                ):
                    process.kill()
        shutil.rmtree(folder, ignore_errors=True)


class Release:
    """The pods of a release; only addresses, ports and places of files are others."""

    def __init__(self, folder: Path) -> None:
        resources = rendered({**SOFTWARE, "rooms": ONE_ROOM})
        self._pods, self._folder = pods(resources), folder
        self.page, self.web, directory, gcs, *raylets = ports.private_ports(8)
        places = {"/run/deltalight": "keys", "/var/lib/deltalight": "data", "/etc/deltalight": "etc"}
        places |= {"/run/secrets/tokens": "tokens", "/run/secrets/ray": "ray"}
        for name in places.values():
            (folder / name).mkdir()
        self._others = {inside: str(folder / name) for inside, name in places.items()}
        self._others |= {"5604": str(directory), "6379": str(gcs), "fleet-keeper": KEEPER}
        self._own_ports: dict[str, dict[str, str]] = {
            "keeper": {"6380": str(raylets[0]), "6381": str(raylets[1]), "=8000": f"={self.page}"},
            "render": {"6380": str(raylets[2]), "6381": str(raylets[3])},
            "web": {"=8000": f"={self.web}"},
        }
        (rooms_file,) = of_kind(resources, "ConfigMap")
        (folder / "etc" / "rooms.yaml").write_text(rooms_file["data"]["rooms.yaml"])
        create_keys("fleet", folder / "keys")
        self.token = secrets.token_hex(32)
        (folder / "tokens" / "control_token").write_text(self.token)
        (folder / "tokens" / "view_token").write_text(secrets.token_hex(32))
        (folder / "ray" / "ray_token").write_text(secrets.token_hex(32))

    def start(self, name: str, address: str) -> None:
        """Starts the container of a pod at an address."""
        container = self._pods[name]["spec"]["containers"][0]
        command = [*container.get("command", ["deltalight"]), *container["args"]]
        environment = {
            each["name"]: self._here(name, each.get("value", address))
            for each in container["env"]
            if "secretKeyRef" not in each.get("valueFrom", {})  # a database: SQLite does here
        }
        environment |= {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "HOME": str(self._folder),
            "RAY_TMPDIR": str(self._folder),
            "DELTALIGHT_KEYS__ON_LOOPBACK": "true",
        }
        subprocess.Popen([self._here(name, word) for word in command], env=environment, cwd=self._folder)

    def _here(self, pod: str, text: str) -> str:
        for inside, outside in (self._others | self._own_ports[pod]).items():
            text = text.replace(inside, outside)
        return text

    def client(self, port: int) -> httpx.Client:
        headers = {"Authorization": f"Bearer {self.token}"}
        return httpx.Client(base_url=f"http://127.0.0.1:{port}/api/v1", headers=headers, timeout=30)


def wait_for(condition: Callable[[], Any]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        with suppress(httpx.TransportError):
            if condition():
                return
        time.sleep(0.2)
    pytest.fail("it never came")


def test_the_commands_of_the_pods_show_a_room_that_another_host_renders() -> None:
    with closed_folder() as folder:
        release = Release(folder)
        release.start("keeper", KEEPER)
        keeper = release.client(release.page)
        wait_for(lambda: keeper.get("/ready").status_code == 200)
        wait_for(lambda: "start one" in keeper.get("/rooms/hall").json()["why"])  # no host offers a slot
        release.start("render", RENDER)
        release.start("web", WEB)
        web = release.client(release.web)
        wait_for(lambda: web.get("/ready").status_code == 200)
        wait_for(lambda: web.get("/rooms/hall").json()["state"] == "running")
        wait_for(lambda: web.get("/rooms/hall/live.jpg").content.startswith(b"\xff\xd8"))
        assert {slot["host"] for slot in web.get("/rooms").json()["slots"]} != {"local"}
        assert web.post("/recordings", json={}).status_code == 409, "the keeper's web process records"
        check_names(web.get("/metrics").text, [FLEET_BOARD])
        assert (
            httpx.get(f"http://127.0.0.1:{release.web}/api/v1/rooms", timeout=PATIENCE_S).status_code == 401
        )
