"""`bench sweep`: points are methods with settings that exist; tables join our times with published ones."""

import io
import json

import pytest
from rich.console import Console

from deltalight.benchmarks.speed.report import MotionFigures, Peaks, SpeedReport, Spread, StageFigures
from deltalight.benchmarks.speed.sweep import SWEEPS, Measured, Point, Sweep, as_data, print_sweeps
from deltalight.benchmarks.variants import RENDERED, parse_variants
from deltalight.protocol.scene import SceneDocument


def spread(ms: float) -> Spread:
    return Spread(median=ms, p95=ms)


def figures(**stages_ms: float) -> MotionFigures:
    stages = {name.replace("_", " "): StageFigures(ms=spread(ms), runs=1.0) for name, ms in stages_ms.items()}
    return MotionFigures(
        frame_ms=spread(50),
        picture_ms=spread(50),
        submit_ms=spread(1),
        stages_ms=spread(40),
        outside_ms=spread(10),
        late=0,
        stages=stages,
    )


@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.motion + sweep.title[:8])
def test_every_point_is_a_method_with_settings_that_exist(sweep: Sweep) -> None:
    variants = parse_variants(",".join(point.method for point in sweep.points), RENDERED)
    for variant, point in zip(variants, sweep.points, strict=True):
        assert variant.applied(SceneDocument(), None).method is not None
        assert variant.name == point.method
        assert len(point.published_ms) == len(sweep.columns)
    assert any(point.is_small for point in sweep.points)
    assert not all(point.is_small for point in sweep.points)


def test_tables_join_our_stages_with_published_times() -> None:
    point = Point("64^3", "paper", (1.5, None), is_small=True)
    sweep = Sweep("Both", "arm", {"voxels": ("voxelize a", "voxelize b"), "rest": ("missing",)}, (point,))
    report = SpeedReport(
        version="0",
        renderer="none",
        cpus=2,
        size=(64, 48),
        frames=1,
        budget_ms=100,
        peaks=Peaks(bytes_per_s=1, flops_per_s=1),
        methods={"paper": {"motions": {"arm": figures(voxelize_a=2.0, voxelize_b=3.0)}, "notices": []}},
    )
    measured = [Measured(sweep, (point,), report)]
    (found,) = as_data(measured)["sweeps"][0]["points"]
    assert found["ms"] == {"voxels": 5.0, "rest": None}
    assert found["published_ms"] == {"voxels": 1.5, "rest": None}
    assert json.loads(json.dumps(as_data(measured)))["size"] == [64, 48]
    shown = io.StringIO()
    print_sweeps(measured, Console(file=shown, width=100))
    assert [cell for cell in shown.getvalue().splitlines()[-2].split() if cell] == [
        "64^3",
        "5.00",
        "1.5",
        "–",
        "–",
        "50.0",
    ]
