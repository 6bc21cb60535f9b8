"""Times of passes: summed by name, known some frames late, by queries that are used again."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.render_server.gpu import timers as timers_module
from deltalight.render_server.gpu.context import GpuContext, count_gl_objects
from deltalight.render_server.gpu.timers import PassTimers
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    HEIGHT,
    WIDTH,
    Stage,
    cube,
    depth_image,
    directional,
    floor,
    frame,
    pass_times_ms,
)

pytestmark = pytest.mark.usefixtures("clean_gl")


def test_timers_sum_a_pass_by_name_and_begin_anew_each_frame(gpu: GpuContext) -> None:
    timers = PassTimers(gpu)
    for _ in range(5):
        for name in ("a", "b", "a"):
            with timers.measure(name):
                gpu.ctx.finish()
        times = timers.end_frame()
    assert set(times) == {"a", "b"}
    assert all(0 <= value < 1e4 for value in times.values())
    timers.end_frame()
    timers.wait()
    assert timers.times_ms == {}
    timers.release()


@pytest.fixture
def queried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Passes are timed by queries, as on a GPU; in software these read zero."""
    monkeypatch.setattr(timers_module, "has_timer_queries", lambda _: True)


def timed(gpu: GpuContext, timers: PassTimers, frames: int) -> None:
    for _ in range(frames):
        for name in ("a", "b", "a"):
            with timers.measure(name):
                gpu.ctx.finish()
        timers.end_frame()


@pytest.mark.usefixtures("queried")
def test_queries_pass_from_timers_to_timers(gpu: GpuContext) -> None:
    counts = []
    for _ in range(3):
        timers = PassTimers(gpu)
        timed(gpu, timers, frames=4)
        with pytest.raises(ZeroDivisionError), timers.measure("c"):
            _ = 1 // 0
        with timers.measure("d"):  # of a frame that does not end
            pass
        timers.release()
        counts.append(count_gl_objects()["Query"])
    assert counts[0] > 0
    assert counts == counts[:1] * 3


@pytest.mark.usefixtures("queried")
def test_whoever_waits_knows_the_newest_frame(gpu: GpuContext) -> None:
    timers = PassTimers(gpu)
    timed(gpu, timers, frames=1)
    assert timers.times_ms == {}
    timers.wait()
    assert set(timers.times_ms) == set(timers.submit_ms) == {"a", "b"}
    timers.release()


@pytest.mark.usefixtures("queried")
def test_a_renderer_leaves_no_queries(gpu: GpuContext, tmp_path: Path) -> None:
    stage, counts = Stage(tmp_path), []
    document = stage.document([stage.virtual(cube())], [directional()], floor())
    for _ in range(2):
        renderer = SceneRenderer(gpu, document)
        renderer.render(frame())
        assert "cones" in pass_times_ms(renderer)
        renderer.release()
        counts.append(count_gl_objects()["Query"])
    assert counts[0] == counts[1]


@pytest.mark.usefixtures("queried")
def test_frames_without_a_surface_use_queries_again(gpu: GpuContext, tmp_path: Path) -> None:
    stage, counts = Stage(tmp_path), []
    document = stage.document([stage.virtual(cube())], [directional()])
    blind = frame(depth=depth_image(np.zeros((HEIGHT, WIDTH), np.float32)))
    for frames in (4, 8):
        gpu.spare_queries.clear()
        renderer = SceneRenderer(gpu, document)
        for _ in range(frames):
            renderer.render(blind)
        renderer.release()
        counts.append(len(gpu.spare_queries))
    assert counts[0] == counts[1] > 0


def test_what_the_cpu_takes_for_a_pass_is_told_apart_from_what_the_gpu_takes(gpu: GpuContext) -> None:
    timers = PassTimers(gpu)
    timed(gpu, timers, frames=1)
    timers.wait()
    assert set(timers.submit_ms) == {"a", "b"}
    if not timers_module.has_timer_queries(gpu):
        assert all(timers.submit_ms[name] <= ms for name, ms in timers.times_ms.items())
    timers.end_frame()
    assert timers.submit_ms == {}
    timers.release()
