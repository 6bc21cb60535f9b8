"""The report of a soak: figures beside their bars, faults one by one, and the course of everything over time."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from deltalight.benchmarks.soak.profiles import Profile
from deltalight.protocol.documents import StrictModel

REPORT: Final = "deltalight bench soak"
LARGE = 1000.0  # without digits after the point


class Figure(StrictModel):
    """One figure of the table: how it was measured, what came out, the bar, and whether it is met."""

    what: str
    how: str
    result: str
    bar: str
    is_met: bool


class FaultRecord(StrictModel):
    """One fault: when it began and ended, in seconds from the first picture, and what came of it."""

    name: str
    began_s: float
    ended_s: float
    outcome: dict[str, Any]


Lines = Mapping[str, Sequence[float | None]]
"""Values at the times of the samples, by the name of a line in a plot; None where one is unknown."""


class Machine(StrictModel):
    """Where it was measured; `load_before` is the load average."""

    renderer: str
    cpus: int
    load_before: float


class SoakReport(StrictModel):
    """A whole soak.

    `orphans` counts processes that outlived it. `courses` are values at `times_s`, seconds from the first picture, by
    the plot's panel and line.
    """

    report: Literal["deltalight bench soak"] = REPORT
    version: str
    machine: Machine
    profile: str
    seed: int
    seconds: float
    pictures: int
    deaths: dict[str, int]
    orphans: int
    figures: list[Figure]
    faults: list[FaultRecord]
    times_s: list[float]
    courses: dict[str, dict[str, list[float | None]]]


@dataclass(frozen=True)
class Bar:
    """A bar for values of outcomes: `shown` is its text."""

    shown: str
    holds: Callable[[float], bool]


def worst(
    what: str, how: str, values: Sequence[float], bar: Bar, unit: str, *, smallest: bool = False
) -> Figure | None:
    """Returns the figure of the greatest of some values (or the smallest), with their range; None of none."""
    if not values:
        return None
    low, high = min(values), max(values)
    shown = " to ".join(dict.fromkeys((_number(low), _number(high))))
    return Figure(
        what=what,
        how=f"{how} ({len(values)})",
        result=f"{shown} {unit}".strip(),
        bar=bar.shown,
        is_met=bar.holds(low if smallest else high),
    )


def markdown(report: SoakReport, plot: str) -> str:
    """Returns the report as a page; `plot` is the name of the picture beside it."""
    lines = [
        "# Soak",
        "",
        f"`deltalight bench soak --profile {report.profile} --seed {report.seed}` of version {report.version} for "
        f"{report.seconds / 60:.1f} minutes; {report.machine.renderer}, {report.machine.cpus} CPUs, load before "
        f"{report.machine.load_before:.1f}.",
        "",
        f"![Age, rate, memory, handles, GL objects and drops over time]({plot})",
        "",
        *figure_rows(report.figures),
        "",
        "| fault | began, s | outcome |",
        "|---|--:|---|",
        *(f"| {each.name} | {each.began_s:.0f} | {_outcome(each.outcome)} |" for each in report.faults),
    ]
    return "\n".join(lines) + "\n"


def figure_rows(figures: Sequence[Figure]) -> list[str]:
    """Returns the lines of a table of figures, in Markdown."""
    head = ["| figure | how tested (times) | result | bar | met |", "|---|---|---|---|---|"]
    return [*head, *(_row(each) for each in figures)]


def print_figures(title: str, figures: Sequence[Figure], where: str) -> None:
    """Prints a table of figures, and `where` the files are."""
    from rich.console import Console
    from rich.table import Table

    table = Table("Figure", "How tested (times)", "Result", "Bar", "Met", title=title, title_justify="left")
    for each in figures:
        table.add_row(each.what, each.how, each.result, each.bar, "yes" if each.is_met else "no")
    console = Console()
    console.print(table)
    console.print(where)


def _row(figure: Figure) -> str:
    met = "yes" if figure.is_met else "**no**"
    return f"| {figure.what} | {figure.how} | {figure.result} | {figure.bar} | {met} |"


def _number(value: float) -> str:
    """Returns three significant digits, or all before the point."""
    return f"{value:.0f}" if abs(value) >= LARGE else f"{value:.3g}"


def _outcome(values: Mapping[str, Any]) -> str:
    shown = []
    for name, value in values.items():
        if isinstance(value, dict):
            shown.append(f"{name}: {_outcome(value)}")
        else:
            shown.append(f"{name.replace('_', ' ')} {_number(value) if isinstance(value, float) else value}")
    return "; ".join(shown)


def period_bar(profile: Profile) -> Bar:
    """Returns the bar of ages: two periods of a node."""
    limit_ms = 2 * profile.period_ms
    return Bar(f"< {limit_ms:.0f} ms (2 periods)", lambda value: value < limit_ms)
