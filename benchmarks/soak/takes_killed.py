"""A recorder that is killed while it records: what of the recording is left."""

import os
import subprocess
import sys
import time
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import ACTIVE_SUFFIX
from deltalight.protocol.source import open_source
from deltalight.services import ports
from deltalight.services.parent_death_signal import SUPERVISOR_VARIABLE
from deltalight.services.recording_copies import recover_recording

PATIENCE_S = 60.0
RECORDED_S = (1.0, 4.0)  # the least and the most before the kill


def kill_recorder(node_port: int, dice: Random) -> dict[str, Any]:
    """Records a node, kills the recorder at a random moment, closes its file and compares.

    `lost_s` runs from the last frame's capture to the kill, so that one period of the node is part of it.

    Raises:
        DeltalightError: nothing was recorded, or the file cannot be closed.
    """
    with TemporaryDirectory(prefix="deltalight-soak-") as folder:
        out = Path(folder) / "take.mcap"
        active = out.with_name(out.name + ACTIVE_SUFFIX)
        with _recorder(node_port, out) as recorder:
            _wait_for_frames(active)
            time.sleep(dice.uniform(*RECORDED_S))
            killed_ns = time.time_ns()
            recorder.kill()
        recover_recording(active, out, iter)
        source = open_source(out)
        return {"frames": len(source), "lost_s": (killed_ns - source.timestamps_ns[-1]) / 1e9}


def _recorder(node_port: int, out: Path) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-P", "-m", "deltalight.services.cli", "record", "--out", str(out)]
    return subprocess.Popen(
        [*command, "--subscribe", ports.endpoint(node_port)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        env={**os.environ, SUPERVISOR_VARIABLE: str(os.getpid())},
    )


def _wait_for_frames(active: Path) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not (active.exists() and active.stat().st_size > 0):
        if time.monotonic() > deadline_s:
            raise DeltalightError("The recorder wrote nothing; see whether its node runs.")
        time.sleep(0.02)
