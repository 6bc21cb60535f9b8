"""The command line beside `render`: help, schema, doctor, sentences, quick start."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any

import pytest
from rich.text import Text
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner

from deltalight.services import doctor, ports
from deltalight.services.api.serve import listening
from deltalight.services.cli import BLAS_THREADS, app, limit_blas_threads, run
from deltalight.services.commands.examples import EXAMPLES
from deltalight.services.demo import RECORDING
from tests.services.conftest import ROOT, RunCli

COMMANDS = {
    "render",
    "demo",
    "precompute",
    "node",
    "server",
    "up",
    "record",
    "replay",
    "rooms list",
    "rooms drain",
    "rooms start",
    "rooms move",
    "rooms drain-host",
    "rooms undrain-host",
    "rooms claim",
    "recordings info",
    "recordings recover",
    "recordings import",
    "recordings export",
    "backup",
    "restore",
    "board",
    "ping",
    "calibrate camera",
    "calibrate fisheye",
    "calibrate extrinsics",
    "calibrate photometric",
    "api",
    "api token",
    "api tokens",
    "api revoke",
    "keys create",
    "keys list",
    "keys trust",
    "keys allow",
    "config",
    "doctor",
    "foxglove",
    "graph",
    "schema",
    "bench speed",
    "bench counts",
    "bench kernels",
    "bench roofline",
    "bench plot",
    "bench quality",
    "bench real",
    "bench rest",
    "bench rooms",
    "bench soak",
    "bench sweep",
    "bench node",
    "bench views",
    "gpu-check",
    "virtual-camera",
    "stream",
}


def commands_below(command: object, names: tuple[str, ...] = ()) -> Iterator[str]:
    """All commands that can be called, with those of groups that do something by themselves."""
    below = getattr(command, "commands", {})
    if names and (not below or getattr(command, "invoke_without_command", False)):
        yield " ".join(names)
    for name, each in below.items():
        yield from commands_below(each, (*names, name))


def test_every_command_is_there_and_has_help() -> None:
    assert set(commands_below(get_command(app))) == COMMANDS
    for command in sorted(COMMANDS | {command.split()[0] for command in COMMANDS}):
        done = CliRunner().invoke(app, [*command.split(), "--help"], prog_name="deltalight")
        assert done.exit_code == 0, done.output
        assert f"Usage: deltalight {command} " in " ".join(done.output.split())


def options_below(command: Any, name: str = "deltalight") -> Iterator[tuple[str, Any]]:  # noqa: ANN401 - typer's own click
    for option in command.params:
        yield f"{name} {option.name}", option
    for below, each in getattr(command, "commands", {}).items():
        yield from options_below(each, f"{name} {below}")


def test_help_is_shown_as_it_is_written_and_out_has_a_short_form() -> None:
    """Brackets are markup, which the help would leave out."""
    for name, option in options_below(get_command(app)):
        written = getattr(option, "help", None) or ""
        assert Text.from_markup(written).plain == written, name
        assert "--out" not in option.opts or "-o" in option.opts, name


def test_help_has_a_short_form_and_ends_with_examples_that_can_be_run() -> None:
    root = get_command(app)
    assert isinstance(root, TyperGroup)
    for name, lines in ((function.replace("_", "-"), lines) for function, lines in EXAMPLES.items()):
        done = CliRunner().invoke(app, [name, "-h"], prog_name="deltalight", terminal_width=200)
        assert done.exit_code == 0, done.output
        shown = " ".join(done.output.split())
        for line in lines:
            assert line in shown
            program, command, *arguments = line.split()
            assert (program, command) == ("deltalight", name)
            root.commands[name].make_context(name, arguments)


def test_a_shell_completes_commands_and_options(cli: RunCli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_DELTALIGHT_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_CWORD", "1")
    monkeypatch.setenv("COMP_WORDS", "deltalight re")
    assert cli().stdout.split() == ["render", "record", "replay", "restore", "recordings"]
    monkeypatch.setenv("COMP_CWORD", "2")
    monkeypatch.setenv("COMP_WORDS", "deltalight render --met")
    assert cli().stdout.split() == ["--method"]


def test_overview_lists_the_commands(cli: RunCli) -> None:
    overview = cli("--help")
    assert overview.returncode == 0
    for command in COMMANDS:
        assert command.split()[0] in overview.stdout


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("rendr",), "rendr"),
        (("render", "--scenes", "x"), "--scenes"),
        (("calibrate", "everything"), "everything"),
        (("bench", "speed", "--frames", "0"), "--frames"),
        (("node", "--source"), "--source"),
    ],
)
def test_wrong_use_ends_with_2_and_names_what_is_wrong(
    cli: RunCli, arguments: tuple[str, ...], named: str
) -> None:
    done = cli(*arguments)
    assert done.returncode == 2
    assert named in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("render", "take", "--out", ""), "--out"),
        (("render", "take", "-o", ""), "--out"),
        (("render", "take", "--out=out", "--scene="), "--scene"),
        (("recordings", "info", ""), "file"),
    ],
)
def test_an_empty_path_is_not_the_current_folder(cli: RunCli, words: tuple[str, ...], named: str) -> None:
    done = cli(*words)
    said = " ".join(done.stderr.replace("│", " ").split())
    assert (done.returncode, f"invalid value for '{named}" in said.lower()) == (2, True), said
    assert "the path is empty" in said


@pytest.mark.parametrize("command", [("config",), ("schema",), ("--help",)])
def test_output_that_nobody_reads_ends_a_command_quietly(command: tuple[str, ...]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    program = [sys.executable, "-m", "deltalight.services", *command]
    with os.fdopen(writer, "wb") as unread:
        done = subprocess.run(
            program, cwd=ROOT, stdout=unread, stderr=subprocess.PIPE, text=True, timeout=60, check=False
        )
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize(
    "words",
    [
        ("render", "{name}", "--out", "out"),
        ("render", RECORDING, "--frames", "0:1", "--out", "{name}.mp4"),
        ("node", "--source", "{name}"),
        ("recordings", "export", RECORDING, "--out", "{name}"),
        ("recordings", "import", "{name}", "--out", "a.mcap"),
        ("calibrate", "camera", "{name}", "--out", "out"),
        ("board", "--out", "{name}.pdf"),
        ("graph", "--svg", "{name}.svg"),
    ],
)
def test_a_path_that_the_system_refuses_is_a_sentence(
    cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[object, ...]
) -> None:
    """As it refuses those below a folder that may not be entered, which a test that root runs cannot have."""
    monkeypatch.chdir(tmp_path)
    done = cli(*(str(word).format(name="x" * 300) for word in words))
    assert done.returncode == 2
    assert "(File name too long)" in done.stderr
    assert "internal error" not in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_closed_streams_end_no_command(tmp_path: Path, closed: tuple[int, ...]) -> None:
    redirects = " ".join(f"{number}>&-" for number in closed)
    command = f'"{sys.executable}" -m deltalight.services board --out "{tmp_path}/board.pdf" {redirects}'
    done = subprocess.run(["sh", "-c", command], cwd=ROOT, timeout=60, check=False, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")


def test_a_wrong_choice_is_told_in_plain_words(cli: RunCli) -> None:
    done = cli("recordings", "export", "take.mcap", "--format", "fbx", "-o", "out")
    said = " ".join(done.stderr.replace("│", " ").split())
    assert "Invalid value for '--format': 'fbx' is not one of 'dataset', 'colmap'" in said


def test_help_loads_no_heavy_module() -> None:
    heavy = "('cv2', 'moderngl', 'zmq', 'fastapi', 'numpy', 'pydantic')"
    code = f"import sys, deltalight.services.cli\nprint([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=30, check=True
    )
    assert done.stdout.strip() == "[]"


def test_output_that_the_disk_refuses_is_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with suppress(OSError), Path("/dev/full").open("w") as full, redirect_stdout(full):
        assert run(["schema"]) == 2
    assert capsys.readouterr().err == (
        "deltalight: the output cannot be written (No space left on device); free some space, and run it again.\n"
    )


def test_schema_is_json_schema(cli: RunCli) -> None:
    keys = {"scene": "objects", "server": "subscribe", "api": "port", "node": "source"}
    for document, key in keys.items():
        done = cli("schema", document)
        assert done.returncode == 0, done.stderr
        assert key in json.loads(done.stdout)["properties"]


def test_doctor_finds_what_the_demo_needs(cli: RunCli) -> None:
    done = cli("doctor", "--json")
    assert done.returncode == 0, done.stdout
    checks = {check["name"]: check for check in json.loads(done.stdout)}
    assert checks["OpenGL device 0"]["state"] == "ok"
    assert checks["OpenCV"]["state"] == "ok"
    assert f"port {ports.PAGE_PORT}" in checks


def test_doctor_prints_commands_in_one_piece(cli: RunCli, monkeypatch: pytest.MonkeyPatch) -> None:
    command = (
        "/opt/station/environments/deltalight/bin/python -m pip install 'opencv-contrib-python-headless<5'"
    )
    check = doctor.Check("OpenNI 2 cameras", "note", "this OpenCV was built without it", f"run `{command}`")
    monkeypatch.setattr("deltalight.services.doctor.examine", lambda: [check])
    monkeypatch.setenv("COLUMNS", "60")
    assert command in cli("doctor").stdout


def test_doctor_says_what_is_missing_without_opengl(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from deltalight.services.commands.doctor import _print_table

    monkeypatch.setenv("GLCONTEXT_LINUX_LIBEGL", "/nonexistent/libEGL.so")
    monkeypatch.setattr(doctor, "PACKAGES", {"to render": ("no-such-package",)})
    checks = [check.as_dict() for check in doctor.examine()]
    found = {check["name"]: check for check in checks}
    assert found["OpenGL device 0"]["state"] == "missing"
    assert "apt-get install" in found["OpenGL device 0"]["detail"]
    assert found["packages to render"]["hint"] == f"{sys.executable} -m pip install no-such-package"
    _print_table(checks)
    assert "packages to render" in capsys.readouterr().out


def test_server_and_up_refuse_wrong_input_in_a_sentence(cli: RunCli, tmp_path: object) -> None:
    for arguments, sentence in (
        (("server", "--scene", f"{tmp_path}/absent.json", "--allow-software"), "absent.json"),
        (("up", "--source", f"{tmp_path}/absent.mcap"), "absent.mcap"),
        (("up", "--source", "synthetic", "--scene", f"{tmp_path}/absent.json"), "absent.json"),
        (("--log-level", "loud", "doctor"), "log level"),
        (
            ("up", "--source", "synthetic", "--data", f"{tmp_path}/data", "--port", 5601),
            "give --port another",
        ),
        (("demo", "--method", "exakt"), "the nearest is exact"),
        (("demo", "--out", f"{tmp_path}/pictures"), "add --headless"),
        (("bench", "speed", "--methods", "guess"), "exact"),
        (("bench", "speed", "--motions", "stil"), "still"),
        (("bench", "counts", "--methods", "path"), "exact"),
        (("bench", "speed", "--out", tmp_path), "is a folder; name a file in it"),
        (("bench", "sweep", "--out", "/proc/sweep.json"), "cannot be written"),
        (("graph", "--svg", tmp_path), "is a folder; name a file in it"),
        (("bench", "quality", "--methods", "exact:cone_cont=9"), "cone_count"),
        (("bench", "quality", "--scenes", "tabletopp"), "tabletop"),
        (("bench", "quality", "--spp", 3, "--scenes", "tabletop", "--out", f"{tmp_path}/quality"), "even"),
        (("bench", "quality", "--ablation", "--volume", 64), "--volume"),
        (("bench", "quality", "--size", "big"), "WIDTHxHEIGHT"),
    ):
        done = cli(*arguments)
        assert done.returncode == 2, done.stderr
        assert sentence in done.stderr
        assert "Traceback" not in done.stderr


def test_up_names_the_page_once_it_answers(
    cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Supervisor:
        def __init__(self, _specs: object, *, spares: object) -> None:
            pass

        def __enter__(self) -> "Supervisor":
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def run(self, until: Callable[[], bool] | None = None) -> None:
            print("waits until it answers" if until else "runs")

    monkeypatch.setattr("deltalight.services.supervisor.Supervisor", Supervisor)
    monkeypatch.setattr("deltalight.services.commands.up.fork_spares", lambda _commands: {})
    options = ("--port", "--node-port", "--composite-port", "--control-port")
    chosen = [word for pair in zip(options, ports.private_ports(4), strict=True) for word in pair]
    done = cli("up", "--source", "synthetic", "--data", tmp_path, *chosen)
    said = done.stdout.splitlines()
    assert [line.partition(" at http")[0] for line in said] == [
        "waits until it answers",
        "The dashboard is",
        "runs",
    ], done.stderr


@pytest.mark.parametrize(
    "command",
    [
        ("node", "--source", "synthetic", "--publish"),
        ("server", "--allow-software", "--publish"),
        ("server", "--allow-software", "--control"),
    ],
)
def test_port_in_use_is_a_sentence_that_names_it(cli: RunCli, command: tuple[str, ...]) -> None:
    port, own = ports.private_ports(2)
    rest = ("--publish", ports.endpoint(own)) if command[-1] == "--control" else ()
    with listening(ports.LOOPBACK, port):
        done = cli(*command, ports.endpoint(port), *rest)
    assert done.returncode == 2, done.stderr
    assert str(port) in done.stderr
    assert "Traceback" not in done.stderr


def test_keys_allow_limits_what_a_trusted_machine_may_send(cli: RunCli, tmp_path: Path) -> None:
    here, there = ("--folder", tmp_path / "here"), ("--folder", tmp_path / "there")
    cli("keys", "create", "desk", *there)
    assert "no key of `desk` is trusted" in cli("keys", "allow", "desk", "color", *here).stderr
    cli("keys", "trust", tmp_path / "there" / "desk.key", *here)
    assert "name the streams" in cli("keys", "allow", "desk", *here).stderr
    assert "the nearest is color" in cli("keys", "allow", "desk", "colour", *here).stderr
    assert (
        cli("keys", "allow", "desk", "pose.desk", "color", *here).stdout
        == "desk may send color, pose.desk.\n"
    )
    assert "may send only: color, pose.desk" in cli("keys", "list", *here).stdout
    assert json.loads(cli("keys", "list", "--json", *here).stdout)["allow"] == {
        "desk": ["color", "pose.desk"]
    }
    assert cli("keys", "allow", "desk", "--everything", *here).returncode == 0
    assert "may send only" not in cli("keys", "list", *here).stdout


def test_the_web_process_of_rooms_needs_keys_for_nodes_of_other_hosts(cli: RunCli, tmp_path: Path) -> None:
    directory, node = "tcp://127.0.0.1:1", "tcp://10.0.0.5:5601"
    refused = cli("api", "--data", tmp_path / "data", "--rooms", directory, "--subscribe", node)
    assert refused.returncode == 2
    assert f"{node} needs keys" in " ".join(refused.stderr.split())


def test_live_processes_have_one_thread_of_blas(monkeypatch: pytest.MonkeyPatch) -> None:
    environment: dict[str, str] = {}
    monkeypatch.setattr(os, "environ", environment)
    limit_blas_threads(["render", "take.mcap"])
    assert environment == {}
    limit_blas_threads(["--log-level", "warning", "node", "--source", "synthetic"])
    assert environment == {BLAS_THREADS: "1"}
    environment[BLAS_THREADS] = "3"  # the user's own number
    limit_blas_threads(["server"])
    assert environment == {BLAS_THREADS: "3"}
