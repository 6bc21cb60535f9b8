"""`deltalight render`: what it writes, and a sentence with exit code 2 for every bad input."""

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
import trimesh

import deltalight as dl
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import linear_color
from deltalight.protocol.radiance_files import read_linear
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.render_server.view import resized_frame
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera
from deltalight.services.object_sizes import likely_factor
from deltalight.services.offline import RenderJob
from tests.services.conftest import ROOT, RunCli

FRAMES = 3
FRAME_WITHOUT_BOARD = 2
SIZE = (320, 240)


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `take` (dataset), `take.mcap`, `scene.json` and the box that it names."""
    folder = tmp_path_factory.mktemp("render")
    write_take(folder)
    trimesh.creation.box((0.06, 0.06, 0.06)).export(folder / "box.glb")
    write_scene(folder / "scene.json")
    return folder


def write_take(folder: Path) -> None:
    matrix = np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]])
    synthetic = SyntheticCamera(camera=CameraModel(*SIZE, matrix))
    frames = [synthetic.frame_at(index) for index in range(FRAMES)]
    grey = np.full_like(frames[0].color, 120)
    frames[FRAME_WITHOUT_BOARD] = replace(frames[FRAME_WITHOUT_BOARD], color=grey)
    with (
        DatasetWriter(folder / "take", board=synthetic.board) as dataset,
        RecordingWriter(folder / "take.mcap", board=synthetic.board) as recording,
    ):
        for frame in frames:
            dataset.add(frame)
            recording.add(frame)


def scene_document(**changes: object) -> dict[str, object]:
    directional = {"type": "directional", "direction": [0.3, 0.4, -1.0], "irradiance": 2.0}
    return {
        "name": "box",
        "objects": [{"asset": "box.glb", "pose": {"translation_m": [0.1, -0.1, 0.03]}}],
        "lights": {"mode": "manual", "manual": [directional, {"type": "ambient", "radiance": 0.2}]},
        "method": {
            "name": "dvct",
            "operator": "paper",
            "volume_size": 32,
            "rsm_size": 128,
            "triangle_budget": 5000,
        },
        **changes,
    }


def write_scene(path: Path, **changes: object) -> Path:
    path.write_text(json.dumps(scene_document(**changes)))
    return path


def records(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]


def read_rgb(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def test_writes_pictures_index_and_one_summary_line(cli: RunCli, take: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = cli("render", take / "take", "--scene", take / "scene.json", "--out", out)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in out.iterdir()) == [
        *(f"{number:06d}.png" for number in range(FRAMES)),
        "frames.jsonl",
    ]
    lines = records(out)
    assert [line["frame"] for line in lines] == [0, 1, 2]
    assert [line["status"] for line in lines] == ["ok", "ok", "no_pose"]
    assert np.array(lines[0]["pose"]["world_from_camera"]).shape == (4, 4)
    assert lines[0]["pass_times_ms"]
    assert lines[0]["lights"]
    assert lines[FRAME_WITHOUT_BOARD]["pose"] is None
    assert all(line["drops"] == 0 for line in lines)
    assert done.stdout.count("\n") == 1
    assert "3 frames, 1 without a pose" in done.stdout
    assert done.stderr.count("warning: no GPU found") <= 1


def test_frame_without_pose_is_the_camera_picture_bit_for_bit(
    cli: RunCli, take: Path, tmp_path: Path
) -> None:
    done = cli(
        "render", take / "take.mcap", "--scene", take / "scene.json", "--out", tmp_path, "--frames", "1:3"
    )
    assert done.returncode == 0, done.stderr
    assert [line["frame"] for line in records(tmp_path)] == [1, 2]
    assert np.all(read_rgb(tmp_path / "000002.png") == 120)
    assert not (tmp_path / "000000.png").exists()


@pytest.mark.slow
def test_second_run_overwrites_and_is_bit_identical(
    cli: RunCli, cli_process: RunCli, take: Path, tmp_path: Path
) -> None:
    pictures = []
    for start, is_second in ((cli, False), (cli_process, True)):
        done = start(
            "render", take / "take", "--scene", take / "scene.json", "--out", tmp_path, "--frames", ":1"
        )
        assert done.returncode == 0, done.stderr
        assert ("has pictures of an earlier run" in done.stderr) is is_second
        pictures.append((tmp_path / "000000.png").read_bytes())
    assert pictures[0] == pictures[1]
    assert len(records(tmp_path)) == 1


def test_size_exr_and_json(cli: RunCli, take: Path, tmp_path: Path) -> None:
    options = (
        "--frames",
        "0:1",
        "--size",
        "160x120",
        "--exr",
        "--layers",
        "exr",
        "--json",
        "--allow-software",
    )
    done = cli("render", take / "take", "--scene", take / "scene.json", "--out", tmp_path, *options)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["frames"] == 1
    assert read_rgb(tmp_path / "000000.png").shape == (120, 160, 3)
    assert (tmp_path / "000000.exr").read_bytes()[:4] == struct.pack("<I", 20000630)
    assert "no GPU" not in done.stderr
    with OpenEXR.File(str(tmp_path / "000000.layers.exr")) as file:
        layers = {name: channel.pixels for name, channel in file.channels().items()}
    plate = linear_color_of(take / "take", (160, 120))
    over, cover = layers["RGBA"][..., :3], layers["RGBA"][..., 3:]
    assert 0 < np.count_nonzero(cover) < cover.size / 4
    assert plate * layers["ratio"] * (1 - cover) + over == pytest.approx(
        read_linear(tmp_path / "000000.exr"), rel=2e-3, abs=1e-4
    )
    assert layers["Z"][60, 80] == pytest.approx(np.median(layers["Z"]), rel=0.5), "metres, as the room's"


def linear_color_of(folder: Path, size: tuple[int, int]) -> np.ndarray:
    """The camera's first picture in linear units at another size."""
    take = dl.open(folder)
    assert isinstance(take, dl.Take)
    frame = resized_frame(take[0], *size)
    return linear_color(frame, frame.color)


def test_another_method_by_the_short_form_of_out(cli: RunCli, take: Path, tmp_path: Path) -> None:
    common = ("render", take / "take", "--scene", take / "scene.json", "--frames", "0:1", "--allow-software")
    for method in ("dlpv", "dvct"):
        done = cli(*common, "-o", tmp_path / method, "--method", method)
        assert done.returncode == 0, done.stderr
    passes = [records(tmp_path / method)[0]["pass_times_ms"] for method in ("dlpv", "dvct")]
    assert [any("propagate" in name for name in of_one) for of_one in passes] == [True, False]


def test_pictures_are_the_best_unless_another_quality_is_asked_for(
    cli: RunCli, take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    qualities: list[str] = []

    def refuse(job: RenderJob, _watcher: object) -> None:
        qualities.append(job.scene.method.quality)
        raise DeltalightError("nothing is rendered here")

    monkeypatch.setattr("deltalight.services.offline.run_job", refuse)
    scene = write_scene(tmp_path / "scene.json", objects=[], method={"name": "none", "quality": "balanced"})
    common = ("render", take / "take", "--scene", scene, "-o", tmp_path / "out")
    for options in ((), ("--quality", "live")):
        assert_refused(cli(*common, *options), "nothing is rendered")
    assert qualities == ["best", "live"]
    assert cli(*common, "--quality", "fast").returncode == 2


def test_a_video_in_place_of_a_folder(cli: RunCli, take: Path, tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    out = tmp_path / "take.mp4"
    common = ("render", take / "take", "--scene", take / "scene.json", "--out", out)
    done = cli(*common, "--frames", "0:2", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["frames"] == 2
    with av.open(str(out)) as container:
        assert len(list(container.decode(video=0))) == 2
    assert_refused(cli(*common), "already exists")
    assert_refused(cli(*common[:-1], tmp_path / "b.mp4", "--exr"), "name a folder")
    assert [path.name for path in tmp_path.iterdir()] == ["take.mp4"]


def test_a_file_in_another_unit_is_told_with_the_scale_that_helps(
    cli: RunCli, take: Path, tmp_path: Path
) -> None:
    (tmp_path / "mug.obj").write_text(triangles([[0, 0, 0], [12, 0, 0], [0, 9, 0]]))
    mugs = [{"id": "mug", "asset": "mug.obj"}, {"id": "small", "asset": "mug.obj", "pose": {"scale": 0.01}}]
    scene = write_scene(tmp_path / "scene.json", objects=mugs, method={"name": "none"})
    done = cli("render", take / "take", "--scene", scene, "-o", tmp_path / "out", "--frames", "0:1")
    assert done.returncode == 0, done.stderr
    told = [line for line in done.stderr.splitlines() if "object `" in line]
    assert len(told) == 1
    assert 'object `mug` is 12 m long. If its file is in centimetres, write "scale": 0.01' in told[0]


@pytest.mark.parametrize(
    ("edge_m", "factor"), [(30, 0.01), (12, 0.01), (1.5, 0.01), (120, 0.001), (800, 0.001), (0.002, 100)]
)
def test_the_likely_unit_of_a_file(edge_m: float, factor: float) -> None:
    assert likely_factor(edge_m) == pytest.approx(factor)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--frames", "2:2"), "choose A < B"),
        (("--frames", "0:99"), "which has 3"),
        (("--frames", "first"), "write A:B"),
        (("--size", "640"), "WIDTHxHEIGHT"),
        (("--size", "8x8"), "each from 16"),
    ],
)
def test_wrong_options_are_sentences(
    cli: RunCli, take: Path, tmp_path: Path, options: tuple[str, str], sentence: str
) -> None:
    out = tmp_path / "out"
    done = cli("render", take / "take", "--scene", take / "scene.json", "--out", out, *options)
    assert_refused(done, sentence)
    assert not out.exists()


def test_wrong_use_is_exit_code_2(cli: RunCli) -> None:
    assert cli("render").returncode == 2
    assert cli("redner").returncode == 2
    assert cli("render", "x", "--out", "y", "--view", "sideways").returncode == 2


def assert_refused(done: subprocess.CompletedProcess[str], sentence: str) -> None:
    assert done.returncode == 2, done.stderr
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
    last_line = done.stderr.strip().splitlines()[-1]
    assert last_line.startswith("deltalight: ")


def test_out_that_is_a_file_or_cannot_be_made(cli: RunCli, take: Path, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.touch()
    for out, sentence in ((taken, "is a file"), (taken / "below", "cannot be written")):
        assert_refused(cli("render", take / "take", "--scene", take / "scene.json", "--out", out), sentence)


def test_out_that_looks_like_another_file_makes_no_folder(cli: RunCli, take: Path, tmp_path: Path) -> None:
    for name in ("take.mov", "frame.PNG", "take.MP4"):
        done = cli("render", take / "take", "--scene", take / "scene.json", "--out", tmp_path / name)
        assert_refused(done, "name a folder for the pictures, or NAME.mp4 for a video")
        assert not (tmp_path / name).exists()


def test_source_without_scene_needs_one(cli: RunCli, take: Path, tmp_path: Path) -> None:
    assert_refused(cli("render", take / "take", "--out", tmp_path / "out"), "--scene")


def remove(name: str) -> object:
    def change(folder: Path) -> None:
        target = folder / name
        shutil.rmtree(target) if target.is_dir() else target.unlink()

    return change


def shrink_depth(folder: Path) -> None:
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), np.full((10, 10), 500, np.uint16))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        pytest.param(remove("rgb.txt"), "rgb.txt", id="missing list"),
        pytest.param(remove("calibration"), "calibration", id="no calibration"),
        pytest.param(shrink_depth, "10", id="depth of another size"),
    ],
)
def test_broken_datasets_are_sentences(
    cli: RunCli, take: Path, tmp_path: Path, change: object, sentence: str
) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(take / "take", broken)
    assert callable(change)
    change(broken)
    out = tmp_path / "out"
    assert_refused(cli("render", broken, "--scene", take / "scene.json", "--out", out), sentence)
    assert not list(out.glob("*.png"))
    assert not list(out.glob(".*"))


def test_source_that_is_missing_or_no_recording(cli: RunCli, take: Path, tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("no recording")
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    for source in (tmp_path / "nowhere", text, empty):
        assert_refused(
            cli("render", source, "--scene", take / "scene.json", "--out", tmp_path / "out"), source.name
        )


def light(**changes: object) -> dict[str, object]:
    return {"mode": "manual", "manual": [{"type": "directional", "direction": [0, 0, -1], **changes}]}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        pytest.param({"lihgts": {}}, "nearest known key is `lights`", id="unknown key"),
        pytest.param({"lights": light(irradiance=-1.0)}, "irradiance", id="negative light"),
        pytest.param({"objects": [{"asset": "absent.glb"}]}, "absent.glb", id="missing asset"),
        pytest.param({"method": {"name": "dvtc"}}, "dvct", id="unknown method"),
        pytest.param(
            {"method": {"name": "dvct", "volume_size": 512, "memory_budget_mb": 16}},
            "memory_budget_mb",
            id="memory",
        ),
    ],
)
def test_broken_scenes_are_sentences(
    cli: RunCli, take: Path, tmp_path: Path, changes: dict[str, object], sentence: str
) -> None:
    scene = take / f"broken-{os.getpid()}.json"
    write_scene(scene, **changes)
    out = tmp_path / "out"
    assert_refused(cli("render", take / "take", "--scene", scene, "--out", out), sentence)
    assert not list(out.glob("*"))


def test_fish_eye_light_that_the_source_lacks_is_a_sentence(cli: RunCli, take: Path, tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene.json", lights={"mode": "fisheye"})
    shutil.copy(take / "box.glb", tmp_path)
    done = cli("render", str(take / "take"), "--scene", str(scene), "--out", str(tmp_path / "out"))
    assert_refused(done, "the source shows none")
    assert list((tmp_path / "out").glob("*.png")) == []


def triangles(vertices: list[list[float]]) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    return "\n".join([*lines, *(["f 1 2 3"] if vertices else [])]) + "\n"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        pytest.param(triangles([[float("nan"), 0, 0], [1, 0, 0], [0, 1, 0]]), "mesh.obj", id="NaN"),
        pytest.param(triangles([[1e30, 0, 0], [1, 0, 0], [0, 1, 0]]), "mesh.obj", id="huge"),
        pytest.param(triangles([]), "mesh.obj", id="empty"),
    ],
)
def test_broken_meshes_are_sentences(
    cli: RunCli, take: Path, tmp_path: Path, content: str, sentence: str
) -> None:
    (tmp_path / "mesh.obj").write_text(content)
    scene = write_scene(tmp_path / "scene.json", objects=[{"asset": "mesh.obj"}])
    out = tmp_path / "out"
    assert_refused(cli("render", take / "take", "--scene", scene, "--out", out), sentence)
    assert not list(out.glob("*"))


def test_truncated_recording(cli: RunCli, take: Path, tmp_path: Path) -> None:
    """What is complete in it is rendered, or it is refused in a sentence: nothing else."""
    whole = (take / "take.mcap").read_bytes()
    for share in (0.3, 0.9):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(whole[: int(share * len(whole))])
        done = cli("render", cut, "--scene", take / "scene.json", "--out", tmp_path / f"out{share}")
        assert done.returncode in (0, 2)
        assert "Traceback" not in done.stderr
        assert done.stderr.strip()


def test_missing_gpu_is_a_sentence(
    cli: RunCli, take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("render", take / "take", "--scene", take / "scene.json", "--out", tmp_path / "out")
    assert_refused(cli(*command, "--device", "77"), "deltalight doctor")
    monkeypatch.setenv("GLCONTEXT_LINUX_LIBEGL", "/nonexistent/libEGL.so")
    assert_refused(cli(*command), "apt-get install")


def test_debug_shows_the_traceback(cli_process: RunCli, tmp_path: Path) -> None:
    done = cli_process("render", tmp_path / "nowhere", "--out", tmp_path / "out", "--debug")
    assert done.returncode != 0
    assert "Traceback" in done.stderr


@pytest.mark.slow
def test_ctrl_c_is_130_and_leaves_whole_files(take: Path, tmp_path: Path) -> None:
    scene = write_scene(take / "slow.json", method={"name": "dvct", "volume_size": 128})
    out = tmp_path / "out"
    command: list[str | Path] = [
        sys.executable,
        "-m",
        "deltalight.services.cli",
        "render",
        take / "take",
        "--scene",
        scene,
        "--out",
        out,
    ]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    deadline_s = time.monotonic() + 60
    while not out.exists() and time.monotonic() < deadline_s:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in error
    assert not list(out.glob(".*"))
    pictures = len(list(out.glob("*.png")))
    lines = len(records(out)) if (out / "frames.jsonl").exists() else 0
    assert lines <= pictures <= lines + 1
