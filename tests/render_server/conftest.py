"""What the renderer's tests share: scenes, kernels, and no GL error left behind."""

from collections.abc import Iterator
from pathlib import Path

import moderngl
import numpy as np
import pytest

from deltalight.render_server.gpu import kernel as kernel_module
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.gpu.shader_source import expanded
from deltalight.render_server.gpu.textures import texture_2d
from deltalight.render_server.methods import registry
from deltalight.render_server.methods.method import SOFTWARE_DEFAULTS
from tests.render_server.scenes import ObjectsRenderer, Stage
from tests.render_server.tiny_kernel import OUT, MakeKernel


@pytest.fixture(scope="session", autouse=True)
def same_defaults() -> Iterator[None]:
    """What a scene leaves open is as in software on every device: a finer volume is another test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "GPU_DEFAULTS", SOFTWARE_DEFAULTS)
        yield


@pytest.fixture(scope="module")
def objects(gpu: GpuContext, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ObjectsRenderer]:
    shared = ObjectsRenderer(gpu, Stage(tmp_path_factory.mktemp("objects")))
    yield shared
    shared.renderer.release()


@pytest.fixture
def clean_gl(gpu: GpuContext) -> Iterator[None]:
    """Modules ask for it with `pytestmark = pytest.mark.usefixtures("clean_gl")`."""
    assert gpu.ctx.error == "GL_NO_ERROR"
    gpu.errors.clear()
    yield
    assert gpu.ctx.error == "GL_NO_ERROR"
    assert not gpu.errors, "of frames"


@pytest.fixture
def make(gpu: GpuContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[MakeKernel]:
    """Makes kernel `tiny` of declarations and the statements of its main function."""
    monkeypatch.setattr(kernel_module, "SHADERS", tmp_path)
    made: list[Kernel] = []

    def tiny(
        declared: str, statements: str, local_size: str = "local_size_x = 1", **defines: float
    ) -> Kernel:
        text = f"layout({local_size}) in;\n{OUT}{declared}\nvoid main() {{ {statements} }}"
        (tmp_path / "tiny.comp.glsl").write_text(text)
        expanded.cache_clear()  # a file that changes: only here
        made.append(Kernel(gpu, "tiny", **defines))
        return made[-1]

    yield tiny
    for item in made:
        item.release()


@pytest.fixture
def out(gpu: GpuContext) -> Iterator[moderngl.Buffer]:
    """What kernel `tiny` writes into: 64 floats."""
    buffer = gpu.ctx.buffer(reserve=256)
    yield buffer
    buffer.release()


@pytest.fixture
def texture(gpu: GpuContext) -> Iterator[moderngl.Texture]:
    """4 x 4, RGBA16F, of ones."""
    item = texture_2d(gpu, (4, 4), 4, "f2", data=np.ones((4, 4, 4), np.float16).tobytes())
    yield item
    item.release()
