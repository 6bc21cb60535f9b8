"""Where the stages of a frame's graph stand in a picture: bands of sections, columns by dependency, rows."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from deltalight.render_server.graph_report import StageReport

LEAST_COLUMNS = 7  # that sections may share a band for


@dataclass(eq=False)
class Box:
    """A stage in the picture, with the value stages that serve it first; `column` and `row` are those of its band."""

    stage: StageReport
    values: list[str] = field(default_factory=list)
    band: int = 0
    column: int = 0
    row: int = 0


@dataclass(frozen=True, eq=False)
class Arrow:
    """One box is needed by another. `row`: where it passes columns that stand between them in one band."""

    start: Box
    end: Box
    row: int | None = None

    @property
    def crosses_bands(self) -> bool:
        """Whether it leaves its band."""
        return self.start.band != self.end.band


@dataclass(frozen=True)
class Section:
    """A named group of boxes: `columns` of a band from `first` on."""

    name: str
    band: int
    first: int
    columns: int


@dataclass(frozen=True)
class Layout:
    """Boxes and the arrows between them, without those that others imply; `rows` of each band."""

    boxes: tuple[Box, ...]
    arrows: tuple[Arrow, ...]
    sections: tuple[Section, ...]
    columns: int
    rows: tuple[int, ...]


def lay_out(stages: Sequence[StageReport]) -> Layout:
    """Places the stages: a column after all columns that it depends on within its section."""
    boxes = _boxes(stages)
    needs = _reduced(_needs(stages, boxes))
    sections = _place_columns(list(boxes.values()), needs)
    arrows, rows = _place_rows(list(boxes.values()), needs)
    columns = max(section.first + section.columns for section in sections)
    return Layout(tuple(boxes.values()), tuple(arrows), tuple(sections), columns, rows)


def _boxes(stages: Sequence[StageReport]) -> dict[str, Box]:
    """Boxes by the stage's name; a value stands in the box of the first stage that reads it, directly or not."""
    readers: dict[str, list[StageReport]] = {}
    for stage in stages:
        for item in stage.inputs:
            readers.setdefault(item, []).append(stage)

    def hosts(value: StageReport) -> set[str]:
        reading = [reader for output in value.outputs for reader in readers.get(output, ())]
        return {name for each in reading for name in (hosts(each) if each.is_value else {each.name})}

    boxes = {stage.name: Box(stage) for stage in stages if not stage.is_value or not hosts(stage)}
    for stage in stages:
        if stage.name not in boxes:
            serving = hosts(stage)
            next(box for name, box in boxes.items() if name in serving).values.append(stage.name)
    return boxes


Needs = dict[Box, list[Box]]


def _needs(stages: Sequence[StageReport], boxes: dict[str, Box]) -> Needs:
    """What each box reads, through values too."""
    writers = {output: stage for stage in stages for output in stage.outputs}

    def behind(inputs: Iterable[str]) -> Iterable[Box]:
        for item in inputs:
            if item in writers and writers[item].name in boxes:
                yield boxes[writers[item].name]
            elif item in writers:
                yield from behind(writers[item].inputs)

    return {box: list(dict.fromkeys(behind(box.stage.inputs))) for box in boxes.values()}


def _reduced(needs: Needs) -> Needs:
    """The same without what follows from the rest. Boxes come after all that they need."""
    all_needs: dict[Box, set[Box]] = {}
    for box, direct in needs.items():
        all_needs[box] = set(direct).union(*(all_needs[each] for each in direct))
    return {
        box: [each for each in direct if not any(each in all_needs[other] for other in direct)]
        for box, direct in needs.items()
    }


def _place_columns(boxes: Sequence[Box], needs: Needs) -> list[Section]:
    """Longest paths within each section; sections stand beside each other where a band has room."""
    names = list(dict.fromkeys(box.stage.section for box in boxes))
    for box in boxes:
        before = [each.column for each in needs[box] if each.stage.section == box.stage.section]
        box.column = max(before, default=-1) + 1
    lengths = {name: 1 + max(box.column for box in boxes if box.stage.section == name) for name in names}
    widest = max(LEAST_COLUMNS, *lengths.values())
    sections: list[Section] = []
    band = end = 0
    for name in names:
        if end + lengths[name] > widest:
            band, end = band + 1, 0
        sections.append(Section(name, band, end, lengths[name]))
        end += lengths[name]
    by_name = {section.name: section for section in sections}
    for box in boxes:
        section = by_name[box.stage.section]
        box.band, box.column = section.band, section.first + box.column
    return sections


def _place_rows(boxes: Sequence[Box], needs: Needs) -> tuple[list[Arrow], tuple[int, ...]]:
    """Rows in which chains run straight on and long arrows meet no box; returns how many each band has."""
    arrows = [Arrow(each, box) for box in boxes for each in needs[box] if each.band != box.band]
    counts = []
    for band in range(1 + max(box.band for box in boxes)):
        own = [box for box in boxes if box.band == band]
        taken = _place_boxes(own, needs)
        for box in own:
            arrows += [_passed(each, box, taken) for each in needs[box] if each.band == band]
        counts.append(1 + max(row for _, row in taken))
    return arrows, tuple(counts)


Taken = dict[tuple[int, int], Box]
"""By column and row: the box there, or where the arrow comes from that passes."""


def _place_boxes(boxes: Sequence[Box], needs: Needs) -> Taken:
    """A box takes the row of what it needs last, or the nearest free one."""
    taken: Taken = {}
    for box in sorted(boxes, key=lambda box: (box.column, -len(needs[box]))):
        before = [each for each in needs[box] if each.band == box.band]
        wanted = max(before, key=lambda each: each.column).row if before else 0
        rows = (row for row in range(len(boxes)) if (box.column, row) not in taken)
        box.row = min(rows, key=lambda row: (abs(row - wanted), row))
        taken[box.column, box.row] = box
    return taken


def _passed(start: Box, end: Box, taken: Taken) -> Arrow:
    """The arrow, in the row that costs the least detour of those where it meets nothing that is not its own."""
    columns = range(start.column + 1, end.column)
    if not columns:
        return Arrow(start, end)
    rows = range(2 + max(row for _, row in taken))
    free = [row for row in rows if all(taken.get((column, row), start) is start for column in columns)]
    row = min(free, key=lambda row: abs(row - start.row) + abs(row - end.row))
    taken.update({(column, row): start for column in columns})
    return Arrow(start, end, row)
