"""Processor time of a moving object per frame: `python -m deltalight.benchmarks.posing_speed` (a minute).

A ball each of whose vertices depends on four of forty joints. The steps are those of
`render_server/virtual_objects.py`.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from deltalight.benchmarks.glb_builder import GlbBuilder
from deltalight.render_server.scene.gltf_meshes import load_gltf
from deltalight.render_server.scene.gpu_mesh import merge_for_gpu
from deltalight.render_server.scene.moved_meshes import transformed

JOINTS = 40
REPEATS = 9


def skinned_ball(path: Path, subdivisions: int) -> Path:
    """Writes a ball of 0.1 m radius whose joints drift."""
    mesh = trimesh.creation.icosphere(subdivisions, 0.1)
    count = len(mesh.vertices)
    random, glb = np.random.default_rng(0), GlbBuilder()
    weights = random.random((count, 4))
    nodes = [glb.add("nodes", {}) for _ in range(JOINTS)]
    attributes = {
        "POSITION": glb.floats(mesh.vertices),
        "NORMAL": glb.floats(mesh.vertex_normals),
        "JOINTS_0": glb.array(random.integers(0, JOINTS, (count, 4)).astype(np.uint8)),
        "WEIGHTS_0": glb.floats(weights / weights.sum(axis=1, keepdims=True)),
    }
    part = {"attributes": attributes, "indices": glb.array(mesh.faces.astype(np.uint32).ravel())}
    skin = glb.add("skins", {"joints": nodes})
    glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [part]}), "skin": skin})
    clip: dict[str, Any] = {"name": "drift"}
    times = glb.floats([0, 1])
    for node in nodes:
        glb.track(clip, node, "translation", times, [[0, 0, 0], random.random(3) * 0.02])
    glb.add("animations", clip)
    return glb.write(path)


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Returns the least processor time, ms (other work on the machine only adds to it), and the result."""
    spent = []
    for _ in range(REPEATS):
        start = time.thread_time()
        made = work()
        spent.append(time.thread_time() - start)
    return 1e3 * min(spent), made


def row(path: Path) -> str:
    """Returns one line of the table."""
    asset = load_gltf(path)
    clip = asset.clips[0]
    pose_ms, meshes = timed(lambda: asset.meshes(asset.pose(clip, 0.3)))
    place_ms, placed = timed(lambda: [transformed(mesh, np.diag([2.0, 2, 2, 1])) for mesh in meshes])
    merge_ms, merged = timed(lambda: merge_for_gpu(placed))
    counts = f"{len(merged.vertices):>8} {len(merged.triangles):>9}"
    steps = (pose_ms, place_ms, merge_ms)
    return counts + "".join(f" {spent_ms:>10.1f}" for spent_ms in steps)


def main() -> None:
    """Prints the table."""
    print("vertices triangles    pose ms   place ms   merge ms")
    with tempfile.TemporaryDirectory() as folder:
        for subdivisions in (3, 4, 5, 6, 7):
            print(row(skinned_ball(Path(folder) / "ball.glb", subdivisions)))


if __name__ == "__main__":
    main()
