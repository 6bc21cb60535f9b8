"""Recordings: what goes in comes out bit for bit, Foxglove can read it, and a crash loses next to nothing."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.protocol.pictures import depth_from_steps
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.scene import parse_scene
from deltalight.protocol.source import open_source
from tests.protocol.fisheye_samples import assert_same_frames

ROOT = Path(__file__).resolve().parents[2]
WIDTH, HEIGHT = 64, 48
LENS = np.array([0.1, -0.05, 0.001, -0.002, 0.01])


def camera(width: int = WIDTH, height: int = HEIGHT, distortion: np.ndarray | None = None) -> CameraModel:
    matrix = np.array([[60.5, 0, width / 2], [0, 61.25, height / 2], [0, 0, 1]])
    return CameraModel(width, height, matrix, "plumb_bob", np.zeros(0) if distortion is None else distortion)


def board() -> BoardSpec:
    return BoardSpec(
        type="charuco", dictionary="DICT_5X5_100", marker_length_m=0.03, separation_m=0.01, rows=5, columns=4
    )


def random_depth(rng: np.random.Generator, scale: float = 0.001) -> DepthImage:
    steps = rng.integers(0, 3000, (HEIGHT // 2, WIDTH // 2)).astype(np.uint16)
    steps[0, :5] = 0
    return depth_from_steps(steps, scale, camera(WIDTH // 2, HEIGHT // 2), 0.002)


def frames(count: int) -> list[SensorFrame]:
    """Frames that differ in every part that may be absent."""
    rng = np.random.default_rng(11)
    made = []
    for index in range(count):
        color = rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
        pose = np.eye(4)
        pose[:3, :3], _ = cv2.Rodrigues(rng.normal(size=3))
        pose[:3, 3] = rng.normal(size=3)
        made.append(
            SensorFrame(
                frame_id=index + 5,
                timestamp_ns=1_700_000_000_000_000_001 + index * 33_333_333,
                color=color,
                camera=camera(distortion=LENS),
                response=None if index % 2 else rng.random((256, 3), np.float32),
                exposure_s=None if index % 3 else 0.0125,
                depth=None if index % 4 == 3 else random_depth(rng),
                depth_timestamp_ns=None if index % 4 == 3 else 1_700_000_000_000_000_777 + index,
                world_from_camera=None if index % 5 == 4 else pose,
            )
        )
    return made


def record(path: Path, recorded: list[SensorFrame]) -> Path:
    with RecordingWriter(path, board=board()) as writer:
        for frame in recorded:
            writer.add(frame)
    return path


def test_frames_board_and_transforms_come_back_bit_for_bit(tmp_path: Path) -> None:
    recorded = frames(9)
    shift = np.eye(4)
    shift[:3, 3] = [0.05, -1e-3, 1 / 3]
    with RecordingWriter(
        tmp_path / "a.mcap", board=board(), extrinsics=Extrinsics(depth_from_rgb=shift)
    ) as writer:
        for frame in recorded:
            writer.add(frame)
        assert not (tmp_path / "a.mcap").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    source = open_source(tmp_path / "a.mcap")
    for ours, theirs in zip(source, recorded, strict=True):
        assert_same_frames(ours, theirs)
    assert_same_frames(source[4], recorded[4])
    assert_same_frames(source[-1], recorded[-1])
    with pytest.raises(IndexError):
        source[9]
    assert source.board == board()
    assert source.camera == recorded[0].camera
    assert source[3].camera is source.camera, "rays are computed once"
    assert source.depth_scale == 0.001
    assert np.array_equal(np.asarray(source.extrinsics.depth_from_rgb), shift)
    assert source.timestamps_ns == [frame.timestamp_ns for frame in recorded]
    assert not any("recovered" in note for note in source.notes)
    assert open_source(tmp_path / "a.mcap", board().replaced(rows=7)).board == board().replaced(rows=7)


def test_jpeg_bytes_are_kept_and_decoded(tmp_path: Path) -> None:
    jpeg = cv2.imencode(".jpg", frames(1)[0].color)[1].tobytes()
    decoded = np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR))[..., ::-1]
    frame = replace(frames(1)[0], color=decoded, color_jpeg=jpeg)
    assert_same_frames(RecordingReader(record(tmp_path / "a.mcap", [frame]))[0], frame)


def test_a_picture_of_another_size_than_its_camera_is_told(tmp_path: Path) -> None:
    frame = replace(frames(1)[0], camera=camera(WIDTH + 2))
    with pytest.raises(DeltalightError, match="frame 5 has a picture whose size differs"):
        RecordingReader(record(tmp_path / "a.mcap", [frame]))[0]


def test_depth_that_fits_no_step_is_kept_as_floats_unless_a_step_is_given(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    depth_m = (0.5 + rng.random((HEIGHT, WIDTH))).astype(np.float32)
    valid = rng.random((HEIGHT, WIDTH)) > 0.1
    depth = DepthImage(np.where(valid, depth_m, 0).astype(np.float32), valid, camera(distortion=LENS))
    frame = replace(frames(1)[0], depth=depth)
    assert_same_frames(RecordingReader(record(tmp_path / "a.mcap", [frame]))[0], frame)
    with RecordingWriter(tmp_path / "b.mcap", depth_scale=0.002) as writer:
        writer.add(frame)
    rounded = RecordingReader(tmp_path / "b.mcap")[0].depth
    assert rounded is not None
    assert np.array_equal(rounded.valid, valid)
    assert np.abs(rounded.depth_m - depth.depth_m).max() < 0.00101


@pytest.mark.data
def test_a_real_dataset_is_the_same_as_its_recording(shared_data: Path, tmp_path: Path) -> None:
    dataset = open_source(shared_data / "rgbd" / "visp_rbt_apriltag")
    recorded = [dataset[index] for index in range(4)]
    with RecordingWriter(tmp_path / "a.mcap", board=dataset.board, depth_scale=dataset.depth_scale) as writer:
        for frame in recorded:
            writer.add(frame)
    source = open_source(tmp_path / "a.mcap")
    for ours, theirs in zip(source, recorded, strict=True):
        assert_same_frames(ours, theirs)
    assert source.board == dataset.board
    assert source.depth_scale == dataset.depth_scale


def test_foxglove_messages_say_what_the_frame_holds(tmp_path: Path) -> None:
    recorded = frames(2)
    record(tmp_path / "a.mcap", recorded)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        topics = {channel.topic: channel for channel in summary.channels.values()}
        schemas = {channel.topic: summary.schemas.get(channel.schema_id) for channel in topics.values()}
        assert schemas["/color/image"].name == "foxglove.CompressedImage"
        assert schemas["/depth/image"].name == "foxglove.RawImage"
        own = topics["/deltalight/frame"]
        assert own.message_encoding == "msgpack"
        assert schemas["/deltalight/frame"] is None, "no schema of MCAP describes msgpack"
        assert json.loads(own.metadata["fields"])["title"] == "FrameRecord"
        shown = ["/color/image", "/color/calibration", "/depth/image", "/tf"]
        first = {
            (item.channel.topic, getattr(item.decoded_message, "child_frame_id", "")): item.decoded_message
            for item in reader.iter_decoded_messages(topics=shown, ending_at=recorded[0].timestamp_ns)
        }
    image, calibration = first["/color/image", ""], first["/color/calibration", ""]
    depth, pose = first["/depth/image", ""], first["/tf", "camera"]
    assert image.format == "png"
    assert image.timestamp.ToNanoseconds() == recorded[0].timestamp_ns
    assert list(calibration.K) == recorded[0].camera.matrix.ravel().tolist()
    assert list(calibration.D) == LENS.tolist()
    assert (depth.encoding, depth.width, depth.step) == ("16UC1", WIDTH // 2, WIDTH)
    assert depth.frame_id == "depth_camera"
    assert pose.parent_frame_id == "world"
    assert recorded[0].world_from_camera is not None
    assert pose.translation.x == recorded[0].world_from_camera[0, 3]


def test_a_pose_that_a_node_found_is_for_viewers(tmp_path: Path) -> None:
    found = np.eye(4)
    found[:3] = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3]]
    taken = replace(frames(1)[0], world_from_camera=None, found_pose=found)
    (frame,) = RecordingReader(record(tmp_path / "a.mcap", [taken]))
    assert frame.world_from_camera is None, "a replay finds it again"
    assert frame.found_pose is not None
    np.testing.assert_allclose(frame.found_pose, found, atol=1e-12)
    (other,) = RecordingReader(record(tmp_path / "b.mcap", [replace(taken, found_pose=None)]))
    assert other.found_pose is None, "the depth camera's transform is another one"


def test_the_scene_is_attached_with_paths_relative_to_the_recording(tmp_path: Path) -> None:
    asset = tmp_path / "assets" / "a.ply"
    scene = parse_scene({"objects": [{"asset": str(asset)}, {"asset": "sha256:00"}], "name": "Müller"})
    (tmp_path / "takes").mkdir()
    with RecordingWriter(tmp_path / "takes" / "a.mcap", scene=scene) as writer:
        writer.add(frames(1)[0])
    data = (tmp_path / "takes" / "a.mcap").read_bytes()
    assert b"../assets/a.ply" in data
    assert str(tmp_path).encode() not in data
    found = RecordingReader(tmp_path / "takes" / "a.mcap").scene
    assert found is not None
    assert found.objects[0].asset == str(asset.resolve())
    assert found.replaced(objects=scene.objects) == scene
    assert RecordingReader(record(tmp_path / "b.mcap", frames(1))).scene is None


def test_a_damaged_scene_document_costs_no_frames(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, scene=parse_scene({"name": "kept-intact"})) as writer:
        for frame in frames(2):
            writer.add(frame)
    data = path.read_bytes()
    path.write_bytes(data.replace(b'"kept-intact"', b'"kept-intac\\x'))
    reader = RecordingReader(path)
    assert len(list(reader)) == 2
    assert reader.scene is None
    assert any("scene document" in note for note in reader.notes)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75, 0.9, 0.999])
def test_a_truncated_recording_gives_every_frame_that_was_written(tmp_path: Path, share: float) -> None:
    recorded, ends = frames(8), []
    scene = parse_scene({"name": "kept"})
    with RecordingWriter(tmp_path / "a.mcap", board=board(), scene=scene) as writer:
        for frame in recorded:
            writer.add(frame)
            ends.append(writer.active_path.stat().st_size)
    data = (tmp_path / "a.mcap").read_bytes()
    cut = int(len(data) * share)
    (tmp_path / "cut.mcap").write_bytes(data[:cut])
    source = open_source(tmp_path / "cut.mcap")
    # The message index behind a frame's chunks is not needed to read it.
    assert len(source) >= sum(end <= cut for end in ends) > 0
    told = "1 frame was" if len(source) == 1 else f"{len(source)} frames were"
    assert any(f"{told} recovered" in note for note in source.notes)
    for ours, theirs in zip(source, recorded, strict=False):
        assert_same_frames(ours, theirs)
    assert source.board == board()
    assert source.scene == scene


def test_a_tail_of_zeros_and_a_damaged_chunk_lose_only_themselves(tmp_path: Path) -> None:
    recorded, ends = frames(6), []
    with RecordingWriter(tmp_path / "a.mcap", board=board()) as writer:
        for frame in recorded:
            writer.add(frame)
            ends.append(writer.active_path.stat().st_size)
    data = bytearray((tmp_path / "a.mcap").read_bytes()[: ends[-1]])
    data[ends[2] + 500] ^= 0xFF
    (tmp_path / "b.mcap").write_bytes(bytes(data) + bytes(5000))
    source = open_source(tmp_path / "b.mcap")
    assert [frame.frame_id for frame in source] == [5, 6, 7, 9, 10]
    assert any("damaged" in note for note in source.notes)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not an MCAP recording"),
        (b"no recording at all", "not an MCAP recording"),
        (b"\x89MCAP0\r\n", "no complete Deltalight frame"),
        (b"\x89MCAP0\r\n" + bytes(range(256)) * 20, "no complete Deltalight frame"),
        (b"\x89MCAP0\r\n" * 4, "no complete Deltalight frame"),
    ],
)
def test_files_without_a_frame_are_told_in_one_sentence(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(DeltalightError, match=message) as caught:
        open_source(tmp_path / "a.mcap")
    assert "\n" not in str(caught.value)


def test_random_damage_ends_in_frames_or_in_a_sentence(tmp_path: Path) -> None:
    data = record(tmp_path / "a.mcap", frames(2)).read_bytes()
    rng = np.random.default_rng(2)
    outcomes = set()
    for _ in range(150):
        damaged = np.frombuffer(data, np.uint8).copy()
        # Half of the damage goes to the index, which is small.
        start = len(data) - 2500 if rng.random() < 0.5 else 0
        damaged[rng.integers(start, len(data), 3)] = rng.choice([0, 255, 77], 3)
        (tmp_path / "b.mcap").write_bytes(damaged.tobytes())
        try:
            outcomes.add(f"{len(list(open_source(tmp_path / 'b.mcap')))} frames")
        except DeltalightError as error:
            outcomes.add("lines" if "\n" in str(error) else "sentence")
    assert {"2 frames", "sentence"} <= outcomes
    assert "lines" not in outcomes


def test_a_recording_cut_before_its_first_frame(tmp_path: Path) -> None:
    data = record(tmp_path / "a.mcap", frames(2)).read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[:2000])
    with pytest.raises(DeltalightError, match=r"b\.mcap holds no complete Deltalight frame"):
        open_source(tmp_path / "b.mcap")


def test_names_that_are_taken_or_wrong_are_refused(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", frames(1))
    with pytest.raises(DeltalightError, match="already exists"):
        RecordingWriter(path)
    (tmp_path / "b.mcap.active").touch()
    with pytest.raises(DeltalightError, match=r"b\.mcap\.active already exists"):
        RecordingWriter(tmp_path / "b.mcap")
    with pytest.raises(DeltalightError, match=r"end in \.mcap"):
        RecordingWriter(tmp_path / "b.bag")
    with pytest.raises(DeltalightError, match="cannot be written"):
        RecordingWriter(tmp_path / "nowhere" / "b.mcap")


def test_frames_must_come_in_order_and_before_the_end(tmp_path: Path) -> None:
    first, second = frames(2)
    writer = RecordingWriter(tmp_path / "a.mcap")
    writer.add(second)
    with pytest.raises(DeltalightError, match="not later"):
        writer.add(first)
    writer.close()
    writer.close()
    with pytest.raises(DeltalightError, match="already finished"):
        writer.add(second)
    assert len(RecordingReader(tmp_path / "a.mcap")) == 1


def test_an_error_leaves_no_half_recording_under_the_final_name(tmp_path: Path) -> None:
    with pytest.raises(KeyError), RecordingWriter(tmp_path / "a.mcap"):
        raise KeyError
    assert not list(tmp_path.iterdir())
    with pytest.raises(DeltalightError, match="not later"):
        record(tmp_path / "a.mcap", frames(1) * 2)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.active"]
    assert len(open_source(tmp_path / "a.mcap.active")) == 1


CHILD = """
import sys, time
from dataclasses import replace
from pathlib import Path
import numpy as np
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.recording_writer import RecordingWriter
camera = CameraModel(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]))
writer = RecordingWriter(Path(sys.argv[1]))
for index in range(10_000):
    writer.add(SensorFrame(index, time.time_ns(), np.full((48, 64, 3), index % 256, np.uint8), camera))
    print(index, flush=True)
    time.sleep(0.02)
"""


def test_a_killed_writer_loses_no_frame_that_it_has_taken(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", CHILD, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as child:
        assert child.stdout is not None
        taken = [int(child.stdout.readline()) for _ in range(40)]
        child.send_signal(signal.SIGKILL)
        taken += [int(line) for line in child.stdout]
    assert not path.exists()
    source = open_source(tmp_path / "a.mcap.active")
    assert len(source) >= len(taken)
    assert [frame.frame_id for frame in source][: len(taken)] == taken
    assert (source[20].color == 20).all()
    assert any("recovered" in note for note in source.notes)


def test_the_demo_recording_stays_small(tmp_path: Path) -> None:
    """Sixty VGA frames of a smooth room in JPEG and millimetres fit into 5 MB (scaled from six)."""
    rows, columns = np.mgrid[:480, :640]
    lens = CameraModel(640, 480, np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]))
    with RecordingWriter(tmp_path / "a.mcap", depth_scale=0.001) as writer:
        for index in range(6):
            depth_m = (1 / (1 + (rows - 240) * 0.0012 + (columns - 320 + index) * 1e-4)).astype(np.float32)
            depth_m[100:300, 200:400] -= 0.1
            color = (
                np.dstack([(depth_m * 120).astype(np.uint8)] * 3)
                + ((columns // 20 + rows // 20) % 2 * 60)[..., None]
            )
            jpeg = cv2.imencode(".jpg", color.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
            depth = DepthImage(depth_m, depth_m > 0, lens)
            writer.add(SensorFrame(index, index, color.astype(np.uint8), lens, depth=depth, color_jpeg=jpeg))
    assert (tmp_path / "a.mcap").stat().st_size * 10 < 5_000_000
