"""`deltalight bench views`: one, two and three cameras in one room, in turn."""

from pathlib import Path

import pytest

from deltalight.benchmarks.variants import RENDERED, parse_variants
from deltalight.benchmarks.views import MOTIONS, Room, ViewsJob, ViewsReport, moments_of, run_views
from deltalight.services.demo import demo_scene

SMALL = "paper:volume_size=32,rsm_size=128"


def test_its_motions_move_the_cameras_or_the_object() -> None:
    room, scene = Room((200, 150)), demo_scene("dvct")
    for motion in MOTIONS:
        (first, before), (then, after) = moments_of(motion, room, scene, 2)
        assert [each.pose is not None for each in (*before, *after)] == [True] * 6
        assert len({each.pose.world_from_camera.tobytes() for each in before if each.pose is not None}) == 3
        assert {each.timestamp_ns for each in after} != {each.timestamp_ns for each in before}
        moves = [bool((a.color != b.color).any()) for a, b in zip(before, after, strict=True)]
        assert moves == [motion == "camera"] * 3
        assert (first.objects != then.objects) == (motion == "object")


@pytest.mark.slow
def test_its_report_has_the_cost_of_each_number_of_cameras(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    job = ViewsJob(parse_variants(SMALL, RENDERED), 1, (200, 150), "depth")
    run_views(job, out=tmp_path / "views.json", as_json=False)
    report = ViewsReport.model_validate_json((tmp_path / "views.json").read_text())
    for found in report.methods[SMALL].values():
        assert (len(found.processor_ms), len(found.wall_ms), len(found.further)) == (3, 3, 2)
        assert min(found.processor_ms) > 0
        of_one = [each / found.processor_ms[0] for each in found.processor_ms]
        assert found.ratios == pytest.approx(of_one), "of the only moment"
    assert "2nd adds" in capsys.readouterr().out
