"""`deltalight bench rest` at tiny durations: it runs, and its figures hang together."""

import gzip
import json
from pathlib import Path

import pytest

from deltalight.benchmarks.rest import VIEWERS, dashboard_sizes, measure_rest, print_report
from deltalight.services.cli import run
from deltalight.services.demo import RECORDING, SCENE
from tests.services.record_samples import slow_demo


def test_the_page_counts_as_it_is_sent(tmp_path: Path) -> None:
    assert dashboard_sizes(tmp_path) is None
    text, font = b"<p>text</p>" * 1000, bytes(range(256)) * 10
    (tmp_path / "assets").mkdir()
    (tmp_path / "index.html").write_bytes(text)
    (tmp_path / "assets" / "a.woff2").write_bytes(font)
    sizes = dashboard_sizes(tmp_path)
    assert sizes is not None
    assert sizes["files"]["index.html"] == {"bytes": len(text), "gzipped_bytes": len(gzip.compress(text))}
    assert sizes["files"]["assets/a.woff2"]["gzipped_bytes"] == len(font)
    assert sizes["gzipped_bytes"] == len(gzip.compress(text)) + len(font)


@pytest.mark.slow(seconds=25)
@pytest.mark.skipif(
    not (RECORDING.is_file() and SCENE.is_file()), reason="the demo's recording is not in this checkout"
)
def test_it_runs_and_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("deltalight.services.demo.RECORDING", slow_demo(tmp_path))
    report = measure_rest(0.4, size=(96, 72), device=None)
    for key in ("without_rendering", "with_rendering"):
        figures = report[key]
        answered = figures["GET"]["requests"] + figures["PATCH"]["requests"]
        assert answered + figures["failed"] == 20
        assert answered >= 15
        assert sum(figures["pictures"].values()) == figures["PATCH"]["requests"]
        assert figures["cores"]["web process"] > 0
        assert all(0 < figures[method]["p50_ms"] <= figures[method]["p99_ms"] for method in ("GET", "PATCH"))
    assert report["size"] == [96, 72]
    viewers = report["viewers"]
    assert viewers["viewers"] == VIEWERS
    taken = viewers["cores_with"]["web process"] - viewers["cores_without"]["web process"]
    assert viewers["share_of_processors"]["web process"] == taken / report["cpus"]
    print_report(json.loads(json.dumps(report)))
    assert "50 requests/s" in capsys.readouterr().out


def test_wrong_options_are_sentences(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "rest", "--size", "big"]) == 2
    assert "WIDTHxHEIGHT" in capsys.readouterr().err
