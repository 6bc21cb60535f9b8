"""A replay under control: it goes where it is told, and what it gives looks like one camera all the time."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.source import Source, open_source
from deltalight.sensor_node.cameras import playback
from deltalight.sensor_node.cameras.base import EndOfStream
from deltalight.sensor_node.cameras.playback import PlaybackCamera
from tests.services.record_samples import PERIOD_NS, frames, write

COUNT = 12
PERIOD_S = PERIOD_NS / 1e9


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    recorded = frames(COUNT, with_fisheye=True)
    return open_source(write(tmp_path_factory.mktemp("take") / "a.mcap", recorded))


class Reader:
    """Takes what a camera gives, with its stamps."""

    def __init__(self, camera: PlaybackCamera, source: Source) -> None:
        self.camera = camera
        self.frames: list[SensorFrame] = []
        self.stamps: list[int] = []
        self._pictures = {source[index].color.tobytes(): index for index in range(len(source))}

    def read(self, count: int) -> list[int]:
        """Places in the recording of the next frames."""
        for _ in range(count):
            self.frames.append(self.camera.read())
            self.stamps.append(self.camera.capture_ns)
        return [self._pictures[frame.color.tobytes()] for frame in self.frames[-count:]]


@contextmanager
def reading(source: Source, **options: object) -> Iterator[Reader]:
    with PlaybackCamera(source, **{"loop": False, **options}) as camera:  # type: ignore[arg-type]
        yield Reader(camera, source)


def test_it_plays_as_recorded_to_the_end(source: Source) -> None:
    with reading(source) as reader:
        assert reader.read(COUNT) == list(range(COUNT))
        with pytest.raises(EndOfStream):
            reader.camera.read()
    assert [frame.frame_id for frame in reader.frames] == list(range(COUNT))
    assert all(later - earlier == PERIOD_NS for earlier, later in pairwise(reader.stamps))
    assert reader.stamps[-1] <= time.time_ns()


def test_numbers_times_and_stamps_rise_over_seek_pause_and_a_new_round(source: Source) -> None:
    with reading(source, loop=True) as reader:
        reader.read(4)
        reader.camera.seek(1.5 * PERIOD_S)
        assert reader.read(3) == [1, 2, 3]
        reader.camera.seek(99.0)
        assert reader.read(3) == [COUNT - 1, 0, 1]
        reader.camera.pause()
        assert reader.read(1) == [1]
        reader.camera.play()
        assert reader.read(2) == [2, 3]
    for earlier, later in pairwise(reader.frames):
        assert later.frame_id == earlier.frame_id + 1
        assert later.timestamp_ns > earlier.timestamp_ns
        assert later.depth_timestamp_ns is not None
        assert later.depth_timestamp_ns - later.timestamp_ns == 0
    assert all(earlier < later for earlier, later in pairwise(reader.stamps))


def test_steps_go_from_frame_to_frame_whatever_the_times_between_them(tmp_path: Path) -> None:
    recorded = [
        replace(each, timestamp_ns=each.timestamp_ns + 5 * PERIOD_NS * (each.frame_id >= 3))
        for each in frames(COUNT)
    ]
    source = open_source(write(tmp_path / "uneven.mcap", recorded))
    with reading(source, playing=False, start_s=2 * PERIOD_S, stays=True) as reader:
        assert reader.read(1) == [2]
        for frames_on, expected in ((1, 3), (1, 4), (-2, 2), (-9, 0), (COUNT + 9, COUNT - 1)):
            reader.camera.step(frames_on)
            assert reader.read(1) == [expected]


def test_a_pause_repeats_the_frame_at_a_bounded_rate_with_a_new_stamp(source: Source) -> None:
    with reading(source, start_s=5 * PERIOD_S, playing=False, stays=True) as reader:
        assert reader.read(3) == [5, 5, 5]
        state = reader.camera.playback
    assert not state.playing
    assert state.position_s == pytest.approx(5 * PERIOD_S)
    assert state.duration_s == pytest.approx((COUNT - 1) * PERIOD_S)
    assert [later - earlier for earlier, later in pairwise(reader.stamps)] == [playback.LEAST_REPEAT_NS] * 2
    held = [frame.fisheye for frame in reader.frames]
    assert held[0] is held[1] is held[2], "light that stays is not computed again"
    colors = [frame.color for frame in reader.frames]
    assert colors[0] is colors[1] is colors[2], "nor is the picture unpacked again"


def test_light_after_a_jump_is_not_older_than_the_jump(source: Source) -> None:
    with reading(source) as reader:
        reader.read(7)
        reader.camera.seek(PERIOD_S)
        reader.read(1)
    before, after = reader.frames[-2:]
    assert before.fisheye is not None
    assert after.fisheye is not None
    assert after.fisheye.timestamp_ns == after.timestamp_ns > before.fisheye.timestamp_ns


@pytest.mark.parametrize("rate", [0.5, 4.0])
def test_another_rate_spreads_the_stamps_and_not_the_recorded_times(source: Source, rate: float) -> None:
    with reading(source, rate=rate) as reader:
        reader.read(3)
    assert [later - earlier for earlier, later in pairwise(reader.stamps)] == [int(PERIOD_NS / rate)] * 2
    assert reader.frames[1].timestamp_ns - reader.frames[0].timestamp_ns == PERIOD_NS


def test_at_its_end_it_waits_for_another_command_where_it_is_told_to(source: Source) -> None:
    with reading(source, start_s=99.0, stays=True) as reader:
        assert reader.read(2) == [COUNT - 1, COUNT - 1]
        assert not reader.camera.playback.playing
        reader.camera.play()
        assert reader.read(2) == [0, 1]


def test_a_reader_that_is_far_behind_gets_the_newest_frame(
    source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(playback, "LATE_NS", 0)
    with reading(source) as reader:
        reader.read(1)
        time.sleep(4 * PERIOD_S)
        (place,) = reader.read(1)
    assert place >= 4
    assert reader.frames[-1].frame_id == place, "what was left out is missing in the numbers"


def test_commands_reach_a_camera_that_waits(source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(playback, "LEAST_REPEAT_NS", 60 * 10**9)  # nothing but a command ends the wait
    monkeypatch.setattr(playback, "MOST_REPEAT_NS", 60 * 10**9)
    with reading(source, playing=False, stays=True) as reader:
        reader.read(1)
        timer = threading.Timer(0.02, reader.camera.seek, [3 * PERIOD_S])
        timer.start()
        assert reader.read(1) == [3]
        timer.join()
        reader.camera.interrupt()
        with pytest.raises(EndOfStream):
            reader.camera.read()


def test_wrong_commands_are_refused(source: Source) -> None:
    with reading(source) as reader:
        for rate in (0.0, -1.0, 1e9, float("nan")):
            with pytest.raises(DeltalightError, match=r"rate of 0\.05 to 20"):
                reader.camera.set_rate(rate)
        with pytest.raises(DeltalightError, match="is not a position"):
            reader.camera.seek(float("nan"))
    with pytest.raises(DeltalightError, match="rate"):
        PlaybackCamera(source, loop=False, rate=0)


def test_a_recording_of_one_frame_is_shown_again_and_again(tmp_path: Path) -> None:
    alone = open_source(write(tmp_path / "a.mcap", frames(1)))
    with reading(alone, loop=True) as reader:
        assert reader.read(3) == [0, 0, 0]
    assert [frame.frame_id for frame in reader.frames] == [0, 1, 2]
