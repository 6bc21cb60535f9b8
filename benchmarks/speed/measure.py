"""Frames of each motion by each method, one after the other, each waited for."""

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version

from rich.progress import Progress

from benchmarks.speed.motions import Step, Take, prepare_take, steps_of
from benchmarks.speed.peaks import measure_peaks, stage_bytes
from benchmarks.speed.report import (
    EndToEnd,
    MethodFigures,
    MotionFigures,
    Peaks,
    SpeedReport,
    Spread,
    StageFigures,
)
from benchmarks.variants import Variant
from protocol.scene import SceneDocument
from render_server.gpu.context import GpuContext, create_context
from render_server.graph import Graph
from render_server.renderer import SceneRenderer
from services.demo import collect_composites, demo_scene
from services.offline import with_output

WARM_UP_FRAMES = 3  # drivers compile and specialise shaders in the first frames


@dataclass(frozen=True)
class SpeedJob:
    """What to measure: `frames` of each motion by each method; `size` (width, height) None = the demo's.

    `device` None = the driver's first.
    """

    methods: Sequence[Variant]
    motions: Sequence[str]
    frames: int
    size: tuple[int, int] | None = None
    device: int | None = None

    def scenes(self) -> dict[str, SceneDocument]:
        """Return the demo's scene for each method.

        Raises:
            DeltalightError: the demo's files are missing.
        """
        demo = with_output(demo_scene("dvct"), self.size, None)
        return {method.name: method.applied(demo, None) for method in self.methods}


@dataclass(frozen=True)
class FrameTimes:
    """Of one frame, milliseconds; as `MotionFigures` has them."""

    frame_ms: float
    picture_ms: float
    submit_ms: float
    stages_ms: Mapping[str, float]

    @property
    def all_stages_ms(self) -> float:
        """Sum of the stages."""
        return sum(self.stages_ms.values())


def measure_speed(job: SpeedJob, budget_ms: float, progress: Progress, *, end_to_end: bool) -> SpeedReport:
    """Measure every motion by every method; frames that take longer than `budget_ms` are late.

    Raises:
        DeltalightError: no OpenGL, missing demo files, or a process that died for good.
    """
    scenes, take = job.scenes(), prepare_take(progress)
    with opened(job.device) as gpu:
        run = _Run(gpu, job, take, measure_peaks(gpu), budget_ms, progress)
        methods = {name: run.method(name, scene) for name, scene in scenes.items()}
    if end_to_end:
        for method in progress.track(methods, description="camera to viewer"):
            through = _measure_end_to_end(scenes[method], job.frames)
            methods[method] = methods[method].replaced(end_to_end=through)
    frame = take.standing[0].camera
    return SpeedReport(
        version=version("deltalight"),
        renderer=gpu.renderer_name,
        cpus=os.cpu_count() or 1,
        size=job.size or (frame.width, frame.height),
        frames=job.frames,
        budget_ms=budget_ms,
        peaks=run.peaks,
        methods=methods,
    )


@contextmanager
def opened(device: int | None) -> Iterator[GpuContext]:
    """Opens the process's OpenGL context, and releases it."""
    gpu = create_context(device)
    try:
        yield gpu
    finally:
        gpu.release()


@contextmanager
def rendering(gpu: GpuContext, scene: SceneDocument) -> Iterator[SceneRenderer]:
    """Makes a renderer, and releases it."""
    renderer = SceneRenderer(gpu, scene)
    try:
        yield renderer
    finally:
        renderer.release()


@dataclass(frozen=True)
class _Run:
    """What all measurements of a run share."""

    gpu: GpuContext
    job: SpeedJob
    take: Take
    peaks: Peaks
    budget_ms: float
    progress: Progress

    def method(self, name: str, scene: SceneDocument) -> MethodFigures:
        """Measure one method, its motions by one renderer."""
        with rendering(self.gpu, scene) as renderer:
            renderer.render(self.take.standing[0])
            notices = list(renderer.notices)  # those of the demo itself; other lights bring further ones
            motions = {motion: self._motion(name, motion, scene, renderer) for motion in self.job.motions}
            return MethodFigures(motions=motions, notices=notices)

    def _motion(self, name: str, motion: str, scene: SceneDocument, renderer: SceneRenderer) -> MotionFigures:
        count = WARM_UP_FRAMES + self.job.frames
        steps = steps_of(motion, self.take, scene, count)
        shown = self.progress.track(steps, count, description=f"{name}: {motion}")
        times = [time_step(renderer, step) for step in shown][WARM_UP_FRAMES:]
        moved = {} if renderer.graph is None else stage_bytes(renderer.graph)
        return motion_figures(times, moved, self.peaks, self.budget_ms)


def time_step(renderer: SceneRenderer, step: Step) -> FrameTimes:
    """Render one step and wait for its picture."""
    started_s = time.perf_counter()
    if step.scene is not renderer.scene:
        renderer.set_scene(step.scene)
    submitting_s = time.perf_counter()
    pending = renderer.submit(step.frame)
    submitted_s = time.perf_counter()
    pending.finish()
    finished_s = time.perf_counter()
    return FrameTimes(
        1000 * (finished_s - started_s),
        1000 * (finished_s - submitting_s),
        1000 * (submitted_s - submitting_s),
        _stage_times(renderer.graph),
    )


def _stage_times(graph: Graph | None) -> dict[str, float]:
    """Return the newest frame's times by stage, ms; timer queries are otherwise read some frames late."""
    if graph is None or graph.timers is None:
        return {}
    graph.timers.wait()
    return dict(graph.timers.times_ms)


def motion_figures(
    times: Sequence[FrameTimes], moved: Mapping[str, int], peaks: Peaks, budget_ms: float
) -> MotionFigures:
    """Sum up the frames of a motion; `moved`: bytes that each stage reads and writes."""
    names = dict.fromkeys(name for each in times for name in each.stages_ms)
    return MotionFigures(
        frame_ms=Spread.of([each.frame_ms for each in times]),
        picture_ms=Spread.of([each.picture_ms for each in times]),
        submit_ms=Spread.of([each.submit_ms for each in times]),
        stages_ms=Spread.of([each.all_stages_ms for each in times]),
        outside_ms=Spread.of([each.frame_ms - each.all_stages_ms for each in times]),
        late=sum(each.frame_ms > budget_ms for each in times),
        stages={name: _stage_figures(name, times, moved.get(name), peaks) for name in names},
    )


def _stage_figures(
    name: str, times: Sequence[FrameTimes], moved_bytes: int | None, peaks: Peaks
) -> StageFigures:
    ran = [each.stages_ms[name] for each in times if name in each.stages_ms]
    floor_ms = None if moved_bytes is None else 1000 * moved_bytes / peaks.bytes_per_s
    return StageFigures(
        ms=Spread.of(ran), runs=len(ran) / len(times), moved_bytes=moved_bytes, floor_ms=floor_ms
    )


def _measure_end_to_end(scene: SceneDocument, frames: int) -> EndToEnd:
    summary = collect_composites(scene, WARM_UP_FRAMES + frames, None)
    return EndToEnd(**{key: summary[key] for key in EndToEnd.model_fields})
