"""The benchmark's figures as tables, for terminals and Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from deltalight.benchmarks.quality.evaluate import CEILING, QualityResult, SceneResult

MISSING = "–"
WHOLE_NAME = 14
"""Names up to this length are not broken in a terminal, whatever its width."""
CHANGED_PSNR = "changed_psnr_db"


@dataclass(frozen=True)
class Column:
    """A figure with its heading and number of decimals."""

    figure: str
    heading: str
    digits: int
    meaning: str


AGREEMENT = (
    Column("picture_psnr_db", "PSNR dB", 2, "whole picture"),
    Column("picture_ssim", "SSIM", 4, "whole picture, 1 is best"),
    Column("picture_flip", "FLIP", 4, "whole picture, 0 is best"),
    Column("changed_psnr_db", "changed PSNR dB", 2, "pixels that the objects change by more than 2/255"),
    Column("changed_ssim", "changed SSIM", 3, "the same pixels"),
    Column("changed_flip", "changed FLIP", 3, "the same pixels"),
    Column("changed_real_psnr_db", "real PSNR dB", 2, "changed real surfaces"),
    Column("changed_virtual_psnr_db", "virtual PSNR dB", 2, "the objects themselves"),
)
LIGHT_AND_TIME = (
    Column("darkening", "darker", 2, "light taken away on real surfaces, ratio to truth's; 1 is right"),
    Column("brightening", "brighter", 2, "light added on real surfaces, ratio to truth's; 1 is right"),
    Column(
        "virtual_radiance", "objects' light", 2, "mean radiance of the objects, ratio to truth's; 1 is right"
    ),
    Column("penumbra_error", "penumbra error", 2, "width of shadow edges, mean relative error; 0 is right"),
    Column(
        "temporal_unchanged", "unsteady", 2, "wrong change between frames on unchanged pixels, rms, 1/255"
    ),
    Column("temporal_changed", "unsteady changed", 2, "the same on changed pixels"),
    Column(
        "delta_error", "E rms", 3, "the printed operator's error ([P1] eq. 9), irradiance in camera units"
    ),
    Column("frame_ms", "ms", 1, "median time of a frame in which everything is built anew"),
)


COLUMNS = (*AGREEMENT, *LIGHT_AND_TIME)


@dataclass(frozen=True)
class Table:
    """Text cells; the first column holds names, the others figures."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """Returns it as Markdown with its title as heading."""
        lines = [self.headings, [":--", *["--:"] * (len(self.headings) - 1)], *self.rows]
        return "\n".join([f"## {self.title}", "", *(f"| {' | '.join(line)} |" for line in lines), ""])

    def print(self, console: Console) -> None:
        """Shows it in a terminal."""
        shown = RichTable(title=self.title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        name_width = min(WHOLE_NAME, max((len(row[0]) for row in self.rows), default=0))
        shown.add_column(self.headings[0], overflow="fold", min_width=name_width)
        for heading in self.headings[1:]:
            shown.add_column(heading, justify="right", overflow="fold")
        for row in self.rows:
            shown.add_row(*row)
        console.print(shown)


def all_tables(result: QualityResult) -> list[Table]:
    """Returns the report's tables: means over scenes, changed pixels of each scene, the scenes themselves."""
    return [
        means_table(result, "Agreement with truth, mean over scenes", AGREEMENT),
        means_table(result, "Light, steadiness and time, mean over scenes", LIGHT_AND_TIME),
        changed_table(result),
        scenes_table(result),
    ]


def means_table(result: QualityResult, title: str, columns: Sequence[Column]) -> Table:
    """Returns figures as means over scenes, one row per variant."""
    rows = [
        [name, *(_number(figures.get(column.figure, np.nan), column.digits) for column in columns)]
        for name, figures in result.means().items()
    ]
    return Table(title, ["Method", *(column.heading for column in columns)], rows)


def changed_table(result: QualityResult) -> Table:
    """Returns PSNR over changed pixels: one row per scene, one column per variant."""
    names = [variant.name for variant in result.variants]
    rows = [
        [scene.scene.name, *(_number(scene.variants[name].figures[CHANGED_PSNR], 2) for name in names)]
        for scene in result.scenes
    ]
    return Table("PSNR of changed pixels, dB", ["Scene", *names], rows)


def scenes_table(result: QualityResult) -> Table:
    """Returns how much each scene changes, how accurate its truth is, and whether pictures are repeatable.

    In brackets the greatest difference of a channel, in 8-bit codes.
    """
    headings = [
        "Scene",
        "Frames",
        "changed",
        "real",
        "truth's halves dB",
        "not repeatable",
        "depends on earlier frames",
    ]
    return Table("Scenes", headings, [_scene_row(scene) for scene in result.scenes])


def _scene_row(scene: SceneResult) -> list[str]:
    figures = scene.variants[CEILING.name].figures
    changed = figures["changed_share"]
    real = figures["changed_real_share"] / changed if changed else np.nan
    differing = [name for name, variant in scene.variants.items() if variant.is_repeatable is False]
    dependent = [
        f"{name} ({variant.history_codes})"
        for name, variant in scene.variants.items()
        if variant.history_codes
    ]
    return [
        scene.scene.name,
        str(scene.scene.frame_count),
        f"{100 * changed:.1f} %",
        MISSING if np.isnan(real) else f"{100 * real:.0f} %",
        _number(scene.halves_psnr_db, 1),
        ", ".join(differing) or "none",
        ", ".join(dependent) or "none",
    ]


def _number(value: float, digits: int) -> str:
    return MISSING if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.{digits}f}"
