"""A frame's graph as a picture (SVG): what runs after what, what each stage follows, costs and holds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final
from xml.etree import ElementTree

from deltalight.render_server.graph_report import CLOCKS, Clock, SourceReport, StageReport
from deltalight.services.graph_layout import Arrow, Box, Layout, lay_out
from deltalight.services.svg import (
    BOLD_LETTER,
    FAINT,
    GREY,
    INK,
    LETTER,
    PANEL,
    Point,
    as_text,
    new_svg,
    rect,
    text,
)

WIDTH = 1600
MARGIN = 20
GAP = 0.22  # of a column: arrows run there
LINE = 16
TITLE = 30  # of a section
ROW_GAP = 14
CHANNEL = 34  # between bands
LANE = 6  # at most, between arrows side by side
LEGEND_TOP = 50
CARD_HEIGHT = 68  # of a clock in the legend
TEXT_LEFT = 14  # in a box
RADIUS = 8  # of an arrow's corners
LEAST_BYTES = 50_000  # that a box tells of

COLORS: Final[dict[Clock, str]] = {
    "scene": "#6b7280",
    "lights": "#c27803",
    "world": "#1a7f4b",
    "objects": "#7c3aed",
    "view": "#1d5fd0",
}
MEANINGS: Final[dict[Clock, str]] = {
    "scene": "the scene document changes",
    "lights": "light is measured or edited",
    "world": "the real scene shows something new",
    "objects": "an object is moved or animated",
    "view": "every camera frame",
}
NOTE = (
    "Colour: the fastest clock that a stage follows; dots: all of them. "
    "Faded: nothing that the stage reads has changed, so what it made before is kept. "
    "+: values that are put together for the stage."
)


@dataclass(frozen=True)
class _Metrics:
    """Where columns and bands of a layout lie, px."""

    layout: Layout
    box_width: float
    gap: float
    box_heights: tuple[float, ...]
    tops: tuple[float, ...]
    height: float

    def left(self, column: int) -> float:
        return MARGIN + self.gap / 2 + column * (self.box_width + self.gap)

    def top(self, band: int, row: int) -> float:
        return self.tops[band] + TITLE + row * (self.box_heights[band] + ROW_GAP)

    def middle(self, band: int, row: int) -> float:
        return self.top(band, row) + self.box_heights[band] / 2


def draw_graph(title: str, sources: Sequence[SourceReport], stages: Sequence[StageReport]) -> str:
    """The picture as text of an SVG file. Stages that did not run are faded; colours are the fastest clocks'."""
    layout = lay_out(stages)
    metrics = _measure(layout)
    svg = new_svg(title, (WIDTH, metrics.height))
    text(svg, (MARGIN, 34), title, 20, INK, bold=True)
    _draw_legend(svg, sources)
    _draw_sections(svg, metrics)
    _draw_arrows(svg, metrics)
    for box in layout.boxes:
        _draw_box(svg, metrics, box)
    return as_text(svg)


def _measure(layout: Layout) -> _Metrics:
    column = (WIDTH - 2 * MARGIN) / layout.columns
    gap, width = GAP * column, (1 - GAP) * column
    heights = tuple(
        max(_box_height(box, width) for box in layout.boxes if box.band == band)
        for band in range(len(layout.rows))
    )
    tops, y = [], float(LEGEND_TOP + CARD_HEIGHT + 36)
    for height, rows in zip(heights, layout.rows, strict=True):
        tops.append(y)
        y += TITLE + rows * (height + ROW_GAP) + CHANNEL
    return _Metrics(layout, width, gap, heights, tuple(tops), y - CHANNEL + MARGIN)


def _draw_legend(svg: ElementTree.Element, sources: Sequence[SourceReport]) -> None:
    """A card a clock: what advances it, and its sources; those that changed are black."""
    width = (WIDTH - 2 * MARGIN + 10) / len(CLOCKS)
    for index, clock in enumerate(CLOCKS):
        x = MARGIN + index * width
        rect(svg, (x, LEGEND_TOP, width - 10, CARD_HEIGHT), fill="white", stroke=COLORS[clock], rx="5")
        rect(svg, (x, LEGEND_TOP, 6, CARD_HEIGHT), fill=COLORS[clock])
        text(svg, (x + 18, LEGEND_TOP + 21), clock, 15, COLORS[clock], bold=True)
        text(svg, (x + 18, LEGEND_TOP + 39), MEANINGS[clock], 12, GREY)
        own = [source for source in sources if source.clock == clock]
        line = text(svg, (x + 18, LEGEND_TOP + 57), "", 12, GREY)
        for source in own:
            name = ElementTree.SubElement(line, "tspan", {"fill": INK if source.changed else FAINT})
            name.text = source.name + ("" if source is own[-1] else ", ")
    text(svg, (MARGIN, LEGEND_TOP + CARD_HEIGHT + 22), NOTE, 12.5, GREY)


def _draw_sections(svg: ElementTree.Element, metrics: _Metrics) -> None:
    for section in metrics.layout.sections:
        x = metrics.left(section.first) - metrics.gap / 2 + 4
        rows = metrics.layout.rows[section.band]
        height = TITLE + rows * (metrics.box_heights[section.band] + ROW_GAP) + 2
        width = section.columns * (metrics.box_width + metrics.gap) - 8
        y = metrics.tops[section.band]
        rect(svg, (x, y, width, height), fill=PANEL, rx="8")
        text(svg, (x + 12, y + 21), section.name, 15, GREY, bold=True)


def _draw_arrows(svg: ElementTree.Element, metrics: _Metrics) -> None:
    crossing = [arrow.start for arrow in metrics.layout.arrows if arrow.crosses_bands]
    lanes = {box: lane for lane, box in enumerate(dict.fromkeys(crossing))}
    for arrow in sorted(metrics.layout.arrows, key=lambda arrow: arrow.start.stage.ran):
        path = _crossing_path(metrics, arrow, lanes) if arrow.crosses_bands else _path(metrics, arrow)
        color = COLORS[_fastest(arrow.start.stage)]
        faded = not arrow.start.stage.ran
        style = {"fill": "none", "stroke": color, "stroke-width": "1.6"}
        if faded:
            style |= {"stroke-opacity": "0.4"}
        ElementTree.SubElement(svg, "path", {"d": path, **style})
        _draw_head(svg, _entry(metrics, arrow), color, faded=faded)


def _exit(metrics: _Metrics, box: Box) -> Point:
    return metrics.left(box.column) + metrics.box_width, metrics.middle(box.band, box.row)


def _entry(metrics: _Metrics, arrow: Arrow) -> Point:
    """Where an arrow meets its box: arrows to one box in the order of where they come from."""
    box = arrow.end
    others = [each for each in metrics.layout.arrows if each.end is box]
    others.sort(key=lambda each: (each.start.band, each.start.row if each.row is None else each.row))
    shift = others.index(arrow) - (len(others) - 1) / 2
    return metrics.left(box.column), metrics.middle(box.band, box.row) + 11 * shift


def _path(metrics: _Metrics, arrow: Arrow) -> str:
    """Smooth steps through the gaps, straight along a row past the columns between."""
    start, end = _exit(metrics, arrow.start), _entry(metrics, arrow)
    path = f"M{start[0]:.1f} {start[1]:.1f}"
    if arrow.row is None:
        return path + _step(start, end)
    y = metrics.middle(arrow.end.band, arrow.row)
    first, last = (start[0] + metrics.gap, y), (end[0] - metrics.gap, y)
    return f"{path}{_step(start, first)}H{last[0]:.1f}{_step(last, end)}"


def _step(start: Point, end: Point) -> str:
    middle = (start[0] + end[0]) / 2
    return f"C{middle:.1f} {start[1]:.1f} {middle:.1f} {end[1]:.1f} {end[0]:.1f} {end[1]:.1f}"


def _crossing_path(metrics: _Metrics, arrow: Arrow, lanes: dict[Box, int]) -> str:
    """Down the gap beside its box, along the channel above the band that it leads to, and in; a lane a start."""
    start, end = _exit(metrics, arrow.start), _entry(metrics, arrow)
    lane = min(LANE, (CHANNEL - 4) / len(lanes))
    shift = lane * (lanes[arrow.start] - (len(lanes) - 1) / 2)
    channel = metrics.tops[arrow.end.band] - CHANNEL / 2 + shift
    corners = [
        (start[0] + metrics.gap / 2 + shift, start[1]),
        (start[0] + metrics.gap / 2 + shift, channel),
        (end[0] - metrics.gap / 2 + shift, channel),
        (end[0] - metrics.gap / 2 + shift, end[1]),
    ]
    path = f"M{start[0]:.1f} {start[1]:.1f}"
    for before, corner, after in zip([start, *corners], corners, [*corners[1:], end], strict=False):
        path += _rounded(before, corner, after)
    return f"{path}L{end[0]:.1f} {end[1]:.1f}"


def _rounded(before: Point, corner: Point, after: Point) -> str:
    """A line towards a corner and an arc around it."""
    near, far = (_toward(corner, other) for other in (before, after))
    return f"L{near[0]:.1f} {near[1]:.1f}Q{corner[0]:.1f} {corner[1]:.1f} {far[0]:.1f} {far[1]:.1f}"


def _toward(corner: Point, other: Point) -> Point:
    """The point of a side at most RADIUS from its corner; sides are level or upright."""
    x, y = other[0] - corner[0], other[1] - corner[1]
    fraction = min(RADIUS / max(abs(x), abs(y), RADIUS), 0.5)
    return corner[0] + fraction * x, corner[1] + fraction * y


def _draw_head(svg: ElementTree.Element, tip: Point, color: str, *, faded: bool) -> None:
    x, y = tip
    style = {"fill": color, **({"fill-opacity": "0.4"} if faded else {})}
    path = f"M{x:.1f} {y:.1f}l-8 -4v8z"
    ElementTree.SubElement(svg, "path", {"d": path, **style})


def _draw_box(svg: ElementTree.Element, metrics: _Metrics, box: Box) -> None:
    stage, color = box.stage, COLORS[_fastest(box.stage)]
    x, y = metrics.left(box.column), metrics.top(box.band, box.row)
    width, height = metrics.box_width, metrics.box_heights[box.band]
    group = ElementTree.SubElement(svg, "g")
    ElementTree.SubElement(group, "title").text = f"{stage.name}: {stage.summary}"
    line = (
        {"stroke": color, "stroke-width": "1.4"}
        if stage.ran
        else {"stroke": FAINT, "stroke-dasharray": "4 3"}
    )
    rect(group, (x, y, width, height), fill=_tint(color) if stage.ran else "white", rx="5", **line)
    rect(group, (x, y, 5, height), fill=color, **({} if stage.ran else {"fill-opacity": "0.4"}))
    for index, clock in enumerate(CLOCKS):
        fill = COLORS[clock] if clock in stage.clocks else "#e3e6ea"
        place = {"cx": f"{x + TEXT_LEFT + 4 + 11 * index:.1f}", "cy": f"{y + height - 11:.1f}", "r": "3.5"}
        ElementTree.SubElement(group, "circle", {**place, "fill": fill})
    for number, (words, size, bold) in enumerate(_lines(box, width)):
        ink = (INK if size > 12 else GREY) if stage.ran else FAINT if size < 12 else GREY
        text(group, (x + TEXT_LEFT, y + 20 + LINE * number), words, size, ink, bold=bold)


def _lines(box: Box, width: float) -> list[tuple[str, float, bool]]:
    """Name, what it costs and holds, and the values in it: text, size, whether it is bold."""
    room = width - TEXT_LEFT
    values = [word for name in box.values for word in f"+\N{NO-BREAK SPACE}{name}".split(" ")]
    return [
        *((text, 14.0, True) for text in _wrapped(box.stage.name.split(), room / (14 * BOLD_LETTER), " ")),
        *((text, 12.5, False) for text in _wrapped(_costs(box.stage), room / (12.5 * LETTER), ", ")),
        *((text, 11.0, False) for text in _wrapped(values, room / (11 * LETTER), " ")),
    ]


def _costs(stage: StageReport) -> list[str]:
    """Time when it last ran and memory, as far as they are known."""
    time = [] if stage.time_ms is None else [format_ms(stage.time_ms)]
    return time + [f"{stage.size_bytes / 1e6:.1f} MB"] * (stage.size_bytes >= LEAST_BYTES)


def format_ms(time_ms: float) -> str:
    """Milliseconds with three digits."""
    digits = 0 if time_ms >= 100 else 1 if time_ms >= 10 else 2
    return f"{time_ms:.{digits}f} ms"


def _box_height(box: Box, width: float) -> float:
    return 30 + LINE * max(len(_lines(box, width)), 2)


def _wrapped(words: Sequence[str], room: float, gap: str) -> list[str]:
    """Lines of words that have room for so many letters."""
    lines: list[str] = []
    for word in words:
        if lines and len(lines[-1] + gap + word) <= room:
            lines[-1] += gap + word
        else:
            lines.append(word)
    return lines


def _fastest(stage: StageReport) -> Clock:
    return stage.clocks[-1]


def _tint(color: str) -> str:
    """The colour mixed with nine parts of white."""
    channels = (int(color[at : at + 2], 16) for at in (1, 3, 5))
    return "#" + "".join(f"{round(255 - (255 - channel) / 10):02x}" for channel in channels)
