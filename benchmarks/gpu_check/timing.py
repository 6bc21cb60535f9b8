"""Times of one method's frames: the one place that knows what `measure_speed` returns."""

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from deltalight.benchmarks.speed.motions import Take

BUDGET_MS = 100.0
MOTIONS = ("camera", "object", "still")


@dataclass(frozen=True)
class Timing:
    """Medians in milliseconds: of frames by motion, and of the stages while the camera moves by name.

    `submit_ms` is what the CPU takes to issue a stage: one that takes the GPU about as long may wait for the CPU.
    """

    frames_ms: dict[str, float]
    stages_ms: dict[str, float]
    submit_ms: dict[str, float]


def time_method(method: str, frames: int, size: tuple[int, int], volume: int) -> Timing:
    """Times a method on the demo; `size` in pixels, `volume` in voxels an edge where the method has voxels.

    Raises:
        DeltalightError: no OpenGL, missing demo files, or a volume beyond the memory budget.
    """
    from rich.progress import Progress

    from deltalight.benchmarks.speed.measure import SpeedJob, measure_speed
    from deltalight.benchmarks.variants import parse_variants

    (variant,) = parse_variants(method)
    if variant.kind in ("dvct", "differential"):
        variant = replace(variant, settings={**variant.settings, "volume_size": volume})
    job = SpeedJob([variant], MOTIONS, frames, size)
    progress = Progress(disable=True)
    report = measure_speed(job, BUDGET_MS, progress, lambda _: None, end_to_end=False, take=_prepared_take())
    motions = report.methods[method].motions
    stages = motions["camera"].stages
    return Timing(
        {motion: figures.frame_ms.median for motion, figures in motions.items()},
        {name: stage.ms.median for name, stage in stages.items()},
        {name: stage.submit_ms.median for name, stage in stages.items() if stage.submit_ms is not None},
    )


@cache
def _prepared_take() -> "Take":
    """Prepares the demo's frames, once for all methods: it takes some seconds."""
    from rich.progress import Progress

    from deltalight.benchmarks.speed.motions import prepare_take

    return prepare_take(Progress(disable=True))
