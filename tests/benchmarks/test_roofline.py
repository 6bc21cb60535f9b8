"""Frames are counted by stage without a change of the picture, and the floors of a speed report heed it."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.benchmarks.speed.arithmetic import ArithmeticCounter, counted_arithmetic
from deltalight.benchmarks.speed.flop_weights import NOTHING, Cost
from deltalight.benchmarks.speed.measure import opened, rendering
from deltalight.benchmarks.speed.motions import steps_of
from deltalight.benchmarks.speed.report import (
    MethodFigures,
    MotionFigures,
    Peaks,
    SpeedReport,
    Spread,
    StageFigures,
    read_report,
)
from deltalight.benchmarks.speed.roofline import require_sizes, with_arithmetic
from deltalight.benchmarks.variants import parse_variants
from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.context import GpuContext
from deltalight.services.cli import run
from deltalight.services.demo import demo_scene
from tests.benchmarks.small_demo import METHOD, SIZE, needs_demo, needs_tools, small_take

TWO_MS = Spread(median=2, p95=2)
REPORT = SpeedReport(  # 4 kB are moved in 0.004 ms, 4000 operations take as long
    version="1",
    renderer="llvmpipe",
    cpus=2,
    size=SIZE,
    frames=1,
    budget_ms=100,
    peaks=Peaks(bytes_per_s=1e9, flops_per_s=1e9),
    methods={
        METHOD: MethodFigures(
            motions={
                "camera": MotionFigures(
                    **dict.fromkeys(
                        ("frame_ms", "picture_ms", "submit_ms", "stages_ms", "outside_ms"), TWO_MS
                    ),
                    late=0,
                    stages={
                        "direct light": StageFigures(ms=TWO_MS, runs=1, moved_bytes=4000, floor_ms=0.004),
                        "upload": StageFigures(ms=TWO_MS, runs=1),
                        "of before": StageFigures(ms=TWO_MS, runs=1, moved_bytes=4000, floor_ms=0.004),
                    },
                )
            },
            notices=[],
        )
    },
)


def test_the_floor_is_the_longer_of_both() -> None:
    for cost, arithmetic_ms, floor_ms in (
        (Cost(3000, 5000), 0.008, 0.008),
        (Cost(1000, 1000), 0.002, 0.004),
        (NOTHING, 0.0, 0.004),
    ):
        counts = {"direct light": cost, "upload": NOTHING}
        stages = with_arithmetic(REPORT, METHOD, "camera", counts).methods[METHOD].motions["camera"].stages
        light = stages["direct light"]
        assert (light.flops, light.special_functions) == (cost.flops, cost.special)
        assert light.floor_ms == pytest.approx(floor_ms)
        assert light.times_floor == pytest.approx(2 / floor_ms)
        assert light.arithmetic_floor_ms == pytest.approx(arithmetic_ms)
        assert stages["upload"].times_floor is None
        assert stages["of before"] == REPORT.methods[METHOD].motions["camera"].stages["of before"]


def test_arithmetic_of_volumes_of_another_size_is_refused() -> None:
    found = REPORT.methods[METHOD].motions["camera"]
    require_sizes(METHOD, found, {"direct light": 5000, "of before": 3000, "another": 10**9})
    for moved in (1000, 9000):
        with pytest.raises(DeltalightError, match="give `bench speed --methods` the size"):
            require_sizes(METHOD, found, dict.fromkeys(("direct light", "of before"), moved))


def rendered(
    gpu: GpuContext, size: tuple[int, int], counter: ArithmeticCounter | None
) -> tuple[np.ndarray, dict[str, Cost]]:
    """The second picture of the camera's swing, and what each stage of it executed."""
    (paper,) = parse_variants(METHOD)
    demo = demo_scene("dvct")
    scene = paper.applied(demo.replaced(lights=demo.lights.replaced(surroundings="none")), None)
    with rendering(gpu, scene) as renderer:
        for step in steps_of("camera", small_take(size), scene, 2):
            if counter is not None:
                counter.take_stages()
            picture = renderer.render(step.frame).color.copy()
    return picture, {} if counter is None else counter.take_stages()


@needs_tools
@needs_demo
@pytest.mark.slow(seconds=60)
def test_a_frame_that_counts_is_the_same_and_grows_with_its_pixels(gpu: GpuContext) -> None:
    plain, _ = rendered(gpu, SIZE, None)
    with counted_arithmetic() as counter, opened(None) as counting_gpu:
        picture, stages = rendered(counting_gpu, SIZE, counter)
        _, larger = rendered(counting_gpu, (2 * SIZE[0], 2 * SIZE[1]), counter)
    assert (picture == plain).all()
    assert stages["upload"] == stages["readback"] == NOTHING
    assert min(stages[name].flops for name in ("cones", "direct light", "relit picture")) > 0
    for name, error in {
        "real surface": 0.001,
        "change of light": 0.01,
    }.items():  # each pixel, whatever it shows
        assert larger[name].flops == pytest.approx(4 * stages[name].flops, rel=error), name
    assert larger["filter"].flops == pytest.approx(
        stages["filter"].flops, rel=0.01
    )  # voxels, of the same number


@needs_tools
@needs_demo
@pytest.mark.slow(seconds=30)
def test_the_command_completes_a_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deltalight.benchmarks.speed.roofline.prepare_take", lambda _: small_take(SIZE))
    (before, after), options = (tmp_path / "before.json", tmp_path / "after.json"), ("--frames", "1")
    before.write_text(REPORT.model_dump_json().replace('"moved_bytes":4000', '"moved_bytes":null'))
    assert run(["bench", "roofline", str(before), *options, "--out", str(after)]) == 0
    shown = capsys.readouterr().out
    assert "MFLOP" in shown
    figures = read_report(after).methods[METHOD].motions["camera"]
    assert figures.frame_ms == TWO_MS
    assert (figures.stages["direct light"].flops or 0) > 1e5
    assert figures.stages["upload"].flops == 0
    assert figures.stages["of before"].flops is None


def test_what_is_missing_is_said_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    report = tmp_path / "report.json"
    report.write_text(REPORT.model_dump_json())
    assert run(["bench", "roofline", str(report), "--motions", "arm"]) == 2
    assert "none of these methods and motions" in capsys.readouterr().err
    monkeypatch.setenv("PATH", str(tmp_path))
    assert run(["bench", "roofline", str(report)]) == 2
    assert "apt-get install glslang-tools spirv-cross" in capsys.readouterr().err
