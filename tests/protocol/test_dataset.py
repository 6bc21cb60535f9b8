"""Dataset folders: every form that docs/formats.md 1 allows, the real captures, and what bad folders are told."""

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel, save_camera_yaml
from deltalight.protocol.dataset import open_dataset
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.pictures import decode_depth_png, decode_rgb, depth_from_steps, encode_png
from deltalight.protocol.source import open_source

WIDTH, HEIGHT = 32, 24


def camera(width: int = WIDTH, height: int = HEIGHT, focal: float = 30.0) -> CameraModel:
    return CameraModel(width, height, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]))


def pixels(path: Path) -> np.ndarray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def write_folder(folder: Path, count: int = 4, depth_offset_s: float = 0.001) -> Path:
    """A small dataset: colour pictures 0.1 s apart, depth a little later; the last depth code is 65535."""
    rng = np.random.default_rng(7)
    for name in ("rgb", "depth", "calibration"):
        (folder / name).mkdir(parents=True)
    save_camera_yaml(folder / "calibration" / "rgb.yaml", camera(), "rgb")
    (folder / "calibration" / "depth.yaml").write_text("depth_scale: 0.001\n")
    colors, depths = ["# timestamp filename"], []
    for index in range(count):
        color = rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
        steps = rng.integers(400, 3000, (HEIGHT, WIDTH), np.uint16)
        steps[0, 0], steps[0, 1] = 0, 65535
        cv2.imwrite(str(folder / f"rgb/{index}.png"), color)
        cv2.imwrite(str(folder / f"depth/{index}.png"), steps)
        colors.append(f"{10 + index / 10:.6f} rgb/{index}.png")
        depths.append(f"{10 + index / 10 + depth_offset_s:.6f} depth/{index}.png")
    (folder / "rgb.txt").write_text("\n".join(colors) + "\n")
    (folder / "depth.txt").write_text("\n".join(depths) + "\n\n# end\n")
    return folder


def test_frames_are_decoded_with_units_masks_and_times(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a")
    reader = open_dataset(folder)
    assert len(reader) == 4
    frame = reader[2]
    steps = pixels(folder / "depth/2.png")
    bgr = pixels(folder / "rgb/2.png")
    assert np.array_equal(frame.color, bgr[..., ::-1])
    assert frame.frame_id == 2
    assert frame.timestamp_ns == 10_200_000_000
    assert frame.depth_timestamp_ns == 10_201_000_000
    assert frame.depth is not None
    assert not frame.depth.valid[0, :2].any()
    assert frame.depth.valid[1:].all()
    assert (frame.depth.depth_m[0, :2] == 0).all()
    assert frame.depth.depth_m[5, 5] == np.float32(steps[5, 5]) * np.float32(0.001)
    assert frame.depth.camera == frame.camera == camera()
    assert frame.color_jpeg is None
    assert frame.world_from_camera is None
    assert reader.depth_scale == 0.001
    assert reader[-1].frame_id == 3
    assert [item.frame_id for item in reader] == [0, 1, 2, 3]
    with pytest.raises(IndexError):
        reader[4]


def test_missing_optional_parts_are_said_once(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a")
    (folder / "calibration" / "depth.yaml").unlink()
    notes = "\n".join(open_dataset(folder).notes)
    for part in ("board.yaml", "depth.yaml", "groundtruth.txt", "fisheye.txt"):
        assert notes.count(part) == 1
    (folder / "depth.txt").unlink()
    reader = open_dataset(folder)
    assert reader[0].depth is None
    assert reader.depth_scale is None
    assert any("depth.txt" in note for note in reader.notes)


def test_tum_depth_without_calibration_is_in_five_thousandths(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a")
    (folder / "calibration" / "depth.yaml").unlink()
    depth = open_dataset(folder)[0].depth
    steps = pixels(folder / "depth/0.png")
    assert depth is not None
    assert depth.depth_m[3, 3] == pytest.approx(steps[3, 3] / 5000)


def test_pairing_takes_the_nearest_within_the_tolerance_and_counts_the_rest(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a")
    # Colour at 10.0, 10.1, 10.2, 10.3; the tolerance is the 20 ms limit, half the period being 50 ms.
    (folder / "depth.txt").write_text(
        "10.015 depth/0.png\n10.110 depth/1.png\n10.119 depth/2.png\n10.221 depth/3.png\n"
    )
    reader = open_dataset(folder)
    assert reader.tolerance_ns == 20_000_000
    assert [frame.depth_timestamp_ns for frame in reader] == [10_015_000_000, 10_110_000_000, None, None]
    assert reader.unpaired == 2
    assert any("2 of 4" in note for note in reader.notes)


def test_half_the_period_limits_the_pairing_of_fast_cameras(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a")
    (folder / "rgb.txt").write_text("".join(f"{10 + index / 100} rgb/{index}.png\n" for index in range(4)))
    assert open_dataset(folder).tolerance_ns == 5_000_000


def test_poses_are_interpolated_between_near_neighbours(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a")
    half = np.sqrt(0.5)
    (folder / "groundtruth.txt").write_text(
        "# timestamp tx ty tz qx qy qz qw\n10.05 0 0 0 0 0 0 1\n"
        f"10.15 1 2 3 0 0 {half} {half}\n10.21 5 5 5 0 0 0 2\n"
    )
    poses = [frame.world_from_camera for frame in open_dataset(folder)]
    assert poses[0] is None
    assert poses[3] is None
    assert poses[1] is not None
    assert poses[1][:3, 3] == pytest.approx([0.5, 1, 1.5])
    # 45 degrees about z, half way to 90.
    assert poses[1][:3, 0] == pytest.approx([half, half, 0])
    assert poses[2] is not None
    assert poses[2][0, 3] > 4


def test_exposure_response_jpeg_and_noise_are_read(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a", count=1)
    jpeg = cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), (10, 100, 200), np.uint8))[1].tobytes()
    (folder / "rgb" / "my picture.jpg").write_bytes(jpeg)
    (folder / "rgb.txt").write_text("10.0 rgb/my picture.jpg 0.02\n")
    (folder / "calibration" / "depth.yaml").write_text("depth_scale: 0.001\nnoise_sigma_m: 0.002\n")
    table = np.linspace(0, 1, 768, dtype=np.float32).reshape(256, 3)
    np.savetxt(folder / "response.txt", table, fmt="%.9g")
    frame = open_dataset(folder)[0]
    assert frame.color_jpeg == jpeg
    assert frame.exposure_s == 0.02
    assert frame.response is not None
    assert np.array_equal(frame.response, table)
    assert frame.depth is not None
    assert frame.depth.noise_sigma_m == 0.002
    assert frame.color[5, 5].tolist() == pytest.approx([200, 100, 10], abs=4)


def test_fisheye_lines_of_one_time_are_a_bracket(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a")
    names = [f"rgb/{index}.png" for index in range(3)]
    (folder / "fisheye.txt").write_text(f"9.5 {names[0]} 0.01\n9.5 {names[1]} 0.1\n20 {names[2]}\n")
    entries = open_dataset(folder).fisheye
    assert [entry.exposures_s for entry in entries] == [(0.01, 0.1), (None,)]
    assert entries[0].paths == (folder / names[0], folder / names[1])
    assert entries[0].timestamp_ns == 9_500_000_000


def edit(name: str, text: str) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        (folder / name).write_text(text)

    return apply


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def picture(name: str, values: np.ndarray) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        (folder / name).write_bytes(cv2.imencode(".png", values)[1].tobytes())

    return apply


def instead(*names: str) -> Callable[[Path], None]:
    """Other files in place of rgb.txt."""

    def apply(folder: Path) -> None:
        (folder / "rgb.txt").unlink()
        for name in names:
            (folder / name).touch()

    return apply


MIRROR = "depth_from_rgb: [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
SKEWED = "depth_from_rgb: [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
BAD_FOLDERS: list[tuple[Callable[[Path], None], str]] = [
    (remove("rgb.txt"), r"has no rgb\.txt; write it"),
    (
        instead("metadata.yaml", "a.db3"),
        "is a ROS 2 bag; make a recording of it with `deltalight recordings import`",
    ),
    (
        instead("b.db3", "a.db3"),
        r"is a ROS 2 bag \(a\.db3\) without its metadata\.yaml; let `ros2 bag reindex`",
    ),
    (
        instead("a.mcap"),
        r"has no rgb\.txt, but a\.mcap; name that recording, or, if the folder is a ROS 2 bag, let",
    ),
    (remove("calibration/rgb.yaml"), r"has no calibration/rgb\.yaml"),
    (remove("rgb/1.png"), r"rgb\.txt names .*1\.png, which is missing; restore it"),
    (remove("depth/3.png"), r"depth\.txt names .*3\.png, which is missing; restore it"),
    (edit("rgb.txt", "10.0 a.png\n11.0 b.png\n"), r"rgb\.txt names 2 missing files, first .*a\.png"),
    (edit("rgb.txt", "# nothing\n"), r"rgb\.txt names no picture"),
    (edit("rgb.txt", "10.0\n"), r"rgb\.txt line 1 has no filename"),
    (edit("rgb.txt", "#\nten rgb/0.png\n"), r"rgb\.txt line 2 has the timestamp `ten`"),
    (edit("rgb.txt", "nan rgb/0.png\n"), "`nan`"),
    (edit("rgb.txt", "-1 rgb/0.png\n"), "`-1`"),
    (edit("rgb.txt", "11 rgb/0.png\n10 rgb/1.png\n"), "line 2 is earlier"),
    (edit("rgb.txt", "10 rgb/0.png\n10 rgb/1.png\n"), r"gives 1\.png the time of 0\.png"),
    (edit("depth.txt", "99 depth/0.png\n"), "same clock"),
    (edit("groundtruth.txt", "10 0 0 0 0 0 1\n"), r"groundtruth\.txt line 1 is not"),
    (edit("groundtruth.txt", "10 0 0 0 0 0 0 0\n"), r"groundtruth\.txt line 1 holds no usable pose"),
    (edit("groundtruth.txt", "10 0 nan 0 0 0 0 1\n"), "no usable pose"),
    (edit("response.txt", "1 2 3\n"), "256 rows"),
    (edit("response.txt", "a b c\n"), "256 rows"),
    (edit("calibration/depth.yaml", "depth_scale: -1\n"), "depth_scale"),
    (edit("calibration/depth.yaml", "depth_scale: near\n"), "depth_scale"),
    (edit("calibration/board.yaml", "type: aruco_grid\n"), "`dictionary` is missing"),
    (edit("calibration/extrinsics.yaml", MIRROR), "`depth_from_rgb` mirrors space"),
    (edit("calibration/extrinsics.yaml", SKEWED), "not a rigid transform"),
    (edit("calibration/extrinsics.yaml", "depth_from_rbg: []\n"), "nearest known key is `depth_from_rgb`"),
    (edit("calibration/extrinsics.yaml", "depth_from_rgb: [1, 2]\n"), "4x4 matrix"),
    (edit("fisheye.txt", "1 rgb/0.png\n1 rgb/1.png\n"), "bracket without exposures"),
    (edit("rgb/0.png", "no picture"), r"0\.png cannot be decoded"),
    (edit("depth/0.png", ""), "depth/0.png cannot be decoded; replace it by a 16-bit PNG"),
    (
        picture("rgb/0.png", np.zeros((8, 8, 3), np.uint8)),
        r"0\.png has 8x8 pixels but calibration/rgb\.yaml says 32x24",
    ),
    (
        picture("depth/0.png", np.zeros((8, 8), np.uint16)),
        r"0\.png has 8x8 pixels but calibration/depth\.yaml",
    ),
    (picture("depth/0.png", np.zeros((HEIGHT, WIDTH), np.uint8)), "not a 16-bit PNG"),
]


@pytest.mark.parametrize(("damage", "message"), BAD_FOLDERS, ids=[message for _, message in BAD_FOLDERS])
def test_bad_folders_are_told_in_one_sentence(
    tmp_path: Path, damage: Callable[[Path], None], message: str
) -> None:
    folder = write_folder(tmp_path / "a")
    damage(folder)
    with pytest.raises(DeltalightError, match=message) as caught:
        open_source(folder)
    assert "\n" not in str(caught.value)


def test_a_later_picture_of_another_size_is_told_when_it_is_read(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a")
    picture("rgb/2.png", np.zeros((8, 8, 3), np.uint8))(folder)
    reader = open_dataset(folder)
    assert reader[1].frame_id == 1
    with pytest.raises(DeltalightError, match=r"2\.png has 8x8"):
        reader[2]


def test_what_is_no_source_is_told(tmp_path: Path) -> None:
    with pytest.raises(DeltalightError, match="does not exist"):
        open_source(tmp_path / "nowhere")
    (tmp_path / "a.txt").touch()
    with pytest.raises(DeltalightError, match="neither a folder nor"):
        open_source(tmp_path / "a.txt")
    (tmp_path / "A.MCAP").touch()
    with pytest.raises(DeltalightError, match=r"A\.MCAP .*not an MCAP recording"):
        open_source(tmp_path / "A.MCAP")
    (tmp_path / "a.bag").touch()
    with pytest.raises(DeltalightError, match=r"a\.bag is a ROS bag; .*`deltalight recordings import`"):
        open_source(tmp_path / "a.bag")


def random_frames(count: int, scale: float = 0.0005) -> list[SensorFrame]:
    rng = np.random.default_rng(3)
    depth_camera = camera(16, 12, 14.0)
    turn, _ = cv2.Rodrigues(np.array([0.3, -2.0, 1.1]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [0.1, -0.2, 1.5]
    table = np.linspace(0, 1, 768, dtype=np.float32).reshape(256, 3)
    return [
        SensorFrame(
            frame_id=index,
            timestamp_ns=1_305_031_231_925_706_001 + index * 33_333_333,
            color=rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8),
            camera=camera(),
            response=table,
            exposure_s=0.01,
            depth=depth_from_steps(
                rng.integers(0, 4000, (12, 16)).astype(np.uint16), scale, depth_camera, 0.003
            ),
            depth_timestamp_ns=1_305_031_231_925_706_001 + index * 33_333_333 + 5,
            world_from_camera=pose,
        )
        for index in range(count)
    ]


def assert_equal_frames(ours: SensorFrame, theirs: SensorFrame) -> None:
    assert (ours.frame_id, ours.timestamp_ns, ours.exposure_s) == (
        theirs.frame_id,
        theirs.timestamp_ns,
        theirs.exposure_s,
    )
    assert np.array_equal(ours.color, theirs.color)
    assert ours.camera == theirs.camera
    assert ours.response is not None
    assert np.array_equal(ours.response, np.asarray(theirs.response))
    assert ours.depth_timestamp_ns == theirs.depth_timestamp_ns
    assert ours.depth is not None
    assert theirs.depth is not None
    assert np.array_equal(ours.depth.depth_m, theirs.depth.depth_m)
    assert np.array_equal(ours.depth.valid, theirs.depth.valid)
    assert ours.depth.camera == theirs.depth.camera
    assert ours.depth.noise_sigma_m == theirs.depth.noise_sigma_m


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    frames = random_frames(3)
    board = BoardSpec(
        type="aruco_grid",
        dictionary="DICT_4X4_50",
        marker_length_m=0.04,
        separation_m=0.01,
        rows=2,
        columns=2,
    )
    shift = np.eye(4)
    shift[0, 3] = 0.05
    with DatasetWriter(
        tmp_path / "a", board=board, extrinsics=Extrinsics(depth_from_rgb=shift), depth_scale=0.0005
    ) as writer:
        for index, frame in enumerate(frames):
            writer.add(frame)
            assert len(open_dataset(tmp_path / "a")) == index + 1, "the folder is readable after every frame"
    reader = open_dataset(tmp_path / "a")
    for ours, theirs in zip(reader, frames, strict=True):
        assert_equal_frames(ours, theirs)
        assert ours.world_from_camera == pytest.approx(np.asarray(theirs.world_from_camera), abs=1e-12)
    assert reader.board == board
    assert reader.extrinsics.depth_from_rgb == pytest.approx(shift)


def test_writing_keeps_jpeg_bytes_and_refuses_what_does_not_fit(tmp_path: Path) -> None:
    first, second, *_ = random_frames(3)
    jpeg = cv2.imencode(".jpg", first.color)[1].tobytes()
    with DatasetWriter(tmp_path / "a") as writer:
        writer.add(SensorFrame(0, 5, first.color, first.camera, color_jpeg=jpeg))
        with pytest.raises(DeltalightError, match="not later"):
            writer.add(SensorFrame(1, 5, first.color, first.camera))
        with pytest.raises(DeltalightError, match="a different camera or response"):
            writer.add(second)
    frame = open_dataset(tmp_path / "a")[0]
    assert frame.color_jpeg == jpeg
    assert frame.timestamp_ns == 5
    with pytest.raises(DeltalightError, match="already exists"), DatasetWriter(tmp_path / "a"):
        pass


def test_a_picture_that_states_more_than_its_bytes_can_hold_is_refused_undecoded() -> None:
    honest = np.zeros((1000, 2000, 3), np.uint8)
    assert decode_rgb(encode_png(honest), "flat").shape == honest.shape
    png, jpeg = encode_png(np.zeros((4, 4), np.uint16)), cv2.imencode(".jpg", honest[:16, :16])[1].tobytes()
    size = struct.pack(">II", 16_000, 16_000)
    lies = [
        png[:16] + size + png[24:],  # the size
        png[:33] + b"\x7f" + png[34:],  # the length of the chunk that follows
        png[:33] + struct.pack(">I4sIII", 8, b"acTL", 2**31, 0, 0) + png[33:],  # many pictures
        jpeg.replace(b"\x00\x10\x00\x10\x03", b"\x40\x00\x40\x00\x03"),
    ]
    assert jpeg not in lies
    for data in lies:
        with pytest.raises(DeltalightError, match="cannot be decoded"):
            decode_rgb(data, "picture")
        with pytest.raises(DeltalightError, match=r"depth picture .* cannot be decoded"):
            decode_depth_png(data, "picture")
