"""Two reports of `bench speed` side by side."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from deltalight.benchmarks.speed.report import MotionFigures, SpeedReport, read_report
from deltalight.benchmarks.speed.tables import figure_table
from deltalight.protocol.errors import DeltalightError

SLOWER = 1.05
"""Ratio above which a time is marked."""


@dataclass(frozen=True)
class Row:
    """One median (ms) in both reports; None where it did not run."""

    method: str
    motion: str
    name: str
    before_ms: float | None
    after_ms: float | None

    @property
    def ratio(self) -> float | None:
        """After over before."""
        return self.after_ms / self.before_ms if self.before_ms and self.after_ms is not None else None

    @property
    def is_slower(self) -> bool:
        """Whether it takes more than 5 % longer."""
        return self.ratio is not None and self.ratio > SLOWER


def compare_reports(before: Path, after: Path) -> list[Row]:
    """Compares the medians of all motions that both reports have.

    Raises:
        DeltalightError: a file is no report, or the two are of different machines or sizes, or share no motion.
    """
    old, new = read_report(before), read_report(after)
    require_alike(old, new)
    rows = list(_rows(old, new))
    if not rows:
        raise DeltalightError(f"{before} and {after} have no motion of the same method in common.")
    return rows


def require_alike(old: SpeedReport, new: SpeedReport) -> None:
    """Checks that times of two reports may stand beside each other.

    Raises:
        DeltalightError: they are of different machines or picture sizes.
    """
    sizes = ["x".join(map(str, each.size)) for each in (old, new)]
    for kind, first, second in (("machines", old.machine, new.machine), ("picture sizes", *sizes)):
        if first != second:
            raise DeltalightError(
                f"The reports are of different {kind} ({first}; {second}), so their times cannot be compared."
            )


def _rows(old: SpeedReport, new: SpeedReport) -> Iterator[Row]:
    for method in _common(old.methods, new.methods):
        motions = old.methods[method].motions, new.methods[method].motions
        for motion in _common(*motions):
            before, after = (medians(each[motion]) for each in motions)
            for name in dict.fromkeys([*before, *after]):
                yield Row(method, motion, name, before.get(name), after.get(name))


def _common(old: Mapping[str, object], new: Mapping[str, object]) -> list[str]:
    return [name for name in old if name in new]


def medians(found: MotionFigures) -> dict[str, float]:
    """Returns the medians (ms) of a motion's frame, of what lies outside its stages, and of each stage."""
    whole = {"frame": found.frame_ms, "submit to picture": found.picture_ms, "stages": found.stages_ms}
    times = {**whole, "outside stages": found.outside_ms}
    stages = {f"  {name}": stage.ms for name, stage in found.stages.items()}
    return {name: spread.median for name, spread in {**times, **stages}.items()}


def print_comparison(rows: list[Row], console: Console) -> None:
    """Prints a table for each motion by each method."""
    for method, motion in dict.fromkeys((row.method, row.motion) for row in rows):
        table = figure_table(f"{method}: {motion}", ("Stage",), ("A ms", "B ms", "B / A", ""))
        for row in rows:
            if (row.method, row.motion) == (method, motion):
                table.add_row(row.name, *_cells(row), style="bold red" if row.is_slower else None)
        console.print(table)
    count = sum(row.is_slower for row in rows)
    console.print(f"{count} of {len(rows)} medians are more than {SLOWER - 1:.0%} slower.")


def _cells(row: Row) -> list[str]:
    times = ["–" if each is None else f"{each:.2f}" for each in (row.before_ms, row.after_ms)]
    return [*times, "–" if row.ratio is None else f"{row.ratio:.2f}", "slower" if row.is_slower else ""]
