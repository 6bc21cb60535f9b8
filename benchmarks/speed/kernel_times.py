"""How long each kernel and draw of a frame takes, timed one by one: stages hold several."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from itertools import islice
from typing import Any, Literal

import moderngl
from rich.console import Console
from rich.progress import Progress

from deltalight import __version__
from deltalight.benchmarks.speed.instruments import DISPATCHES, DRAWS, Wrapped, wrapped
from deltalight.benchmarks.speed.measure import SpeedJob, opened, rendering, time_step, warm_up
from deltalight.benchmarks.speed.motions import Step, prepare_take, steps_of
from deltalight.benchmarks.speed.report import Spread
from deltalight.benchmarks.speed.tables import figure_table
from deltalight.protocol.documents import StrictModel
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Dispatch, watched
from deltalight.render_server.gpu.timers import PassTimers, has_timer_queries
from deltalight.render_server.renderer import SceneRenderer

OUTSIDE = "(no stage)"


class KernelFigures(StrictModel):
    """One kernel in one stage: all its runs in a frame together, over the frames in which it ran.

    `runs` are its runs in a frame, a mean over all frames.
    """

    stage: str
    kernel: str
    runs: float
    ms: Spread


class KernelsReport(StrictModel):
    """A whole run: by method, then by motion, the kernels that take most first; `size` in pixels."""

    report: Literal["deltalight bench kernels"] = "deltalight bench kernels"
    version: str
    renderer: str
    size: tuple[int, int]
    frames: int
    methods: dict[str, dict[str, list[KernelFigures]]]


@dataclass
class _Run:
    """A run of a kernel, or a draw; the driver's query tells how long it took, or the clock has."""

    stage: str
    kernel: str = ""
    query: moderngl.Query | None = None
    clocked_ms: float = 0.0

    @property
    def ms(self) -> float:
        """How long it took; waits for the GPU."""
        return self.clocked_ms if self.query is None else self.query.elapsed / 1e6


class KernelTimes:
    """Notes how long each dispatch and draw takes while it is watched; stages are not timed then."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._stage = OUTSIDE
        self._runs: list[_Run] = []

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Notes what runs inside. Timer queries do not nest, so those of stages are left out."""
        timed: list[Wrapped] = [(owner, name, self._timing) for owner, name in (*DISPATCHES, *DRAWS)]
        staged: Wrapped = (PassTimers, "measure", lambda _: lambda _, name: self._in_stage(name))
        with wrapped([*timed, staged]), watched(self._gpu, self._name_newest):
            yield

    @contextmanager
    def _in_stage(self, name: str) -> Iterator[None]:
        self._stage, before = name, self._stage
        try:
            yield
        finally:
            self._stage = before

    def _timing(self, original: Callable[..., None]) -> Callable[..., None]:
        @wraps(original)
        def call(*given: Any, **named: Any) -> None:  # noqa: ANN401 (as the wrapped method)
            run = _Run(self._stage)
            with self._timed(run):
                original(*given, **named)
            self._runs.append(run)

        return call

    @contextmanager
    def _timed(self, run: _Run) -> Iterator[None]:
        if has_timer_queries(self._gpu):
            run.query = self._gpu.ctx.query(time=True)
            with run.query:
                yield
        else:
            self._gpu.ctx.finish()
            started_s = time.perf_counter()
            yield
            self._gpu.ctx.finish()
            run.clocked_ms = 1000 * (time.perf_counter() - started_s)

    def _name_newest(self, dispatch: Dispatch) -> None:
        if self._runs and not self._runs[-1].kernel:  # a mesh without triangles is not drawn
            self._runs[-1].kernel = dispatch.kernel

    def take(self) -> list[_Run]:
        """Returns the runs since it was last asked."""
        runs, self._runs = self._runs, []
        return runs


def time_kernels(job: SpeedJob, progress: Progress) -> KernelsReport:
    """Times the kernels of every motion by every method.

    Raises:
        DeltalightError: no OpenGL, or missing demo files.
    """
    scenes, take = job.scenes(), prepare_take(progress).at(job.size)
    methods: dict[str, dict[str, list[KernelFigures]]] = {}
    with opened(job.device) as gpu:
        for name, scene in scenes.items():
            with rendering(gpu, scene) as renderer:
                found = methods[name] = {}
                for motion in progress.track(job.motions, description=f"timing {name}"):
                    steps = steps_of(motion, take, scene)
                    warm_up(gpu, renderer, steps)
                    found[motion] = time_motion(gpu, renderer, list(islice(steps, job.frames)))
        renderer_name = gpu.renderer_name
    camera = take.standing[0].camera
    return KernelsReport(
        version=__version__,
        renderer=renderer_name,
        size=job.size or (camera.width, camera.height),
        frames=job.frames,
        methods=methods,
    )


def time_motion(gpu: GpuContext, renderer: SceneRenderer, steps: Sequence[Step]) -> list[KernelFigures]:
    """Renders the steps, and sums up what their kernels take; those that take most come first."""
    times = KernelTimes(gpu)
    frames = []
    with times.watching():
        for step in steps:
            time_step(renderer, step)
            frames.append(_by_kernel(times.take()))
    kernels = {kernel for frame in frames for kernel in frame}
    figures = [_figures(*kernel, [frame.get(kernel, []) for frame in frames]) for kernel in kernels]
    return sorted(figures, key=lambda each: -each.ms.median)


def _by_kernel(runs: Sequence[_Run]) -> dict[tuple[str, str], list[float]]:
    """Returns the times of each run in ms, by stage and kernel."""
    found: dict[tuple[str, str], list[float]] = {}
    for run in runs:
        found.setdefault((run.stage, run.kernel), []).append(run.ms)
    return found


def _figures(stage: str, kernel: str, frames: Sequence[Sequence[float]]) -> KernelFigures:
    """Returns the figures of a kernel; for each frame, the times of its runs, ms."""
    runs = sum(len(frame) for frame in frames) / len(frames)
    return KernelFigures(
        stage=stage, kernel=kernel, runs=runs, ms=Spread.of([sum(frame) for frame in frames if frame])
    )


def print_kernels(report: KernelsReport, console: Console) -> None:
    """Prints a table for each motion by each method."""
    width, height = report.size
    console.print(f"{report.renderer}, {width}x{height}, {report.frames} frames of each motion")
    for method, motions in report.methods.items():
        for motion, kernels in motions.items():
            table = figure_table(f"{method}: {motion}", ("Stage", "Kernel"), ("runs", "median ms", "p95"))
            for each in kernels:
                figures = f"{each.runs:g}", f"{each.ms.median:.3f}", f"{each.ms.p95:.3f}"
                table.add_row(each.stage, each.kernel, *figures)
            console.print(table)
