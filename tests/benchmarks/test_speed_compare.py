"""Two reports of `bench speed` side by side, and reports of speed and quality in one picture."""

import json
import math
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import pytest

from deltalight.benchmarks.plot import BOTTOM, LEFT, RIGHT, TOP, place_labels
from deltalight.benchmarks.speed.compare import Row, compare_reports
from deltalight.benchmarks.speed.report import (
    MethodFigures,
    MotionFigures,
    Peaks,
    SpeedReport,
    Spread,
    StageFigures,
)
from deltalight.services.cli import run


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
        (tmp_path / "counts.json", "is not a report"),
        (write(tmp_path / "size.json", "exact", size=(640, 480)), "64x48; 640x480"),
        (write(tmp_path / "machine.json", "exact", cpus=4), "different machines"),
        (write(tmp_path / "method.json", "paper"), "in common"),
    ):
        assert run(["bench", "speed", "--compare", str(good), str(other)]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert sentence in line


def write_quality(file: Path, **db: float | None) -> Path:
    means = {name: {"changed_psnr_db": value, "frame_ms": 1.0} for name, value in db.items()}
    scenes: dict[str, object] = {"tabletop": {}, "cornell": {}}
    about = {"kind": "deltalight quality report", "size": [16, 12], "spp": 8, "cpus": 2}
    file.write_text(json.dumps({**about, "means": means, "scenes": scenes}))
    return file


def drawn(path: Path) -> dict[str, tuple[float, float]]:
    """Where the picture's round markers lie, by the label of their group."""
    svg = "{http://www.w3.org/2000/svg}"
    found = {}
    for group in ElementTree.parse(path).getroot().iter(f"{svg}g"):
        circle, label = group.find(f"{svg}circle"), group.findtext(f"{svg}text")
        if circle is not None:
            found[str(label)] = float(circle.attrib["cx"]), float(circle.attrib["cy"])
    return found


def test_a_picture_has_a_point_for_each_method_of_both_kinds_of_reports(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times_ms = {"fast": 10, "middle": 100, "slow": 1000}
    reports = [
        write(tmp_path / f"{name}.json", name, motions={"arm": motion(ms)}) for name, ms in times_ms.items()
    ]
    reports.append(write(tmp_path / "again.json", "slow", motions={"arm": motion(3)}))
    quality = write_quality(tmp_path / "quality.json", slow=35, middle=30, path=20, undefined=None)
    more = write_quality(tmp_path / "more.json", slow=10, fast=25)
    speed = [option for report in reports for option in ("--speed", str(report))]
    options = (
        "--quality",
        str(quality),
        "--quality",
        str(more),
        "--motion",
        "arm",
        "--out",
        str(tmp_path / "plot.svg"),
    )
    assert run(["bench", "plot", *speed, *options]) == 0
    assert "path, undefined" in capsys.readouterr().err
    places = drawn(tmp_path / "plot.svg")
    (fast, high), (middle, between), (slow, low) = (places[name] for name in times_ms)
    assert middle - fast == pytest.approx(slow - middle, abs=0.2)  # a logarithmic axis: times ten, twice
    assert fast < slow
    assert high - between == pytest.approx(between - low, abs=0.2)
    assert high > low  # better is further up
    text = (tmp_path / "plot.svg").read_text()
    assert "tabletop, cornell" in text
    assert "motion `arm`" in text


def test_labels_lie_beside_their_points_and_on_nothing_else() -> None:
    points = [(LEFT + 300 + 14 * (number % 4), TOP + 200 + 9 * (number // 4)) for number in range(12)]
    points += [(RIGHT - 3, BOTTOM - 3), (LEFT + 3, TOP + 3)]
    line = (points[0], points[11])
    boxes = place_labels(points, [f"exact balanced {number}" for number in range(14)], [line])
    for one, other in combinations(boxes, 2):
        assert one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]
    for left, top, right, bottom in boxes:
        assert LEFT < left < right < RIGHT
        assert TOP < top < bottom < BOTTOM
        assert not any(left <= x <= right and top <= y <= bottom for x, y in points)
    lone = place_labels([(500.0, 300.0)], ["exact"])[0]
    assert math.dist((lone[0], (lone[1] + lone[3]) / 2), (500, 300)) < 15


def test_what_cannot_be_drawn_is_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    speed = write(tmp_path / "a.json", "exact")
    quality = write_quality(tmp_path / "quality.json", paper=30)
    other = write(tmp_path / "machine.json", "paper", cpus=4)
    finer = write_quality(tmp_path / "finer.json", exact=30)
    finer.write_text(finer.read_text().replace('"spp": 8', '"spp": 512'))
    for options, sentence in (
        (("--speed", speed, "--quality", quality), "same --methods"),
        (("--speed", speed, "--speed", other, "--quality", quality), "different machines"),
        (("--speed", speed, "--quality", quality, "--quality", finer), "different light paths (8; 512)"),
        (("--speed", other, "--quality", quality), "moving as in `camera`"),
        (("--speed", speed, "--quality", speed), "not a report of `bench quality`"),
        (("--speed", quality, "--quality", quality), "not a report of this version's `bench speed`"),
    ):
        assert run(["bench", "plot", *map(str, options), "--out", str(tmp_path / "plot.svg")]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert sentence in line
