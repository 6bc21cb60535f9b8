"""What the renderer's tests share: one GL context a module, and no GL error left behind."""

from collections.abc import Iterator

import pytest

from render_server.gpu.context import GpuContext, create_context


@pytest.fixture(scope="module")
def gpu() -> Iterator[GpuContext]:
    context = create_context()
    yield context
    context.release()


@pytest.fixture
def clean_gl(gpu: GpuContext) -> Iterator[None]:
    """Modules ask for it with `pytestmark = pytest.mark.usefixtures("clean_gl")`."""
    assert gpu.ctx.error == "GL_NO_ERROR"
    yield
    assert gpu.ctx.error == "GL_NO_ERROR"
