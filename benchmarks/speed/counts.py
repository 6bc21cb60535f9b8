"""What a frame of each motion asks of the GPU, and what Python takes for it while the GPU is left out."""

import time
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Literal

from rich.console import Console
from rich.progress import Progress

from deltalight import __version__
from deltalight.benchmarks.speed.instruments import GpuCounts, ReadBacks, counted
from deltalight.benchmarks.speed.measure import WARM_UP_FRAMES, SpeedJob, opened, rendering, time_step
from deltalight.benchmarks.speed.motions import Step, prepare_take, steps_of
from deltalight.benchmarks.speed.report import Spread
from deltalight.benchmarks.speed.tables import figure_table
from deltalight.protocol.documents import StrictModel
from deltalight.render_server.renderer import SceneRenderer

ROWS = {
    "dispatches": "dispatches",
    "draws": "draws",
    "framebuffer_clears": "framebuffer clears",
    "buffer_clears": "buffer clears by the CPU",
    "buffer_clear_bytes": "cleared by the CPU, MB",
    "uploads": "uploads",
    "uploaded_bytes": "uploaded, MB",
    "reads": "reads that wait for the GPU",
    "uniform_writes": "uniform writes",
}


class FrameCounts(StrictModel):
    """Of one motion by one method: means per frame of `GpuCounts`' fields, and a frame's time without the GPU.

    `thread_ms` of `python_ms` are processor time of the frame's own thread; the rest waits for other threads.
    """

    per_frame: dict[str, float]
    python_ms: Spread
    thread_ms: Spread


class CountsReport(StrictModel):
    """A whole run: by method, then by motion; `size` in pixels."""

    report: Literal["deltalight bench counts"] = "deltalight bench counts"
    version: str
    renderer: str
    size: tuple[int, int]
    frames: int
    methods: dict[str, dict[str, FrameCounts]]


def count_frames(job: SpeedJob, progress: Progress, *, gpu_paths: bool = False) -> CountsReport:
    """Counts every motion by every method; with `gpu_paths`, as on a GPU also where there is none.

    Raises:
        DeltalightError: no OpenGL, or missing demo files.
    """
    scenes, take = job.scenes(), prepare_take(progress).at(job.size)
    methods: dict[str, dict[str, FrameCounts]] = {}
    frames = WARM_UP_FRAMES + 2 * job.frames
    with opened(job.device) as gpu:
        for name, scene in scenes.items():
            with rendering(replace(gpu, is_software=False) if gpu_paths else gpu, scene) as renderer:
                counts = methods[name] = {}
                for motion in progress.track(job.motions, description=f"counting {name}"):
                    steps = list(steps_of(motion, take, scene, frames))
                    counts[motion] = count_motion(renderer, steps, job.frames)
        renderer_name = gpu.renderer_name
    camera = take.standing[0].camera
    return CountsReport(
        version=__version__,
        renderer=renderer_name,
        size=job.size or (camera.width, camera.height),
        frames=job.frames,
        methods=methods,
    )


def count_motion(renderer: SceneRenderer, steps: Sequence[Step], frames: int) -> FrameCounts:
    """Renders all but the last 2 `frames` steps to warm up, counts as many, then times as many without the GPU."""
    reads = ReadBacks()
    for step in steps[: -2 * frames]:
        time_step(renderer, step)
    with counted() as counts, reads.remembered():
        for step in steps[-2 * frames : -frames]:
            time_step(renderer, step)
    with reads.without_gpu():
        times_ms = [_python_times(renderer, step) for step in steps[-frames:]]
    python_ms, thread_ms = (Spread.of(each) for each in zip(*times_ms, strict=True))
    return FrameCounts(per_frame=_per_frame(counts, frames), python_ms=python_ms, thread_ms=thread_ms)


def _python_times(renderer: SceneRenderer, step: Step) -> tuple[float, float]:
    """Returns how long a step takes, and the processor time of this thread in it, ms."""
    started_s = time.thread_time()
    frame_ms = time_step(renderer, step).frame_ms
    return frame_ms, 1000 * (time.thread_time() - started_s)


def _per_frame(counts: GpuCounts, frames: int) -> dict[str, float]:
    return {field.name: getattr(counts, field.name) / frames for field in fields(counts)}


def print_counts(report: CountsReport, console: Console) -> None:
    """Prints a table for each method, one column per motion."""
    width, height = report.size
    console.print(f"{report.renderer}, {width}x{height}, means of {report.frames} frames")
    for method, motions in report.methods.items():
        table = figure_table(method, ("Per frame",), tuple(motions))
        for field, name in ROWS.items():
            table.add_row(name, *(_number(field, each.per_frame[field]) for each in motions.values()))
        for name, spreads in (
            ("Python", [each.python_ms for each in motions.values()]),
            ("its thread", [each.thread_ms for each in motions.values()]),
        ):
            table.add_row(f"{name}, median ms", *(f"{each.median:.1f}" for each in spreads))
            table.add_row(f"{name}, p95 ms", *(f"{each.p95:.1f}" for each in spreads))
        console.print(table)


def _number(field: str, value: float) -> str:
    if field.endswith("_bytes"):
        return f"{value / 1e6:.2f}"
    return f"{value:.0f}" if value.is_integer() else f"{value:.1f}"
