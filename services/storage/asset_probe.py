"""Loading an untrusted file once, in a child process with limits, before anything else may load it.

Run as `python -m services.storage.asset_probe PATH KIND`; prints one JSON object.
"""

import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

from protocol.errors import DeltalightError
from services.storage.asset_kinds import AssetKind
from services.storage.faults import RejectedAssetError

MEMORY_LIMIT_BYTES = (
    3 << 30
)  # an 8192 x 4096 map takes 1.6 GB while it is checked, a mesh of 10 M triangles 2 GB
TIME_LIMIT_S = 60
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # each thread's buffers count as memory

Facts = dict[str, Any]


def probe(path: Path, kind: AssetKind, name: str, *, memory_bytes: int = MEMORY_LIMIT_BYTES) -> Facts:
    """Load a file in a child process and return what is known of it then.

    A mesh has `triangles`, `vertices`, `minimum` and `maximum` (in the file's own units and axes), a map `width`
    and `height` in pixels. `name` stands for the file in sentences.

    Raises:
        RejectedAssetError: it cannot be loaded, or not within the limits.
    """
    command = [sys.executable, "-m", __name__, str(path), kind, str(memory_bytes)]
    environment = {**os.environ, **_ENVIRONMENT}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=TIME_LIMIT_S, check=False, env=environment
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


def _limit(memory_bytes: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (TIME_LIMIT_S, TIME_LIMIT_S))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))  # a loader has nothing to write
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _mesh_facts(path: Path) -> Facts:
    from render_server.scene.asset_check import check_mesh_file, read_gltf

    if check_mesh_file(path) == ".glb":
        read_gltf(path)  # a file that lies is refused before the loader's second of imports
    import numpy as np

    from render_server.scene.mesh import load_mesh

    meshes = load_mesh(path)
    bounds = np.stack([mesh.bounds() for mesh in meshes])
    return {
        "triangles": sum(len(mesh.triangles) for mesh in meshes),
        "vertices": sum(len(mesh.positions) for mesh in meshes),
        "minimum": bounds[:, 0].min(axis=0).tolist(),
        "maximum": bounds[:, 1].max(axis=0).tolist(),
    }


def _map_facts(path: Path) -> Facts:
    from protocol.radiance_files import read_linear

    height, width = read_linear(path).shape[:2]
    if width != 2 * height:
        raise DeltalightError(
            f"{path} has {width}x{height} pixels; a latitude-longitude map is twice as wide as high."
        )
    return {"width": width, "height": height}


def _main(path: str, kind: str, memory_bytes: str) -> None:
    _limit(int(memory_bytes))
    try:
        facts = (_mesh_facts if kind == "mesh" else _map_facts)(Path(path))
    except DeltalightError as fault:
        facts = {"fault": str(fault)}
    except ModuleNotFoundError as fault:
        facts = {"fault": f"{path} cannot be checked without {fault.name}: pip install 'deltalight[render]'."}
    except MemoryError:
        facts = {"fault": f"{path} needs more than {int(memory_bytes) >> 20} MB to load; simplify it."}
    print(json.dumps(facts))


if __name__ == "__main__":
    _main(*sys.argv[1:])
