"""`deltalight recordings`: info, recover, import, export."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from typer.testing import CliRunner

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.protocol.recording_format import FOXGLOVE_TOPICS
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.scene import parse_scene
from deltalight.protocol.source import open_source
from deltalight.services.cli import app
from deltalight.services.recording_copies import (
    Copied,
    export_recording,
    import_folder,
    recover_recording,
    recovered_name,
)
from deltalight.services.recording_info import describe_recording
from tests.protocol.fisheye_samples import assert_same_frames, linear
from tests.services.conftest import RunCli
from tests.services.record_samples import BOARD, HEIGHT, PERIOD_NS, WIDTH, camera, frames, write

SCENE = parse_scene({"name": "kept"})
CUT_EVERY = 4096


def quietly(numbers: range) -> Iterable[int]:
    return numbers


def interrupted(numbers: range) -> Iterator[int]:
    yield from numbers[:2]
    raise KeyboardInterrupt


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def recovered_or_told(path: Path, out: Path) -> Copied | str | None:
    """What was mended, or the sentence that says why not."""
    try:
        return recover_recording(path, out, quietly)
    except DeltalightError as error:
        return str(error)


def assert_finished(path: Path, count: int) -> None:
    """The index is there and names every frame."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    topics = {number: channel.topic for number, channel in summary.channels.items()}
    assert {topics[number]: found for number, found in counts.items()}["/deltalight/frame"] == count


def test_info_says_what_is_in_a_recording(tmp_path: Path) -> None:
    recorded = frames(7, with_fisheye=True)
    del recorded[4]
    path = write(tmp_path / "a.mcap", recorded, SCENE)
    done = CliRunner().invoke(app, ["recordings", "info", str(path), "--json"])
    assert done.exit_code == 0
    found = json.loads(done.stdout)
    assert found == describe_recording(path)
    assert (found["is_finished"], found["damaged_parts"], found["unread_bytes"]) == (True, 0, 0)
    assert (found["frames"], found["frames_skipped"], found["gaps"]) == (6, 1, 1)
    assert found["longest_gap_s"] == pytest.approx(2 * PERIOD_NS / 1e9)
    assert found["duration_s"] == pytest.approx(6 * PERIOD_NS / 1e9)
    assert found["bytes"] == path.stat().st_size
    assert found["streams"]["/color/image"]["messages"] == 6
    assert found["streams"]["/depth/image"]["bytes"] > 6 * WIDTH * HEIGHT * 2
    assert found["color"]["camera"] == camera().to_dict()
    assert found["color"]["exposure_s"] == [0.0125, 0.0125]
    assert found["color"]["has_response"]
    assert found["depth"]["scale_m"] == 0.001
    assert found["depth"]["noise_sigma_m"] == 0.002
    assert found["fisheye"]["pictures"] == 3
    assert found["fisheye"]["exposures_s"] == [0.1, 1 / 3, 0.0125]
    assert found["fisheye"]["lens"]["distortion_model"] == "equidistant"
    assert found["board"] == BOARD.model_dump(mode="json", exclude_none=True)
    assert (found["extrinsics"], found["scene"], found["given_poses"]) == (["rgb_from_fisheye"], "kept", 6)


def test_info_of_a_cut_recording_is_a_table_with_what_is_left(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mcap", frames(6, with_fisheye=True)).read_bytes()
    path = tmp_path / "b.mcap.active"
    path.write_bytes(whole[: len(whole) // 2])
    found = describe_recording(path)
    assert not found["is_finished"]
    assert 0 < found["frames"] < 6
    assert found["unread_bytes"] > 0
    done = CliRunner().invoke(app, ["recordings", "info", str(path)])
    assert done.exit_code == 0
    assert "recordings recover" in done.stdout
    assert "/fisheye/image" in done.stdout
    assert "40x36, equidistant" in done.stdout


def test_a_recording_cut_anywhere_is_mended(tmp_path: Path) -> None:
    recorded, ends = frames(4, with_fisheye=True), []
    with RecordingWriter(tmp_path / "a.mcap", board=BOARD, scene=SCENE) as writer:
        for frame in recorded:
            writer.add(frame)
            ends.append(writer.active_path.stat().st_size)
    data = (tmp_path / "a.mcap").read_bytes()
    mended = 0
    for size in range(CUT_EVERY, len(data), CUT_EVERY):
        cut, out = tmp_path / f"{size}.mcap.active", tmp_path / f"{size}.mcap"
        cut.write_bytes(data[:size])
        whole = sum(end <= size for end in ends)
        copied = recovered_or_told(cut, recovered_name(cut))
        if isinstance(copied, str):
            assert whole == 0
            assert "no complete Deltalight frame" in copied
            assert not out.exists()
            continue
        assert copied is not None
        assert copied.out == out
        assert cut.read_bytes() == data[:size], "the original is only read"
        assert copied.frames >= whole
        assert_finished(out, copied.frames)
        source = open_source(out)
        for ours, theirs in zip(source, recorded, strict=False):
            assert_same_frames(ours, theirs)
        assert (source.board, source.scene) == (BOARD, SCENE)
        mended += 1
    assert mended >= 10


def test_flipped_bytes_end_in_a_finished_recording_or_in_a_sentence(tmp_path: Path) -> None:
    recorded = frames(4, as_jpeg=False)
    data = write(tmp_path / "a.mcap", recorded).read_bytes()
    known = {frame.timestamp_ns: frame for frame in recorded}
    rng = np.random.default_rng(3)
    outcomes: set[int] = set()
    for _ in range(60):
        damaged = np.frombuffer(data, np.uint8).copy()
        damaged[rng.integers(0, len(data), 3)] ^= rng.integers(1, 256, 3).astype(np.uint8)
        path, out = tmp_path / "b.mcap", tmp_path / "c.mcap"
        path.write_bytes(damaged.tobytes())
        copied = recovered_or_told(path, out)
        if not isinstance(copied, Copied):
            assert copied is None or "\n" not in copied
            assert names(tmp_path) == ["a.mcap", "b.mcap"]
            continue
        outcomes.add(copied.frames)
        assert_finished(out, copied.frames)
        for frame in open_source(out):
            assert np.array_equal(frame.color, known[frame.timestamp_ns].color)
        out.unlink()
    assert {2, 3} <= outcomes
    assert path.read_bytes() == damaged.tobytes()


def test_what_was_lost_is_told(tmp_path: Path, cli: RunCli) -> None:
    recorded, ends = frames(5), []
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for frame in recorded:
            writer.add(frame)
            ends.append(writer.active_path.stat().st_size)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[ends[1] + 500] ^= 0xFF
    (tmp_path / "a.mcap").write_bytes(data)
    done = cli("recordings", "recover", tmp_path / "a.mcap")
    assert done.returncode == 0, done.stderr
    assert "1 damaged" in done.stderr
    assert done.stdout == f"4 frames, 1 lost, written to {tmp_path / 'a-recovered.mcap'}\n"
    assert [frame.frame_id for frame in open_source(tmp_path / "a-recovered.mcap")] == [0, 1, 3, 4]


def test_recover_leaves_whole_recordings_and_taken_names_alone(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", frames(2))
    done = CliRunner().invoke(app, ["recordings", "recover", str(path)])
    assert (done.exit_code, "nothing to recover" in done.stdout) == (0, True)
    assert names(tmp_path) == ["a.mcap"]
    active = tmp_path / "b.mcap.active"
    active.write_bytes(path.read_bytes())  # finished by its content, and yet not by its name
    (tmp_path / "b.mcap").touch()
    with pytest.raises(DeltalightError, match=r"b\.mcap already exists"):
        recover_recording(active, recovered_name(active), quietly)
    (tmp_path / "b.mcap").unlink()
    copied = recover_recording(active, recovered_name(active), quietly)
    assert copied is not None
    assert len(open_source(tmp_path / "b.mcap")) == copied.frames == 2


def test_what_is_interrupted_leaves_nothing(tmp_path: Path) -> None:
    data = write(tmp_path / "a.mcap", frames(4)).read_bytes()
    (tmp_path / "b.mcap.active").write_bytes(data[:-100])
    export_recording(tmp_path / "a.mcap", tmp_path / "folder", quietly)
    before = names(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        recover_recording(tmp_path / "b.mcap.active", tmp_path / "b.mcap", interrupted)
    with pytest.raises(KeyboardInterrupt):
        import_folder(tmp_path / "folder", tmp_path / "c.mcap", None, interrupted)
    with pytest.raises(KeyboardInterrupt):
        export_recording(tmp_path / "a.mcap", tmp_path / "other", interrupted)
    assert names(tmp_path) == before


def both_ways(folder: Path, recorded: list[SensorFrame]) -> None:
    """Recording -> dataset folder -> recording: nothing changes."""
    write(folder / "a.mcap", recorded, SCENE)
    exported = export_recording(folder / "a.mcap", folder / "take", quietly)
    imported = import_folder(folder / "take", folder / "b.mcap", None, quietly)
    assert exported.frames == imported.frames == len(recorded)
    first, dataset, second = (open_source(folder / name) for name in ("a.mcap", "take", "b.mcap"))
    for original, middle, last in zip(first, dataset, second, strict=True):
        same_pose = replace(middle, world_from_camera=original.world_from_camera)
        assert_same_frames(same_pose, original)
        assert np.asarray(middle.world_from_camera) == pytest.approx(original.world_from_camera, abs=1e-12)
        assert_same_frames(replace(last, world_from_camera=original.world_from_camera), original)
    assert first.board == dataset.board == second.board == BOARD
    assert first.scene == second.scene == SCENE
    assert first.depth_scale == second.depth_scale == 0.001
    assert dataset.extrinsics.to_dict() == second.extrinsics.to_dict() == first.extrinsics.to_dict()


def test_export_and_import_are_bit_identical(tmp_path: Path) -> None:
    both_ways(tmp_path, frames(5, with_fisheye=True))


def test_export_and_import_are_bit_identical_for_png_and_linear_fisheye(tmp_path: Path) -> None:
    recorded = frames(4, as_jpeg=False)
    fisheye = linear(recorded[0].timestamp_ns)
    both_ways(tmp_path, [replace(frame, fisheye=fisheye) for frame in recorded])


@pytest.mark.data
def test_a_real_dataset_survives_both_ways(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "rgbd" / "visp_rbt_apriltag"
    import_folder(folder, tmp_path / "a.mcap", None, quietly)
    export_recording(tmp_path / "a.mcap", tmp_path / "take", lambda numbers: numbers[:3])
    original, again = open_source(folder), open_source(tmp_path / "take")
    for index in range(3):
        assert_same_frames(again[index], original[index])


def test_depth_without_steps_is_rounded_and_told(tmp_path: Path) -> None:
    depth_m = np.random.default_rng(1).uniform(0.5, 2, (HEIGHT, WIDTH)).astype(np.float32)
    depth = DepthImage(depth_m, depth_m > 0, camera())
    write(tmp_path / "a.mcap", [replace(frames(1)[0], depth=depth)])
    assert "32-bit floats" in CliRunner().invoke(app, ["recordings", "info", str(tmp_path / "a.mcap")]).stdout
    copied = export_recording(tmp_path / "a.mcap", tmp_path / "take", quietly)
    assert any("rounded" in note for note in copied.notes)
    rounded = open_source(tmp_path / "take")[0].depth
    assert rounded is not None
    assert np.abs(rounded.depth_m - depth_m).max() < 0.000501


def test_every_foxglove_topic_of_a_mended_recording_decodes(tmp_path: Path) -> None:
    recorded = frames(4, with_fisheye=True)
    linear_ns = recorded[3].timestamp_ns
    recorded[3] = replace(recorded[3], fisheye=linear(linear_ns))
    data = write(tmp_path / "a.mcap", recorded, SCENE).read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[:-60])
    assert recover_recording(tmp_path / "b.mcap", tmp_path / "c.mcap", quietly) is not None
    seen: dict[str, int] = {}
    with (tmp_path / "c.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        topics = list(FOXGLOVE_TOPICS)
        for item in reader.iter_decoded_messages(topics=topics):
            kind = FOXGLOVE_TOPICS[item.channel.topic].DESCRIPTOR.full_name
            assert item.decoded_message.DESCRIPTOR.full_name == kind
            assert kind.startswith("foxglove.")
            seen[item.channel.topic] = seen.get(item.channel.topic, 0) + 1
            if item.channel.topic == "/color/image":
                assert item.decoded_message.data == recorded[seen["/color/image"] - 1].color_jpeg
        attachments = [attachment.name for attachment in reader.iter_attachments()]
    assert set(seen) == set(FOXGLOVE_TOPICS)
    assert seen["/color/image"] == seen["/depth/image"] == 4
    assert attachments == ["scene.json"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["info", "{folder}/none.mcap"], "none.mcap"),
        (["info", "{folder}"], "Is a directory"),
        (["info", "{folder}/empty.mcap"], "not an MCAP recording"),
        (["info", "{folder}/a.bag"], "a.bag is a ROS bag; make a recording of it"),
        (["recover", "{folder}/empty.mcap"], "not an MCAP recording"),
        (["recover", "{folder}/none.mcap.active"], "none.mcap.active"),
        (["recover", "{folder}/a.mcap", "--out", "{folder}/b"], "must end in .mcap"),
        (["import", "{folder}/a.mcap", "--out", "{folder}/b.mcap"], "is not a folder"),
        (["import", "{folder}/none", "--out", "{folder}/b.mcap"], "is not a folder"),
        (["import", "{folder}", "--out", "{folder}/b.mcap"], "has no rgb.txt"),
        (["import", "{folder}", "--out", "{folder}/a.mcap"], "already exists"),
        (
            ["import", "{folder}/a.bag", "--scene", "{folder}/s.json", "--out", "{folder}/b.mcap"],
            "leave it out",
        ),
        (["export", "{folder}/a.mcap", "--out", "{folder}"], "already exists"),
        (["export", "{folder}/none.mcap", "--out", "{folder}/b"], "none.mcap"),
        (["export", "{folder}/a.mcap", "--out", "{folder}/a.mcap/b"], "is a file"),
    ],
)
def test_wrong_input_is_a_sentence(tmp_path: Path, words: list[str], message: str) -> None:
    write(tmp_path / "a.mcap", frames(1))
    for name in ("a.bag", "empty.mcap"):
        (tmp_path / name).touch()
    done = CliRunner().invoke(app, ["recordings", *(word.format(folder=tmp_path) for word in words)])
    assert isinstance(done.exception, DeltalightError), done.exception
    assert message in str(done.exception)
    assert "\n" not in str(done.exception)
    assert names(tmp_path) == ["a.bag", "a.mcap", "empty.mcap"]
