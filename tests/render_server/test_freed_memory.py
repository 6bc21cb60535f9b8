"""A render server whose method changes again and again does not keep the holes that each leaves in the heap."""

import gc
import platform
import subprocess
import sys
from pathlib import Path
from weakref import ref

import pytest

from deltalight.protocol.scene import SceneDocument
from deltalight.render_server import freed_memory
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import Stage, everyday, frame

SCRIPT = """
import numpy as np
import psutil
from deltalight.render_server.freed_memory import give_back_freed_memory

def resident_mb():
    return psutil.Process().memory_info().rss / 1e6

arrays = [np.ones(12_000) for _ in range(2000)]  # 192 MB, too small to be mapped apart
kept = [np.ones(10) for _ in range(10)], arrays[-1]  # the heap's end is in use
full = resident_mb()
del arrays
holes = resident_mb()
give_back_freed_memory()
print(full - holes, holes - resident_mb())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep what they like")
def test_holes_in_the_heap_are_given_back() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    by_itself_mb, given_back_mb = map(float, done.stdout.split())
    assert given_back_mb > 150
    assert by_itself_mb < 20


@pytest.fixture
def document(tmp_path: Path) -> SceneDocument:
    document = everyday(Stage(tmp_path))
    return document.replaced(method={"name": "none"}, output=document.output.replaced(width=80))


def test_they_are_when_the_method_changes_and_only_then(
    gpu: GpuContext, document: SceneDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[None] = []
    monkeypatch.setattr(freed_memory, "give_back_freed_memory", lambda: given.append(None))
    renderer = SceneRenderer(gpu, document)
    try:
        renderer.render(frame())
        renderer.set_scene(document.replaced(name="renamed"))
        renderer.render(frame())
        assert not given
        renderer.set_scene(document.replaced(method={"name": "differential", "volume_size": 32}))
        assert len(given) == gpu.is_software
    finally:
        renderer.release()


def test_nothing_of_the_graphs_is_left_when_another_camera_comes(
    gpu: GpuContext, document: SceneDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the memory of a room grows with each camera that comes or goes: new graphs lie behind what is left."""
    if not gpu.is_software:
        pytest.skip("only a software renderer's textures lie in the heap")
    left: list[object] = []
    renderer = SceneRenderer(gpu, document)
    try:
        renderer.render(frame())
        old = ref(renderer.graph)
        monkeypatch.setattr(freed_memory, "give_back_freed_memory", lambda: left.append(old()))
        gc.disable()  # it would depend on chance
        renderer.render_views([frame(), frame()])
        assert left == [None]
    finally:
        gc.enable()
        renderer.release()
