"""`deltalight gpu-check`: every step that goes wrong is told and ends nothing but itself."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from deltalight.benchmarks.gpu_check import beside_tests, compiling, packages
from deltalight.benchmarks.gpu_check.beside_tests import ComparedPicture
from deltalight.benchmarks.gpu_check.check import check_gpu
from deltalight.benchmarks.gpu_check.child import take_step
from deltalight.benchmarks.gpu_check.compiling import compile_everything
from deltalight.benchmarks.gpu_check.gpu_tests import Recorder
from deltalight.benchmarks.gpu_check.picture_check import compare_pictures
from deltalight.benchmarks.gpu_check.plan import BUDGETS_S, MACHINE, STEPS, Step, choose_steps
from deltalight.benchmarks.gpu_check.processes import spread
from deltalight.benchmarks.gpu_check.record import Findings, Record, State
from deltalight.benchmarks.gpu_check.report import Report
from deltalight.benchmarks.gpu_check.steps import RATED
from deltalight.benchmarks.gpu_check.stored_truth import FILE, REFERENCE_FILE, StoredTruth
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.pictures import decode_rgb
from deltalight.render_server.gpu.context import GpuContext, SharedPrograms
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.services.cli import run
from tests.benchmarks import gpu_check_samples
from tests.render_server import protected_scenes, shader_variants
from tests.render_server.protected_scenes import Case

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = "tests.benchmarks.gpu_check_samples"
MOST_S = 8 * 60
CASE = Case("paper", "model", "plain")


def sample(name: str, budget_s: float = 60) -> Step:
    return Step(name, f"{SAMPLES}:{name}", budget_s)


def written(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "report.json").read_bytes())
    return found


def findings(folder: Path) -> Findings:
    (folder / "out").mkdir()
    (folder / "scratch").mkdir()
    return Findings(folder / "record.json", folder / "out", folder / "scratch")


@pytest.fixture
def one_picture(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The step `pictures` has a single case, and occlusion fields are nobody's."""
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(protected_scenes, "cases", lambda: iter([CASE]))


@pytest.fixture
def own_goldens(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The folder of goldens is empty and the test's."""
    folder = tmp_path / "goldens"
    folder.mkdir()
    monkeypatch.setattr(protected_scenes, "FOLDER", folder)
    return folder


def test_all_steps_together_take_eight_minutes_at_most() -> None:
    assert MACHINE.budget_s + sum(step.budget_s for step in STEPS) <= MOST_S


def test_steps_are_chosen_by_name_and_keep_their_order() -> None:
    assert [step.name for step in choose_steps("speed, doctor")] == ["doctor", "speed"]
    assert choose_steps(None) == STEPS
    with pytest.raises(
        DeltalightError, match=r"'shader' is not a step of gpu-check; the nearest is shaders, of doctor,"
    ):
        choose_steps("doctor,shader")


def test_an_unknown_step_is_one_sentence(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(["gpu-check", "--steps", "everything", "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_every_package_that_is_asked_for_has_its_right_name() -> None:
    assert packages.missing_packages() == []
    assert not packages._is_there("cv2/no_such_part")
    assert all(version(package) for package in packages.PACKAGES.values())
    assert set(BUDGETS_S) == {step.name for step in STEPS}


def test_a_package_without_which_nothing_starts_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        packages, "find_spec", lambda name: None if name in ("cv2", "xdist") else find_spec(name)
    )
    with pytest.raises(
        DeltalightError, match=r"cannot start without opencv-contrib-python-headless; install"
    ):
        packages.missing_packages()


@pytest.mark.slow
def test_a_step_that_crashes_hangs_or_fails_ends_itself_alone(tmp_path: Path) -> None:
    names = ("fine", "crash", "wrong", "left_out", "broken", "packageless")
    said: list[str] = []
    report = check_gpu(tmp_path, [*map(sample, names)], ["xdist"], said.append)
    steps = written(tmp_path)["steps"]
    assert {name: step["state"] for name, step in steps.items()} == {
        "machine": "passed",
        "fine": "passed",
        "crash": "failed",
        "wrong": "failed",
        "left_out": "skipped",
        "broken": "failed",
        "packageless": "failed",
    }
    assert steps["fine"]["figures"] == {"answer": 42}
    assert steps["crash"]["figures"] == {"done": 1}
    assert steps["crash"]["sentence"] == "half of it was done; the step's process was ended by SIGABRT"
    assert "the driver's last words" in steps["crash"]["faults"][0]
    assert steps["wrong"]["faults"] == ["the sky is green"]
    assert steps["left_out"]["sentence"] == f"nothing for it in {tmp_path.name}"
    assert steps["broken"]["sentence"] == "ValueError: no .json"
    assert steps["packageless"]["sentence"] == "the Python module no_such_package is not installed"
    assert report.sentence.startswith(
        "crash failed, wrong failed, broken failed, packageless failed on llvmpipe"
    )
    assert "a software renderer: no GPU was checked" in report.sentence
    assert said[0] == "machine: up to 15 s"
    about = written(tmp_path)
    assert about["finished"]
    assert about["is_software"]
    assert about["missing_packages"] == ["xdist"]
    assert {"gpu", "driver", "gl_version", "date", "commit", "python"} <= set(about)
    markdown = (tmp_path / "report.md").read_text()
    assert "| crash | failed |" in markdown
    assert "* the sky is green" in markdown
    assert "Traceback" in (tmp_path / "output.log").read_text()


@pytest.mark.slow
def test_a_step_that_hangs_runs_out_of_time_and_the_next_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deltalight.benchmarks.gpu_check.check.MACHINE", sample("fine", 1))
    report = check_gpu(tmp_path, [sample("hang", 12), sample("left_out")], [], lambda _: None)
    hung = report.records["hang"]
    assert hung.state is State.OUT_OF_TIME
    assert hung.sentence.endswith("; begun")
    with pytest.raises(ProcessLookupError):
        os.kill(hung.figures["pid"], 0)
    assert report.records["left_out"].state is State.SKIPPED
    assert "hang ran out of time" in report.bad_steps


@pytest.mark.slow
def test_the_command_takes_chosen_steps_in_software(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "deltalight.services.cli",
        "gpu-check",
        "--steps",
        "doctor,quality",
    ]
    done = subprocess.run(
        [*command, "--out", str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=280, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("gpu-check: no step failed on llvmpipe")
    steps = written(tmp_path)["steps"]
    assert steps["doctor"]["figures"]["checks"][0]["name"] == "python"
    assert steps["quality"]["state"] == "passed"
    assert steps["quality"]["sentence"].startswith("two_lights: exact ")
    assert {path.name for path in tmp_path.iterdir()} == {"report.json", "report.md", "output.log"}


def test_stored_truth_tells_how_good_a_picture_is(tmp_path: Path) -> None:
    """Truth itself is perfect, the camera's picture far off, and a shift by two codes what it is."""
    truth = StoredTruth.unpacked(tmp_path)
    reference = decode_rgb((tmp_path / REFERENCE_FILE).read_bytes(), REFERENCE_FILE)
    assert truth.psnr_of(reference) > 100
    assert truth.psnr_of(truth.view.color) < 25
    off = np.where(reference > 127, reference - 2, reference + 2).astype(np.uint8)
    assert truth.psnr_of(off) == pytest.approx(20 * np.log10(255 / 2))
    assert 0.02 < truth.changed.mean() < 0.5
    assert FILE.stat().st_size < 1_000_000
    assert set(truth.about["psnr_db"]) == set(RATED)


def test_a_method_that_became_worse_fails_the_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured = {"exact": 37.0, "paper": 12.0}
    monkeypatch.setattr(StoredTruth, "psnr_db", lambda _self, _gpu, method: measured.get(method, 99.0))
    step = findings(tmp_path)
    take_step("deltalight.benchmarks.gpu_check.steps:quality", step)
    assert step.record.state is State.FAILED
    (fault,) = step.record.faults
    assert fault.startswith("paper: 12.0 dB, in software 29.")
    assert step.record.figures["changed_psnr_db"]["exact"] == 37.0


@pytest.mark.usefixtures("one_picture")
def test_a_picture_like_its_golden_passes(tmp_path: Path) -> None:
    step = findings(tmp_path)
    take_step("deltalight.benchmarks.gpu_check.steps:pictures", step)
    assert (step.record.state, step.record.sentence) == (
        State.PASSED,
        "1 of 1 pictures agree with their goldens",
    )
    assert not list(step.out.iterdir())


@pytest.mark.usefixtures("one_picture")
def test_a_changed_golden_fails_with_a_picture(tmp_path: Path, own_goldens: Path) -> None:
    sheet = cv2.imread(str(ROOT / "tests" / "render_server" / "goldens" / "protected_paper.png"))
    assert sheet is not None
    cv2.imwrite(
        str(own_goldens / "protected_paper.png"), np.clip(sheet.astype(int) + 3, 0, 255).astype(np.uint8)
    )
    step = findings(tmp_path)
    take_step("deltalight.benchmarks.gpu_check.steps:pictures", step)
    assert step.record.state is State.FAILED
    assert step.record.faults[0].startswith("paper-model-plain: 3")
    assert step.record.faults[0].endswith(" dB, at least 60 are asked for")
    shown = cv2.imread(str(step.out / "failed_pictures.png"))
    assert shown is not None
    assert shown.shape == (72, 240 + 3 * 96, 3)


def test_one_picture_that_cannot_be_rendered_leaves_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(protected_scenes, "cases", lambda: iter([Case("paper", "model", "no kind"), CASE]))
    step = findings(tmp_path)
    take_step("deltalight.benchmarks.gpu_check.steps:pictures", step)
    assert step.record.faults == ["paper-model-no kind: KeyError, 'no kind'"]
    assert step.record.sentence == "1 of 2 pictures agree with their goldens"


def test_a_shader_that_the_driver_refuses_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(gpu: GpuContext, folder: Path) -> None:
        del folder
        gpu.compiled("odd ODD=1", {})
        gpu.ctx.compute_shader("#version 430 core\nlayout(local_size_x = 1) in;\nvoid main() { odd(); }")

    def taken(gpu: GpuContext, folder: Path) -> None:
        del folder
        gpu.compiled("even", {})

    monkeypatch.setattr(shader_variants, "PARTS", {"first": refused, "second": taken})
    step = findings(tmp_path)
    take_step("deltalight.benchmarks.gpu_check.steps:shaders", step)
    assert step.record.state is State.FAILED
    assert step.record.faults[0].startswith("first, odd ODD=1: Error, GLSL Compiler failed")
    assert step.record.figures["variants"] == ["even", "odd ODD=1"]


@pytest.mark.usefixtures("one_picture", "own_goldens")
def test_a_missing_golden_fails(tmp_path: Path) -> None:
    step = findings(tmp_path)
    take_step("deltalight.benchmarks.gpu_check.steps:pictures", step)
    assert step.record.faults == ["paper-model-plain: its golden is missing"]
    assert json.loads((tmp_path / "record.json").read_text())["state"] == "failed"


@pytest.mark.parametrize("name", ["shaders", "pictures", "tests", "slow_tests"])
def test_an_installed_package_has_no_tests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(beside_tests, "TESTS", tmp_path / "nowhere")
    step = findings(tmp_path)
    take_step(f"deltalight.benchmarks.gpu_check.steps:{name}", step)
    assert step.record.state is State.SKIPPED
    assert step.record.sentence.startswith("the project's tests are not here")


def test_without_pytest_the_tests_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deltalight.benchmarks.gpu_check.steps.find_spec", lambda _: None)
    step = findings(tmp_path)
    take_step("deltalight.benchmarks.gpu_check.steps:tests", step)
    assert (step.record.state, step.record.sentence) == (State.SKIPPED, "pytest is not installed")


@pytest.mark.slow
def test_tests_are_counted_and_what_fails_is_named(tmp_path: Path) -> None:
    """In a process of its own, as the step has it: pytest runs in a process once. Without plugins that take a second
    of each of its processes.
    """
    (tmp_path / "some").mkdir()
    lines = [
        "def test_good(): pass",
        "def test_bad(): assert 1 == 2",
        "def test_skipped(): pytest.skip()",
        "def test_packageless(): import no_such_package",
        "@pytest.mark.slow",
        "def test_slow(): pass",
    ]
    (tmp_path / "some" / "test_other.py").write_text("import no_such_package")
    (tmp_path / "some" / "test_some.py").write_text("\n".join(["import pytest", *lines]))
    code = (
        "import sys; from pathlib import Path; from deltalight.benchmarks.gpu_check.gpu_tests import run_tests;"
        "from deltalight.benchmarks.gpu_check.record import Findings; here = Path(sys.argv[1]);"
        "print('said:', run_tests(Findings(here / 'record.json', here, here), 'not slow', here / 'some'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "PYTEST_ADDOPTS": "-p no:schemathesis -p no:hypothesispytest"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "said: 1 passed, 1 failed, 1 skipped, 2 left out for want of a package" in done.stdout, (
        done.stdout + done.stderr
    )
    record = json.loads((tmp_path / "record.json").read_text())
    (fault,) = record["faults"]
    assert "test_some.py::test_bad: " in fault
    assert "assert 1 == 2" in fault
    left_out = sorted(record["figures"]["left_out"])
    assert ["test_other.py" in left_out[0], "test_some.py::test_packageless" in left_out[1]] == [True, True]
    assert " of 4 tests done" in record["sentence"]


def test_a_module_of_the_project_is_no_package_that_is_missing(tmp_path: Path) -> None:
    recorder = Recorder(findings(tmp_path))
    for module in ("deltalight.nowhere", "tests.nowhere"):
        report = Mock(when="call", passed=False, failed=True, outcome="failed", nodeid="test_it")
        report.longreprtext = f"E   ModuleNotFoundError: No module named '{module}'"
        recorder.pytest_runtest_logreport(report)
    assert (recorder.counts["failed"], recorder.left_out) == (2, [])


@pytest.mark.slow
def test_several_processes_compile_what_one_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two small parts: in processes of their own, which know nothing of what is patched here."""
    parts = ["image-based shading", "soft mattes"]
    monkeypatch.setattr(shader_variants, "PARTS", {name: shader_variants.PARTS[name] for name in parts})
    variants = []
    for processes in (1, 2):
        (tmp_path / str(processes)).mkdir()
        step = findings(tmp_path / str(processes))
        compile_everything(step, processes)
        assert step.record.faults == []
        assert step.record.sentence.endswith("2 of 2 scenes rendered")
        assert set(parts) <= set(step.record.figures["done_after_s"])
        variants.append(step.record.figures["variants"])
    assert variants[0] == variants[1]
    assert len(variants[0]) > 5


def test_a_part_tells_what_it_would_compile(gpu: GpuContext, monkeypatch: pytest.MonkeyPatch) -> None:
    def part(gpu: GpuContext, folder: Path) -> None:
        del folder
        kernel = Kernel(gpu, "count_groups")
        kernel.run((1,))
        raise ValueError("of pictures that are worthless")

    monkeypatch.setattr(shader_variants, "PARTS", {"part": part})
    monkeypatch.setattr(
        compiling, "opened_context", lambda: nullcontext(replace(gpu, programs=SharedPrograms()))
    )
    monkeypatch.setattr(gpu.ctx, "compute_shader", gpu.ctx.compute_shader)  # which it replaces
    asked = compiling.asked_variants("part")
    assert list(asked) == ["count_groups"]
    assert asked["count_groups"].startswith("#version")


def test_variants_that_the_driver_refuses_are_named_each(
    gpu: GpuContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiling, "process_context", lambda: gpu)
    head = "#version 430 core\nlayout(local_size_x = 1) in;\nvoid main() { %s }"
    chunk = [("good", head % ""), ("bad", head % "odd();"), ("worse", head % "worse();")]
    faults = compiling.compile_variants(chunk)
    assert [fault.partition(": ")[0] for fault in faults] == ["bad", "worse"]
    assert gpu.ctx.error == "GL_NO_ERROR"


def test_variants_are_dealt_by_length() -> None:
    found = {name: "x" * length for name, length in zip("abcde", (5, 1, 4, 2, 3), strict=True)}
    dealt = compiling.dealt(found, 2)
    assert [[label for label, _ in chunk] for chunk in dealt] == [["a", "e", "b"], ["c", "d"]]
    assert len(compiling.dealt(found, 9)) == 5


@pytest.mark.slow
def test_a_process_that_ends_is_a_fault_of_what_it_left() -> None:
    fine, *crashed = sorted(spread(gpu_check_samples.at_work, [0, 1, 2], 1), key=lambda done: done.item)
    assert (fine.result, fine.fault) == (0, None)
    assert all("BrokenProcessPool" in str(done.fault) for done in crashed)


@pytest.mark.slow
def test_what_is_raised_in_a_process_is_told() -> None:
    (done,) = spread(gpu_check_samples.at_fault, ["the sky"], 1)
    assert (done.result, done.fault) == (None, "the sky is green")


@pytest.mark.slow
@pytest.mark.usefixtures("one_picture")
def test_pictures_are_compared_in_processes_of_their_own(tmp_path: Path) -> None:
    step = findings(tmp_path)
    assert compare_pictures(step, 2) == "1 of 1 pictures agree with their goldens"
    assert step.record.sentence == "1 of 1 pictures compared"


def test_leaks_are_counted_by_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = iter([{"Buffer": 3, "Texture": 5}, {"Buffer": 3, "Texture": 5}, {"Buffer": 3, "Texture": 7}])
    monkeypatch.setattr("deltalight.benchmarks.gpu_check.steps.METHODS", ("paper",))
    monkeypatch.setattr("deltalight.render_server.gpu.context.count_gl_objects", lambda: next(counts))
    monkeypatch.setattr("deltalight.benchmarks.gpu_check.steps._rendered", Mock())
    step = findings(tmp_path)
    take_step("deltalight.benchmarks.gpu_check.steps:leaks", step)
    assert step.record.faults == ["paper: +2 Texture after 2 more renderers"]


@pytest.mark.slow
def test_a_method_leaves_no_objects_and_says_what_it_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deltalight.benchmarks.gpu_check.steps.METHODS", ("paper",))
    step = findings(tmp_path)
    take_step("deltalight.benchmarks.gpu_check.steps:leaks", step)
    assert step.record.state is State.PASSED, step.record
    take_step("deltalight.benchmarks.gpu_check.steps:memory", step)
    assert step.record.state is State.PASSED, step.record
    assert step.record.figures["held"]["paper"]["gl_objects"] > 50
    assert step.record.figures["held"]["paper"]["total_bytes"] > 1_000_000
    assert step.record.figures["room_bytes"] > step.record.figures["held"]["paper"]["total_bytes"]


@pytest.mark.slow
def test_speed_is_told_by_frames_and_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deltalight.benchmarks.gpu_check.steps.METHODS", ("paper",))
    monkeypatch.setattr("deltalight.benchmarks.gpu_check.steps.SIZES", {"small": ((72, 54), 32)})
    monkeypatch.setattr("deltalight.benchmarks.gpu_check.steps.SPEED_FRAMES", 2)
    step = findings(tmp_path)
    take_step("deltalight.benchmarks.gpu_check.steps:speed", step)
    assert step.record.state is State.PASSED, step.record
    assert step.record.figures["timed"]["small"]["paper"]["frames_ms"]["camera"] > 0
    report = Report(tmp_path, {}, [])
    report.put("speed", step.record)
    assert "## Speed at small" in (tmp_path / "report.md").read_text()
    assert "| composite |" in (tmp_path / "report.md").read_text()


def test_a_report_is_there_before_the_last_step_ends(tmp_path: Path) -> None:
    report = Report(tmp_path, {"commit": None}, ["pytest"])
    report.put("shaders", Record(sentence="12 shader variants so far"))
    assert not written(tmp_path)["finished"]
    markdown = (tmp_path / "report.md").read_text()
    assert "**Not finished**" in markdown
    assert "packages that are not installed: pytest" in markdown
    assert report.bad_steps == ["shaders did not end"]


def test_a_picture_without_golden_is_never_alike() -> None:
    black = np.zeros((2, 2, 3), np.uint8)
    assert not ComparedPicture("a", black, None, float("nan"), 60.0).is_alike


def test_run_takes_a_python_that_has_the_packages(tmp_path: Path) -> None:
    """Without .venv and network: by itself for gpu-check, elsewhere where DELTALIGHT_PYTHON names it."""
    shutil.copy(ROOT / "run", tmp_path)
    python = tmp_path / "bin" / "python3"
    python.parent.mkdir()
    python.write_text('#!/bin/sh\n[ "$1" = -c ] || echo "$PYTHONPATH: $*"\n')
    python.chmod(0o755)
    environment = {"PATH": f"{python.parent}:{os.environ['PATH']}"}

    def said(*words: str, **more: str) -> str:
        command = [str(tmp_path / "run"), *words]
        done = subprocess.run(
            command, env=environment | more, capture_output=True, text=True, timeout=30, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert said("gpu-check", "--out", "x") == f"{tmp_path}: -m deltalight.services gpu-check --out x\n"
    assert said("doctor", DELTALIGHT_PYTHON=str(python)) == f"{tmp_path}: -m deltalight.services doctor\n"
