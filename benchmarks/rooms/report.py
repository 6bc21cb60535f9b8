"""The report on rooms: the gaps beside their bars, and every act by itself."""

from collections.abc import Mapping, Sequence
from typing import Final, Literal

from deltalight.benchmarks.rooms.acts import Act, ActRecord
from deltalight.benchmarks.soak.figures import ALL
from deltalight.benchmarks.soak.report import Bar, Figure, Machine, figure_rows, worst
from deltalight.protocol.documents import StrictModel

REPORT: Final = "deltalight bench rooms"


class RoomsReport(StrictModel):
    """All acts with all placers, and the table of their figures; `seconds` is the time that all took."""

    report: Literal["deltalight bench rooms"] = REPORT
    version: str
    machine: Machine
    times: int
    seconds: float
    figures: list[Figure]
    acts: list[ActRecord]


def all_figures(acts: Mapping[str, Mapping[str, Act]], records: Sequence[ActRecord]) -> list[Figure]:
    """Returns the table of `acts`, by placer and name: gaps, and what has to hold each time, 1 = it did."""
    figures = []
    for placer, of_placer in acts.items():
        own = [each for each in records if each.placer == placer]
        for name, act in of_placer.items():
            gaps_s = [each.gap_s for each in own if each.act == name]
            bar = Bar(f"<= {act.bar_s:g} s", act.bar_s.__ge__)
            figures.append(worst(f"{placer}: {act.what}", act.how, gaps_s, bar, "s"))
        for what, values in (
            ("picture equal", [each.same_picture for each in own]),
            ("epoch newer", [each.epoch_after > each.epoch_before for each in own]),
            ("taken over by a spare", [each.by_spare for each in own if of_placer[each.act].is_warm]),
        ):
            answers = [float(value) for value in values]
            figures.append(worst(f"{placer}: {what}", "after each, 1 = yes", answers, ALL, "", smallest=True))
    return [each for each in figures if each is not None]


def markdown(report: RoomsReport) -> str:
    """Returns the report as a page."""
    lines = [
        "# Rooms",
        "",
        f"`deltalight bench rooms --times {report.times}` of version {report.version}, {report.seconds / 60:.1f} "
        f"minutes; {report.machine.renderer}, {report.machine.cpus} CPUs, load before "
        f"{report.machine.load_before:.1f}.",
        "",
        *figure_rows(report.figures),
        "",
        "| placer | act | gap, s | by the spare | equal picture | epochs newer by | load before |",
        "|---|---|--:|---|---|--:|--:|",
        *(_act_row(each) for each in report.acts),
    ]
    return "\n".join(lines) + "\n"


def _act_row(act: ActRecord) -> str:
    spare, same = ("yes" if value else "no" for value in (act.by_spare, act.same_picture))
    newer = act.epoch_after - act.epoch_before
    return f"| {act.placer} | {act.act} | {act.gap_s:.2f} | {spare} | {same} | {newer} | {act.load:.1f} |"
