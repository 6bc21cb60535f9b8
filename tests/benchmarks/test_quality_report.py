"""The quality report's folder and page."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.progress import Progress

from deltalight.benchmarks.ground_truth.scenes import SCENES
from deltalight.benchmarks.quality import report
from deltalight.benchmarks.quality.evaluate import (
    CEILING,
    QualityJob,
    QualityResult,
    SceneResult,
    measure_quality,
)
from deltalight.benchmarks.quality.kept import KeptResults, VariantResult
from deltalight.benchmarks.quality.report import require_replaceable, write_report
from deltalight.benchmarks.quality.tables import COLUMNS
from deltalight.benchmarks.variants import Variant, parse_variants
from deltalight.protocol.errors import DeltalightError


def result(psnr_db: float = 31.25) -> QualityResult:
    picture = np.full((12, 16, 3), 90, np.uint8)
    figures = {column.figure: 0.5 for column in COLUMNS} | {"changed_share": 0.2, "changed_real_share": 0.1}
    figures |= {"changed_psnr_db": psnr_db, "penumbra_error": np.nan, "picture_psnr_db": np.inf}
    variants = parse_variants("camera,exact,exact:cone_count=8")
    measured = {
        name: VariantResult(
            figures,
            picture + np.uint8(5),
            is_repeatable=name != "exact",
            history_codes=2 * (name == "exact"),
            note="<one> note",
        )
        for name in (*(variant.name for variant in variants), CEILING.name)
    }
    scene = SceneResult(SCENES[0], 52.0, picture, picture, measured)
    return QualityResult(QualityJob([SCENES[0]], variants, (16, 12), 64), "a renderer", [scene])


def test_page_shows_every_picture_that_it_names(tmp_path: Path) -> None:
    folder = tmp_path / "quality"
    write_report(result(), folder)
    page = (folder / "index.html").read_text()
    named = set(re.findall(r'src="([^"]+)"', page)) | set(re.findall(r'data-truth="([^"]+)"', page))
    assert named == {f"pictures/{path.name}" for path in (folder / "pictures").iterdir()}
    assert len(named) == 1 + 2 * 4  # truth; camera, two variants and the ceiling with their errors
    assert "&lt;one&gt; note" in page
    assert "http" not in page


def test_json_has_null_for_what_is_not_a_number(tmp_path: Path) -> None:
    write_report(result(), tmp_path / "quality")
    data = json.loads((tmp_path / "quality" / "quality.json").read_text(), parse_constant=pytest.fail)
    means = data["means"]["exact:cone_count=8"]
    assert means["changed_psnr_db"] == 31.25
    assert means["penumbra_error"] is None
    assert means["picture_psnr_db"] is None
    assert data["variants"]["exact:cone_count=8"]["settings"] == {"operator": "exact", "cone_count": 8}


def test_markdown_has_a_row_for_every_variant(tmp_path: Path) -> None:
    write_report(result(), tmp_path / "quality")
    text = (tmp_path / "quality" / "quality.md").read_text()
    assert text.count("| exact:cone_count=8 |") >= 2
    assert "31.25" in text
    assert (
        "| 50 % | 52.0 | exact | exact (2) |" in text
    )  # half of the changed pixels real, `exact` not repeatable


def test_older_report_is_replaced_and_nothing_is_left_beside_it(tmp_path: Path) -> None:
    folder = tmp_path / "quality"
    write_report(result(20.0), folder)
    (folder / "stale.txt").touch()
    write_report(result(30.0), folder)
    assert json.loads((folder / "quality.json").read_text())["means"]["exact"]["changed_psnr_db"] == 30
    assert not (folder / "stale.txt").exists()
    assert list(tmp_path.iterdir()) == [folder]


def test_other_folders_and_files_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").touch()
    (tmp_path / "file").touch()
    for name in ("photos", "file"):
        with pytest.raises(DeltalightError, match="--out"):
            require_replaceable(tmp_path / name)
    (tmp_path / "empty").mkdir()
    require_replaceable(tmp_path / "empty")
    assert (tmp_path / "photos" / "a.png").exists()


def test_interrupted_report_leaves_the_older_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "quality"
    write_report(result(20.0), folder)

    def interrupt(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "html_page", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_report(result(30.0), folder)
    assert json.loads((folder / "quality.json").read_text())["means"]["exact"]["changed_psnr_db"] == 20
    assert list(tmp_path.iterdir()) == [folder]


def test_a_run_goes_on_where_it_was_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[str] = []

    def measure(_gpu: object, _case: object, variant: Variant, *_: object) -> VariantResult:
        if len(measured) == 2:
            raise KeyboardInterrupt
        measured.append(variant.name)
        return result().scenes[0].variants[variant.name]

    truth = SimpleNamespace(folder=tmp_path / "scene-0123")
    for name, value in {
        "create_context": lambda _: SimpleNamespace(renderer_name="a renderer", release=lambda: None),
        "ensure_truth": lambda *_, **__: truth,
        "SceneCase": SimpleNamespace(opened=lambda _: SimpleNamespace(truth=truth, frames=[])),
        "_measure": measure,
        "_result": lambda *_: result().scenes[0].variants["camera"],
        "_scene_result": lambda _, variants: variants,
    }.items():
        monkeypatch.setattr(f"deltalight.benchmarks.quality.evaluate.{name}", value)
    job, kept = result().job, KeptResults.beside(tmp_path / "quality")
    with pytest.raises(KeyboardInterrupt):
        measure_quality(job, Progress(disable=True), kept)
    damaged = next((tmp_path / ".quality.partial").glob("*.npz"))
    damaged.write_bytes(damaged.read_bytes()[:-1])
    measured.clear()
    scenes: Any = measure_quality(job, Progress(disable=True), kept).scenes  # of what is patched
    (again,) = scenes
    assert kept.taken == 1
    assert len(measured) == 2
    taken, wanted = again["exact"], result().scenes[0].variants["exact"]
    np.testing.assert_equal({**vars(taken)}, {**vars(wanted)})

    def fail() -> VariantResult:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        kept.result(fail, "another renderer", "scene-0123", job.variants[0], None)
    kept.remove()
    assert list(tmp_path.iterdir()) == []
