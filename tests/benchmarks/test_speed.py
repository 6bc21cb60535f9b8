"""`bench speed` and `bench counts` on tiny pictures: what moves is what runs, figures hang together."""

import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import moderngl
import numpy as np
import pytest
from rich.progress import Progress

from deltalight.benchmarks.cli import DEFAULT_MOTIONS, TIMED_METHODS
from deltalight.benchmarks.speed.counts import count_motion
from deltalight.benchmarks.speed.instruments import ReadBacks
from deltalight.benchmarks.speed.kernel_times import time_motion
from deltalight.benchmarks.speed.measure import WARM_UP_FRAMES, FrameTimes, motion_figures, time_step
from deltalight.benchmarks.speed.motions import (
    ARM_STEPS,
    DRAG_STEPS,
    LAMP_FACTORS,
    MOTIONS,
    STANDING,
    SWING,
    Step,
    Take,
    parse_motions,
    steps_of,
)
from deltalight.benchmarks.speed.peaks import measure_peaks, stage_bytes
from deltalight.benchmarks.speed.report import MotionFigures, Peaks, read_report
from deltalight.benchmarks.variants import FIXED, RENDERED, parse_variants
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_lights import SphereLight
from deltalight.protocol.source import open_source
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.timers import PassTimers
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.motion_detection import FrameSamples, KeptWorld
from deltalight.render_server.view import output_size
from deltalight.sensor_node.view_frames import ViewFrameBuilder
from deltalight.services.cli import run
from deltalight.services.demo import RECORDING, demo_scene
from deltalight.services.offline import with_output

pytestmark = pytest.mark.skipif(
    not RECORDING.is_file(), reason="the demo's recording is not in this checkout"
)
SIZE = (80, 60)  # no power of two (CONTRIBUTING.md)
UNTOUCHED = PassTimers.measure, moderngl.ComputeShader.run
PEAKS = Peaks(bytes_per_s=1e9, flops_per_s=1e9)


@pytest.fixture(autouse=True)
def current(gpu: GpuContext) -> None:
    gpu.ctx.__enter__()  # type: ignore[no-untyped-call]  # the command makes a context of its own


@pytest.fixture(scope="module")
def whole_take() -> Take:
    """Two frames of the demo at rest and all of its swing."""
    source = open_source(RECORDING)
    builder = ViewFrameBuilder(source)
    return Take(*([builder(source[number]) for number in numbers] for numbers in (STANDING[:2], SWING)))


@pytest.fixture(scope="module")
def take(whole_take: Take) -> Take:
    """The same, small."""
    return whole_take.at(SIZE)


@pytest.fixture(scope="module")
def scene() -> SceneDocument:
    (paper,) = parse_variants("paper:volume_size=32,rsm_size=128")
    demo = demo_scene("dvct")
    return paper.applied(demo.replaced(lights=demo.lights.replaced(surroundings="none")), None)


@pytest.fixture(scope="module")
def renderer(gpu: GpuContext, scene: SceneDocument) -> Iterator[SceneRenderer]:
    made = SceneRenderer(gpu, scene)
    yield made
    made.release()


def measured(renderer: SceneRenderer, motion: str, take: Take, scene: SceneDocument) -> MotionFigures:
    times = [time_step(renderer, step) for step in steps_of(motion, take, scene, 4)][1:]
    assert renderer.graph is not None
    return motion_figures(times, stage_bytes(renderer.graph), PEAKS, 1e9)


# Motions


def test_the_camera_never_shows_two_equal_frames_after_another(take: Take, scene: SceneDocument) -> None:
    frames = [step.frame for step in steps_of("camera", take, scene, 3 * len(SWING))]
    assert all(frame.pose is not None and frame.depth is not None for frame in frames)
    for before, after in pairwise(frames):
        assert before.pose is not None
        assert after.pose is not None
        moved = after.pose.world_from_camera[:3, 3] - before.pose.world_from_camera[:3, 3]
        assert np.linalg.norm(moved) > 0.005


def test_a_larger_picture_is_taken_by_a_larger_camera(take: Take, scene: SceneDocument) -> None:
    assert take.at(None) is take.at((take.standing[0].camera.width, take.standing[0].camera.height)) is take
    larger = take.at((64, 36))
    assert (len(larger.standing), len(larger.swing)) == (len(take.standing), len(take.swing))
    for frame in (*larger.standing, *larger.swing):
        assert (
            output_size(frame, with_output(scene, (64, 36), None).output)
            == frame.color.shape[1::-1]
            == (64, 36)
        )


@pytest.mark.parametrize("size", [None, (500, 375), (72, 54)])
def test_a_scene_kept_from_any_frame_of_the_swing_explains_all(
    whole_take: Take, size: tuple[int, int] | None
) -> None:
    """In pictures of any size: nothing in them moves."""
    frames, kept = [FrameSamples(each) for each in whole_take.at(size).swing], KeptWorld()
    for built_from in frames:
        kept.built_from = built_from
        assert all(kept.explains(each) for each in frames)


def test_an_arm_reaches_further_into_colour_and_depth_and_back(take: Take, scene: SceneDocument) -> None:
    steps = list(steps_of("arm", take, scene, ARM_STEPS + 1))
    covered = []
    for step in steps:
        assert step.scene is scene
        depth = step.frame.depth
        assert depth is not None
        arm = depth.valid & (depth.depth_m > 0) & (depth.depth_m < 0.43)
        assert depth.depth_m[arm].min() > 0.25
        red, _, blue = step.frame.color[arm].mean(axis=0)
        assert red > 1.3 * blue
        covered.append(arm.mean())
    half = ARM_STEPS // 2
    assert all(more > less for less, more in pairwise(covered[: half + 1]))
    assert all(less < more for more, less in pairwise(covered[half:]))


def test_an_object_is_dragged_and_a_lamp_dimmed_every_frame(take: Take, scene: SceneDocument) -> None:
    dragged = [step.scene for step in steps_of("object", take, scene, DRAG_STEPS + 2)]
    places = [each.objects[0].pose.translation_m for each in dragged]
    assert all(before != after for before, after in pairwise(places))
    assert all(each.lights == scene.lights for each in dragged)
    dimmed = [step.scene for step in steps_of("lamps", take, scene, len(LAMP_FACTORS) + 1)]
    lamps = [each.lights.manual[0] for each in dimmed]
    strengths = [lamp.intensity for lamp in lamps if isinstance(lamp, SphereLight)]
    assert len(strengths) == len(dimmed)
    assert all(before != after for before, after in pairwise(strengths))
    assert min(strengths) == 0
    assert all(each.objects == scene.objects for each in dimmed)


@pytest.mark.parametrize("motion", MOTIONS)
def test_frames_of_a_motion_are_new_and_the_same_every_time(
    motion: str, take: Take, scene: SceneDocument
) -> None:
    first, again = (list(steps_of(motion, take, scene, 5)) for _ in range(2))
    assert len({id(step.frame) for step in first}) == 5
    times = [step.frame.timestamp_ns for step in first]
    assert times == sorted(set(times))
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.frame.color, other.frame.color)
        assert one.scene == other.scene


def test_names_of_motions_and_methods() -> None:
    assert parse_motions(DEFAULT_MOTIONS) == list(MOTIONS)
    assert parse_motions("still, arm") == ["still", "arm"]
    for text, sentence in (("stil", "nearest is still"), ("", "camera"), ("arm,arm", "twice")):
        with pytest.raises(DeltalightError, match=sentence):
            parse_motions(text)
    assert [each.name for each in parse_variants(TIMED_METHODS, RENDERED)] == TIMED_METHODS.split(",")
    assert set(RENDERED) < set(FIXED)
    for name in ("camera", "path", "fisheye"):
        with pytest.raises(DeltalightError, match=f"'{name}' is not a method"):
            parse_variants(name, RENDERED)


# Figures


@pytest.mark.slow
def test_what_moves_is_what_runs(renderer: SceneRenderer, take: Take, scene: SceneDocument) -> None:
    found = {motion: measured(renderer, motion, take, scene) for motion in MOTIONS}
    shared = {"upload", "composite", "readback"}
    assert found["still"].stages.keys() == shared | {"relit picture"}  # `paper` adds to each picture anew
    for motion in ("camera", "arm"):
        assert {"real surface", "object surface", "voxelize real"} | shared <= found[motion].stages.keys()
        assert found[motion].stages["real surface"].runs == 1
    assert "real surface" not in found["object"].stages
    assert found["object"].stages["voxelize objects"].runs == 1
    assert not {"real surface", "object surface", "voxelize real"} & found["lamps"].stages.keys()
    assert found["lamps"].stages["environment"].runs == 1
    for figures in found.values():
        assert figures.stages["upload"].moved_bytes is None
        moved = figures.stages["composite"].moved_bytes
        assert moved is not None
        assert moved > 4 * SIZE[0] * SIZE[1]
        assert figures.late == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [
        "none",
        "dlpv-paper:volume_size=16",
        "differential:volume_size=32,rsm_size=128",
        "aroof:resolution=12,rays=64,shells=2",
    ],
)
def test_each_kind_of_method_is_measured_and_counted(method: str, gpu: GpuContext, take: Take) -> None:
    (variant,) = parse_variants(method, RENDERED)
    scene = variant.applied(demo_scene("dvct"), None)
    renderer = SceneRenderer(gpu, scene)
    camera, still = (measured(renderer, motion, take, scene) for motion in ("camera", "still"))
    counts = count_motion(renderer, list(steps_of("camera", take, scene, 3)), 1)
    renderer.release()
    assert {"direct light", "composite"} <= camera.stages.keys()
    assert "direct light" not in still.stages
    assert counts.per_frame["dispatches"] > 10


def test_figures_are_of_the_frames_in_which_a_stage_ran() -> None:
    times = [
        FrameTimes(10, 9, 5, {"a": 1.0, "b": 4.0}, {"a": 0.5, "b": 3.0}),
        FrameTimes(20, 19, 6, {"a": 3.0}, {"a": 0.7}),
        FrameTimes(30, 28, 7, {"a": 2.0}, {"a": 0.6}),
    ]
    found = motion_figures(times, {"a": 4_000_000}, PEAKS, 15)
    assert (found.frame_ms.median, found.picture_ms.median, found.submit_ms.median) == (20, 19, 6)
    assert found.frame_ms.p95 == pytest.approx(29)
    assert (found.stages_ms.median, found.outside_ms.median) == (3, 17)
    assert found.late == 2
    a, b = found.stages["a"], found.stages["b"]
    assert (a.ms.median, a.runs, a.moved_bytes, a.floor_ms, a.times_floor) == (2, 1, 4_000_000, 4, 0.5)
    assert (b.ms.median, b.runs, b.floor_ms, b.times_floor) == (4, 1 / 3, None, None)
    assert [each.submit_ms.median for each in (a, b) if each.submit_ms is not None] == [0.6, 3]


def test_peaks_are_measured(gpu: GpuContext, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deltalight.benchmarks.speed.peaks.COPIED_BYTES", 1 << 20)
    monkeypatch.setattr("deltalight.benchmarks.speed.peaks.SOFTWARE_THREADS", 256)
    found = measure_peaks(gpu)
    assert min(found.bytes_per_s, found.flops_per_s) > 0
    assert gpu.ctx.error == "GL_NO_ERROR"


@pytest.mark.slow
def test_counted_frames_agree_with_what_the_graph_ran(
    gpu: GpuContext, renderer: SceneRenderer, take: Take, scene: SceneDocument
) -> None:
    """In software, kernels that write whole pictures are drawn: linearize, the real surface and first samples."""
    still = count_motion(renderer, list(steps_of("still", take, scene, 7)), 2)
    assert still.per_frame == {
        "dispatches": 2 - gpu.is_software,  # linearize and composite
        "draws": int(gpu.is_software),
        "framebuffer_clears": 0,
        "buffer_clears": 0,
        "buffer_clear_bytes": 0,
        "uploads": 1,
        "uploaded_bytes": 4 * SIZE[0] * SIZE[1],
        "reads": 0,
        "uniform_writes": 0,
    }
    camera = count_motion(renderer, list(steps_of("camera", take, scene, 6)), 2)
    assert (
        camera.per_frame["draws"] == 2 + 3 * gpu.is_software
    )  # the objects' first samples, and a shadow map
    assert camera.per_frame["dispatches"] > 10
    assert camera.python_ms.median > 0
    assert camera.thread_ms.median > 0


MOST_ASKED = {  # dispatches and uploads in a frame on a GPU, while the camera moves and while an object does
    "exact:quality=live,volume_size=32": ((24, 29), (3, 6)),
    "exact:volume_size=32": ((52, 51), (8, 10)),
    "paper:volume_size=32": ((29, 29), (4, 7)),
    "dlpv:volume_size=16": ((42, 40), (4, 8)),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", MOST_ASKED)
def test_a_gpu_is_asked_for_no_more(method: str, gpu: GpuContext, take: Take) -> None:
    """Dispatches and uploads cost Python tens of microseconds each, and a GPU barriers; reads would wait for it.

    Nothing is dispatched in earnest: frames ask for the same whatever they show.
    """
    (variant,) = parse_variants(method, RENDERED)
    demo = demo_scene("dvct")  # without estimates of light, which read back whenever they are due
    scene = variant.applied(demo.replaced(lights=demo.lights.replaced(surroundings="none")), None)
    renderer = SceneRenderer(replace(gpu, is_software=False), scene)
    found = []
    with ReadBacks().without_gpu():
        for motion in ("camera", "object"):
            counts = count_motion(
                renderer, list(steps_of(motion, take, scene, 9)), 3
            )  # `live` has turns of three: one to warm up, one that is counted, one for Python's time
            assert counts.per_frame["buffer_clears"] == counts.per_frame["reads"] == 0
            found.append([counts.per_frame[name] for name in ("dispatches", "uploads")])
    renderer.release()
    dispatches, uploads = MOST_ASKED[method]
    assert all(np.less_equal(found, np.transpose([dispatches, uploads])).ravel()), found


# The commands

OPTIONS = ("--methods", "paper:cone_scale=4", "--motions", "still,camera", "--frames", "2", "--size", "80x60")


@pytest.fixture
def prepared(monkeypatch: pytest.MonkeyPatch, take: Take, scene: SceneDocument) -> None:
    """The commands take the small frames and the small scene; peaks are not measured."""

    def small(_: Progress) -> Take:
        return take

    monkeypatch.setattr("deltalight.benchmarks.speed.measure.prepare_take", small)
    monkeypatch.setattr("deltalight.benchmarks.speed.counts.prepare_take", small)
    monkeypatch.setattr("deltalight.benchmarks.speed.kernel_times.prepare_take", small)
    monkeypatch.setattr("deltalight.benchmarks.speed.measure.measure_peaks", lambda _: PEAKS)
    monkeypatch.setattr("deltalight.benchmarks.speed.measure.demo_scene", lambda _: scene)


@pytest.mark.usefixtures("prepared")
def test_a_run_writes_its_report_and_prints_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "speed.json"
    more = ("--no-end-to-end", "--budget-ms", "0.1", "--out", str(report))
    assert run(["bench", "speed", *OPTIONS, *more]) == 0
    shown = capsys.readouterr().out
    assert "2/2" in shown
    assert "real surface" in shown
    found = read_report(report)
    assert (found.size, found.frames) == (SIZE, 2)
    assert list(found.methods["paper:cone_scale=4"].motions) == ["still", "camera"]
    assert run(["bench", "speed", "--compare", str(report), str(report)]) == 0
    assert "0 of" in capsys.readouterr().out


@pytest.mark.usefixtures("prepared")
def test_a_run_that_is_stopped_loses_nothing_and_has_told_what_it_did(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[Step] = []

    def until_ctrl_c(renderer: SceneRenderer, step: Step) -> FrameTimes:
        taken.append(step)
        if len(taken) > WARM_UP_FRAMES + 2:
            assert list(read_report(report).methods["paper:cone_scale=4"].motions) == ["still"]
            raise KeyboardInterrupt
        return time_step(renderer, step)

    monkeypatch.setattr("deltalight.benchmarks.speed.measure.time_step", until_ctrl_c)
    report = tmp_path / "speed.json"
    assert run(["bench", "speed", *OPTIONS, "--out", str(report)]) == 130
    out, err = capsys.readouterr()
    assert "still" in out
    assert "camera" not in out
    assert "paper:cone_scale=4: still, " in err
    assert "(1 of 2 motions)" in err
    assert list(read_report(report).methods["paper:cone_scale=4"].motions) == ["still"]


def test_the_floor_draws_the_object_and_leaves_all_else(gpu: GpuContext, take: Take) -> None:
    (raster,) = parse_variants("raster", RENDERED)
    renderer = SceneRenderer(gpu, raster.applied(demo_scene("dvct"), None), checks=True)
    frame = take.standing[0]
    shown = renderer.render(frame).color
    assert renderer.graph is not None
    coverage = renderer.graph["object surface"].coverage.texture
    covered = np.frombuffer(coverage.read(), np.float16).reshape(SIZE[1], SIZE[0], -1)[..., 0] > 0
    moved = measured(renderer, "camera", take, renderer.scene)
    dimmed = measured(renderer, "lamps", take, renderer.scene)
    renderer.release()
    assert 0.02 < covered.mean() < 0.2
    assert (shown[~covered] == frame.color[~covered]).all()
    assert (np.abs(shown[covered].astype(int) - frame.color[covered]).max(axis=1) > 8).mean() > 0.9
    assert not any("shadow" in name or "voxel" in name for name in moved.stages)
    assert {"lamps", "object radiance"} <= dimmed.stages.keys()


@pytest.mark.slow
@pytest.mark.usefixtures("prepared")
def test_counts_are_printed_as_table_and_as_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    report = tmp_path / "counts.json"
    assert run(["bench", "counts", *OPTIONS, "--out", str(report)]) == 0
    assert "reads that wait for the GPU" in capsys.readouterr().out
    counts = json.loads(report.read_text())["methods"]["paper:cone_scale=4"]
    still = counts["still"]["per_frame"]
    assert still["dispatches"] + still["draws"] == 2
    assert counts["camera"]["per_frame"]["draws"] >= 2


@pytest.mark.slow
@pytest.mark.usefixtures("prepared")
def test_a_gpu_s_paths_are_counted_without_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "counts", *OPTIONS, "--gpu-paths", "--json"]) == 0
    counts = json.loads(capsys.readouterr().out)["methods"]["paper:cone_scale=4"]
    still = counts["still"]["per_frame"]
    assert (still["dispatches"], still["draws"]) == (2, 0)  # in software whole pictures are drawn
    assert counts["camera"]["per_frame"]["reads"] == 0  # where software waits


@pytest.mark.slow
@pytest.mark.usefixtures("prepared")
def test_kernels_are_timed_one_by_one(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    report = tmp_path / "kernels.json"
    assert run(["bench", "kernels", *OPTIONS, "--out", str(report)]) == 0
    assert "voxelize real" in capsys.readouterr().out
    motions = json.loads(report.read_text())["methods"]["paper:cone_scale=4"]
    still = {(each["stage"], each["kernel"].split()[0]): each["runs"] for each in motions["still"]}
    assert still == {("(no stage)", "linearize"): 1, ("relit picture", "composite"): 1}
    times = [each["ms"]["median"] for each in motions["camera"]]
    assert times == sorted(times, reverse=True)
    assert min(times) > 0


def test_timed_kernels_are_those_that_are_counted(
    gpu: GpuContext, renderer: SceneRenderer, take: Take, scene: SceneDocument
) -> None:
    steps = list(steps_of("camera", take, scene, 4))
    counts = count_motion(renderer, steps, 1)
    figures = time_motion(gpu, renderer, steps[2:3])  # the frame that was counted
    assert all(each.kernel for each in figures)
    assert sum(each.runs for each in figures) == counts.per_frame["dispatches"] + counts.per_frame["draws"]
    assert (PassTimers.measure, moderngl.ComputeShader.run) == UNTOUCHED
