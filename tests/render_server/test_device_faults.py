"""What a driver reports beside pictures: a lost context, memory that is full, errors."""

import ctypes
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import glcontext
import moderngl
import numpy as np
import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_output import Output
from deltalight.render_server import renderer as renderer_module
from deltalight.render_server.gpu import lost_context
from deltalight.render_server.gpu.context import GpuContext, GpuMemoryError, count_gl_objects
from deltalight.render_server.gpu.lost_context import GpuResetError, ReportingContext, reporting
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import HEIGHT, WIDTH, Stage, cube, directional, floor, frame

RESET_NOTIFICATION_STRATEGY, LOSE_CONTEXT_ON_RESET = 0x8256, 0x8252  # GL_KHR_robustness
INVALID_CAPABILITY = 0xFFFF
LARGE_PICTURE = 2_000_000  # bytes of a buffer for 640x480 pixels, and not of one for 160x120
ENORMOUS = 1 << 46  # bytes: more than any device has

pytestmark = pytest.mark.usefixtures("clean_gl")


def function(gpu: GpuContext, name: str, *arguments: type) -> Any:  # noqa: ANN401 - of OpenGL
    return ctypes.CFUNCTYPE(None, *arguments)(gpu.ctx.mglo._context.load(name))


@pytest.fixture
def stage(tmp_path: Any) -> Stage:  # noqa: ANN401
    return Stage(tmp_path)


def test_the_driver_reports_resets(gpu: GpuContext) -> None:
    if not isinstance(gpu.ctx.mglo._context, ReportingContext):
        pytest.skip("this driver makes no such contexts")
    strategy = ctypes.c_int()
    read = function(gpu, "glGetIntegerv", ctypes.c_uint, ctypes.POINTER(ctypes.c_int))
    read(RESET_NOTIFICATION_STRATEGY, ctypes.byref(strategy))
    assert strategy.value == LOSE_CONTEXT_ON_RESET
    assert gpu.reset_status() == 0


def test_where_a_driver_reports_none_its_own_context_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_context: object) -> None:
        raise OSError("eglCreateContext failed (0x3009)")

    monkeypatch.setattr(lost_context, "ReportingContext", refuse)
    plain = glcontext.get_backend_by_name("egl")
    assert reporting(plain) is plain


def test_a_picture_of_a_lost_context_is_not_returned(gpu: GpuContext, stage: Stage) -> None:
    """No machine here can bring a reset about: the status is simulated."""
    answers = [0, 0, 0x8253]
    lost = replace(gpu, reset_status=lambda: answers.pop(0))
    renderer = SceneRenderer(lost, stage.document([stage.virtual(cube())], [directional()], floor()))
    assert renderer.render(frame()).status == "ok"
    answers += [0, 0x8253]
    with pytest.raises(GpuResetError, match="by work of this process"):  # noticed before a frame
        renderer.render(frame())
    pending = renderer.submit(frame())
    with pytest.raises(GpuResetError):  # and while one was on the GPU
        pending.finish()
    renderer.release()


@pytest.fixture
def fill_memory(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Makes the driver report once that its memory is full; some say nothing until memory is written."""
    reports: list[str] = []
    ask = vars(moderngl.Context)["error"].fget
    monkeypatch.setattr(
        moderngl.Context, "error", property(lambda ctx: reports.pop() if reports else ask(ctx))
    )
    return lambda: reports.append("GL_OUT_OF_MEMORY")


def test_what_no_device_holds_is_noticed(gpu: GpuContext) -> None:
    gpu.ctx.buffer(reserve=ENORMOUS).release()
    if gpu.is_software:
        with pytest.raises(GpuMemoryError, match=r"memory is full, .* lower"):
            gpu.check()
    else:  # drivers need not notice before the memory is written
        with suppress(GpuMemoryError):
            gpu.check()


def test_full_memory_refuses_frames_until_a_scene_was_built_anew(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch, fill_memory: Callable[[], None]
) -> None:
    scene = stage.document([stage.virtual(cube())], [directional()], floor())
    renderer = SceneRenderer(gpu, scene)
    before = renderer.render(frame()).color
    pending = renderer.submit(frame())
    fill_memory()
    with pytest.raises(GpuMemoryError, match=r"memory is full, .* lower"):
        pending.finish()
    with pytest.raises(GpuMemoryError):
        renderer.render(frame())
    renderer.set_scene(scene)  # is tried at once
    assert np.array_equal(renderer.render(frame()).color, before)
    monkeypatch.setattr(renderer_module, "MEMORY_RETRY_S", 0.0)
    fill_memory()
    assert np.array_equal(renderer.render(frame()).color, before)  # built anew
    assert not gpu.errors
    renderer.release()


def test_a_size_beyond_the_gpu_is_refused_and_nothing_of_it_stays(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The refusal comes in the middle, when textures of that size are there already. It is not tried every frame."""
    refused: list[int] = []

    def check(_: GpuContext, size: int, lower: str) -> None:
        if "output.width" in lower and size > LARGE_PICTURE:
            refused.append(size)
            raise DeltalightError("too large")

    monkeypatch.setattr(GpuContext, "check_storage", check)
    document = stage.document([stage.virtual(cube())], [directional()], floor())
    large, small = (document.replaced(output=Output(height=height)) for height in (4 * HEIGHT, HEIGHT // 2))
    renderer = SceneRenderer(gpu, document)
    before = renderer.render(frame()).color
    renderer.set_scene(small)
    assert renderer.render(frame()).color.shape == (HEIGHT // 2, WIDTH // 2, 3)
    held = count_gl_objects()["Texture"]
    renderer.set_scene(large)
    for _ in range(3):
        with pytest.raises(DeltalightError, match="too large"):
            renderer.render(frame())
    assert len(refused) == 1
    renderer.set_scene(document)
    assert np.array_equal(renderer.render(frame()).color, before)
    assert count_gl_objects()["Texture"] <= held
    renderer.release()


def test_a_size_that_no_message_holds_is_refused(gpu: GpuContext, stage: Stage) -> None:
    document = stage.document([stage.virtual(cube())], [directional()], floor())
    renderer = SceneRenderer(gpu, document.replaced(output=Output(height=6699)))
    with pytest.raises(
        DeltalightError, match=r"8932 x 6699 pixels is asked for, and 22 million .* lower output"
    ):
        renderer.render(frame())
    renderer.release()


def test_an_error_of_opengl_is_told_once_and_pictures_go_on(gpu: GpuContext, stage: Stage) -> None:
    watched = replace(gpu, errors=Counter())
    renderer = SceneRenderer(watched, stage.document([stage.virtual(cube())], [directional()], floor()))
    before = renderer.render(frame()).color
    for number in (1, 2):
        function(gpu, "glEnable", ctypes.c_uint)(INVALID_CAPABILITY)
        assert np.array_equal(renderer.render(frame()).color, before)
        assert watched.errors["GL_INVALID_ENUM"] >= number
    assert [text for text in renderer.notices if "OpenGL" in text] == [
        "OpenGL reports GL_INVALID_ENUM, so pictures may be wrong: please report it."
    ]
    renderer.release()
