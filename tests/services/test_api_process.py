"""`deltalight api` as a process: with a real render server, killed and started again, its tokens and faults."""

import json
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner

from deltalight.benchmarks.soak.samples import read_process
from deltalight.protocol.documents import validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import RequestClient
from deltalight.services import ports
from deltalight.services.api.serve import listening, run_api
from deltalight.services.api.settings import ApiSettings
from deltalight.services.commands.api import api
from tests.services.api_samples import sentence
from tests.services.conftest import ROOT, RunCli

SCENE = ROOT / "services" / "demo_assets" / "scene.json"
ENDED_BY_SIGTERM = 143


@contextmanager
def process(*arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "deltalight.services.cli", *map(str, arguments)]
    running = subprocess.Popen(command, cwd=ROOT)
    try:
        yield running
    finally:
        running.kill()
        running.wait()


def wait_for(condition: Callable[[], bool]) -> None:
    for _ in range(600):
        with suppress(httpx.TransportError):
            if condition():
                return
        time.sleep(0.1)
    pytest.fail("it never came")


@pytest.mark.slow(seconds=20)
def test_a_change_is_in_the_real_render_server_and_outlives_kill_9_of_both(tmp_path: Path) -> None:
    port, control_port, publish_port, node_port = ports.private_ports(4)
    control = ports.endpoint(control_port)
    server = ["server", "--control", control, "--publish", ports.endpoint(publish_port)]
    server += ["--subscribe", ports.endpoint(node_port), "--allow-software"]
    rest: list[object] = ["api", "--port", port, "--data", tmp_path, "--control", control]
    rest += ["--subscribe", ports.endpoint(publish_port)]
    client = httpx.Client(base_url=f"http://{ports.LOOPBACK}:{port}/api/v1", timeout=60)
    control_client = RequestClient(control)

    def rendered() -> dict[str, object]:
        asked = ControlRequest(node="test", id=f"{time.time_ns()}", op="get_scene")
        return dict(control_client.request(asked, 30).payload["scene"])  # type: ignore[call-overload]

    with process(*server) as first_server:
        with process(*rest, "--scene", SCENE) as first_api:
            wait_for(lambda: (client.get("/state").json()["picture"] or {}).get("state") == "shown")
            scene = client.get("/active-scene").json()
            address = f"/scenes/{scene['id']}"
            item = scene["document"]["objects"][0]
            assert item["asset"].startswith("sha256:")
            moved = client.patch(
                f"{address}/objects/{item['id']}", json={"pose": {"translation_m": [0, 0, 0.5]}}
            )
            assert moved.json()["picture"] == {"state": "shown", "revision": 2, "detail": ""}
            before = rendered()
            assert before["objects"][0]["pose"]["translation_m"] == [0, 0, 0.5]  # type: ignore[index]
            assert (
                client.patch(f"{address}/output", json={"view": "delta"}).json()["picture"]["state"]
                == "shown"
            )
            after = rendered()
            assert after["revision"] == before["revision"] + 1  # type: ignore[operator]
            wait_for(
                lambda: (
                    [each["name"] for each in client.get("/state").json()["processes"]] == ["render-server"]
                )
            )
            first_server.kill()
            first_api.send_signal(signal.SIGKILL)
            first_api.wait()
        with process(*rest) as second_api, process(*server):
            wait_for(lambda: (client.get("/state").json()["picture"] or {}).get("state") == "shown")
            assert rendered()["output"]["view"] == "delta"  # type: ignore[index]
            assert client.get(address).json()["revision"] == 3
            second_api.send_signal(signal.SIGTERM)
            assert second_api.wait(timeout=60) == ENDED_BY_SIGTERM
    control_client.close()


def test_tokens_are_made_listed_and_revoked(tmp_path: Path) -> None:
    def run(*arguments: str) -> str:
        done = CliRunner().invoke(api, [*arguments, "--data", str(tmp_path)], catch_exceptions=False)
        assert done.exit_code == 0
        return done.stdout

    assert "make one with" in run("tokens")
    assert run("token", "wall", "--role", "view").startswith("deltalight-")
    rows = json.loads(run("tokens", "--json"))
    assert [(row["name"], row["role"]) for row in rows] == [("wall", "view")]
    assert "wall" in run("tokens")
    with pytest.raises(DeltalightError, match="there is a token called `wall`"):
        run("token", "wall")
    run("revoke", "wall")
    with pytest.raises(DeltalightError, match="no token called `wall`"):
        run("revoke", "wall")


@contextmanager
def open_to_others(folder: Path, port: int, stdout: int) -> Iterator[subprocess.Popen[str]]:
    """A web process that other hosts can reach, once it answers; it is ended with the block."""
    words = ["api", "--host", "0.0.0.0", "--port", str(port), "--data", str(folder)]
    command = [sys.executable, "-m", "deltalight.services.cli", *words]
    running = subprocess.Popen(command, cwd=ROOT, stdout=stdout, stderr=subprocess.PIPE, text=True)
    try:
        with httpx.Client(base_url=f"http://{ports.LOOPBACK}:{port}/api/v1") as client:
            wait_for(lambda: client.get("/health").status_code == 200)
        yield running
    finally:
        running.terminate()


def require_lets_in(port: int, token: str) -> None:
    with httpx.Client(base_url=f"http://{ports.LOOPBACK}:{port}/api/v1", timeout=60) as client:
        assert "token is needed" in sentence(client.get("/scenes"), 401)
        scenes = client.get("/scenes", headers={"Authorization": f"Bearer {token}"}).json()
        assert [scene["active"] for scene in scenes] == [True]  # there is something to begin with


@pytest.mark.slow(seconds=20)
def test_leaving_loopback_makes_a_token_once_and_no_log_holds_it(tmp_path: Path) -> None:
    (port,) = ports.private_ports(1)
    file = tmp_path / "first_token"
    with open_to_others(tmp_path, port, subprocess.PIPE) as first:
        token = file.read_text().strip()
        require_lets_in(port, token)
    stdout, stderr = first.communicate(timeout=60)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stdout == ""
    assert str(file) in stderr
    assert token not in stderr
    file.unlink()
    with open_to_others(tmp_path, port, subprocess.PIPE) as second:
        require_lets_in(port, token)
    stdout, stderr = second.communicate(timeout=60)
    assert stdout == ""
    assert "nothing is encrypted" in stderr
    assert not file.exists()


@pytest.mark.slow(seconds=10)
def test_at_a_terminal_the_first_token_is_shown_and_in_no_file(tmp_path: Path) -> None:
    (port,) = ports.private_ports(1)
    seen, terminal = os.openpty()
    with open_to_others(tmp_path, port, terminal) as running:
        line = os.read(seen, 4096).decode()
        assert "shown this once: deltalight-" in line
        require_lets_in(port, line.split()[-1])
    assert line.split()[-1] not in running.communicate(timeout=60)[1]
    assert not (tmp_path / "first_token").exists()
    for handle in (seen, terminal):
        os.close(handle)


def test_wrong_use_is_a_sentence(cli: RunCli, tmp_path: Path) -> None:
    (port,) = ports.private_ports(1)
    with listening(ports.LOOPBACK, port):
        done = cli("api", "--port", port, "--data", tmp_path)
    assert done.returncode == 2
    assert f"cannot listen on 127.0.0.1 port {port} (Address already in use); stop" in done.stderr
    (tmp_path / "file").touch()
    with pytest.raises(DeltalightError, match="--data"):
        run_api(ApiSettings(port=port, data=tmp_path / "file"))
    with pytest.raises(DeltalightError, match="`host` is wrong"):
        validate(ApiSettings, {"host": "somewhere.example"}, "api")


MOST_GROWTH_BYTES = 20 << 20  # imports would take 127 MB for the shelf and 131 to 175 MB for cameras


@pytest.mark.slow(seconds=20)
def test_requests_that_need_large_packages_or_are_refused_leave_the_process_as_small(tmp_path: Path) -> None:
    port, control_port, stats_port = ports.private_ports(3)
    rest = ("api", "--port", port, "--data", tmp_path, "--control", ports.endpoint(control_port))
    wide = b"[" + b"0, " * 30_000 + b"0]"
    client = httpx.Client(base_url=f"http://{ports.LOOPBACK}:{port}/api/v1", timeout=60)

    def refused(content: bytes, media_type: str) -> None:
        answer = client.post("/scenes", content=content, headers={"Content-Type": media_type})
        assert 400 <= answer.status_code < 500, answer.text

    with process(*rest, "--subscribe", ports.endpoint(stats_port)) as running:
        wait_for(lambda: client.get("/health").is_success)
        for place in ("/scenes", "/state", "/recordings", "/assets", "/openapi.json"):
            client.get(place)
        refused(wide, "application/yaml")
        before = read_process(running.pid).rss_bytes
        assert client.get("/cameras").is_success
        for item in ("helmet", "chrome-ball", "helmet"):
            assert client.post(f"/shelf/{item}").is_success
        for _ in range(5):
            refused(b'{"a": ' * 3000, "application/json")
            refused(b'{"a": %s}' % wide, "application/json")
            refused(wide, "application/yaml")
        assert read_process(running.pid).rss_bytes - before < MOST_GROWTH_BYTES
