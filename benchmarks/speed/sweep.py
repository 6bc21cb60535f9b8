"""The sweeps of the dissertation ([D] 4.2, 5.2 to 5.4): what stages take as a size grows, beside the published times.

Published: GeForce GTX 470 to GTX 780 with scenes of their own; ours: the demo on this machine. Compare how times
grow, not the times.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.progress import Progress

from deltalight.benchmarks.speed.measure import SpeedJob, measure_speed, opened
from deltalight.benchmarks.speed.motions import Take, prepare_take
from deltalight.benchmarks.speed.report import MotionFigures, SpeedReport
from deltalight.benchmarks.speed.tables import MISSING, figure_table
from deltalight.benchmarks.variants import RENDERED, parse_variants
from deltalight.protocol.errors import DeltalightError

BUDGET_MS = 100.0
ALL_STAGES: tuple[str, ...] = ()


@dataclass(frozen=True)
class Point:
    """A row: size in words, the method with that size, published times (ms) by column, and whether 2 CPUs do it.

    `method` None: this project has nothing of that size.
    """

    size: str
    method: str | None
    published_ms: Sequence[float | None]
    is_small: bool


@dataclass(frozen=True)
class Sweep:
    """A table: columns are sums of stages, named as in the dissertation; `motion` is what makes them run.

    A column of ALL_STAGES is the sum of all.
    """

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
        128: (79.96, 158.36, 304.57, 625.89, 1250.5),
    }
    small = {16: 64, 32: 64, 64: 32, 128: 16}  # most steps that two CPUs do in seconds
    for cells, times_ms in published.items():
        for power, steps in enumerate((16, 32, 64, 128, 256)):
            known = times_ms[power] if power < len(times_ms) else None
            method = f"dlpv-paper:volume_size={cells},steps={steps},objects_steps=1,direct_steps=0"
            yield Point(f"{cells}^3, {steps} steps", method, (known,), steps <= small[cells])


def _lights() -> Iterator[Point]:
    """[D] compares DLPVs, each of whose texels is a virtual light (the last row), with splatting of fewer lights."""
    method = "dlpv-paper:steps=32,rsm_size="
    yield Point("1024 lights", None, (5.81,), is_small=True)
    yield Point("4096 lights", None, (9.8,), is_small=True)
    yield Point("16384 lights", f"{method}128", (11.23,), is_small=True)
    yield Point("262144 lights", f"{method}512", (9.6,), is_small=True)


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
        {"shading": ("ambient occlusion", "image-based radiance")},
        tuple(_pictures("image_based", (1.3, 6.1, 14.4))),
    ),
    Sweep(
        "Shading by precomputed transfer by picture ([D] table 4.1)",
        "camera",
        {"shading": ("transferred light", "precomputed radiance")},
        tuple(_pictures("precomputed", (0.02, 0.021, 0.04))),
    ),
    Sweep(
        "Image-based shading by samples, 1280x720 ([D] figure 4.5)",
        "camera",
        {"shading": ("image-based radiance",)},
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
        "Pictures by DLPV beside multi-resolution splatting at 10 degrees ([D] table 5.5, figure 5.9)",
        "lamps",
        {"all stages": ALL_STAGES},
        tuple(_lights()),
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
    """A sweep with the times found: by method, of the motion that it asks for; or the sentence that refuses it."""

    sweep: Sweep
    points: Sequence[Point]
    reports: Mapping[str, SpeedReport]
    refused: Mapping[str, str] = field(default_factory=dict)

    def column_ms(self, point: Point, stages: Sequence[str]) -> float | None:
        """Returns the summed medians of the stages that ran; None if none did."""
        found = self.figures(point)
        if found is None:
            return None
        if stages == ALL_STAGES:
            return found.stages_ms.median
        times = [found.stages[stage].ms.median for stage in stages if stage in found.stages]
        return sum(times) if times else None

    def figures(self, point: Point) -> MotionFigures | None:
        """Returns what was measured at a point; None: nothing of that size, or refused."""
        report = None if point.method is None else self.reports.get(point.method)
        return None if report is None else report.methods[str(point.method)].motions[self.sweep.motion]

    def frame_ms(self, point: Point) -> float | None:
        """Returns the median of the whole frames; None as in `figures`."""
        found = self.figures(point)
        return None if found is None else found.frame_ms.median


def measure_sweeps(
    frames: int, size: tuple[int, int] | None, device: int | None, progress: Progress, *, full: bool
) -> list[Measured]:
    """Measures the small points of every sweep, or all; what this machine refuses is listed with the reason.

    Raises:
        DeltalightError: no OpenGL, missing demo files, or a machine that refuses every size.
    """
    take = prepare_take(progress)
    with opened(device):
        pass  # what this refuses, no point could do
    found = [_measured(sweep, frames, size, device, progress, take, full=full) for sweep in SWEEPS]
    if not any(each.reports for each in found):
        raise DeltalightError(next(reason for each in found for reason in each.refused.values()))
    return found


def _measured(  # noqa: PLR0917 (as the command has them)
    sweep: Sweep,
    frames: int,
    size: tuple[int, int] | None,
    device: int | None,
    progress: Progress,
    take: Take,
    *,
    full: bool,
) -> Measured:
    points = [point for point in sweep.points if full or point.is_small]
    reports: dict[str, SpeedReport] = {}
    refused: dict[str, str] = {}
    for method in (point.method for point in points if point.method is not None):
        job = SpeedJob(parse_variants(method, RENDERED), [sweep.motion], frames, size, device)
        try:
            reports[method] = measure_speed(
                job, BUDGET_MS, progress, lambda _: None, end_to_end=False, take=take
            )
        except DeltalightError as error:
            refused[method] = str(error)
    return Measured(sweep, points, reports, refused)


def print_sweeps(measured: Sequence[Measured], console: Console) -> None:
    """Prints a table of each sweep, ms: our times, then the published ones ([D]); after that, what was refused."""
    for each in measured:
        headings = [text for name in each.sweep.columns for text in (name, "[D]")]
        table = figure_table(f"{each.sweep.title}, ms", ("Size",), (*headings, "frame"))
        for point in each.points:
            table.add_row(point.size, *_cells(each, point), _shown(each.frame_ms(point), 1))
        console.print(table)
        for method, sentence in each.refused.items():
            console.print(f"{method}: {sentence}", markup=False, highlight=False, soft_wrap=True)


def _cells(each: Measured, point: Point) -> Iterator[str]:
    for stages, published_ms in zip(each.sweep.columns.values(), point.published_ms, strict=True):
        yield _shown(each.column_ms(point, stages), 2)
        yield MISSING if published_ms is None else f"{published_ms:g}"


def _shown(time_ms: float | None, digits: int) -> str:
    return MISSING if time_ms is None else f"{time_ms:.{digits}f}"


def as_data(measured: Sequence[Measured]) -> dict[str, Any]:
    """Returns the times as JSON; null where nothing was published, no such stage ran, or the machine refused."""
    first = next(report for each in measured for report in each.reports.values())
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
                "frame_ms": each.frame_ms(point),
                "ms": {name: each.column_ms(point, stages) for name, stages in each.sweep.columns.items()},
                "published_ms": dict(zip(names, point.published_ms, strict=True)),
                **({"refused": reason} if (reason := each.refused.get(point.method or "")) else {}),
            }
            for point in each.points
        ],
    }
