"""`deltalight bench speed`, `bench counts`, `bench kernels` and `bench roofline` with parsed options."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from json import dumps
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from deltalight.benchmarks.report_output import put_report
from deltalight.benchmarks.speed.compare import compare_reports, print_comparison
from deltalight.benchmarks.speed.counts import count_frames, print_counts
from deltalight.benchmarks.speed.kernel_times import print_kernels, time_kernels
from deltalight.benchmarks.speed.measure import Keep, SpeedJob, measure_speed
from deltalight.benchmarks.speed.report import SpeedReport
from deltalight.benchmarks.speed.roofline import RooflineJob, count_roofline
from deltalight.benchmarks.speed.sweep import as_data, measure_sweeps, print_sweeps
from deltalight.benchmarks.speed.tables import print_report
from deltalight.protocol.files import write_bytes


def run_speed(job: SpeedJob, budget_ms: float, *, end_to_end: bool, out: Path | None, as_json: bool) -> None:
    """Measures, writes the report to `out` if given after every motion, and prints it, also if stopped before."""
    with _kept(out, as_json=as_json) as keep, _progress() as progress:
        measure_speed(job, budget_ms, progress, keep, end_to_end=end_to_end)


def run_roofline(job: RooflineJob, *, out: Path | None, as_json: bool) -> None:
    """Counts, writes the report to `out` if given after every motion, and prints it, also if it is stopped before."""
    with _kept(out, as_json=as_json) as keep, _progress() as progress:
        count_roofline(job, progress, keep)


@contextmanager
def _kept(out: Path | None, *, as_json: bool) -> Iterator[Keep]:
    """Gives what takes a report that grows and writes it to `out`, and prints the newest at the end."""
    newest: SpeedReport | None = None

    def keep(report: SpeedReport) -> None:
        nonlocal newest
        newest = report
        if out is not None:
            write_bytes(out, _as_text(report).encode())

    try:
        yield keep
    finally:  # Ctrl-C, or a method that fails after others were measured
        if newest is not None:
            _print_speed(newest, as_json=as_json)


def _as_text(report: SpeedReport) -> str:
    return report.model_dump_json(indent=2)


def _print_speed(report: SpeedReport, *, as_json: bool) -> None:
    if as_json:
        print(_as_text(report))
    else:
        print_report(report, Console())


def run_counts(job: SpeedJob, *, gpu_paths: bool, out: Path | None, as_json: bool) -> None:
    """Counts, writes the report to `out` if given, and prints it."""
    with _progress() as progress:
        report = count_frames(job, progress, gpu_paths=gpu_paths)
    put_report(
        report.model_dump_json(indent=2), lambda: print_counts(report, Console()), out=out, as_json=as_json
    )


def run_kernels(job: SpeedJob, *, out: Path | None, as_json: bool) -> None:
    """Times kernels one by one, writes the report to `out` if given, and prints it."""
    with _progress() as progress:
        report = time_kernels(job, progress)
    put_report(
        report.model_dump_json(indent=2), lambda: print_kernels(report, Console()), out=out, as_json=as_json
    )


def run_sweeps(
    frames: int,
    size: tuple[int, int] | None,
    device: int | None,
    *,
    full: bool,
    out: Path | None,
    as_json: bool,
) -> None:
    """Measures the dissertation's sweeps, writes them to `out` if given, and prints them."""
    with _progress() as progress:
        measured = measure_sweeps(frames, size, device, progress, full=full)
    put_report(
        dumps(as_data(measured), indent=2),
        lambda: print_sweeps(measured, Console()),
        out=out,
        as_json=as_json,
    )


def run_comparison(before: Path, after: Path, *, as_json: bool) -> None:
    """Compares two reports and prints the comparison."""
    rows = compare_reports(before, after)
    if as_json:
        print(dumps([{**asdict(row), "ratio": row.ratio, "slower": row.is_slower} for row in rows], indent=2))
    else:
        print_comparison(rows, Console())


@contextmanager
def _progress() -> Iterator[Progress]:
    """Shows progress on stderr, seldom redrawn: that takes time from what is measured."""
    console = Console(stderr=True)
    hidden = not console.is_terminal
    with Progress(console=console, transient=True, refresh_per_second=1, disable=hidden) as progress:
        yield progress
