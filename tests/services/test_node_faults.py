"""Node processes that meet trouble: one sentence and an exit code, and others are not disturbed."""

import json
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.receiver import Receiver
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera
from deltalight.services import ports
from tests.services.conftest import ROOT, RunCli

LIMIT_S = 60.0


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames of the synthetic camera."""
    camera = SyntheticCamera()
    path = tmp_path_factory.mktemp("faults") / "take"
    with DatasetWriter(path, board=camera.board) as writer:
        for index in range(4):
            writer.add(camera.frame_at(index))
    return path


@pytest.fixture
def endpoint() -> str:
    return ports.endpoint(ports.private_ports(1)[0])


@contextmanager
def node_process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "deltalight.services.cli", "node", *arguments]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(LIMIT_S)
        if process.stderr is not None:
            process.stderr.close()


def assert_sentence(done: subprocess.CompletedProcess[str], *words: str) -> None:
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in done.stderr


def hears(receiver: Receiver) -> bool:
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        if receiver.latest(0.2):
            return True
    return False


@pytest.mark.slow
def test_a_second_node_at_the_same_endpoint_is_refused_and_the_first_goes_on(
    cli: RunCli, take: Path, endpoint: str
) -> None:
    with node_process("--source", str(take), "--publish", endpoint, "--loop") as first:
        receiver = Receiver([endpoint], ["color"])
        try:
            assert hears(receiver)
            assert_sentence(
                cli("node", "--source", take, "--publish", endpoint), f"cannot listen at {endpoint}"
            )
            receiver.latest(0)
            assert hears(receiver)
            assert first.poll() is None
        finally:
            receiver.close()
    assert first.returncode == 128 + signal.SIGTERM


def test_a_source_that_breaks_in_the_middle_says_where_and_one_that_ends_is_no_fault(
    cli: RunCli, take: Path, endpoint: str, tmp_path: Path
) -> None:
    import shutil

    done = cli("node", "--source", take, "--publish", endpoint, "--fast")
    assert done.returncode == 0, done.stderr
    broken = tmp_path / "broken"
    shutil.copytree(take, broken)
    picture = sorted((broken / "rgb").iterdir())[2]
    picture.write_bytes(b"torn")
    assert_sentence(cli("node", "--source", broken, "--publish", endpoint), picture.name)


@pytest.mark.slow
def test_a_node_tells_its_state_and_what_its_source_lacks(take: Path, endpoint: str, tmp_path: Path) -> None:
    import shutil

    unlit = tmp_path / "unlit"
    shutil.copytree(take, unlit)
    (unlit / "fisheye.txt").write_text("0.0 rgb/000000.png 0.1\n")
    with node_process("--source", str(unlit), "--publish", endpoint, "--loop") as process:
        assert process.stderr is not None
        said: list[str] = []
        while "live" not in "".join(said[-1:]):
            said.append(process.stderr.readline())
            assert said[-1], "the node ended"
    assert any(line.rstrip().endswith("no calibration/fisheye.yaml; they are not used.") for line in said)


def test_wrong_settings_are_told_before_anything_starts(cli: RunCli, tmp_path: Path) -> None:
    wrong = tmp_path / "deltalight.toml"
    wrong.write_text("[node]\nsuorce = 'x'\n")
    for command in ("node", "config"):
        assert_sentence(cli(command, "--config", wrong), str(wrong), "unknown key `suorce`", "`source`")
    assert_sentence(cli("node", "--config", tmp_path / "absent.toml"), "absent.toml")
    assert_sentence(cli("up", "--config", wrong), "unknown key `suorce`")
    assert_sentence(cli("up", "--source", "synthetic", "--node", "desk"), "one of them")
    right = tmp_path / "right.toml"
    right.write_text("[node]\nsource = 'absent.mcap'\n")
    assert_sentence(cli("up", "--config", right), "absent.mcap does not exist")
    assert_sentence(cli("up", "--config", os.devnull), "--source", "--node")


def test_an_endpoint_that_leaves_the_host_needs_keys_first(
    cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    port = ports.private_ports(1)[0]
    words = ("needs keys", "deltalight keys create NAME")
    assert_sentence(cli("node", "--publish", f"tcp://0.0.0.0:{port}"), *words)
    assert_sentence(cli("server", "--allow-software", "--subscribe", "tcp://10.255.255.1:5601"), *words)
    assert_sentence(
        cli("record", "--out", tmp_path / "a.mcap", "--subscribe", "tcp://10.255.255.1:5601"), "leaves"
    )


def test_keys_are_made_listed_and_trusted_by_commands(
    cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    here, there = tmp_path / "config" / "deltalight" / "keys", tmp_path / "there"
    assert cli("keys", "create", "desk").returncode == 0
    assert stat.S_IMODE((here / "desk.key_secret").stat().st_mode) == 0o600
    assert_sentence(cli("keys", "create", "desk"), "has keys called `desk`")
    made = cli("keys", "create", "gpu", "--folder", there)
    assert "deltalight keys trust gpu.key" in made.stdout
    assert_sentence(cli("keys", "trust", there / "gpu.key_secret"), "stays on its host")
    assert cli("keys", "trust", there / "gpu.key", "--name", "cellar").returncode == 0
    listed = json.loads(cli("keys", "list", "--json").stdout)
    assert list(listed["own"]) == ["desk"]
    assert list(listed["trusted"]) == ["cellar"]
    secret = (here / "desk.key_secret").read_text().split('secret-key = "')[1].split('"')[0]
    assert secret not in cli("keys", "list").stdout
    assert "XDG_CONFIG_HOME" in os.environ


def test_cameras_and_nodes_are_listed_also_as_json(cli: RunCli) -> None:
    done = cli("node", "--list", "--json")
    assert done.returncode == 0, done.stderr
    assert isinstance(json.loads(done.stdout)["cameras"], list)
    words = cli("node", "--list")
    assert words.returncode == 0
    assert "uvc" in words.stdout


def test_the_commands_of_settings_and_keys_have_help(cli: RunCli) -> None:
    for command in (("config",), ("keys",), ("keys", "create"), ("keys", "list"), ("keys", "trust")):
        done = cli(*command, "--help")
        assert done.returncode == 0
        assert "Usage" in done.stdout
