"""`deltalight replay`: a recording comes out as it was recorded, in time or fast, once or in a loop."""

import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from typer.testing import CliRunner

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.source import open_source
from deltalight.services import ports
from deltalight.services.cli import app
from deltalight.services.recorder import Recorder, RecordJob
from tests.services.conftest import ROOT, RunCli
from tests.services.record_samples import BOARD, PERIOD_NS, frames, write


def test_what_is_replayed_and_recorded_again_is_the_same(tmp_path: Path) -> None:
    original = frames(8, with_fisheye=True)
    source = write(tmp_path / "a.mcap", original)
    endpoint = ports.endpoint(ports.private_ports(1)[0])
    command = [
        sys.executable,
        "-m",
        "deltalight.services.cli",
        "replay",
        str(source),
        "--loop",
        "--publish",
        endpoint,
    ]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        try:
            status = Recorder(RecordJob(tmp_path / "b.mcap", (endpoint,), frames=20), print).run(Event())
        finally:
            process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in error
    again = open_source(tmp_path / "b.mcap")
    assert status.frames == len(again) == 20
    assert again.board == BOARD
    assert again.camera == original[0].camera
    for before, after in pairwise(again):
        rounds = after.frame_id - before.frame_id
        assert after.timestamp_ns - before.timestamp_ns == rounds * PERIOD_NS, "times are those recorded"
    for frame in again:
        source_frame = original[frame.frame_id % 8]
        assert frame.color_jpeg == source_frame.color_jpeg
        assert np.array_equal(np.asarray(frame.response), np.asarray(source_frame.response))
        assert frame.exposure_s == source_frame.exposure_s
        assert np.array_equal(np.asarray(frame.world_from_camera), np.asarray(source_frame.world_from_camera))
        assert frame.depth is not None
        assert source_frame.depth is not None
        assert np.array_equal(frame.depth.depth_m, source_frame.depth.depth_m)
    # The fish-eye pictures that held when the recorder came had been sent before.
    lit = [frame.fisheye for frame in again if frame.fisheye is not None]
    assert len(lit) >= 18
    assert original[0].fisheye is not None
    assert {pictures.exposures_s for pictures in lit} == {original[0].fisheye.exposures_s}
    assert all(pictures.calibration == original[0].fisheye.calibration for pictures in lit)


def test_a_fast_replay_ends_and_takes_no_camera_from_the_configuration(cli: RunCli, tmp_path: Path) -> None:
    source = write(tmp_path / "a.mcap", frames(3))
    (tmp_path / "deltalight.toml").write_text('[node.fisheye]\nsource = "uvc:77"\n')
    endpoint = ports.endpoint(ports.private_ports(1)[0])
    done = cli("replay", source, "--fast", "--publish", endpoint, "--config", tmp_path / "deltalight.toml")
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{folder}/none.mcap"], "none.mcap does not exist"),
        (["uvc:0"], "give a dataset folder or an .mcap recording"),
        (["{folder}"], "has no rgb.txt"),
        (["{folder}/a.mcap", "--publish", "127.0.0.1"], "is not an endpoint"),
        (["{folder}/a.mcap", "--start", "1e9"], "a.mcap is 0.0 s long; start it before that"),
        (["{folder}/a.mcap", "--name", "a b"], "`name` is wrong: must be letters, digits, dashes"),
    ],
)
def test_wrong_input_is_a_sentence(tmp_path: Path, words: list[str], message: str) -> None:
    write(tmp_path / "a.mcap", frames(1))
    done = CliRunner().invoke(app, ["replay", *(word.format(folder=tmp_path) for word in words)])
    assert isinstance(done.exception, DeltalightError), done.exception
    assert message in str(done.exception)
    assert "\n" not in str(done.exception)
