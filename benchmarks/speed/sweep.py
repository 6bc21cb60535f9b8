"""The sweeps of the dissertation ([D] 4.2, 5.2 to 5.4): what stages take as a size grows, beside the published times.

Published: GeForce GTX 470 to GTX 780 with scenes of their own; ours: the demo on this machine. Compare how times
grow, not the times.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.progress import Progress

from deltalight.benchmarks.speed.measure import SpeedJob, measure_speed
from deltalight.benchmarks.speed.report import MotionFigures, SpeedReport
from deltalight.benchmarks.speed.tables import MISSING, figure_table
from deltalight.benchmarks.variants import RENDERED, Variant, parse_variants

BUDGET_MS = 100.0


@dataclass(frozen=True)
class Point:
    """A row: size in words, the method with that size, published times (ms) by column, and whether 2 CPUs do it."""

    size: str
    method: str
    published_ms: Sequence[float | None]
    is_small: bool


@dataclass(frozen=True)
class Sweep:
    """A table: columns are sums of stages, named as in the dissertation; `motion` is what makes them run."""

    title: str
    motion: str
    columns: dict[str, tuple[str, ...]]
    points: Sequence[Point]


def _maps() -> Iterator[Point]:
    published = {
        256: (0.091, 0.184, 0.18),
        512: (0.462, 0.862, 0.895),
        1024: (2.108, 4.667, 4.494),
        2048: (10.74, 21.35, 20.215),
    }
    for edge, times_ms in published.items():
        yield Point(f"{edge}^2", f"dlpv-paper:rsm_size={edge}", times_ms, edge <= 512)


def _steps() -> Iterator[Point]:
    published: dict[int, tuple[float | None, ...]] = {
        16: (0.712, 1.815),
        32: (2.342, 4.552, 8.857),
        64: (11.148, 22.021, 43.23, 85.089),
    }
    for cells, times_ms in published.items():
        for power, steps in enumerate((16, 32, 64, 128, 256)):
            known = times_ms[power] if power < len(times_ms) else None
            method = f"dlpv-paper:volume_size={cells},steps={steps}"
            yield Point(f"{cells}^3, {steps} steps", method, (known,), cells <= 32 and steps <= 64)


def _volumes() -> Iterator[Point]:
    published = {
        64: (0.95, 1.19, 2.32, 3.47),
        128: (1.27, 1.45, 6.07, 5.33),
        256: (3.03, 3.29, 7.79, 8.70),
        512: (17.93, 205.66, 251.76, 24.47),
    }
    for voxels, times_ms in published.items():
        method = f"paper:volume_size={voxels},memory_budget_mb=65536"
        yield Point(f"{voxels}^3", method, times_ms, voxels == 64)


def _receivers() -> Iterator[Point]:
    """About as many pixels as [D] has vertices (100 first), each of which looks up its light."""
    published = {(16, 16): 3.22, (40, 25): 4.45, (400, 250): 27.39, (640, 480): 43.2}
    for (width, height), published_ms in published.items():
        picture = f"output.width={width},output.height={height}"
        method = f"aroof:rays=64,shading_scale=1,indirect=false,{picture}"
        yield Point(f"{width * height} pixels", method, (published_ms,), width <= 400)


def _shaded(name: str, samples: int, width: int, height: int) -> str:
    settings = {"name": name, "samples": samples}
    picture = {"width": width, "height": height}
    written = [f"shading.{key}={value}" for key, value in settings.items()]
    return f"raster:{','.join([*written, *(f'output.{key}={value}' for key, value in picture.items())])}"


def _pictures(shading: str, published_ms: Sequence[float]) -> Iterator[Point]:
    for (width, height), each_ms in zip(((640, 480), (1280, 720), (1920, 1080)), published_ms, strict=True):
        yield Point(f"{height} rows", _shaded(shading, 40, width, height), (each_ms,), height < 1080)


def _samples() -> Iterator[Point]:
    for samples, published_ms in {1: 0.028, 10: 0.546, 20: 1.538, 30: 2.328, 40: 3.162}.items():
        yield Point(
            f"{samples} samples", _shaded("image_based", samples, 1280, 720), (published_ms,), samples <= 20
        )


SWEEPS = (
    Sweep(
        "Image-based shading by picture, 40 samples ([D] 4.2)",
        "camera",
        {"shading": ("ambient occlusion", "image-based surface")},
        tuple(_pictures("image_based", (1.3, 6.1, 14.4))),
    ),
    Sweep(
        "Shading by precomputed transfer by picture ([D] table 4.1)",
        "camera",
        {"shading": ("transferred light", "precomputed surface")},
        tuple(_pictures("precomputed", (0.02, 0.021, 0.04))),
    ),
    Sweep(
        "Image-based shading by samples, 1280x720 ([D] figure 4.5)",
        "camera",
        {"shading": ("image-based surface",)},
        tuple(_samples()),
    ),
    Sweep(
        "Light that occlusion fields leave, by places that receive it ([D] table 5.1)",
        "camera",
        {"fields": ("occlusion real",)},
        tuple(_receivers()),
    ),
    Sweep(
        "Light injected into DLPVs by size of the shadow maps ([D] table 5.3)",
        "lamps",
        {"V_rho": ("inject real",), "V_delta": ("inject change",), "direct": ("inject direct",)},
        tuple(_maps()),
    ),
    Sweep(
        "Propagation of the DLPV by cells and steps ([D] table 5.4)",
        "lamps",
        {"propagation": ("propagate delta",)},
        tuple(_steps()),
    ),
    Sweep(
        "Delta voxel cone tracing as printed, by voxels ([D] table 5.7)",
        "arm",
        {
            "voxelization": ("voxelize real", "voxelize objects"),
            "split injection": ("split inject",),
            "filtering": ("filter",),
            "cones": ("cones",),
        },
        tuple(_volumes()),
    ),
)


@dataclass(frozen=True)
class Measured:
    """A sweep with the times found: by method, of the motion that it asks for."""

    sweep: Sweep
    points: Sequence[Point]
    report: SpeedReport

    def column_ms(self, point: Point, stages: Sequence[str]) -> float | None:
        """Return the summed medians of the stages that ran; None if none did."""
        ran = self.figures(point).stages
        times = [ran[stage].ms.median for stage in stages if stage in ran]
        return sum(times) if times else None

    def figures(self, point: Point) -> MotionFigures:
        """Return what was measured at a point."""
        return self.report.methods[point.method].motions[self.sweep.motion]


def measure_sweeps(
    frames: int, size: tuple[int, int] | None, device: int | None, progress: Progress, *, full: bool
) -> list[Measured]:
    """Measure the small points of every sweep, or all.

    Raises:
        DeltalightError: no OpenGL, missing demo files, or volumes beyond the GPU's memory.
    """
    return [_measured(sweep, frames, size, device, progress, full=full) for sweep in SWEEPS]


def _measured(
    sweep: Sweep,
    frames: int,
    size: tuple[int, int] | None,
    device: int | None,
    progress: Progress,
    *,
    full: bool,
) -> Measured:
    points = [point for point in sweep.points if full or point.is_small]
    job = SpeedJob(_variants(points), [sweep.motion], frames, size, device)
    report = measure_speed(job, BUDGET_MS, progress, lambda _: None, end_to_end=False)
    return Measured(sweep, points, report)


def _variants(points: Sequence[Point]) -> list[Variant]:
    return parse_variants(",".join(point.method for point in points), RENDERED)


def print_sweeps(measured: Sequence[Measured], console: Console) -> None:
    """Print a table of each sweep, ms: our times and, after them, the published ones ([D])."""
    for each in measured:
        headings = [text for name in each.sweep.columns for text in (name, "[D]")]
        table = figure_table(f"{each.sweep.title}, ms", ("Size",), (*headings, "frame"))
        for point in each.points:
            table.add_row(point.size, *_cells(each, point), f"{each.figures(point).frame_ms.median:.1f}")
        console.print(table)


def _cells(each: Measured, point: Point) -> Iterator[str]:
    for stages, published_ms in zip(each.sweep.columns.values(), point.published_ms, strict=True):
        ours_ms = each.column_ms(point, stages)
        yield MISSING if ours_ms is None else f"{ours_ms:.2f}"
        yield MISSING if published_ms is None else f"{published_ms:g}"


def as_data(measured: Sequence[Measured]) -> dict[str, Any]:
    """Return the times as JSON; null where nothing was published, or no such stage ran."""
    first = measured[0].report
    return {
        "report": "deltalight bench sweep",
        "version": first.version,
        "renderer": first.renderer,
        "cpus": first.cpus,
        "size": list(first.size),
        "frames": first.frames,
        "sweeps": [_sweep_data(each) for each in measured],
    }


def _sweep_data(each: Measured) -> dict[str, Any]:
    names = list(each.sweep.columns)
    return {
        "title": each.sweep.title,
        "motion": each.sweep.motion,
        "points": [
            {
                "size": point.size,
                "method": point.method,
                "frame_ms": each.figures(point).frame_ms.median,
                "ms": {name: each.column_ms(point, stages) for name, stages in each.sweep.columns.items()},
                "published_ms": dict(zip(names, point.published_ms, strict=True)),
            }
            for point in each.points
        ],
    }
