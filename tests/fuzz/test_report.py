"""The report of the fuzzing holds every part, and whatever goes wrong is a fault of it."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.fuzz.__main__ import NO_ATHERIS
from tests.fuzz.report import FILES, QUICK, FuzzReport, Sizes, fuzz_all

PARTS = ["envelope", *FILES, "sockets", "openapi"]
KEPT_REPORT = Path(__file__).parents[2] / "benchmarks" / "results" / "fuzz-2cores.json"


def test_the_kept_report_is_of_a_whole_run_without_faults() -> None:
    report = FuzzReport.model_validate_json(KEPT_REPORT.read_text())
    assert report.sizes == Sizes()
    assert [part.name for part in report.parts] == PARTS
    assert report.faults == []


@pytest.mark.slow(seconds=55)
@pytest.mark.skipif(find_spec("atheris") is None, reason=NO_ATHERIS)
def test_the_quick_form_runs_every_part_and_finds_nothing(tmp_path: Path) -> None:
    out = tmp_path / "fuzz.json"
    report = fuzz_all(QUICK, 5, out, tmp_path / "kept")
    assert FuzzReport.model_validate_json(out.read_text()) == report
    assert [part.name for part in report.parts] == PARTS
    least = [QUICK.envelopes, *(QUICK.of_each_file for _ in FILES), QUICK.messages, 1]
    assert all(part.executions >= count for part, count in zip(report.parts, least, strict=True))
    assert report.machine.renderer
    assert all(sum(part.deaths.values()) == 0 and min(part.peak_mb.values()) > 0 for part in report.parts)
    found = [fault for fault in report.faults if ": slow-" not in fault]  # tests time nothing
    assert found == []
