"""`deltalight bench node`: what a frame costs a sensor node, by part."""

from pathlib import Path

import pytest

from deltalight.benchmarks.node_costs import PARTS, NodeReport, run_node_costs


def test_its_report_has_every_part_of_a_resting_and_a_moving_cameras_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_node_costs((160, 120), 1, out=tmp_path / "node.json", as_json=False)
    report = NodeReport.model_validate_json((tmp_path / "node.json").read_text())
    assert report.size == (160, 120)
    assert set(report.motions) == {"rests", "moves"}
    for found in report.motions.values():
        assert set(found) == {*PARTS, "frame"}
        assert all(found["frame"] > found[part] > 0 for part in PARTS)
    assert "clean depth" in capsys.readouterr().out
