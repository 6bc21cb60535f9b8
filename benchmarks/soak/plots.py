"""The course of a soak as a picture: panels above each other, with the faults as bands."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from xml.etree import ElementTree

from deltalight.benchmarks.plot import COLORS, GRID
from deltalight.benchmarks.soak.report import FaultRecord, Lines, SoakReport
from deltalight.services.svg import BOLD_LETTER, GREY, INK, LETTER, Point, as_text, new_svg, rect, text

WIDTH, HEIGHT = 960.0, 130.0  # of the picture, and of each panel
LEFT, RIGHT, TOP, GAP = 60.0, 940.0, 128.0, 42.0
BAND = "#f6e3c8"
FONT = 12.0
TICKS = 8
ROWS, A_ROW = 3, 14  # lines of names of faults, and names in one


def draw_soak(report: SoakReport) -> str:
    """Draws the courses of a report as text of an SVG file."""
    panels = list(report.courses.items())
    bottom = TOP + len(panels) * (HEIGHT + GAP)
    svg = new_svg("Soak", (WIDTH, bottom))
    text(svg, (LEFT, 28), "A station under faults", 20, INK, bold=True)
    text(svg, (LEFT, 48), _caption(report), 12.5, GREY)
    _name_faults(svg, report.faults, _Axes(TOP, report.seconds))
    for number, (title, lines) in enumerate(panels):
        _draw_panel(svg, TOP + number * (HEIGHT + GAP), title, lines, report)
    return as_text(svg)


def _caption(report: SoakReport) -> str:
    machine = report.machine
    return f"{machine.renderer}, {machine.cpus} CPUs; profile {report.profile}, seed {report.seed}; seconds"


@dataclass(frozen=True)
class _Axes:
    """The place of a panel: its upper edge, its time and the greatest value that it shows."""

    top: float
    end_s: float
    high: float = 1.0

    def x(self, at_s: float) -> float:
        return LEFT + (RIGHT - LEFT) * min(max(at_s / self.end_s, 0.0), 1.0)

    def y(self, value: float) -> float:
        return self.top + HEIGHT * (1 - min(value / self.high, 1.0))


def _name_faults(svg: ElementTree.Element, faults: Sequence[FaultRecord], axes: _Axes) -> None:
    """Numbers the bands above the first panel, and lists their names."""
    free = -math.inf
    for number, fault in enumerate(faults, start=1):
        x = axes.x(fault.began_s)
        if x > free:
            label = text(svg, (x, TOP - 22), str(number), 10, GREY)
            ElementTree.SubElement(label, "title").text = fault.name
            free = x + 10 * LETTER * len(str(number)) + 2
    names = [f"{number} {fault.name}" for number, fault in enumerate(faults, start=1)]
    for row in range(ROWS):
        text(svg, (LEFT, 64 + 11 * row), "  ".join(names[row * A_ROW : (row + 1) * A_ROW]), 9, GREY)


def _draw_panel(svg: ElementTree.Element, top: float, title: str, lines: Lines, report: SoakReport) -> None:
    known = [value for values in lines.values() for value in values if value is not None]
    axes = _Axes(top, report.seconds, nice_ceiling(max(known, default=1.0)))
    for fault in report.faults:
        left, right = axes.x(fault.began_s), axes.x(fault.ended_s)
        rect(svg, (left, top, max(right - left, 1.0), HEIGHT), fill=BAND)
    _draw_ticks(svg, axes)
    text(svg, (LEFT, top - 6), title, FONT, INK, bold=True)
    x = LEFT + BOLD_LETTER * FONT * len(title) + 20
    for (name, values), color in zip(lines.items(), COLORS, strict=False):
        text(svg, (x, top - 6), name, FONT, color)
        x += LETTER * FONT * len(name) + 18
        _path(svg, [_points(report.times_s, values, axes, run) for run in known_runs(values)], color)


def _draw_ticks(svg: ElementTree.Element, axes: _Axes) -> None:
    for value in (0.0, axes.high / 2, axes.high):
        y = axes.y(value)
        _path(svg, [[(LEFT, y), (RIGHT, y)]], GRID)
        text(svg, (4, y + 4), f"{value:g}", FONT, GREY)
    for tick in range(TICKS + 1):
        at_s = axes.end_s * tick / TICKS
        text(svg, (axes.x(at_s) - 8, axes.top + HEIGHT + 14), f"{at_s:.0f}", 10, GREY)


def known_runs(values: Sequence[float | None]) -> list[list[int]]:
    """Returns the indices of known values, a list for each run; the usual step from one to the next ends none."""
    known = [index for index, value in enumerate(values) if value is not None]
    steps = sorted(later - earlier for earlier, later in pairwise(known))
    usual = steps[(len(steps) - 1) // 2] if steps else 1
    runs: list[list[int]] = []
    for index in known:
        if runs and index - runs[-1][-1] <= usual:
            runs[-1].append(index)
        else:
            runs.append([index])
    return runs


def _points(
    times_s: Sequence[float], values: Sequence[float | None], axes: _Axes, indices: Sequence[int]
) -> list[Point]:
    places = [(times_s[index], values[index]) for index in indices]
    return [(axes.x(at_s), axes.y(value)) for at_s, value in places if value is not None]


def _path(svg: ElementTree.Element, runs: Sequence[Sequence[Point]], color: str) -> None:
    outline = "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in run) for run in runs if run)
    if outline:
        style = {"fill": "none", "stroke": color, "stroke-width": "1.2"}
        ElementTree.SubElement(svg, "path", {"d": outline, **style})


def nice_ceiling(value: float) -> float:
    """Returns the least of 1, 2, 5 times a power of ten that is no less than a value; 1 for none above 0."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 2, 5, 10) if value <= step * power * (1 + 1e-9))
