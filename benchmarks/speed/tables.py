"""The report of `bench speed` as tables."""

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from deltalight.benchmarks.speed.report import MethodFigures, MotionFigures, SpeedReport, Spread, StageFigures

MISSING = "–"


def print_report(report: SpeedReport, console: Console) -> None:
    """Prints how long frames took, then each method's stages, a table for each motion."""
    width, height = report.size
    console.print(f"{report.machine}, {width}x{height}, {report.frames} frames of each motion")
    console.print(
        f"memory {report.peaks.bytes_per_s / 1e9:.1f} GB/s, arithmetic {report.peaks.flops_per_s / 1e9:.1f} GFLOP/s"
    )
    console.print(frames_table(report))
    for method, figures in report.methods.items():
        for motion, of_motion in figures.motions.items():
            console.print(stages_table(f"{method}: {motion}", of_motion))
        _print_rest(console, method, figures)


def figure_table(title: str, names: Sequence[str], figures: Sequence[str]) -> Table:
    """Returns an empty table that fits into a narrow terminal: names to the left, figures to the right."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in names:
        table.add_column(name, overflow="fold", min_width=6)
    for heading in figures:
        table.add_column(heading, justify="right")
    return table


def frames_table(report: SpeedReport) -> Table:
    """Returns the frames' times: one row for each motion by each method."""
    headings = ("median", "p95", "picture", "submit", "stages", "outside", f"over {report.budget_ms:g}")
    table = figure_table("Frames, ms", ("Method", "Motion"), headings)
    for method, figures in report.methods.items():
        for motion, found in figures.motions.items():
            table.add_row(method, motion, *_frame_cells(found, report.frames))
        table.add_section()
    return table


def _frame_cells(found: MotionFigures, frames: int) -> list[str]:
    shown = (found.picture_ms, found.submit_ms, found.stages_ms, found.outside_ms)
    return [*_both(found.frame_ms), *(f"{each.median:.1f}" for each in shown), f"{found.late}/{frames}"]


def stages_table(title: str, found: MotionFigures) -> Table:
    """Returns the stages of one motion in the order in which they ran; with arithmetic, if it was counted."""
    counts = any(stage.flops is not None for stage in found.stages.values())
    counted, timed = (
        ("MB", "MFLOP", "special", "flops ms", "floor ms"),
        ("p95", "submit", "runs in", "MB", "floor ms"),
    )
    table = figure_table(title, ("Stage",), ("median ms", *(counted if counts else timed), "times floor"))
    for name, stage in found.stages.items():
        moved = MISSING if stage.moved_bytes is None else f"{stage.moved_bytes / 1e6:.1f}"
        floor = MISSING if stage.floor_ms is None else f"{stage.floor_ms:.3f}"
        times = MISSING if stage.times_floor is None else f"{stage.times_floor:.1f}"
        arithmetic = moved, *_arithmetic_cells(stage), floor
        further = arithmetic if counts else (*_run_cells(stage), moved, floor)
        table.add_row(name, f"{stage.ms.median:.2f}", *further, times)
    return table


def _run_cells(stage: StageFigures) -> tuple[str, str, str]:
    submit = MISSING if stage.submit_ms is None else f"{stage.submit_ms.median:.2f}"
    return f"{stage.ms.p95:.2f}", submit, f"{stage.runs:.0%}"


def _arithmetic_cells(stage: StageFigures) -> tuple[str, str, str]:
    """Returns operations, the fraction of special functions among them, and what they take at the peak."""
    if stage.flops is None or stage.special_functions is None:
        return MISSING, MISSING, MISSING
    total = stage.flops + stage.special_functions
    special = f"{stage.special_functions / total:.0%}" if total else MISSING
    return f"{total / 1e6:.2f}", special, f"{stage.arithmetic_floor_ms:.3f}"


def _both(spread: Spread, digits: int = 1) -> tuple[str, str]:
    return f"{spread.median:.{digits}f}", f"{spread.p95:.{digits}f}"


def _print_rest(console: Console, method: str, figures: MethodFigures) -> None:
    for notice in figures.notices:  # among them the memory of the volumes
        console.print(notice, markup=False)
    through = figures.end_to_end
    if through is not None:
        console.print(
            f"{method}, camera to viewer through all processes: {through.frames_per_s:.1f} frames/s,"
            f" age {through.age_median_ms:.0f} ms (p95 {through.age_p95_ms:.0f} ms)"
        )
        if through.settled_frames_per_s is not None:
            console.print(
                f"{method}, the later half of these pictures: {through.settled_frames_per_s:.1f} frames/s,"
                f" age {through.settled_age_median_ms:.0f} ms"
            )
