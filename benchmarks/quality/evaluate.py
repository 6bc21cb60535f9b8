"""The benchmark: every variant on every scene, against truth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from rich.progress import Progress

from deltalight.benchmarks.ground_truth.benchmark_scene import BenchmarkScene
from deltalight.benchmarks.ground_truth.truth import ensure_truth
from deltalight.benchmarks.quality.case import SceneCase
from deltalight.benchmarks.quality.ceiling import ideal_composite
from deltalight.benchmarks.quality.denoising import require_denoiser
from deltalight.benchmarks.quality.figures import Figures, mean_figures, scene_figures
from deltalight.benchmarks.quality.kept import KeptResults, VariantResult
from deltalight.benchmarks.quality.metrics import Picture
from deltalight.benchmarks.quality.path_tracing import trace_in_time
from deltalight.benchmarks.quality.renders import Rendered, render_variant
from deltalight.benchmarks.variants import TIMED_VARIANT, Variant
from deltalight.render_server.gpu.context import GpuContext, create_context

CEILING = Variant(
    "ceiling", "the camera's picture times the true change: what perfect relighting could reach", "camera"
)


@dataclass(frozen=True)
class QualityJob:
    """What to measure; `volume_size` None = the machine's default, `cache` None = the default cache of truth."""

    scenes: Sequence[BenchmarkScene]
    variants: Sequence[Variant]
    size: tuple[int, int]
    spp: int
    volume_size: int | None = None
    device: int | None = None
    cache: Path | None = None


@dataclass(frozen=True, eq=False)
class SceneResult:
    """One scene: every variant by name, and figures of truth itself."""

    scene: BenchmarkScene
    halves_psnr_db: float
    camera: Picture
    reference: Picture
    variants: dict[str, VariantResult]


@dataclass(frozen=True, eq=False)
class QualityResult:
    """All results."""

    job: QualityJob
    renderer: str
    scenes: list[SceneResult] = field(default_factory=list)

    @property
    def variants(self) -> list[Variant]:
        """Rows of the tables."""
        return [*self.job.variants, CEILING]

    def means(self) -> dict[str, Figures]:
        """Figures of each variant, mean over scenes."""
        return {
            variant.name: mean_figures(scene.variants[variant.name].figures for scene in self.scenes)
            for variant in self.variants
        }


def measure_quality(job: QualityJob, progress: Progress, kept: KeptResults | None = None) -> QualityResult:
    """Renders missing truth and measures every variant on every scene.

    What `kept` holds is taken from there, and every other result is put there as soon as it is known.

    Raises:
        DeltalightError: no OpenGL, truth is missing and cannot be rendered, or a variant cannot be used.
    """
    if any(variant.kind == "denoised path" for variant in job.variants):
        require_denoiser()
    gpu = create_context(job.device)
    try:
        result = QualityResult(job, gpu.renderer_name)
        steps = progress.add_task("measuring", total=len(job.scenes) * len(job.variants))
        for scene in job.scenes:
            truth = ensure_truth(scene, size=job.size, spp=job.spp, progress=progress, cache=job.cache)
            case = SceneCase.opened(truth)
            variants: dict[str, VariantResult] = {}
            for variant in job.variants:
                progress.update(steps, description=f"measuring {scene.name}: {variant.name}")
                measure = partial(_measure, gpu, case, variant, job.volume_size, variants)
                inputs = (gpu.renderer_name, truth.folder.name, variant, job.volume_size)
                variants[variant.name] = measure() if kept is None else kept.result(measure, *inputs)
                progress.advance(steps)
            variants[CEILING.name] = _ceiling(case)
            result.scenes.append(_scene_result(case, variants))
    finally:
        gpu.release()
    return result


def _measure(
    gpu: GpuContext,
    case: SceneCase,
    variant: Variant,
    volume_size: int | None,
    before: dict[str, VariantResult],
) -> VariantResult:
    match variant.kind:
        case "camera":
            rendered = Rendered([frame.sensor_without for frame in case.frames])
        case "path" | "denoised path" as kind:
            frame_ms = before[TIMED_VARIANT].figures["frame_ms"]
            rendered = trace_in_time(case, frame_ms, is_denoised=kind == "denoised path")
        case _:
            rendered = render_variant(gpu, case, variant, volume_size)
    return _result(case, rendered)


def _result(case: SceneCase, rendered: Rendered) -> VariantResult:
    figures = scene_figures(rendered.pictures, case)
    if rendered.frame_ms is not None:
        figures["frame_ms"] = rendered.frame_ms
    if rendered.delta_error is not None:
        figures["delta_error"] = rendered.delta_error
    shown = rendered.pictures[_shown_frame(case)]
    return VariantResult(figures, shown, rendered.is_repeatable, rendered.history_codes, rendered.note)


def _ceiling(case: SceneCase) -> VariantResult:
    """Returns perfect relighting without its energy: made of both halves of truth, it would count their noise."""
    result = _result(case, Rendered([ideal_composite(one) for one in case.frames]))
    result.figures["darkening"] = result.figures["brightening"] = math.nan
    return result


def _scene_result(case: SceneCase, variants: dict[str, VariantResult]) -> SceneResult:
    shown = case.frames[_shown_frame(case)]
    halves_db = min(frame.halves_psnr_db for frame in case.frames)
    return SceneResult(case.scene, halves_db, shown.sensor_without, shown.sensor_with, variants)


def _shown_frame(case: SceneCase) -> int:
    """Returns the middle of a sequence."""
    return len(case.frames) // 2
