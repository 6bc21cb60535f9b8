"""Runs `asset_worker` on untrusted files in a limited process, before anything else may load them."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from deltalight.services.storage.asset_kinds import AssetKind, Facts
from deltalight.services.storage.faults import RejectedAssetError
from deltalight.services.storage.worker_forks import WorkerForks

WORKER = "deltalight.services.storage.asset_worker"  # by name: its imports must not happen here
# An 8192 x 4096 map takes 1.6 GB while it is checked, a mesh of 10 M triangles 2 GB.
MEMORY_LIMIT_BYTES = 3 << 30
TIME_LIMIT_S = 60
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # each thread's buffers count as memory
CAN_FORK = sys.platform.startswith("linux")  # elsewhere each worker is a process that imports all anew
_forks = WorkerForks(WORKER, ONE_THREAD)

Task = Literal[
    "mesh",
    "map",
    "material",
    "mesh-thumbnail",
    "map-thumbnail",
    "material-thumbnail",
    "unzip",
    "recording",
    "shelf",
]


def run_limited(
    task: Task,
    path: Path,
    name: str,
    *arguments: str,
    memory_bytes: int = MEMORY_LIMIT_BYTES,
    output_bytes: int = 0,
    time_s: int = TIME_LIMIT_S,
) -> Facts:
    """Runs a task on a file in the worker and returns its facts; `name` names the file in sentences.

    `output_bytes` limits the size of the file that the task writes.

    Raises:
        RejectedAssetError: the file is invalid, or exceeds the limits.
    """
    words = (task, str(path), str(memory_bytes), str(time_s), str(output_bytes), *arguments)
    try:
        said = _forks.run(words, time_s) if CAN_FORK else _said_by_process(words, time_s)
    except (TimeoutError, subprocess.TimeoutExpired) as fault:
        raise RejectedAssetError(f"{name} takes longer than {time_s} s to load; simplify it.") from fault
    try:
        answer = json.loads(said.splitlines()[-1])
    except (IndexError, ValueError) as fault:
        raise RejectedAssetError(f"{name} crashes the program that loads it; export it again.") from fault
    if "fault" in answer:
        raise RejectedAssetError(answer["fault"].replace(str(path), name))
    return dict(answer)


def _said_by_process(words: Sequence[str], timeout_s: float) -> str:
    return subprocess.run(
        [sys.executable, "-P", "-m", WORKER, *words],
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
        env={**os.environ, **ONE_THREAD},
    ).stdout


def probe(path: Path, kind: AssetKind, name: str, *, memory_bytes: int = MEMORY_LIMIT_BYTES) -> Facts:
    """Loads a file in the worker and returns its facts (`asset_facts`).

    `name` names the file in sentences.

    Raises:
        RejectedAssetError: the file cannot be loaded, or not within the limits.
    """
    return run_limited(kind, path, name, memory_bytes=memory_bytes)
