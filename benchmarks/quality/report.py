"""The report's folder: quality.json, quality.md, index.html and pictures/, moved into place as a whole."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from deltalight.benchmarks.quality import REPORT_KIND
from deltalight.benchmarks.quality.error_view import error_view
from deltalight.benchmarks.quality.evaluate import QualityResult, SceneResult
from deltalight.benchmarks.quality.metrics import Picture
from deltalight.benchmarks.quality.report_data import as_data
from deltalight.benchmarks.quality.report_html import ScenePictures, html_page, picture_name
from deltalight.benchmarks.quality.tables import COLUMNS, all_tables
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_png
from deltalight.services.files import make_output_folder

DATA_FILE = "quality.json"
PICTURES = "pictures"


def require_replaceable(folder: Path) -> None:
    """Checks, before anything is computed, that a report may be written as `folder`.

    Raises:
        DeltalightError: `folder` exists and is something else.
    """
    make_output_folder(folder.absolute().parent)
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    try:
        kind = json.loads((folder / DATA_FILE).read_text(encoding="utf-8"))["kind"]
    except (OSError, ValueError, KeyError, TypeError):
        kind = None
    if kind != REPORT_KIND:
        raise DeltalightError(
            f"'{folder}' is not an earlier report of this command; name another folder with --out."
        )


def write_report(result: QualityResult, folder: Path) -> None:
    """Writes the report beside `folder` and moves it into its place, replacing an older report.

    Raises:
        DeltalightError: it cannot be written, or `folder` is something else.
    """
    require_replaceable(folder)
    with _put_in_place(folder) as making:
        (making / PICTURES).mkdir()
        scenes = [_write_pictures(scene, making / PICTURES) for scene in result.scenes]
        (making / DATA_FILE).write_text(json.dumps(as_data(result), indent=2) + "\n", encoding="utf-8")
        (making / "quality.md").write_text(markdown(result), encoding="utf-8")
        (making / "index.html").write_text(html_page(result, scenes), encoding="utf-8")


@contextmanager
def _put_in_place(folder: Path) -> Iterator[Path]:
    folder = folder.absolute()
    making, old = (folder.with_name(f".{folder.name}.{os.getpid()}.{end}") for end in ("making", "old"))
    try:
        making.mkdir()
        yield making
        if folder.exists():
            folder.replace(old)
        making.replace(folder)
    except OSError as fault:
        raise DeltalightError(
            f"'{folder}' cannot be written ({fault.strerror}); free some space or name another --out."
        ) from fault
    finally:
        if old.exists() and not folder.exists():
            old.replace(folder)  # stopped between the two renames
        for rest in (making, old):
            shutil.rmtree(rest, ignore_errors=True)


def _write_pictures(scene: SceneResult, folder: Path) -> ScenePictures:
    name = scene.scene.name

    def write(what: str, picture: Picture) -> str:
        file = picture_name(name, what)
        write_png(folder / file, picture)
        return f"{PICTURES}/{file}"

    def with_error(what: str, picture: Picture) -> tuple[str, str]:
        return write(f"{what} result", picture), write(f"{what} error", error_view(picture, scene.reference))

    return ScenePictures(
        scene,
        reference=write("truth", scene.reference),
        camera=with_error("camera", scene.camera),
        results={
            variant: with_error(variant, result.shown)
            for variant, result in scene.variants.items()
            if variant != "camera"
        },
    )


def markdown(result: QualityResult) -> str:
    """Returns the tables with the meaning of their columns."""
    width, height = result.job.size
    head = [
        "# Quality against ground truth",
        "",
        f"{width}x{height}, truth with {result.job.spp} light paths a pixel, {result.renderer}.",
        "",
    ]
    methods = [f"* `{variant.name}`: {variant.sentence}" for variant in result.variants]
    columns = [f"* {column.heading}: {column.meaning}" for column in COLUMNS]
    tables = [table.markdown() for table in all_tables(result)]
    return "\n".join([*head, *tables, "## Methods", "", *methods, "", "## Columns", "", *columns, ""])
