"""The report's page: tables, and for each scene the pictures with their signed errors."""

import re
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from deltalight.benchmarks.quality.error_view import ENHANCEMENT
from deltalight.benchmarks.quality.evaluate import QualityResult, SceneResult
from deltalight.benchmarks.quality.tables import COLUMNS, all_tables

TEMPLATE = Path(__file__).with_name("report.html.jinja")


@dataclass(frozen=True)
class ScenePictures:
    """Files of one scene's pictures, relative to the page; with an error view where there are two."""

    scene: SceneResult
    reference: str
    camera: tuple[str, str]
    results: dict[str, tuple[str, str]]


def picture_name(scene: str, what: str) -> str:
    """Returns the file name of a picture: letters, digits and dashes only."""
    return f"{re.sub(r'[^a-z0-9]+', '-', f'{scene} {what}'.lower()).strip('-')}.png"


def html_page(result: QualityResult, scenes: list[ScenePictures]) -> str:
    """Returns the page; it needs only the pictures beside it."""
    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = page.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(
        result=result, scenes=scenes, tables=all_tables(result), columns=COLUMNS, enhancement=ENHANCEMENT
    )
