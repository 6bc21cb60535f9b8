"""`deltalight calibrate`: files written, reports, sentences, and nothing written over."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from deltalight.protocol.board import load_board_yaml
from deltalight.protocol.calibration import Extrinsics, load_extrinsics_yaml, save_extrinsics_yaml
from deltalight.protocol.camera_model import CameraModel, load_camera_yaml
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeCalibration, load_fisheye_yaml, save_fisheye_yaml
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera
from deltalight.services.cli import app
from deltalight.services.demo import RECORDING
from tests.sensor_node.calibration_samples import picture, poses
from tests.services.conftest import RunCli

CAMERA = CameraModel(
    400,
    300,
    np.array([[330.0, 0, 203.0], [0, 330.0, 147.0], [0, 0, 1]]),
    "plumb_bob",
    np.array([-0.2, 0.05, 0, 0, 0]),
)
FISHEYE = CameraModel(
    400,
    300,
    np.array([[190.0, 0, 203.0], [0, 190.0, 147.0], [0, 0, 1]]),
    "equidistant",
    np.array([-0.02, 0.004, 0.0, 0.0]),
)
TARGET = ("--target", "chessboard:8x6:0.04")


def calibrate(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["calibrate", *(str(argument) for argument in arguments)])


def sentence(done: Result) -> str:
    assert isinstance(done.exception, DeltalightError), done.output
    return str(done.exception)


def shoot(folder: Path, camera: CameraModel, reach: tuple[float, float], distance: float, count: int) -> Path:
    folder.mkdir()
    for number, pose in enumerate(poses(count, reach, distance)):
        cv2.imwrite(str(folder / f"shot{number}.png"), picture(camera, pose))
    return folder


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shoot(tmp_path_factory.mktemp("shots") / "rgb", CAMERA, (0.3, 0.22), 0.6, 14)


@pytest.fixture(scope="module")
def fisheye_shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shoot(tmp_path_factory.mktemp("shots") / "fisheye", FISHEYE, (0.7, 0.5), 0.4, 14)


def test_camera_writes_rgb_yaml_pictures_and_a_report(shots: Path, tmp_path: Path) -> None:
    done = calibrate("camera", shots, "--out", tmp_path, *TARGET)
    assert done.exit_code == 0, done.output
    found = load_camera_yaml(tmp_path / "calibration" / "rgb.yaml")
    np.testing.assert_allclose(found.matrix, CAMERA.matrix, rtol=0.01, atol=1.5)
    written = sorted(path.name for path in (tmp_path / "calibration").iterdir())
    assert written == ["rgb.yaml", "rgb_coverage.png", "rgb_residuals.png"]
    coverage = cv2.imread(str(tmp_path / "calibration" / "rgb_coverage.png"))
    assert coverage is not None
    assert coverage.shape == (300, 400, 3)
    assert "shot3.png" in done.output
    assert "% of the picture seen" in done.output


def test_json_has_the_figures_and_older_results_stay(shots: Path, tmp_path: Path) -> None:
    arguments = ("camera", shots, "--out", tmp_path, *TARGET, "--json")
    done = calibrate(*arguments)
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["pictures"] == 14
    assert report["views"] == len(report["per_view"])
    assert report["rms_px"] < 0.2
    before = (tmp_path / "calibration" / "rgb.yaml").read_bytes()
    assert "overwrite it with --force" in sentence(calibrate(*arguments))
    assert (tmp_path / "calibration" / "rgb.yaml").read_bytes() == before
    assert calibrate(*arguments, "--force").exit_code == 0


def test_fisheye_keeps_response_and_vignetting_of_an_older_file(fisheye_shots: Path, tmp_path: Path) -> None:
    (tmp_path / "calibration").mkdir()
    path = tmp_path / "calibration" / "fisheye.yaml"
    table = np.repeat(np.linspace(0, 1, 256)[:, None] ** 2, 3, axis=1).astype(np.float32)
    save_fisheye_yaml(path, FisheyeCalibration(EquidistantLens(FISHEYE), table, (-0.05,)))
    done = calibrate("fisheye", fisheye_shots, "--out", tmp_path, *TARGET, "--force", "--model", "ocam")
    assert done.exit_code == 0, done.output
    found = load_fisheye_yaml(path)
    assert found.vignetting == (-0.05,)
    np.testing.assert_array_equal(found.response, table)
    rays = np.array([[0.0, 0.0, 1.0], [0.5, 0.2, 1.0], [-0.6, 0.3, 1.0]])
    truth = EquidistantLens(FISHEYE).project(rays)
    np.testing.assert_allclose(found.lens.project(rays), truth, atol=0.8)


def test_a_refused_set_leaves_pictures_but_no_calibration(tmp_path: Path) -> None:
    middle = shoot(tmp_path / "shots", CAMERA, (0.01, 0.01), 1.3, 9)
    done = calibrate("camera", middle, "--out", tmp_path / "out", *TARGET)
    assert "of the picture's cells" in sentence(done)
    written = sorted(path.name for path in (tmp_path / "out" / "calibration").iterdir())
    assert written == ["rgb_coverage.png", "rgb_residuals.png"]


def test_wrong_use_ends_with_code_2_and_one_sentence(cli: RunCli, shots: Path, tmp_path: Path) -> None:
    done = cli("calibrate", "camera", shots, "--out", tmp_path)
    assert done.returncode == 2
    assert done.stderr.strip().count("\n") == 0
    assert "name the target with --target" in done.stderr
    assert "give 5 or 8" in sentence(calibrate("camera", shots, "--out", tmp_path, "--coefficients", 6))
    for name, said in (
        ("a.bag", "a.bag is a ROS bag; make"),
        ("a.mp4", "a.mp4 is one file; give the folder"),
    ):
        (tmp_path / name).touch()
        assert said in sentence(calibrate("camera", tmp_path / name, "--out", tmp_path))
    wrong = calibrate("camera", shots, "--out", tmp_path, "--target", "chessboard:9x7:0.04")
    assert "only 0 of 14 pictures" in sentence(wrong)


def test_a_camera_that_is_not_there_asks_nobody_to_show_the_target(tmp_path: Path) -> None:
    done = calibrate("camera", "uvc:63", "--out", tmp_path, *TARGET)
    assert "uvc:63" in sentence(done)
    assert "Show the target" not in done.output


def test_what_is_refused_leaves_no_folder(shots: Path, take: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    for out in (tmp_path / "new" / "out", tmp_path / "out"):
        sentence(calibrate("camera", shots, "--out", out))
        sentence(calibrate("camera", tmp_path / "nowhere", "--out", out, *TARGET))
        sentence(calibrate("extrinsics", take, "--out", out, "--what", "rgb_from_fisheye"))
        sentence(calibrate("photometric", take, "--out", out, "--card", "0,0,0,0"))
    assert [path.name for path in tmp_path.rglob("*")] == ["out"]


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of the synthetic scene: one tilt, so its depth sensor cannot be placed."""
    camera = SyntheticCamera()
    path = tmp_path_factory.mktemp("take") / "take"
    with DatasetWriter(path, board=camera.board) as writer:
        for index in range(0, 90, 14):
            writer.add(camera.frame_at(index))
    return path


def test_a_recording_without_pictures_of_the_camera_is_told(tmp_path: Path) -> None:
    assert "holds no pictures of this camera" in sentence(calibrate("fisheye", RECORDING, "--out", tmp_path))


def test_extrinsics_are_refused_or_kept_and_never_overwritten(take: Path, tmp_path: Path) -> None:
    (tmp_path / "calibration").mkdir()
    path = tmp_path / "calibration" / "extrinsics.yaml"
    save_extrinsics_yaml(path, Extrinsics(world_from_fisheye=np.eye(4)))
    before = path.read_bytes()
    arguments = ("extrinsics", take, "--out", tmp_path, "--what")
    assert "has world_from_fisheye already" in sentence(calibrate(*arguments, "world_from_fisheye"))
    assert "no pictures of a fish-eye camera" in sentence(calibrate(*arguments, "rgb_from_fisheye"))
    assert "leave depth_from_rgb uncertain" in sentence(calibrate(*arguments, "depth_from_rgb"))
    assert path.read_bytes() == before


def test_extrinsics_are_written_beside_the_others(
    take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deltalight.sensor_node.calibration import extrinsics

    known = np.eye(4)
    known[:3, 3] = 0.1, 0.2, 0.3
    monkeypatch.setattr(extrinsics, "world_from_fisheye_poses", lambda *_: iter([known] * 6))
    (tmp_path / "calibration").mkdir()
    path = tmp_path / "calibration" / "extrinsics.yaml"
    save_extrinsics_yaml(path, Extrinsics(depth_from_rgb=np.eye(4)))
    done = calibrate("extrinsics", take, "--out", tmp_path, "--what", "world_from_fisheye", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["spread_mm"] == pytest.approx(0)
    found = load_extrinsics_yaml(path)
    assert found.depth_from_rgb is not None
    assert found.world_from_fisheye is not None
    np.testing.assert_allclose(found.world_from_fisheye, known)


def bracket(folder: Path) -> Path:
    folder.mkdir()
    light = np.repeat(10 ** np.linspace(-0.5, 3, 160)[None, :, None], 90, axis=0) * np.ones(3)
    lines = []
    for number, exposure in enumerate((0.002, 0.008, 0.03, 0.12)):
        codes = np.rint(255 * np.clip(light * exposure, 0, 1) ** (1 / 2.2)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), codes)
        lines.append(f"{number} {number}.png {exposure}\n")
    (folder / "rgb.txt").write_text("".join(lines))
    (folder / "fisheye.txt").write_text("".join(lines))
    return folder


def test_photometric_writes_the_response(tmp_path: Path) -> None:
    shots, out = bracket(tmp_path / "shots"), tmp_path / "out"
    done = calibrate("photometric", shots, "--out", out, "--json")
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["residual_percent"] < 3
    table = np.loadtxt(out / "response.txt")
    assert table.shape == (256, 3)
    assert table[128, 1] / table[64, 1] == pytest.approx(2**2.2, rel=0.05)
    assert "holds a response already" in sentence(calibrate("photometric", shots, "--out", out))
    eye = ("photometric", shots, "--out", out, "--eye", "fisheye")
    assert "run `deltalight calibrate fisheye` first" in sentence(calibrate(*eye))
    (out / "calibration").mkdir()
    save_fisheye_yaml(out / "calibration" / "fisheye.yaml", FisheyeCalibration(EquidistantLens(FISHEYE)))
    assert calibrate(*eye).exit_code == 0
    response = load_fisheye_yaml(out / "calibration" / "fisheye.yaml").response
    assert response is not None
    np.testing.assert_allclose(response, table, atol=1e-6)


def test_photometric_finds_the_papers_albedo(take: Path, tmp_path: Path) -> None:
    """The white of the sheet is taken for a card of 0.8: then the paper has 0.8 too."""
    card = ("--card", "0.052,-0.002,0.063,-0.046", "--card-albedo", 0.8)
    done = calibrate("photometric", take, "--out", tmp_path, *card)
    assert done.exit_code == 0, done.output
    board = load_board_yaml(tmp_path / "calibration" / "board.yaml")
    assert board.white_albedo == pytest.approx(0.8, rel=0.02)
    assert "white_albedo 0." in sentence(calibrate("photometric", take, "--out", tmp_path, *card))
