"""A report of `bench speed` completed by its stages' arithmetic, so that each has both sides of a roofline."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from rich.progress import Progress

from deltalight.benchmarks.speed.arithmetic import ArithmeticCounter, counted_arithmetic
from deltalight.benchmarks.speed.flop_weights import Cost
from deltalight.benchmarks.speed.measure import WARM_UP_FRAMES, Keep, SpeedJob, opened, rendering, time_step
from deltalight.benchmarks.speed.motions import Step, prepare_take, steps_of
from deltalight.benchmarks.speed.peaks import stage_bytes
from deltalight.benchmarks.speed.report import MotionFigures, Peaks, SpeedReport, StageFigures
from deltalight.benchmarks.variants import RENDERED, parse_variants
from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.context import GpuContext, is_software_renderer
from deltalight.render_server.renderer import SceneRenderer

ALIKE = 1.5
"""How many times as much stages may hold as in the report: versions differ by a buffer, volumes by twice that."""


@dataclass(frozen=True)
class RooflineJob:
    """What to count: `frames` of each motion by each method of the report; None: all that it has."""

    report: SpeedReport
    methods: Sequence[str] | None = None
    motions: Sequence[str] | None = None
    frames: int = 3
    device: int | None = None

    def chosen(self) -> dict[str, list[str]]:
        """Returns the motions to count by method.

        Raises:
            DeltalightError: the report has none of them.
        """
        found = {
            method: [each for each in figures.motions if self.motions is None or each in self.motions]
            for method, figures in self.report.methods.items()
            if self.methods is None or method in self.methods
        }
        if not any(found.values()):
            raise DeltalightError(
                f"The report has none of these methods and motions; its methods are {', '.join(self.report.methods)}."
            )
        return found


def count_roofline(job: RooflineJob, progress: Progress, keep: Keep) -> SpeedReport:
    """Returns the report's chosen methods and motions with their arithmetic, which are rendered here.

    Times stay those of the report. Where it is of a GPU, stages are rendered as on a GPU. `keep` is given the report
    after every motion.

    Raises:
        DeltalightError: a tool is missing, nothing was chosen, volumes of other sizes, or as `measure_speed`.
    """
    chosen = job.chosen()
    report = _only(job.report, chosen)
    variants = parse_variants(",".join(chosen), RENDERED)
    scenes = SpeedJob(variants, [], job.frames, report.size, job.device).scenes()
    with counted_arithmetic() as counter, _opened_as_reported(job) as gpu:
        take = prepare_take(progress).at(report.size)
        for name, motions in chosen.items():
            with rendering(gpu, scenes[name]) as renderer:
                renderer.render(take.standing[0])
                for motion in progress.track(motions, description=f"counting {name}"):
                    steps = steps_of(motion, take, scenes[name], WARM_UP_FRAMES + job.frames)
                    counts = _count_motion(renderer, counter, steps)
                    moved = {} if renderer.graph is None else stage_bytes(renderer.graph)
                    require_sizes(name, report.methods[name].motions[motion], moved)
                    report = with_arithmetic(report, name, motion, counts)
                    keep(report)
    return report


def _only(report: SpeedReport, chosen: Mapping[str, Sequence[str]]) -> SpeedReport:
    """Returns the chosen methods and motions of a report."""
    methods = {
        name: report.methods[name].model_copy(
            update={"motions": {motion: report.methods[name].motions[motion] for motion in motions}}
        )
        for name, motions in chosen.items()
    }
    return report.model_copy(update={"methods": methods})


def require_sizes(method: str, found: MotionFigures, moved: Mapping[str, int]) -> None:
    """Checks that stages hold about as much here (`moved`, bytes by stage) as in the report.

    Raises:
        DeltalightError: they do not; volumes whose size no setting names are as large as the machine allows.
    """
    both = [
        (stage.moved_bytes, moved[name])
        for name, stage in found.stages.items()
        if stage.moved_bytes is not None and name in moved
    ]
    reported, here = (sum(each) for each in zip((0, 0), *both, strict=True))
    if not reported / ALIKE <= here <= reported * ALIKE:
        raise DeltalightError(
            f"The stages of {method} hold {reported / 1e6:.0f} MB in the report and {here / 1e6:.0f} MB here, so "
            "their arithmetic differs too: give `bench speed --methods` the size of the volume (volume_size=64)."
        )


def with_arithmetic(report: SpeedReport, method: str, motion: str, counts: Mapping[str, Cost]) -> SpeedReport:
    """Returns the report with what each stage of a motion computes, and floors that heed it."""
    figures = report.methods[method]
    found = figures.motions[motion]
    stages = {
        name: _with_cost(stage, counts[name], report.peaks) if name in counts else stage
        for name, stage in found.stages.items()
    }
    motions = {**figures.motions, motion: found.model_copy(update={"stages": stages})}
    methods = {**report.methods, method: figures.model_copy(update={"motions": motions})}
    return report.model_copy(update={"methods": methods})


def _with_cost(stage: StageFigures, cost: Cost, peaks: Peaks) -> StageFigures:
    arithmetic_ms = 1000 * (cost.flops + cost.special) / peaks.flops_per_s
    memory_ms = 0.0 if stage.moved_bytes is None else 1000 * stage.moved_bytes / peaks.bytes_per_s
    changes = {
        "flops": cost.flops,
        "special_functions": cost.special,
        "arithmetic_floor_ms": arithmetic_ms,
        "floor_ms": max(arithmetic_ms, memory_ms),
    }
    return stage.model_copy(update=changes)


@contextmanager
def _opened_as_reported(job: RooflineJob) -> Iterator[GpuContext]:
    """Opens the OpenGL context, with the paths of a GPU if the report is of one."""
    with opened(job.device) as gpu:
        yield replace(gpu, is_software=gpu.is_software and is_software_renderer(job.report.renderer))


def _count_motion(
    renderer: SceneRenderer, counter: ArithmeticCounter, steps: Iterable[Step]
) -> dict[str, Cost]:
    """Returns each stage's arithmetic: medians over the frames in which it ran, after WARM_UP_FRAMES."""
    frames = []
    for step in steps:
        counter.take_stages()  # what ran between frames
        time_step(renderer, step)
        frames.append(counter.take_stages())
    measured = frames[WARM_UP_FRAMES:]
    names = {name for frame in measured for name in frame}
    return {name: _median([frame[name] for frame in measured if name in frame]) for name in names}


def _median(costs: Sequence[Cost]) -> Cost:
    flops, special = (np.median([getattr(each, name) for each in costs]) for name in ("flops", "special"))
    return Cost(int(flops), int(special))
