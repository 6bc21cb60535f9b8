"""What differs on a GPU from the software renderer that the tests run on, or goes unnoticed there.

New memory is not zero on a GPU; what a kernel both writes and reads under another name is undefined; a read within
the frame makes the CPU wait; and some paths are taken only there.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings, Program
from tests.render_server.protected_scenes import METHODS, Case, pictures_of
from tests.render_server.scenes import psnr_db
from tests.unwritten_memory import POISON, FilledContext

pytestmark = [pytest.mark.slow(seconds=8), pytest.mark.usefixtures("clean_gl")]
CASES = [Case(method, "model", "mirror") for method in METHODS if method != "none"]
ZERO = b"\0"  # what Mesa leaves; everything else that the tests render starts with NaN
LEAST_PSNR_DB = 60.0  # light propagates in another order there


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module", params=CASES, ids=str)
def made(
    gpu: GpuContext, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Case, list[np.ndarray]]:
    """A case and its pictures."""
    case: Case = request.param
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DELTALIGHT_CACHE", str(tmp_path_factory.mktemp("cache")))
        return case, pictures_of(gpu, case, tmp_path_factory.mktemp("scene"))[0]


def test_what_new_memory_holds_does_not_show(
    gpu: GpuContext,
    made: tuple[Case, list[np.ndarray]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case, expected = made
    orphan = moderngl.Buffer.orphan

    def poison(buffer: moderngl.Buffer, size: int = -1) -> None:
        orphan(buffer, size)
        buffer.write(POISON * buffer.size)

    monkeypatch.setattr(moderngl.Buffer, "orphan", poison)
    ctx: Any = FilledContext(gpu.ctx, ZERO)
    pictures, _ = pictures_of(replace(gpu, ctx=ctx), case, tmp_path)
    assert ctx.filled > 20  # 2D textures are given zeros
    assert all(np.array_equal(one, other) for one, other in zip(pictures, expected, strict=True))


@pytest.fixture
def audit(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Kernels and names that bind something that they may write twice."""
    faults: list[str] = []
    bind = Program.bind

    def audited(program: Program, own: Bindings, known: Bindings) -> None:
        bind(program, own, known)
        names = [slot.name for slot in (*program._samplers, *program._images, *program._storage)]
        for name, item in program.written(known).items():
            others = [other for other in names if known[other] is item and other != name]
            faults.extend(f"{program.label}: {name} and {other}" for other in others)

    monkeypatch.setattr(Program, "bind", audited)
    return faults


@pytest.fixture
def readers(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Modules that read a buffer or texture, or map a buffer to clear it, in order."""
    found: list[str] = []
    kinds: list[tuple[type, str]] = [(moderngl.Buffer, "read"), (moderngl.Buffer, "clear")]
    kinds += [(kind, "read") for kind in (moderngl.Texture, moderngl.Texture3D, moderngl.TextureArray)]
    for kind, name in [*kinds, (moderngl.Framebuffer, "read")]:
        original = getattr(kind, name)

        def noted(*args: Any, _original: Any = original, **more: Any) -> Any:  # noqa: ANN401
            found.append(sys._getframe(1).f_globals["__name__"])
            return _original(*args, **more)

        monkeypatch.setattr(kind, name, noted)
    return found


def test_the_paths_of_gpus_make_the_same_picture_without_waiting(
    gpu: GpuContext,
    made: tuple[Case, list[np.ndarray]],
    tmp_path: Path,
    audit: list[str],
    readers: list[str],
) -> None:
    """And bind nothing twice that is written.

    Only finished pictures are read back, and before the first how many pairs fill a volume.
    """
    case, expected = made
    pictures, dispatches = pictures_of(replace(gpu, is_software=False), case, tmp_path, checks=True)
    assert min(psnr_db(one, other) for one, other in zip(pictures, expected, strict=True)) >= LEAST_PSNR_DB
    assert audit == []
    pictures_read = "deltalight.render_server.gpu.textures"
    first = readers.index(pictures_read)
    assert set(readers[:first]) <= {"deltalight.render_server.passes.voxelize"}
    assert set(readers[first:]) == {pictures_read}
    assert any(one.kernel.startswith("mirror_smooth") for part in dispatches for one in part) == (
        case.method in ("exact", "differential", "dlpv")
    )


def test_depth_that_the_gpu_meshes_makes_nearly_the_same_picture(
    gpu: GpuContext, tmp_path_factory: pytest.TempPathFactory, audit: list[str]
) -> None:
    """Its triangles are the same; the points that bound them, and so the lights' maps, lie elsewhere."""
    case = Case("exact", "depth", "mirror")
    expected, _ = pictures_of(gpu, case, tmp_path_factory.mktemp("software"))
    folder = tmp_path_factory.mktemp("gpu")
    pictures, dispatches = pictures_of(replace(gpu, is_software=False), case, folder, checks=True)
    assert {"depth_nodes", "depth_triangles"} <= {one.kernel for part in dispatches for one in part}
    least_psnr_db = min(psnr_db(one, other) for one, other in zip(pictures, expected, strict=True))
    assert least_psnr_db >= LEAST_PSNR_DB - 10
    assert audit == []
