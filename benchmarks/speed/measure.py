"""Frames of each motion by each method, one after the other, each waited for."""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice

from rich.progress import Progress

from deltalight import __version__
from deltalight.benchmarks.speed.motions import Step, Take, prepare_take, steps_of
from deltalight.benchmarks.speed.peaks import measure_peaks, stage_bytes
from deltalight.benchmarks.speed.report import (
    EndToEnd,
    MethodFigures,
    MotionFigures,
    Peaks,
    SpeedReport,
    Spread,
    StageFigures,
)
from deltalight.benchmarks.variants import Variant
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext, create_context
from deltalight.render_server.graph import Graph
from deltalight.render_server.renderer import SceneRenderer
from deltalight.services.demo import demo_scene
from deltalight.services.headless_demo import collect_composites
from deltalight.services.offline import with_output

Keep = Callable[[SpeedReport], None]

WARM_UP_FRAMES = 3  # drivers compile and specialise shaders in the first frames
GPU_WARM_UP_S = 1.0  # a GPU that was idle runs at a fraction of its clock for about so long


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
        """Returns the demo's scene for each method.

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
    stages_submit_ms: Mapping[str, float]

    @property
    def all_stages_ms(self) -> float:
        """Sum of the stages."""
        return sum(self.stages_ms.values())


def measure_speed(
    job: SpeedJob,
    budget_ms: float,
    progress: Progress,
    keep: Keep,
    *,
    end_to_end: bool,
    take: Take | None = None,
) -> SpeedReport:
    """Measures every motion by every method; frames that take longer than `budget_ms` are late.

    `keep` is given the report so far after every motion, so that nothing is lost where a run is stopped. `take`: the
    frames, if they have been prepared.

    Raises:
        DeltalightError: no OpenGL, missing demo files, or a process that died for good.
    """
    scenes, take = job.scenes(), (take or prepare_take(progress)).at(job.size)
    with opened(job.device) as gpu:
        frame = take.standing[0].camera
        report = SpeedReport(
            version=__version__,
            renderer=gpu.renderer_name,
            cpus=os.cpu_count() or 1,
            size=job.size or (frame.width, frame.height),
            frames=job.frames,
            budget_ms=budget_ms,
            peaks=measure_peaks(gpu),
            methods={},
        )
        run = _Run(gpu, job, take, report, _Shown(progress, job), keep)
        for name, scene in scenes.items():
            run.measure(name, scene)
    if end_to_end:
        through = [method.name for method in job.methods if method.runs_in_processes]
        for name in progress.track(through, description="camera to viewer"):
            run.add(name, end_to_end=_measure_end_to_end(scenes[name], job.frames))
    return report


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


class _Shown:
    """Tells how far a run is: one bar, and a line for each motion that is done."""

    def __init__(self, progress: Progress, job: SpeedJob) -> None:
        self._progress, self._frames = progress, job.frames
        self._motions, self._done = len(job.methods) * len(job.motions), 0
        self._task = progress.add_task("", total=self._motions * job.frames)

    def frame(self, name: str, motion: str, number: int) -> None:
        """Another frame begins, counted from 1; 0: one of those before."""
        which = f"frame {number} of {self._frames}" if number else "warming up"
        place = f"motion {self._done + 1} of {self._motions}"
        self._progress.update(
            self._task, description=f"{name}: {motion} ({place}), {which}", advance=number > 0
        )

    def motion(self, name: str, motion: str, found: MotionFigures) -> None:
        """A motion is done."""
        self._done += 1
        line = f"{name}: {motion}, {found.frame_ms.median:.1f} ms a frame ({self._done} of {self._motions} motions)"
        self._progress.console.print(line, markup=False, highlight=False, soft_wrap=True)


@dataclass(frozen=True)
class _Run:
    """What all measurements of a run share; `report` grows."""

    gpu: GpuContext
    job: SpeedJob
    take: Take
    report: SpeedReport
    shown: _Shown
    keep: Keep

    def measure(self, name: str, scene: SceneDocument) -> None:
        """Measures one method, its motions by one renderer."""
        with rendering(self.gpu, scene) as renderer:
            renderer.render(self.take.standing[0])
            notices = list(renderer.notices)  # those of the demo itself; other lights bring further ones
            motions: dict[str, MotionFigures] = {}
            for motion in self.job.motions:
                motions[motion] = self._motion(name, motion, scene, renderer)
                self.add(name, motions=dict(motions), notices=notices)
                self.shown.motion(name, motion, motions[motion])

    def add(self, name: str, **figures: object) -> None:
        """Puts figures of a method into the report, and hands that on."""
        known = dict(self.report.methods[name]) if name in self.report.methods else {}
        self.report.methods[name] = MethodFigures.model_validate({**known, **figures})
        self.keep(self.report)

    def _motion(self, name: str, motion: str, scene: SceneDocument, renderer: SceneRenderer) -> MotionFigures:
        steps = steps_of(motion, self.take, scene)
        self.shown.frame(name, motion, 0)
        warm_up(self.gpu, renderer, steps)
        times: list[FrameTimes] = []
        for number, step in enumerate(islice(steps, self.job.frames), start=1):
            self.shown.frame(name, motion, number)
            times.append(time_step(renderer, step))
        moved = {} if renderer.graph is None else stage_bytes(renderer.graph)
        return motion_figures(times, moved, self.report.peaks, self.report.budget_ms)


def warm_up(gpu: GpuContext, renderer: SceneRenderer, steps: Iterator[Step]) -> None:
    """Renders steps until drivers have compiled and a GPU runs at its full clock."""
    until_s = time.monotonic() + (0.0 if gpu.is_software else GPU_WARM_UP_S)
    for number, step in enumerate(steps, start=1):
        time_step(renderer, step)
        if number >= WARM_UP_FRAMES and time.monotonic() >= until_s:
            return


def time_step(renderer: SceneRenderer, step: Step) -> FrameTimes:
    """Renders one step and waits for its picture."""
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
        *_stage_times(renderer.graph),
    )


def _stage_times(graph: Graph | None) -> tuple[dict[str, float], dict[str, float]]:
    """Returns the newest frame's times by stage, and the CPU's to issue them, ms.

    Timer queries are otherwise read some frames late.
    """
    if graph is None or graph.timers is None:
        return {}, {}
    graph.timers.wait()
    return dict(graph.timers.times_ms), dict(graph.timers.submit_ms)


def motion_figures(
    times: Sequence[FrameTimes], moved: Mapping[str, int], peaks: Peaks, budget_ms: float
) -> MotionFigures:
    """Sums up the frames of a motion; `moved`: bytes that each stage reads and writes."""
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
    submitted = [each.stages_submit_ms[name] for each in times if name in each.stages_submit_ms]
    floor_ms = None if moved_bytes is None else 1000 * moved_bytes / peaks.bytes_per_s
    return StageFigures(
        ms=Spread.of(ran),
        runs=len(ran) / len(times),
        submit_ms=Spread.of(submitted),
        moved_bytes=moved_bytes,
        floor_ms=floor_ms,
    )


def _measure_end_to_end(scene: SceneDocument, frames: int) -> EndToEnd:
    summary = collect_composites(scene, WARM_UP_FRAMES + frames, None)
    return EndToEnd(**{key: summary[key] for key in EndToEnd.model_fields})
