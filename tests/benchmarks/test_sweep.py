"""`bench sweep`: points are methods with settings that exist; tables join our times with published ones."""

import io
import json
from contextlib import nullcontext

import pytest
from rich.console import Console
from rich.progress import Progress

from deltalight.benchmarks.speed import sweep
from deltalight.benchmarks.speed.measure import SpeedJob
from deltalight.benchmarks.speed.report import (
    MethodFigures,
    MotionFigures,
    Peaks,
    SpeedReport,
    Spread,
    StageFigures,
)
from deltalight.benchmarks.speed.sweep import (
    ALL_STAGES,
    SWEEPS,
    Measured,
    Point,
    Sweep,
    as_data,
    measure_sweeps,
    print_sweeps,
)
from deltalight.benchmarks.variants import RENDERED, parse_variants
from deltalight.protocol.errors import DeltalightError
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


def report_of(method: str, **motions: MotionFigures) -> SpeedReport:
    return SpeedReport(
        version="0",
        renderer="none",
        cpus=2,
        size=(64, 48),
        frames=1,
        budget_ms=100,
        peaks=Peaks(bytes_per_s=1, flops_per_s=1),
        methods={method: MethodFigures(motions=motions, notices=[])},
    )


@pytest.mark.parametrize("one", SWEEPS, ids=lambda one: one.motion + one.title[:8])
def test_every_point_is_a_method_with_settings_that_exist(one: Sweep) -> None:
    methods = [point.method for point in one.points if point.method is not None]
    for variant, method in zip(parse_variants(",".join(methods), RENDERED), methods, strict=True):
        assert variant.applied(SceneDocument(), None).method is not None
        assert variant.name == method
    assert all(len(point.published_ms) == len(one.columns) for point in one.points)
    assert any(point.is_small and point.method for point in one.points)
    assert "splatting" in one.title or not all(point.is_small for point in one.points)


def test_every_size_of_the_dissertations_propagation_is_there() -> None:
    """[D] table 5.4: 16^3 to 128^3 cells, 16 to 256 steps; times were published where light crosses the volume."""
    (steps,) = (each for each in SWEEPS if "5.4" in each.title)
    published = {point.size: point.published_ms[0] for point in steps.points}
    assert len(published) == 20
    assert published["128^3, 16 steps"] == 79.96
    assert published["128^3, 256 steps"] == 1250.5
    assert published["64^3, 256 steps"] is None


def test_sizes_that_a_machine_refuses_are_listed_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """And do not keep the others from being measured; what this project lacks is listed too."""
    points = (
        Point("512^3", "paper:volume_size=512", (1.5,), is_small=True),
        Point("64^3", "paper:volume_size=64", (0.5,), is_small=True),
        Point("32^3", None, (0.25,), is_small=True),
        Point("256^3", "paper:volume_size=256", (1.0,), is_small=False),
    )
    asked: list[str] = []

    def measure(job: SpeedJob, *_: object, **_more: object) -> SpeedReport:
        (method,) = (variant.name for variant in job.methods)
        asked.append(method)
        if "512" in method:
            raise DeltalightError("A buffer of 537 MB is needed.")
        return report_of(method, arm=figures(cones=2.0))

    monkeypatch.setattr(sweep, "SWEEPS", (Sweep("Voxels", "arm", {"all": ALL_STAGES}, points),))
    monkeypatch.setattr(sweep, "measure_speed", measure)
    monkeypatch.setattr(sweep, "prepare_take", lambda _: None)
    monkeypatch.setattr(sweep, "opened", lambda _: nullcontext())
    measured = measure_sweeps(1, None, None, Progress(disable=True), full=False)
    assert asked == ["paper:volume_size=512", "paper:volume_size=64"]
    large, small, missing = as_data(measured)["sweeps"][0]["points"]
    assert large["refused"] == "A buffer of 537 MB is needed."
    assert "refused" not in small | missing
    assert [each["ms"]["all"] for each in (large, small, missing)] == [None, 40.0, None]
    assert [each["frame_ms"] for each in (large, small, missing)] == [None, 50.0, None]
    shown = io.StringIO()
    print_sweeps(measured, Console(file=shown, width=100))
    assert "paper:volume_size=512: A buffer of 537 MB is needed." in shown.getvalue()


def test_a_machine_that_refuses_every_size_is_told_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(*_: object, **_more: object) -> SpeedReport:
        raise DeltalightError("A buffer of 537 MB is needed.")

    monkeypatch.setattr(sweep, "measure_speed", measure)
    monkeypatch.setattr(sweep, "prepare_take", lambda _: None)
    monkeypatch.setattr(sweep, "opened", lambda _: nullcontext())
    with pytest.raises(DeltalightError, match="A buffer of 537 MB is needed"):
        measure_sweeps(1, None, None, Progress(disable=True), full=False)


def test_tables_join_our_stages_with_published_times() -> None:
    point = Point("64^3", "paper", (1.5, None), is_small=True)
    both = Sweep("Both", "arm", {"voxels": ("voxelize a", "voxelize b"), "rest": ("missing",)}, (point,))
    report = report_of("paper", arm=figures(voxelize_a=2.0, voxelize_b=3.0))
    measured = [Measured(both, (point,), {"paper": report})]
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
