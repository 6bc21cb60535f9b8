"""The dataset reader on real captures of several cameras (skipped where they are absent)."""

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel, save_camera_yaml
from deltalight.protocol.dataset import DatasetReader, open_dataset
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.source import open_source


def link_lists(folder: Path, colors: list[Path], depths: list[Path]) -> None:
    """Lists pictures that lie elsewhere, through links, one a tenth of a second."""
    for kind, paths in (("rgb", colors), ("depth", depths)):
        (folder / kind).mkdir(parents=True)
        for path in paths:
            (folder / kind / path.name).symlink_to(path)
        lines = [f"{index / 10} {kind}/{path.name}\n" for index, path in enumerate(paths)]
        (folder / f"{kind}.txt").write_text("".join(lines))
    (folder / "calibration").mkdir()


def camera_matrix(intrinsics: tuple[float, ...]) -> np.ndarray:
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def visp_intrinsics(path: Path) -> tuple[float, ...]:
    text = path.read_text()
    return tuple(float(re.findall(rf"<{key}>\s*([-0-9.]+)", text)[0]) for key in ("px", "py", "u0", "v0"))


def calibrate(
    folder: Path, intrinsics: tuple[float, ...], distortion: tuple[float, ...], depth_yaml: str
) -> None:
    model = CameraModel(640, 480, camera_matrix(intrinsics), "plumb_bob", np.array(distortion))
    save_camera_yaml(folder / "calibration" / "rgb.yaml", model, "rgb")
    if depth_yaml:
        (folder / "calibration" / "depth.yaml").write_text(depth_yaml)


def check_real(reader: DatasetReader, count: int, median_m: tuple[float, float]) -> None:
    assert len(reader) == count
    assert reader.unpaired == 0
    frame = reader[count - 1]
    assert frame.color.shape == (480, 640, 3)
    assert frame.color.std() > 10
    assert frame.depth is not None
    valid = frame.depth.depth_m[frame.depth.valid]
    assert valid.size > 0.3 * frame.depth.depth_m.size
    assert median_m[0] < np.median(valid) < median_m[1]
    assert (frame.depth.depth_m[~frame.depth.valid] == 0).all()


@pytest.mark.data
def test_visp_desk(shared_data: Path) -> None:
    reader = open_dataset(shared_data / "rgbd" / "visp_rbt_apriltag")
    check_real(reader, 30, (0.4, 1.2))
    assert reader.board is not None
    assert reader.board.marker_ids == tuple(range(11, -1, -1))
    assert reader.camera.matrix[0, 0] == 607.178
    assert reader[1].timestamp_ns == 66_667_000


@pytest.mark.data
def test_tum_freiburg1(shared_data: Path, tmp_path: Path) -> None:
    source, folder = shared_data / "rgbd" / "tum_fr1_rpy", tmp_path / "a"
    shutil.copytree(source, folder, symlinks=True, copy_function=os.symlink)
    for folder_path in (folder, folder / "rgb", folder / "depth"):
        folder_path.chmod(0o755)
    for kind in ("rgb", "depth"):
        names = sorted(path.name for path in (source / kind).iterdir())
        lines = [f"{name.removesuffix('.png')} {kind}/{name}\n" for name in names]
        (folder / f"{kind}.txt").write_text("".join(lines))
    with pytest.raises(DeltalightError, match=r"no calibration/rgb\.yaml"):
        open_dataset(folder)
    (folder / "calibration").mkdir()
    distortion = (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
    calibrate(folder, (517.306408, 516.469215, 318.64304, 255.313989), distortion, "")
    reader = open_dataset(folder)
    check_real(reader, 15, (0.5, 4.0))
    times = [frame.depth_timestamp_ns for frame in reader]
    assert len(set(times)) == 15
    assert reader[0].timestamp_ns == 1_305_031_231_925_706_000
    assert reader[0].depth_timestamp_ns == 1_305_031_231_933_046_000
    poses = [frame.world_from_camera for frame in reader]
    assert all(pose is not None for pose in poses)
    assert all(np.linalg.det(np.asarray(pose)[:3, :3]) == pytest.approx(1) for pose in poses)


@pytest.mark.data
def test_realsense_boxes(shared_data: Path, tmp_path: Path) -> None:
    source, folder = shared_data / "rgbd" / "realsense_plane_boxes_mit", tmp_path / "a"
    link_lists(folder, sorted((source / "color").iterdir()), sorted((source / "depth").iterdir()))
    values = json.loads((source / "cam_params_realsense.json").read_text())["intrinsic_matrix"]
    calibrate(folder, (values[0], values[4], values[6], values[7]), (), "depth_scale: 0.001\n")
    check_real(open_dataset(folder), 10, (0.4, 3.0))


@pytest.mark.data
def test_castle_with_a_depth_camera_of_its_own(shared_data: Path, tmp_path: Path) -> None:
    source, folder = shared_data / "rgbd" / "visp_castel_realsense", tmp_path / "a"
    link_lists(folder, sorted((source / "image").iterdir()), sorted((source / "depth").iterdir()))
    calibrate(folder, visp_intrinsics(source / "chateau.xml"), (), "")
    own = CameraModel(640, 480, camera_matrix(visp_intrinsics(source / "chateau_depth.xml")))
    extra = {"depth_scale": 0.000124986647}
    save_camera_yaml(folder / "calibration" / "depth.yaml", own, "depth", extra)
    depth_from_rgb = np.loadtxt(source / "depth_M_color.txt").reshape(4, 4)
    (folder / "calibration" / "extrinsics.yaml").write_text(f"depth_from_rgb: {depth_from_rgb.tolist()}\n")
    reader = open_dataset(folder)
    check_real(reader, 5, (0.2, 0.35))
    depth = reader[0].depth
    assert depth is not None
    assert depth.camera == own != reader.camera
    assert reader.extrinsics.depth_from_rgb is not None
    assert np.linalg.det(reader.extrinsics.depth_from_rgb[:3, :3]) == pytest.approx(1, abs=1e-4)


@pytest.mark.data
def test_redwood_living_room(shared_data: Path, tmp_path: Path) -> None:
    source, folder = shared_data / "rgbd" / "open3d_redwood_livingroom" / "RGBD", tmp_path / "a"
    link_lists(folder, sorted((source / "color").iterdir()), sorted((source / "depth").iterdir()))
    calibrate(folder, (525.0, 525.0, 319.5, 239.5), (), "depth_scale: 0.001\n")
    reader = open_dataset(folder)
    check_real(reader, 5, (0.5, 5.0))
    assert reader[0].color_jpeg is not None


@pytest.mark.data
def test_linemod_clutter(shared_data: Path, tmp_path: Path) -> None:
    source, folder = shared_data / "rgbd" / "linemod_markerboard", tmp_path / "a"
    link_lists(folder, [source / "0000_rgb.png"], [source / "0000_depth.png"])
    calibrate(folder, (572.4114, 573.57043, 325.2611, 242.04899), (), "depth_scale: 0.001\n")
    check_real(open_dataset(folder), 1, (0.4, 2.0))


@pytest.mark.data
def test_bare_folders_say_that_the_list_is_missing(shared_data: Path) -> None:
    bare = [
        path for path in (shared_data / "rgbd").iterdir() if path.is_dir() and not (path / "rgb.txt").exists()
    ]
    assert len(bare) >= 5
    for folder in bare:
        with pytest.raises(DeltalightError, match=r"has no rgb\.txt"):
            open_source(folder)
