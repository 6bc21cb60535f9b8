"""Writes what docs/how-a-frame-is-made.md shows of the graph: `python -m deltalight.benchmarks.frame_docs`."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from deltalight.render_server.graph_report import StageReport
from deltalight.services.frame_account import FrameAccount, account_frame
from deltalight.services.graph_drawing import draw_graph

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "how-a-frame-is-made.md"
PICTURE = ROOT / "docs" / "images" / "frame_graph.svg"
METHOD = "dvct"
BEGIN = "<!-- stages: written by `python -m deltalight.benchmarks.frame_docs` -->"
END = "<!-- end of stages -->"
HEADINGS = ("stage", "what it does", "reads", "writes", "clocks", "file")


def main() -> None:
    """Writes the page's table and the picture anew."""
    account = account_frame(METHOD, print)
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), account), encoding="utf-8")
    PICTURE.write_text(picture(account), encoding="utf-8")


def with_table(page: str, account: FrameAccount) -> str:
    """The page with its table of stages replaced."""
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n{table(account.sections)}\n{END}{after}"


def table(sections: Mapping[str, Sequence[StageReport]]) -> str:
    """Markdown: a row a stage below a row a section. Values, which cost the GPU nothing, are set in italics."""
    lines = [_row(HEADINGS), _row(["---"] * len(HEADINGS))]
    for name, stages in sections.items():
        lines.append(_row([f"**{name}**", *[""] * (len(HEADINGS) - 1)]))
        lines += [_row(_cells(stage)) for stage in stages]
    return "\n".join(lines)


def _cells(stage: StageReport) -> list[str]:
    name = f"*{stage.name}*" if stage.is_value else stage.name
    file = f"[{stage.file.removeprefix('render_server/')}](../{stage.file})"
    clocks = " ".join(stage.clocks)
    return [name, stage.summary, ", ".join(stage.inputs), ", ".join(stage.outputs), clocks, file]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def picture(account: FrameAccount) -> str:
    """SVG of the frame, without times and sizes: those are a machine's own."""
    stages = [replace(stage, time_ms=None, size_bytes=0) for stage in account.stages]
    return draw_graph(f"{METHOD}: a frame after the camera turned by a degree", account.sources, stages)


if __name__ == "__main__":
    main()
