"""What differs on a GPU from the software renderer that the tests run on, or goes unnoticed there.

New memory is not zero on a GPU; what a kernel both writes and reads under another name is undefined; a read within
the frame makes the CPU wait; and some paths are taken only there.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings, _Program
from tests.render_server.protected_scenes import METHODS, Case, pictures_of
from tests.render_server.test_golden import psnr_db

pytestmark = [pytest.mark.slow(seconds=8), pytest.mark.usefixtures("clean_gl")]
CASES = [Case(method, "model", "mirror") for method in METHODS if method != "none"]
POISON = b"\xff"  # NaN in floats, -1 or the greatest number in integers
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


class PoisonedContext:
    """Fills new buffers and textures of a context that are given no content; `filled` counts them."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx, self.filled = ctx, 0

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self._ctx, name)

    def buffer(
        self, data: bytes | None = None, *, reserve: int = 0, dynamic: bool = False
    ) -> moderngl.Buffer:
        self.filled += data is None
        return self._ctx.buffer(POISON * reserve if data is None else data, dynamic=dynamic)

    def _filled(self, kind: str, data: bytes | None, args: tuple[Any, ...], more: dict[str, Any]) -> Any:  # noqa: ANN401
        texture = getattr(self._ctx, kind)(*args, data, **more)
        if data is None:
            self.filled += 1
            size, components = args
            unit = more.get("alignment", 1)
            row = -(-components * int(texture.dtype[-1]) * size[0] // unit) * unit
            texture.write(POISON * (row * int(np.prod(size[1:]))), alignment=unit)
        return texture

    def texture(self, *args: Any, data: bytes | None = None, **more: Any) -> Any:  # noqa: ANN401
        return self._filled("texture", *_split(args, data), more)

    def texture3d(self, *args: Any, data: bytes | None = None, **more: Any) -> Any:  # noqa: ANN401
        return self._filled("texture3d", *_split(args, data), more)

    def texture_array(self, *args: Any, data: bytes | None = None, **more: Any) -> Any:  # noqa: ANN401
        return self._filled("texture_array", *_split(args, data), more)


def _split(args: tuple[Any, ...], data: bytes | None) -> tuple[bytes | None, tuple[Any, ...]]:
    """Content, and (size, components)."""
    return (args[2] if len(args) > 2 else data), args[:2]


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
    ctx: Any = PoisonedContext(gpu.ctx)
    pictures, _ = pictures_of(replace(gpu, ctx=ctx), case, tmp_path)
    assert ctx.filled > 30
    assert all(np.array_equal(one, other) for one, other in zip(pictures, expected, strict=True))


@pytest.fixture
def audit(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Kernels and names that bind something that they may write twice."""
    faults: list[str] = []
    bind = _Program.bind

    def audited(program: _Program, own: Bindings, known: Bindings) -> None:
        bind(program, own, known)
        names = [slot.name for slot in (*program._samplers, *program._images, *program._storage)]
        for name, item in program.written(known).items():
            others = [other for other in names if known[other] is item and other != name]
            faults.extend(f"{program.label}: {name} and {other}" for other in others)

    monkeypatch.setattr(_Program, "bind", audited)
    return faults


@pytest.fixture
def readers(monkeypatch: pytest.MonkeyPatch) -> Iterator[set[str]]:
    """Modules that read a buffer or texture, or map a buffer to clear it."""
    found: set[str] = set()
    kinds: list[tuple[type, str]] = [(moderngl.Buffer, "read"), (moderngl.Buffer, "clear")]
    kinds += [(kind, "read") for kind in (moderngl.Texture, moderngl.Texture3D, moderngl.TextureArray)]
    for kind, name in [*kinds, (moderngl.Framebuffer, "read")]:
        original = getattr(kind, name)

        def noted(*args: Any, _original: Any = original, **more: Any) -> Any:  # noqa: ANN401
            found.add(sys._getframe(1).f_globals["__name__"])
            return _original(*args, **more)

        monkeypatch.setattr(kind, name, noted)
    return found


def test_the_paths_of_gpus_make_the_same_picture_without_waiting(
    gpu: GpuContext,
    made: tuple[Case, list[np.ndarray]],
    tmp_path: Path,
    audit: list[str],
    readers: set[str],
) -> None:
    """And bind nothing twice that is written. Only finished pictures are read back, and what first fills a volume."""
    case, expected = made
    pictures, dispatches = pictures_of(replace(gpu, is_software=False), case, tmp_path, checks=True)
    assert min(psnr_db(one, other) for one, other in zip(pictures, expected, strict=True)) >= LEAST_PSNR_DB
    assert audit == []
    assert readers - {"deltalight.render_server.passes.voxelize"} == {"deltalight.render_server.gpu.textures"}
    assert any(one.kernel.startswith("mirror_smooth") for part in dispatches for one in part) == (
        case.method in ("exact", "differential", "dlpv")
    )
