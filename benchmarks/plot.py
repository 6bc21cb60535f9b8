"""Speed against quality as a picture: every method a point, by reports of `bench speed` and `bench quality`."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

from pydantic import BaseModel

from deltalight.benchmarks.quality import REPORT_KIND
from deltalight.benchmarks.speed.compare import require_alike
from deltalight.benchmarks.speed.report import SpeedReport, read_report
from deltalight.protocol.documents import read_mapping, validate
from deltalight.protocol.errors import DeltalightError
from deltalight.services.svg import GREY, INK, LETTER, Point, as_text, new_svg, rect, text

SIZE = (960, 600)
LEFT, TOP, RIGHT, BOTTOM = 64.0, 92.0, 936.0, 540.0  # of the field
MARGIN_DB = 2.0  # beyond the best and the worst
MARGIN_MS = 1.5  # a factor, likewise
NAMED_SCENES = 4
TICKS = (1, 2, 5)
MARKER = 6.0
FONT = 14.0
GRID = "#e3e6ea"
QUALITY = ":quality="
COLORS = (
    *("#1d5fd0", "#c2410c", "#1a7f4b", "#7c3aed", "#9a6700", "#be185d"),
    *("#0e7490", "#4b5563", "#b91c1c", "#4d7c0f", "#312e81", "#78350f"),
)
MARKERS = {"best": "circle", "balanced": "diamond", "live": "triangle"}
DISTANCES = (1.0, 2.2, 3.6, 5.0, 7.0, 9.0, 12.0)  # of a label from its point, in lines of text
DIRECTIONS = ((1, 0), (0, -1), (0, 1), (-1, 0), (1, -1), (1, 1), (-1, -1), (-1, 1))

Box = tuple[float, float, float, float]  # left, top, right, bottom


@dataclass(frozen=True)
class Rated:
    """A method: the median of a frame's times, ms, and PSNR on the pixels that objects change, dB."""

    name: str
    ms: float
    db: float

    @property
    def family(self) -> str:
        """The method without its tier."""
        return self.name.partition(QUALITY)[0]

    @property
    def tier(self) -> str:
        """The tier of quality."""
        return self.name.partition(QUALITY)[2] or "best"

    @property
    def label(self) -> str:
        """What stands beside the point."""
        return self.name.replace(QUALITY, " ")


class _Means(BaseModel):
    """What is read of quality.json."""

    size: tuple[int, int]
    spp: int
    means: dict[str, dict[str, float | None]]
    scenes: dict[str, object]


@dataclass(frozen=True)
class Plot:
    """What is drawn, and the names that only one kind of report holds."""

    points: Sequence[Rated]
    left_out: Sequence[str]
    lines: Sequence[str]


def read_plot(speed: Sequence[Path], quality: Sequence[Path], motion: str) -> Plot:
    """Joins reports by the methods' names; of a method that several reports of one kind hold, the first counts.

    Raises:
        DeltalightError: a file is no such report, the reports of speed differ in machine or picture size, those of
            quality in scenes, picture size or light paths, or no method is in both kinds.
    """
    timed, rated = [read_report(path) for path in speed], [_read_means(path) for path in quality]
    for other in timed[1:]:
        require_alike(timed[0], other)
    for other_means in rated[1:]:
        _require_alike(rated[0], other_means)
    times_ms, means = _medians(timed, motion), rated[0]
    qualities = {
        name: figures.get("changed_psnr_db")
        for each in reversed(rated)
        for name, figures in each.means.items()
    }
    points = [Rated(name, ms, db) for name, ms in times_ms.items() if (db := qualities.get(name)) is not None]
    if not points:
        raise DeltalightError(
            f"No method is both in {', '.join(map(str, quality))} and, moving as in `{motion}`, in "
            f"{', '.join(map(str, speed))}; "
            "give both commands the same --methods."
        )
    drawn = {point.name for point in points}
    left_out = [name for name in dict.fromkeys([*times_ms, *qualities]) if name not in drawn]
    return Plot(points, left_out, _captions(timed[0], means, motion))


def _medians(reports: Sequence[SpeedReport], motion: str) -> dict[str, float]:
    found: dict[str, float] = {}
    for report in reports:
        for name, method in report.methods.items():
            if motion in method.motions:
                found.setdefault(name, method.motions[motion].frame_ms.median)
    return found


def _read_means(path: Path) -> _Means:
    data = read_mapping(path)
    if data.get("kind") != REPORT_KIND:
        raise DeltalightError(
            f"{path} is not a report of `bench quality`; give the quality.json in the folder of its --out."
        )
    return validate(_Means, data, str(path))


def _require_alike(one: _Means, other: _Means) -> None:
    of = [(sorted(each.scenes), each.size, each.spp) for each in (one, other)]
    for kind, first, second in zip(("scenes", "picture sizes", "light paths"), *of, strict=True):
        if first != second:
            raise DeltalightError(
                f"The reports of quality are of different {kind} ({first}; {second}), so their means cannot be "
                "compared."
            )


def _captions(speed: SpeedReport, quality: _Means, motion: str) -> list[str]:
    sizes = ["x".join(map(str, size)) for size in (speed.size, quality.size)]
    names = list(quality.scenes)
    scenes = ", ".join(names) if len(names) <= NAMED_SCENES else f"{len(names)} scenes"
    return [
        f"Speed: {speed.machine}, {sizes[0]}, median of {speed.frames} frames, motion `{motion}`",
        f"Quality: {scenes}, {sizes[1]}, mean against {quality.spp} light paths a pixel",
    ]


def draw_plot(plot: Plot) -> str:
    """Draws the points as text of an SVG file; lines join the tiers of a method."""
    svg = new_svg("Speed against quality", SIZE)
    text(svg, (LEFT, 30), "Speed against quality", 20, INK, bold=True)
    for number, line in enumerate(plot.lines):
        text(svg, (LEFT, 52 + 18 * number), line, 12.5, GREY)
    scale = Scale.of(plot.points)
    _draw_field(svg, scale)
    families = dict.fromkeys(point.family for point in plot.points)
    colors = {family: COLORS[number % len(COLORS)] for number, family in enumerate(families)}
    places = [scale.place(point) for point in plot.points]
    lines = list[tuple[Point, Point]]()
    for family, color in colors.items():
        of_family = [scale.place(point) for point in plot.points if point.family == family]
        for start, end in pairwise(of_family):
            lines.append((start, end))
            _line(svg, start, end, color, **{"stroke-width": "1.5", "stroke-opacity": "0.45"})
    labels = place_labels(places, [point.label for point in plot.points], lines)
    for point, place, label in zip(plot.points, places, labels, strict=True):
        _draw_point(svg, point, place, label, colors[point.family])
    _draw_legend(svg, [tier for tier in MARKERS if any(point.tier == tier for point in plot.points)])
    return as_text(svg)


@dataclass(frozen=True)
class Scale:
    """The field's edges: ms, logarithmic, from left to right, dB from bottom to top."""

    ms: tuple[float, float]
    db: tuple[float, float]

    @classmethod
    def of(cls, points: Sequence[Rated]) -> "Scale":
        """Around all points."""
        ms, db = [point.ms for point in points], [point.db for point in points]
        return cls(
            (min(ms) / MARGIN_MS, max(ms) * MARGIN_MS),
            (math.floor(min(db) - MARGIN_DB), math.ceil(max(db) + MARGIN_DB)),
        )

    def x(self, ms: float) -> float:
        """Pixels from the left."""
        low, high = self.ms
        return LEFT + (RIGHT - LEFT) * math.log(ms / low) / math.log(high / low)

    def y(self, db: float) -> float:
        """Pixels from the top."""
        low, high = self.db
        return BOTTOM - (BOTTOM - TOP) * (db - low) / (high - low)

    def place(self, point: Rated) -> Point:
        """Where a point lies."""
        return self.x(point.ms), self.y(point.db)

    def ticks_ms(self) -> Iterator[float]:
        """1, 2, 5, 10, ... within the field."""
        low, high = self.ms
        for power in range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1):
            yield from (tick * 10.0**power for tick in TICKS if low <= tick * 10.0**power <= high)

    def ticks_db(self) -> range:
        """Some ten at most."""
        low, high = (int(edge) for edge in self.db)
        step = next(step for step in (1, 2, 5, 10, 20, 50) if (high - low) / step <= 10)
        return range(-(-low // step) * step, high + 1, step)


def _draw_field(svg: ElementTree.Element, scale: Scale) -> None:
    for ms in scale.ticks_ms():
        x = scale.x(ms)
        _line(svg, (x, TOP), (x, BOTTOM), GRID)
        _centred(svg, (x, BOTTOM + 18), f"{ms:g}")
    for db in scale.ticks_db():
        y = scale.y(db)
        _line(svg, (LEFT, y), (RIGHT, y), GRID)
        text(svg, (LEFT - 26, y + 4), f"{db}", 12, GREY)
    rect(svg, (LEFT, TOP, RIGHT - LEFT, BOTTOM - TOP), fill="none", stroke=GREY)
    _centred(svg, ((LEFT + RIGHT) / 2, BOTTOM + 40), "ms a frame, logarithmic: faster to the left")
    upright = text(svg, (0, 0), "dB on what objects change: better upwards", 12.5, GREY)
    upright.set("transform", f"translate(22 {(TOP + BOTTOM) / 2:.1f}) rotate(-90)")
    upright.set("text-anchor", "middle")


def _draw_point(svg: ElementTree.Element, point: Rated, place: Point, label: Box, color: str) -> None:
    group = ElementTree.SubElement(svg, "g")
    ElementTree.SubElement(group, "title").text = f"{point.label}: {point.ms:.0f} ms, {point.db:.1f} dB"
    nearest = _clamped(place, label)
    if math.dist(place, nearest) > 2 * MARKER:
        _line(group, place, nearest, color, **{"stroke-width": "0.8"})
    _draw_marker(group, point.tier, place, color)
    text(group, (label[0], label[3] - 0.3 * FONT), point.label, FONT, color)


def _draw_marker(parent: ElementTree.Element, tier: str, place: Point, color: str) -> None:
    x, y = place
    if MARKERS.get(tier, "circle") == "circle":
        at = {"cx": f"{x:.1f}", "cy": f"{y:.1f}", "r": f"{MARKER:g}"}
        ElementTree.SubElement(parent, "circle", {**at, "fill": color})
        return
    r = 1.2 * MARKER
    outline = f"l{r} {r}l-{r} {r}l-{r} -{r}z" if tier == "balanced" else f"l{r} {1.8 * r}h-{2 * r}z"
    ElementTree.SubElement(parent, "path", {"d": f"M{x:.1f} {y - r:.1f}{outline}", "fill": color})


def _draw_legend(svg: ElementTree.Element, tiers: Sequence[str]) -> None:
    for number, tier in enumerate(tiers if len(tiers) > 1 else ()):
        x = RIGHT - 90 * (len(tiers) - number) + 20
        _draw_marker(svg, tier, (x, 26), GREY)
        text(svg, (x + 12, 30), tier, 12.5, GREY)


def place_labels(
    points: Sequence[Point], labels: Sequence[str], lines: Sequence[tuple[Point, Point]] = ()
) -> list[Box]:
    """Finds a box for each label, near its point, that meets no other label, marker or line, and stays in the field.

    Greedy: the first free place, outwards. Where there is none, which takes more labels than the field holds, a label
    stands beside its point.
    """
    reach = MARKER + 2
    taken = [_square(point, reach) for point in points]
    taken += [_square(point, 1) for line in lines for point in _along(*line)]
    placed: list[Box] = []
    for point, label in zip(points, labels, strict=True):
        candidates = list(_around(point, label))
        free = (box for box in candidates if _inside(box) and not any(_meet(box, other) for other in taken))
        placed.append(next(free, candidates[0]))
        taken.append(placed[-1])
    return placed


def _square(centre: Point, reach: float) -> Box:
    return centre[0] - reach, centre[1] - reach, centre[0] + reach, centre[1] + reach


def _along(start: Point, end: Point) -> Iterator[Point]:
    """Points of a line, a few pixels apart."""
    count = 1 + int(math.dist(start, end) / 4)
    for number in range(count + 1):
        fraction = number / count
        yield start[0] + fraction * (end[0] - start[0]), start[1] + fraction * (end[1] - start[1])


def _around(point: Point, label: str) -> Iterator[Box]:
    width, height = LETTER * FONT * len(label) + 4, 1.2 * FONT
    for distance in DISTANCES:
        for right, down in DIRECTIONS:
            x = point[0] + right * (width / 2 + MARKER + 3 + (distance - 1) * FONT)
            y = point[1] + down * (height / 2 + MARKER + 1 + (distance - 1) * FONT)
            yield x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _inside(box: Box) -> bool:
    return box[0] > LEFT and box[1] > TOP and box[2] < RIGHT and box[3] < BOTTOM


def _meet(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _clamped(point: Point, box: Box) -> Point:
    """The point of a box that is nearest."""
    return min(max(point[0], box[0]), box[2]), min(max(point[1], box[1]), box[3])


def _line(parent: ElementTree.Element, start: Point, end: Point, color: str, **style: str) -> None:
    path = f"M{start[0]:.1f} {start[1]:.1f}L{end[0]:.1f} {end[1]:.1f}"
    ElementTree.SubElement(parent, "path", {"d": path, "fill": "none", "stroke": color, **style})


def _centred(parent: ElementTree.Element, place: Point, words: str) -> None:
    text(parent, place, words, 12.5, GREY).set("text-anchor", "middle")
