"""What the tests of services share: messages of a small camera, a command-line runner."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import pytest
from typer.testing import CliRunner

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.codecs import encode_color, encode_depth
from deltalight.protocol.envelope import encode
from deltalight.protocol.message_fields import matrix_rows
from deltalight.protocol.messages import ColorMessage, DepthMessage, PoseMessage
from deltalight.protocol.subscriber import ReceivedMultipart
from deltalight.services.cli import run
from tests.services.postgres_samples import PostgresServer

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ROOT = Path(__file__).parents[2]
WIDTH, HEIGHT = 72, 54  # no power of two (CONTRIBUTING.md)
DATABASES = ("sqlite", "postgres")
IDENTITY = matrix_rows(np.eye(4))

RunCli = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    """Not for the whole session: while it runs, nothing else in this thread can run an event loop."""
    from tests.services.dashboard_samples import chromium

    with chromium() as running:
        yield running


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    server = PostgresServer()
    try:
        server.start()
        yield server
    finally:
        server.close()


def _database(request: pytest.FixtureRequest) -> str | None:
    return None if request.param == "sqlite" else request.getfixturevalue("postgres").fresh_database()


@pytest.fixture(params=DATABASES)
def database(request: pytest.FixtureRequest) -> str | None:
    """An empty database, as settings name it: the file in the data folder, or PostgreSQL's."""
    return _database(request)


@pytest.fixture(scope="module", params=DATABASES)
def module_database(request: pytest.FixtureRequest) -> str | None:
    """The same for a whole module."""
    return _database(request)


@pytest.fixture
def homes(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Folders for data and settings that are this test's own."""
    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, str(tmp_path_factory.mktemp(name)))


@pytest.fixture
def cli(homes: None) -> RunCli:
    """Runs `deltalight` in this process."""
    del homes

    def run_here(*arguments: object) -> subprocess.CompletedProcess[str]:
        words = [str(argument) for argument in arguments]
        with CliRunner().isolation() as (output, error, *_):
            code = run(words)
            sys.stdout.flush()
            sys.stderr.flush()
            return subprocess.CompletedProcess(
                words, code, output.getvalue().decode(), error.getvalue().decode()
            )

    return run_here


@pytest.fixture
def cli_process(homes: None) -> RunCli:
    """Runs `deltalight` in a process of its own: for what only a process can show."""
    del homes

    def start(*arguments: object, timeout_s: float = 60) -> subprocess.CompletedProcess[str]:
        command = [
            sys.executable,
            "-m",
            "deltalight.services.cli",
            *(str(argument) for argument in arguments),
        ]
        return subprocess.run(
            command,
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )

    return start


def camera() -> CameraModel:
    matrix = np.array([[60.0, 0, WIDTH / 2 - 0.5], [0, 60.0, HEIGHT / 2 - 0.5], [0, 0, 1]])
    return CameraModel(WIDTH, HEIGHT, matrix, "plumb_bob", np.zeros(5))


def picture(value: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), value, np.uint8)


def received(multipart: list[bytes], received_ns: int) -> ReceivedMultipart:
    return ReceivedMultipart([memoryview(piece) for piece in multipart], received_ns)


def color(
    frame_id: int,
    capture_ns: int,
    received_ns: int = 0,
    described: dict[str, object] | None = None,
    node: str = "cam",
) -> ReceivedMultipart:
    message = ColorMessage(
        node=node,
        frame_id=frame_id,
        capture_ns=capture_ns,
        encoding="raw",
        shape=(HEIGHT, WIDTH, 3),
        camera=described or camera().to_dict(),
    )
    return received(encode(message, [encode_color(picture(frame_id % 256), "raw")]), received_ns)


def depth(
    frame_id: int,
    capture_ns: int,
    metres: float = 1.0,
    described: dict[str, object] | None = None,
    node: str = "cam",
) -> ReceivedMultipart:
    message = DepthMessage(
        node=node,
        stream="clean_depth",
        frame_id=frame_id,
        capture_ns=capture_ns,
        encoding="raw",
        shape=(HEIGHT, WIDTH),
        depth_scale_m=0.001,
        camera=described or camera().to_dict(),
    )
    image = np.full((HEIGHT, WIDTH), metres, np.float32)
    return received(encode(message, [encode_depth(image, image > 0, "raw", 0.001)]), 0)


def pose(
    frame_id: int, capture_ns: int, status: Literal["ok", "no_board"] = "ok", node: str = "cam"
) -> ReceivedMultipart:
    matrix = IDENTITY if status == "ok" else None
    message = PoseMessage(
        node=node, frame_id=frame_id, capture_ns=capture_ns, status=status, world_from_camera=matrix
    )
    return received(encode(message), 0)
