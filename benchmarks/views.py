"""What a second and a third camera in one room cost: `deltalight bench views`."""

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from deltalight import __version__
from deltalight.benchmarks.report_output import put_report
from deltalight.benchmarks.speed.measure import opened, rendering
from deltalight.benchmarks.variants import Variant
from deltalight.protocol.documents import StrictModel
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.renderer import SceneRenderer
from deltalight.sensor_node.cameras.synthetic import (
    FRAMES_PER_ROUND,
    SyntheticCamera,
    SyntheticNoise,
    default_camera,
)
from deltalight.sensor_node.view_frames import ViewFrameBuilder
from deltalight.services.demo import demo_scene
from deltalight.services.offline import with_output

REPORT: Final = "deltalight bench views"
CAMERAS = 3
MOTIONS = ("camera", "object")
APART = FRAMES_PER_ROUND // CAMERAS  # frames of the synthetic camera's round between two cameras
PLACE, CIRCLE_M = (0.08, 0.06, 0.0), 0.02  # of the object, on the board (m)
WARM_UP_STEPS = 2  # drivers compile shaders
STEP_NS = 33_333_333


class ViewsFigures(StrictModel):
    """One motion by one method; lists are by the number of cameras, from 1 on.

    `processor_ms` and `wall_ms`: medians of what a moment takes with all pictures. `ratios`: median over moments of
    the processor time beside that of one camera at the same moment. `further`: what the last camera adds, as a
    fraction of the first's cost.
    """

    processor_ms: list[float]
    wall_ms: list[float]
    ratios: list[float]

    @property
    def further(self) -> list[float]:
        """What each further camera adds, as a fraction of what one costs."""
        return [float(step) for step in np.diff(self.ratios)]


class ViewsReport(StrictModel):
    """What `bench views` measured. `load_before`: of the machine, as other programs left it."""

    report: Literal["deltalight bench views"] = REPORT
    version: str
    renderer: str
    cpus: int
    load_before: float
    size: tuple[int, int]
    moments: int
    geometry: str
    methods: dict[str, dict[str, ViewsFigures]]


@dataclass(frozen=True)
class ViewsJob:
    """What to measure: `moments` of each motion by each method, in pictures of `size` (width, height)."""

    methods: Sequence[Variant]
    moments: int
    size: tuple[int, int]
    geometry: Literal["depth", "fused"]
    device: int | None = None


@dataclass
class _Times:
    """Seconds of each moment, by the number of cameras."""

    processor: dict[int, list[float]] = field(default_factory=dict)
    wall: dict[int, list[float]] = field(default_factory=dict)

    def figures(self) -> ViewsFigures:
        one = np.array(self.processor[1])
        return ViewsFigures(
            processor_ms=[1e3 * float(np.median(each)) for each in self.processor.values()],
            wall_ms=[1e3 * float(np.median(each)) for each in self.wall.values()],
            ratios=[float(np.median(np.array(each) / one)) for each in self.processor.values()],
        )


class Room:
    """The synthetic scene as cameras see it that stand a third of the synthetic camera's round apart."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._camera = SyntheticCamera(camera=default_camera().resized(*size), noise=SyntheticNoise())
        self._build = ViewFrameBuilder(self._camera)
        self._known: dict[int, ViewFrame] = {}

    def frames(self, step: int, moment: int) -> list[ViewFrame]:
        """Returns a frame of each camera at a step of its way, as taken at that moment."""
        taken = [self._at(camera * APART + step) for camera in range(CAMERAS)]
        return [replace(each, frame_id=moment, timestamp_ns=moment * STEP_NS) for each in taken]

    def _at(self, index: int) -> ViewFrame:
        if index not in self._known:
            self._known[index] = self._build(self._camera.frame_at(index))
        return self._known[index]


def moments_of(
    motion: str, room: Room, scene: SceneDocument, count: int
) -> Iterator[tuple[SceneDocument, list[ViewFrame]]]:
    """Returns scene and frames of each moment.

    `camera`: all cameras move, so that everything is made anew but what was learnt of the light. `object`: the object
    goes round a small circle, and nothing else moves.
    """
    for moment in range(count):
        angle = 2 * math.pi * moment / 24 if motion == "object" else 0.0
        turn = CIRCLE_M * np.array([math.cos(angle), math.sin(angle), 0])
        x, y, z = (float(value) for value in PLACE + turn)
        thing = scene.objects[0]
        moved = thing.replaced(pose=thing.pose.replaced(translation_m=(x, y, z)))
        step = moment if motion == "camera" else 0
        yield scene.model_copy(update={"objects": (moved,)}), room.frames(step, moment)


def measure_views(job: ViewsJob, progress: Progress) -> ViewsReport:
    """Measures every motion by every method, with one camera, two and three in turn at each moment.

    Raises:
        DeltalightError: no OpenGL, or missing demo files.
    """
    load, room = os.getloadavg()[0], Room(job.size)
    demo = with_output(demo_scene("dvct"), job.size, None)
    demo = demo.replaced(real=demo.real.replaced(geometry=job.geometry))
    found: dict[str, dict[str, ViewsFigures]] = {}
    with opened(job.device) as gpu:
        task = progress.add_task("", total=len(job.methods) * len(MOTIONS))
        for method in job.methods:
            scene = method.applied(demo, None)
            with ExitStack() as stack:
                renderers = {
                    count: stack.enter_context(rendering(gpu, scene)) for count in range(1, CAMERAS + 1)
                }
                found[method.name] = {}
                for motion in MOTIONS:
                    progress.update(task, description=f"{method.name}: {motion}", advance=1)
                    found[method.name][motion] = _measured(motion, room, scene, renderers, job.moments)
        return ViewsReport(
            version=__version__,
            renderer=gpu.renderer_name,
            cpus=os.cpu_count() or 1,
            load_before=load,
            size=job.size,
            moments=job.moments,
            geometry=job.geometry,
            methods=found,
        )


def _measured(
    motion: str, room: Room, scene: SceneDocument, renderers: Mapping[int, SceneRenderer], moments: int
) -> ViewsFigures:
    times = _Times()
    for number, (document, frames) in enumerate(moments_of(motion, room, scene, WARM_UP_STEPS + moments)):
        for count, renderer in renderers.items():
            renderer.set_scene(document)
            processor, wall = _timed(lambda: renderer.render_views(frames[:count]))  # noqa: B023 (called at once)
            if number >= WARM_UP_STEPS:
                times.processor.setdefault(count, []).append(processor)
                times.wall.setdefault(count, []).append(wall)
    return times.figures()


def _timed(run: Callable[[], object]) -> tuple[float, float]:
    """Returns processor time of this process (software renders in it) and wall time, s."""
    processor_s, wall_s = time.process_time(), time.perf_counter()
    run()
    return time.process_time() - processor_s, time.perf_counter() - wall_s


def run_views(job: ViewsJob, *, out: Path | None, as_json: bool) -> None:
    """Measures, writes the report to `out` if given, and prints it."""
    console = Console(stderr=True)
    hidden = not console.is_terminal
    with Progress(console=console, transient=True, refresh_per_second=1, disable=hidden) as progress:
        report = measure_views(job, progress)
    put_report(
        report.model_dump_json(indent=2), lambda: Console().print(_table(report)), out=out, as_json=as_json
    )


def _table(report: ViewsReport) -> Table:
    width, height = report.size
    title = (
        f"{width} x {height}, {report.geometry}, {report.renderer}, {report.cpus} processors; processor time"
    )
    table = Table(title=title)
    for name in ("method", "moves"):
        table.add_column(name)
    for name in ("one, ms", "two", "three", "2nd adds", "3rd adds"):
        table.add_column(name, justify="right")
    for method, motions in report.methods.items():
        for motion, found in motions.items():
            ratios = [f"x {ratio:.2f}" for ratio in found.ratios[1:]]
            added = [f"{100 * fraction:.0f} %" for fraction in found.further]
            table.add_row(method, motion, f"{found.processor_ms[0]:.0f}", *ratios, *added)
    return table
