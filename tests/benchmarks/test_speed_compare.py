"""Two reports of `bench speed` side by side."""

from pathlib import Path

import pytest

from benchmarks.speed.compare import Row, compare_reports
from benchmarks.speed.report import MethodFigures, MotionFigures, Peaks, SpeedReport, Spread, StageFigures
from services.cli import run


def motion(frame_ms: float, **stages_ms: float) -> MotionFigures:
    def spread(median: float) -> Spread:
        return Spread(median=median, p95=2 * median)

    stages = {name: StageFigures(ms=spread(median), runs=1) for name, median in stages_ms.items()}
    total = sum(stages_ms.values())
    return MotionFigures(
        frame_ms=spread(frame_ms),
        picture_ms=spread(frame_ms),
        submit_ms=spread(frame_ms / 2),
        stages_ms=spread(total),
        outside_ms=spread(frame_ms - total),
        late=0,
        stages=stages,
    )


def write(path: Path, method: str, **changes: object) -> Path:
    motions = changes.pop("motions", {"still": motion(10, a=4, b=2)})
    report = SpeedReport.model_validate(
        {
            "version": "1",
            "renderer": "a renderer",
            "cpus": 2,
            "size": (64, 48),
            "frames": 3,
            "budget_ms": 100,
            "peaks": Peaks(bytes_per_s=1, flops_per_s=1),
            "methods": {method: MethodFigures.model_validate({"motions": motions, "notices": []})},
            **changes,
        }
    )
    path.write_text(report.model_dump_json())
    return path


def test_ratios_and_what_got_slower(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = write(tmp_path / "a.json", "exact", motions={"still": motion(10, a=4, b=2), "arm": motion(9)})
    after = write(tmp_path / "b.json", "exact", motions={"still": motion(10.4, a=4.3, c=1)})
    rows = {row.name: row for row in compare_reports(before, after)}
    assert {row.motion for row in rows.values()} == {"still"}
    assert rows["frame"].ratio == pytest.approx(1.04)
    assert rows["  a"] == Row("exact", "still", "  a", 4, 4.3)
    assert (rows["  b"].after_ms, rows["  b"].ratio) == (None, None)
    assert (rows["  c"].before_ms, rows["  c"].ratio) == (None, None)
    assert [name for name, row in rows.items() if row.is_slower] == ["outside stages", "  a"]
    assert run(["bench", "speed", "--compare", str(before), str(after)]) == 0
    shown = capsys.readouterr().out
    assert shown.count("slower") == 3
    assert "2 of 7" in shown
    assert run(["bench", "speed", "--json", "--compare", str(before), str(after)]) == 0
    assert '"slower": true' in capsys.readouterr().out


def test_what_cannot_be_compared_is_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = write(tmp_path / "a.json", "exact")
    (tmp_path / "text.json").write_text("text")
    (tmp_path / "counts.json").write_text('{"report": "deltalight bench counts"}')
    for other, sentence in (
        (tmp_path / "absent.json", "cannot be read"),
        (tmp_path / "text.json", "not valid JSON"),
        (tmp_path / "counts.json", "is no report"),
        (write(tmp_path / "size.json", "exact", size=(640, 480)), "64x48; 640x480"),
        (write(tmp_path / "machine.json", "exact", cpus=4), "different machines"),
        (write(tmp_path / "method.json", "paper"), "in common"),
    ):
        assert run(["bench", "speed", "--compare", str(good), str(other)]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert sentence in line
