"""Fish-eye pictures in recordings: bit for bit, once for all frames, and what a cut or damage leaves of them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.dataset import open_dataset
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.envelope import decode
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeCalibration, save_fisheye_yaml
from deltalight.protocol.frames import FisheyePictures, SensorFrame
from deltalight.protocol.light_codecs import fisheye_pictures
from deltalight.protocol.messages import FisheyeMessage
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.source import Source, open_source
from deltalight.sensor_node.frame_messages import Stamps, fisheye_multipart
from tests.protocol.fisheye_samples import BRACKET_S, HEIGHT, WIDTH, assert_same_pictures, coded, linear

MS = 1_000_000
START = 1_700_000_000_000_000_001
PERIOD = 33_333_333
DEMO = Path(__file__).parents[2] / "services" / "demo_assets" / "demo.mcap"


def frames(*fisheyes: FisheyePictures | None) -> list[SensorFrame]:
    camera = CameraModel(16, 12, np.array([[14.0, 0, 7.5], [0, 14.0, 5.5], [0, 0, 1]]))
    rng = np.random.default_rng(4)
    return [
        SensorFrame(
            index,
            START + index * PERIOD,
            rng.integers(0, 256, (12, 16, 3), np.uint8),
            camera,
            fisheye=fisheye,
        )
        for index, fisheye in enumerate(fisheyes)
    ]


def record(path: Path, made: list[SensorFrame], extrinsics: Extrinsics | None = None) -> list[int]:
    """Writes a recording; returns its size after each frame."""
    ends = []
    with RecordingWriter(path, extrinsics=extrinsics) as writer:
        for frame in made:
            writer.add(frame)
            ends.append(writer.active_path.stat().st_size)
    return ends


def times(source: Source) -> list[int | None]:
    return [None if frame.fisheye is None else frame.fisheye.timestamp_ns - START for frame in source]


def test_pictures_come_back_to_the_bit_and_are_written_once(tmp_path: Path) -> None:
    first, second = coded(START - 5 * MS), linear(START + 60 * MS, (0.5, None, 2.0))
    made = frames(None, first, first, second, second)
    record(tmp_path / "a.mcap", made)
    source = RecordingReader(tmp_path / "a.mcap")
    read = [frame.fisheye for frame in source]
    for ours, frame in zip(read[1:], made[1:], strict=True):
        assert_same_pictures(ours, frame.fisheye)
    assert read[0] is read[1] is read[2]  # before the first, the first holds
    assert read[3] is read[4]
    assert_same_pictures(source[2].fisheye, first)  # going back finds the earlier ones again
    with (tmp_path / "a.mcap").open("rb") as file:
        topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert topics.count("/fisheye/image") == len(BRACKET_S)
    assert topics.count("/fisheye/linear") == 3
    assert topics.count("/deltalight/fisheye") == 2


def test_foxglove_is_told_what_the_fisheye_sees_and_where_it_is(tmp_path: Path) -> None:
    place = np.eye(4)
    place[:3, 3] = [0.25, -0.1, 0.05]
    made = frames(coded(START - 5 * MS))
    record(tmp_path / "a.mcap", made, Extrinsics(world_from_fisheye=place))
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        shown = ["/fisheye/image", "/fisheye/calibration", "/tf"]
        decoded = [
            (item.schema.name, item.decoded_message) for item in reader.iter_decoded_messages(topics=shown)
        ]
    names = [name for name, _ in decoded]
    assert names == [
        *["foxglove.CompressedImage"] * 3,
        "foxglove.CameraCalibration",
        "foxglove.FrameTransform",
    ]
    image, camera, transform = decoded[0][1], decoded[3][1], decoded[4][1]
    assert image.timestamp.ToNanoseconds() == START - 5 * MS
    assert (camera.width, camera.height, camera.distortion_model) == (WIDTH, HEIGHT, "kannala_brandt")
    assert (transform.parent_frame_id, transform.child_frame_id) == ("world", image.frame_id)
    assert transform.translation.x == 0.25


def test_demo_recording_reads_as_before() -> None:
    source = open_source(DEMO)
    assert [frame.fisheye for frame in (source[0], source[len(source) - 1])] == [None, None]


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    holds=st.lists(st.integers(1, 3), min_size=1, max_size=4),
    exposures=st.lists(st.floats(1e-6, 3599), min_size=1, max_size=4),
    is_linear=st.booleans(),
    data=st.data(),
)
def test_dataset_to_recording_to_dataset_keeps_every_bit(
    tmp_path_factory: pytest.TempPathFactory,
    holds: list[int],
    exposures: list[float],
    is_linear: bool,
    data: st.DataObject,
) -> None:
    folder = tmp_path_factory.mktemp("round")
    make = linear if is_linear else coded
    starts = np.cumsum([0, *holds[:-1]])
    early = data.draw(st.integers(0, PERIOD - 1))
    brackets = [make(START + int(start) * PERIOD - early, tuple(exposures)) for start in starts]
    made = frames(*(bracket for bracket, count in zip(brackets, holds, strict=True) for _ in range(count)))
    with DatasetWriter(folder / "a") as writer:
        for frame in made:
            writer.add(frame)
    record(folder / "b.mcap", list(open_dataset(folder / "a")))
    with DatasetWriter(folder / "c") as writer:
        for frame in open_source(folder / "b.mcap"):
            writer.add(frame)
    for ours, frame in zip(open_dataset(folder / "c"), made, strict=True):
        assert_same_pictures(ours.fisheye, frame.fisheye)
        assert np.array_equal(ours.color, frame.color)
    for file in (folder / "a").rglob("*.*"):
        if file.is_file():
            assert file.read_bytes() == (folder / "c" / file.relative_to(folder / "a")).read_bytes(), file


def test_every_cut_gives_the_frames_before_it_with_their_pictures(tmp_path: Path) -> None:
    brackets = [coded(START + index * 3 * PERIOD - 1) for index in range(4)]
    made = frames(*(bracket for bracket in brackets for _ in range(3)))
    ends = record(tmp_path / "a.mcap", made)
    data = (tmp_path / "a.mcap").read_bytes()
    cuts = sorted({*range(0, len(data), 4096), *ends, *(end - 1 for end in ends)})
    assert len(cuts) > 35
    for cut in cuts:
        (tmp_path / "b.mcap").write_bytes(data[:cut])
        try:
            found = list(open_source(tmp_path / "b.mcap"))
        except DeltalightError:
            assert cut < ends[0]
            continue
        assert len(found) >= sum(end <= cut for end in ends)
        for ours, frame in zip(found, made, strict=False):
            assert np.array_equal(ours.color, frame.color)
            assert_same_pictures(ours.fisheye, frame.fisheye)


def chunks_of(path: Path, topic: str) -> list[int]:
    """Offset of every chunk that holds a message of a topic."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    (number,) = (channel.id for channel in summary.channels.values() if channel.topic == topic)
    return [
        chunk.chunk_start_offset for chunk in summary.chunk_indexes if number in chunk.message_index_offsets
    ]


@pytest.mark.parametrize("is_finished", [True, False])
def test_pictures_that_were_lost_leave_the_earlier_ones(tmp_path: Path, is_finished: bool) -> None:
    rng = np.random.default_rng(1)
    large = (rng.random((HEIGHT * 5, WIDTH * 5, 3)) * 255).astype(np.uint8)

    def bracket(index: int) -> FisheyePictures:
        """Each exposure fills chunks of its own, so that damage can take one alone."""
        sample = coded(START + index)
        height, width = large.shape[:2]
        lens = sample.calibration.lens.to_dict() | {"width": width, "height": height}
        described = sample.calibration.to_dict() | {"lens": lens}
        calibration = type(sample.calibration).from_dict(described)
        return FisheyePictures(sample.timestamp_ns, (large,) * 6, (0.1,) * 6, calibration)

    made = frames(bracket(0), bracket(1), bracket(1), bracket(2))
    ends = record(tmp_path / "a.mcap", made)
    places = chunks_of(tmp_path / "a.mcap", "/fisheye/image")
    damaged = bytearray((tmp_path / "a.mcap").read_bytes()[: None if is_finished else ends[-1]])
    for frame, expected in ((1, [0, 0, 0, 2]), (0, [2, 2, 2, 2])):
        start, end = ([0, *ends][frame], ends[frame])
        first = next(place for place in places if start <= place < end)
        damaged[first + 5000] ^= 0xFF
        (tmp_path / "b.mcap").write_bytes(damaged)
        source = open_source(tmp_path / "b.mcap")
        assert times(source) == expected
        assert_same_pictures(source[3].fisheye, made[3].fisheye)


@pytest.mark.data
def test_a_real_bracket_comes_through_dataset_wire_and_recording(shared_data: Path, tmp_path: Path) -> None:
    office = shared_data / "fisheye" / "indoor_hdr_bracket_office"
    rows = [line.split(",") for line in (office / "exposures.csv").read_text().splitlines()[1:]]
    files = [office / "jpeg_quarter" / row[0].replace(".JPG", ".jpg") for row in rows]
    picture = cv2.imread(str(files[0]))
    assert picture is not None
    height, width = picture.shape[:2]
    focal = height / np.pi
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    lens = EquidistantLens(CameraModel(width, height, matrix, "equidistant", np.zeros(4)))
    with DatasetWriter(tmp_path / "a") as writer:
        writer.add(frames(None)[0])
    save_fisheye_yaml(tmp_path / "a" / "calibration" / "fisheye.yaml", FisheyeCalibration(lens))
    lines = [f"5.0 {file} {row[1]}\n" for file, row in zip(files, rows, strict=True)]
    (tmp_path / "a" / "fisheye.txt").write_text("".join(lines))
    frame = open_dataset(tmp_path / "a")[0]
    assert frame.fisheye is not None
    assert len(frame.fisheye.pictures) == len(rows) == 18
    assert frame.fisheye.pictures[0].mean() > 4 * frame.fisheye.pictures[-1].mean()
    record(tmp_path / "b.mcap", [frame])
    assert_same_pictures(RecordingReader(tmp_path / "b.mcap")[0].fisheye, frame.fisheye)
    stamps = Stamps(node="a", frame_id=0, capture_ns=5 * 10**9, clock_offset_ns=0, clock_bound_ns=None)
    message, parts = decode(fisheye_multipart(frame.fisheye, stamps, "raw", 90))
    assert isinstance(message, FisheyeMessage)
    assert_same_pictures(fisheye_pictures(message, parts), frame.fisheye)
