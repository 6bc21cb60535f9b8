"""Cameras: replay obeys recorded time, loops go on rising, the synthetic scene is exact and repeatable."""

import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.dataset import DatasetReader, open_dataset
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.errors import DeltalightError
from deltalight.sensor_node.cameras.base import EndOfStream, StaleFrameError
from deltalight.sensor_node.cameras.replay import ReplayCamera
from deltalight.sensor_node.cameras.synthetic import PERIOD_NS, SyntheticCamera, SyntheticNoise
from tests.protocol.fisheye_samples import coded

FRAMES = 4


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> DatasetReader:
    """A dataset of four synthetic frames, 33 ms apart."""
    camera = SyntheticCamera()
    path = tmp_path_factory.mktemp("replay") / "take"
    with DatasetWriter(path, board=camera.board) as writer:
        for index in range(FRAMES):
            writer.add(camera.frame_at(index))
    return open_dataset(path)


def test_replay_as_fast_as_possible_gives_every_frame_then_ends(source: DatasetReader) -> None:
    with ReplayCamera(source, realtime=False) as camera:
        frames = [camera.read() for _ in range(FRAMES)]
        with pytest.raises(EndOfStream):
            camera.read()
    assert [frame.frame_id for frame in frames] == [0, 1, 2, 3]
    assert [frame.timestamp_ns for frame in frames] == source.timestamps_ns
    np.testing.assert_array_equal(frames[2].color, source[2].color)


def test_a_loop_goes_on_with_rising_ids_and_times(source: DatasetReader) -> None:
    with ReplayCamera(source, realtime=False, loop=True, start=1, stop=3) as camera:
        frames = [camera.read() for _ in range(5)]
    assert [frame.frame_id for frame in frames] == [1, 2, 3, 4, 5]
    steps = np.diff([frame.timestamp_ns for frame in frames])
    np.testing.assert_allclose(steps, PERIOD_NS, atol=2)
    np.testing.assert_array_equal(frames[2].color, frames[0].color)
    offsets = [frame.depth_timestamp_ns - frame.timestamp_ns for frame in frames if frame.depth_timestamp_ns]
    assert offsets == [0] * 5


@pytest.mark.parametrize(("loop", "least"), [(True, 20), (False, 1)])
def test_a_looped_replay_that_falls_behind_leaves_frames_out(
    source: DatasetReader, loop: bool, least: int
) -> None:
    """It stands in for a camera; one that ends gives every frame."""
    with ReplayCamera(source, realtime=True, loop=loop) as camera:
        camera.read()
        time.sleep(0.7)
        found = camera.read().frame_id
    assert found >= least
    assert loop or found == least


def test_fish_eye_pictures_of_a_later_round_have_its_time(tmp_path: Path) -> None:
    synthetic = SyntheticCamera()
    with DatasetWriter(tmp_path / "take", board=synthetic.board) as writer:
        for index in range(2):
            frame = synthetic.frame_at(index)
            writer.add(replace(frame, fisheye=coded(synthetic.frame_at(0).timestamp_ns)))
    with ReplayCamera(open_dataset(tmp_path / "take"), realtime=False, loop=True) as camera:
        first, _, second, third = (camera.read() for _ in range(4))
    assert first.fisheye is not None
    assert second.fisheye is not None
    assert second.fisheye is third.fisheye
    assert (
        second.fisheye.timestamp_ns - first.fisheye.timestamp_ns == second.timestamp_ns - first.timestamp_ns
    )


def test_real_time_obeys_the_recorded_times_and_stamps_at_capture(source: DatasetReader) -> None:
    before = time.time_ns()
    with ReplayCamera(source, realtime=True) as camera:
        stamps, waits = [], []
        for _ in range(FRAMES):
            camera.read()
            stamps.append(camera.capture_ns)
            waits.append(time.time_ns() - camera.capture_ns)
    np.testing.assert_allclose(np.diff(stamps), np.diff(source.timestamps_ns), atol=2)
    assert before <= stamps[0] <= time.time_ns()
    assert min(waits) > -1_000_000  # no frame comes before its time


def test_read_leaves_out_nothing_when_late_and_read_latest_skips(source: DatasetReader) -> None:
    with ReplayCamera(source, realtime=True) as camera:
        time.sleep(0.075)
        assert camera.read().frame_id == 0
        assert camera.read().frame_id == 1
        newest = camera.read_latest(max_age_s=10)
        assert newest.frame_id >= 2
    with ReplayCamera(source, realtime=True) as camera:
        time.sleep(0.075)
        assert camera.read_latest(max_age_s=10).frame_id >= 2


def test_read_latest_refuses_a_stale_frame(source: DatasetReader) -> None:
    with ReplayCamera(source, realtime=True) as camera:
        time.sleep(0.25)
        with pytest.raises(StaleFrameError, match="old"):
            camera.read_latest(max_age_s=0.1)
        assert camera.read_latest(max_age_s=60).frame_id == FRAMES - 1


def test_interrupt_ends_a_waiting_read_at_once(source: DatasetReader) -> None:
    with ReplayCamera(source, realtime=True, start=0, stop=2) as camera:
        camera._times = np.array([0, 60_000_000_000])
        camera.read()
        timer = threading.Timer(0.05, camera.interrupt)
        timer.start()
        with pytest.raises(EndOfStream):
            camera.read()
        timer.join()


def test_an_empty_range_is_refused(source: DatasetReader) -> None:
    with pytest.raises(DeltalightError, match="no frames"):
        ReplayCamera(source, start=3, stop=3)


def test_the_synthetic_scene_is_repeatable_and_its_noise_has_a_seed(synthetic: SyntheticCamera) -> None:
    again = SyntheticCamera()
    np.testing.assert_array_equal(again.frame_at(7).color, synthetic.frame_at(7).color)
    noisy = [SyntheticCamera(noise=SyntheticNoise(seed=seed)).frame_at(7) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(noisy[0].color, noisy[1].color)
    assert (noisy[0].color != noisy[2].color).any()
    assert noisy[0].depth is not None
    assert not noisy[0].depth.valid.all()
    assert noisy[0].depth.noise_sigma_m == SyntheticNoise().depth_sigma_m


def test_synthetic_depth_lies_on_the_table_or_the_box(synthetic: SyntheticCamera) -> None:
    frame, pose = synthetic.frame_at(30), synthetic.pose_at(30)
    assert frame.depth is not None
    rays = np.dstack([synthetic.camera.rays(), np.ones((480, 640))])
    points = (rays * frame.depth.depth_m[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    on_table = np.abs(points[..., 2]) < 1e-4
    low, high = synthetic.scene.box_bounds
    in_box = ((points > low - 1e-4) & (points < high + 1e-4)).all(axis=-1)
    faces = (np.minimum(np.abs(points - low), np.abs(points - high)) < 1e-4).any(axis=-1)
    assert frame.depth.valid.all()
    assert (on_table | (in_box & faces)).all()
    assert 0.01 < (in_box & ~on_table).mean() < 0.3


def test_a_node_needs_no_opengl() -> None:
    code = (
        "import sys; sys.modules['moderngl'] = None; import deltalight.sensor_node.node; print(*sys.modules)"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "render_server" not in done.stdout
