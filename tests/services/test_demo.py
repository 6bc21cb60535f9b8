"""The demo through real processes: files, killed processes, Ctrl-C, a second start."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import httpx
import psutil
import pytest

from deltalight.protocol.envelope import decode
from deltalight.protocol.messages import CompositeMessage, ControlRequest
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.request import RequestClient
from deltalight.services import ports
from deltalight.services.api.serve import listening
from deltalight.services.demo import POSTER, POSTER_BEFORE, RECORDING, SCENE, demo_plan, demo_scene
from deltalight.services.host import HostPlan
from deltalight.services.session_file import session_file
from deltalight.services.supervisor import Supervisor
from tests.services.conftest import ROOT, RunCli
from tests.services.live_samples import live_socket, read_frame, wait_for_frames
from tests.services.record_samples import slow_demo

pytestmark = pytest.mark.skipif(
    not (RECORDING.is_file() and SCENE.is_file()), reason="the demo's recording is not in this checkout"
)
PATIENCE_S = 90
SMALL = {"width": 160, "height": 120}
CHEAP = {
    "volume_size": 32,
    "cone_count": 4,
    "cone_scale": 4,
    "rsm_size": 256,
    "triangle_budget": 4000,
    "bounces": 0,
}
PLAIN = {"caustics": False, "screen_space": False, "far_volume": False, "shadow_samples": 1}


@pytest.mark.slow(seconds=20)
def test_headless_demo_writes_composites_sheet_and_video(cli_process: RunCli, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ("--headless", "--frames", 3, "--out", out, "--method", "paper", "--json")
    done = cli_process("demo", *options, timeout_s=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    assert len(list(out.glob("??????.jpg"))) == 3
    sheet, first = cv2.imread(str(out / "contact_sheet.png")), cv2.imread(str(out / "000000.jpg"))
    assert sheet is not None
    assert first is not None
    assert sheet.shape[1] == 3 * 256
    video = cv2.VideoCapture(str(out / "demo.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 3
    summary = json.loads(done.stdout)
    assert summary["composites"] == 3
    assert summary["without_pose"] == 0
    assert summary["renderer"]
    assert summary["pass_times_ms"]
    assert summary["restarts"] == {"sensor node": 0, "render server": 0}
    records = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    frames = [record["frame"] for record in records]
    assert frames == sorted(set(frames))
    assert all(record["age_ms"] > 0 for record in records)


@pytest.mark.parametrize("path", [POSTER, POSTER_BEFORE])
def test_the_poster_is_small_and_of_the_pictures_shape(path: Path) -> None:
    assert path.stat().st_size < 60_000
    picture = cv2.imread(str(path))
    assert picture is not None
    assert picture.shape == (480, 640, 3)


def test_headless_demo_needs_a_folder(cli: RunCli) -> None:
    done = cli("demo", "--headless")
    assert done.returncode == 2
    assert "--out" in done.stderr


@pytest.mark.slow(seconds=20)
def test_picture_returns_after_node_and_server_are_killed(tmp_path: Path) -> None:
    with session_file(demo_scene("paper").replaced(output=SMALL)) as session:
        plan = replace(demo_plan(session), source=str(slow_demo(tmp_path)))
        lines: list[str] = []
        with Supervisor(plan.specs(), forward=lines.append) as supervisor:
            receiver = Receiver([ports.endpoint(plan.composite_port)], ["composite"])
            try:
                wait_for_composite(supervisor, receiver, after_ns=0)
                change_view(plan, "effects")
                for name in ("sensor node", "render server"):
                    killed_ns = time.time_ns()
                    os.kill(supervisor.process_ids()[name], signal.SIGKILL)
                    wait_for_composite(supervisor, receiver, after_ns=killed_ns, restarted=name)
                assert current_view(plan) == "effects"
            finally:
                receiver.close()
    assert supervisor.restarts() == {"sensor node": 1, "render server": 1}


def wait_for_composite(
    supervisor: Supervisor, receiver: Receiver, *, after_ns: int, restarted: str | None = None
) -> None:
    """Waits for a composite of a frame that was captured later, sent after the named process came back."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        supervisor.poll()
        is_back = restarted is None or supervisor.restarts()[restarted] == 1
        for multipart in (receiver.latest(0.1) or {}).values():
            message, _ = decode(multipart)
            assert isinstance(message, CompositeMessage)
            if is_back and message.capture_ns > after_ns and message.status == "ok":
                return
    pytest.fail(f"no composite came back after {restarted} was killed")


def ask(plan: HostPlan, op: str, **payload: object) -> dict[str, object]:
    client = RequestClient(ports.endpoint(plan.control_port))
    try:
        reply = client.request(ControlRequest(node="test", id=op, op=op, payload=payload), 20)
    finally:
        client.close()
    assert reply.error is None
    return reply.payload


def change_view(plan: HostPlan, view: str) -> None:
    ask(plan, "set_view", view=view)


def current_view(plan: HostPlan) -> str:
    scene = ask(plan, "get_scene")["scene"]
    assert isinstance(scene, dict)
    return str(scene["output"]["view"])


def wait_until_shown(client: httpx.Client, answer: dict[str, Any]) -> None:
    """Where a busy machine's renderer took the change after its answer."""
    deadline_s = time.monotonic() + PATIENCE_S
    shown = {"state": "shown", "revision": answer["revision"], "detail": ""}
    while answer["picture"] != shown:
        assert answer["picture"]["state"] != "refused"
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
        answer = client.get("/active-scene").json()


@contextmanager
def demo(page_port: int, *options: str) -> Iterator[str]:
    """A demo that shows frames, at host:port; Ctrl-C ends it and leaves nothing."""
    command = [
        sys.executable,
        "-m",
        "deltalight.services.cli",
        "demo",
        "--no-browser",
        "--port",
        str(page_port),
    ]
    demo = subprocess.Popen(
        [*command, *options], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        wait_for_frames(f"{ports.LOOPBACK}:{page_port}", PATIENCE_S)
        children = psutil.Process(demo.pid).children(recursive=True)
        assert len(children) == 3
        yield f"{ports.LOOPBACK}:{page_port}"
        demo.send_signal(signal.SIGINT)
        output, error = demo.communicate(timeout=PATIENCE_S)
    finally:
        demo.kill()  # its children end with it
    assert demo.returncode == 130
    assert "Traceback" not in error
    assert f"http://127.0.0.1:{page_port}" in output
    assert psutil.wait_procs(children, timeout=PATIENCE_S)[1] == []
    assert ports.is_free(page_port)


@pytest.mark.slow(seconds=20)
def test_ctrl_c_ends_the_demo_without_orphans_and_it_starts_again() -> None:
    """The first as people start it; in the second, a change by REST is in the next picture that is begun."""
    (page_port,) = ports.private_ports(1)
    with demo(page_port) as address:
        with httpx.Client(base_url=f"http://{address}/api/v1", timeout=PATIENCE_S) as client:
            assert client.get("/settings").json()["has_poster"]
            assert client.get("/poster.jpg").content == POSTER.read_bytes()
            assert client.get("/poster-before.jpg").content == POSTER_BEFORE.read_bytes()
            (recording,) = client.get("/recordings").json()
            begins = client.get("/replay").json()
            end_s = begins["duration_s"]
            assert client.patch("/replay", json={"position_s": end_s}).json()["position_s"] == pytest.approx(
                end_s
            )
        assert (recording["id"], recording["frames"]) == ("demo", 30)
        assert (begins["recording"], begins["position_s"], begins["playing"]) == (None, 0, False)
    with demo(page_port, "--method", "paper") as address:
        check_changes(address)


def check_changes(address: str) -> None:
    """Of all frames that were captured after the answer, each shows the new revision."""
    client = httpx.Client(base_url=f"http://{address}/api/v1", timeout=30)
    scene = client.get("/active-scene").json()
    assert scene["document"]["name"] == "Demo"
    path, knot = f"/scenes/{scene['id']}", scene["document"]["objects"][0]["id"]
    changes: list[tuple[str, object]] = [
        (f"{path}/output", {"view": "delta", **SMALL}),
        (f"{path}/objects/{knot}", {"pose": {"translation_m": [0.2, -0.1, 0.02]}}),
        (f"{path}/method", {"name": "dvct", "operator": "exact", **CHEAP, **PLAIN}),
    ]
    with live_socket(address) as socket:
        assert read_frame(socket, PATIENCE_S)["camera"]["width"] == 640
        socket.send("ack")
        for route, patch in changes:
            answer = client.patch(route, json=patch).json()
            wait_until_shown(client, answer)
            answered_ns, expected = time.time_ns(), {"id": scene["id"], "revision": answer["revision"]}
            header = read_frame(socket, PATIENCE_S)
            while header["capture_ns"] <= answered_ns:
                assert header["status"] == "ok"
                socket.send("ack")
                header = read_frame(socket, PATIENCE_S)
            assert header["scene"] == expected
            socket.send("ack")
    assert header["camera"]["width"] == SMALL["width"]
    assert header["renderer"]
    assert client.post(f"{path}/undo").json()["document"]["method"]["operator"] == "paper"


def test_page_port_in_use_is_a_sentence(cli: RunCli) -> None:
    (port,) = ports.private_ports(1)
    with listening(ports.LOOPBACK, port):
        done = cli("demo", "--no-browser", "--port", port)
    assert done.returncode == 2
    assert f"Port {port}" in done.stderr
    assert "--port" in done.stderr


@pytest.mark.slow(seconds=20)
def test_up_without_a_gpu_refuses_in_a_sentence(cli: RunCli, cli_process: RunCli, tmp_path: Path) -> None:
    """The server's own sentence ends the command; no restarts are tried."""
    if "llvmpipe" not in cli("doctor", "--json").stdout:
        pytest.skip("this machine has a GPU")
    numbers = ports.private_ports(4)
    names = ("--port", "--node-port", "--composite-port", "--control-port")
    options = [str(part) for pair in zip(names, numbers, strict=True) for part in pair]
    options += ["--data", str(tmp_path)]
    done = cli_process("up", "--source", RECORDING, "--scene", SCENE, *options, timeout_s=PATIENCE_S)
    assert done.returncode == 2
    last_line = done.stderr.strip().splitlines()[-1]
    assert "--allow-software" in last_line
    assert "restarting it" not in done.stderr
