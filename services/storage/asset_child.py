"""Work on untrusted files in a child process with limits, before anything else may touch them.

Run as `python -m services.storage.asset_child TASK PATH MEMORY_BYTES OUTPUT_BYTES [ARGUMENT...]`; prints one JSON
object.
"""

import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from protocol.errors import DeltalightError
from services.storage.faults import RejectedAssetError

MEMORY_LIMIT_BYTES = (
    3 << 30
)  # an 8192 x 4096 map takes 1.6 GB while it is checked, a mesh of 10 M triangles 2 GB
TIME_LIMIT_S = 60
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # each thread's buffers count as memory

Facts = dict[str, Any]
Task = Literal["mesh", "map", "mesh-thumbnail", "map-thumbnail", "unzip"]


def run_limited(
    task: Task,
    path: Path,
    name: str,
    *arguments: str,
    memory_bytes: int = MEMORY_LIMIT_BYTES,
    output_bytes: int = 0,
) -> Facts:
    """Do a task on a file in a child process and return what it found; `name` stands for the file in sentences.

    A file that the task writes may have `output_bytes`.

    Raises:
        RejectedAssetError: the file is not what it must be, or the limits do not allow it.
    """
    words = [task, str(path), str(memory_bytes), str(output_bytes), *arguments]
    try:
        done = subprocess.run(
            [sys.executable, "-m", __name__, *words],
            capture_output=True,
            text=True,
            timeout=TIME_LIMIT_S,
            check=False,
            env={**os.environ, **_ENVIRONMENT},
        )
    except subprocess.TimeoutExpired as fault:
        raise RejectedAssetError(
            f"{name} takes longer than {TIME_LIMIT_S} s to load; simplify it."
        ) from fault
    try:
        answer = json.loads(done.stdout.splitlines()[-1])
    except (IndexError, ValueError) as fault:
        raise RejectedAssetError(f"{name} ends the program that loads it; export it again.") from fault
    if "fault" in answer:
        raise RejectedAssetError(answer["fault"].replace(str(path), name))
    return dict(answer)


def _limit(memory_bytes: int, output_bytes: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (TIME_LIMIT_S, TIME_LIMIT_S))
    resource.setrlimit(resource.RLIMIT_FSIZE, (output_bytes, output_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _task(name: str) -> Callable[..., Facts]:
    """The function that does a task; imported here, because each needs other heavy packages."""
    if name == "unzip":
        from services.storage.gltf_zip import repack

        return repack
    if name.endswith("-thumbnail"):
        from services.storage import thumbnails

        return thumbnails.draw_mesh if name == "mesh-thumbnail" else thumbnails.draw_map
    from services.storage import asset_probe

    return asset_probe.mesh_facts if name == "mesh" else asset_probe.map_facts


def _main(task: str, path: str, memory_bytes: str, output_bytes: str, *arguments: str) -> None:
    _limit(int(memory_bytes), int(output_bytes))
    try:
        facts = _task(task)(Path(path), *arguments)
    except DeltalightError as fault:
        facts = {"fault": str(fault)}
    except ModuleNotFoundError as fault:
        facts = {"fault": f"{path} cannot be checked without {fault.name}: pip install 'deltalight[render]'."}
    except MemoryError:
        facts = {"fault": f"{path} needs more than {int(memory_bytes) >> 20} MB to load; simplify it."}
    print(json.dumps(facts))


if __name__ == "__main__":
    _main(*sys.argv[1:])
