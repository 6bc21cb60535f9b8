"""`deltalight record` on a simulated disk that refuses, fills, or loses the file (test_disk_full.py: a real one)."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.source import open_source
from deltalight.services import recorder
from deltalight.services.recorder import RecordJob
from tests.services.record_samples import PATIENCE_S, feeding, recording, wait_for


class RefusingDisk:
    """Takes nothing more, or only the beginning of a frame, while `error` is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.error = 0
        self._pwrite: Callable[[int, bytes, int], int] = os.pwrite
        monkeypatch.setattr("deltalight.protocol.growing_file.os.pwrite", self._write)
        monkeypatch.setattr("deltalight.services.retrying_writer.RETRY_PERIOD_S", 0.2)

    def _write(self, handle: int, data: bytes, position: int) -> int:
        if not self.error:
            return self._pwrite(handle, data, position)
        if len(data) > 100:
            return self._pwrite(handle, data[:100], position)
        raise OSError(self.error, os.strerror(self.error))


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS])
def test_a_recording_goes_on_when_the_disk_takes_data_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: int
) -> None:
    disk, out = RefusingDisk(monkeypatch), tmp_path / "a.mcap"
    with (
        feeding(relights=True) as (endpoint, _),
        recording(RecordJob(out, (endpoint,), composites=endpoint)) as (running, notices, end),
    ):
        wait_for(lambda: running.status.composites >= 5)
        disk.error = error
        wait_for(lambda: running.status.unkept >= 10)
        kept = len(open_source(out.with_name("a.mcap.active")))
        assert kept == running.status.frames
        disk.error = 0
        wait_for(lambda: running.status.frames >= kept + 10)
    status = end.result()
    told = [notice for notice in notices if "cannot grow" in notice or "takes data again" in notice]
    assert [notice.split("; ")[1] for notice in told] == [
        f"its {kept} frames are kept, and the recording goes on once you free space or lift the limit.",
        f"{status.unkept} frames could not be kept.",
    ]
    assert f"a.mcap.active cannot grow ({os.strerror(error)})" in told[0]
    assert status.disk == told[1]
    found = list(open_source(out))
    assert len(found) == status.frames
    lost = status.unkept + status.missing.get("color", 0)  # the latter on a busy machine
    assert found[-1].frame_id - found[0].frame_id + 1 == status.frames + lost
    assert sum(frame.composite is not None for frame in found) == status.composites > 5
    assert found[-1].composite is not None


def test_a_recording_that_is_stopped_while_the_disk_refuses_is_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, active = RefusingDisk(monkeypatch), tmp_path / "a.mcap.active"
    with (
        feeding() as (endpoint, _),
        recording(RecordJob(tmp_path / "a.mcap", (endpoint,))) as (running, notices, end),
    ):
        wait_for(lambda: running.status.frames >= 3)
        disk.error = errno.ENOSPC
        wait_for(lambda: running.status.unkept)
    with pytest.raises(DeltalightError, match=r"No space left on device") as caught:
        end.result(PATIENCE_S)
    frames_kept, frames_lost = running.status.frames, running.status.unkept
    assert f"after {frames_kept} frames" in str(caught.value)
    assert f"and {frames_lost} frames could not be kept" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert sum("cannot grow" in notice for notice in notices) == 1
    assert list(tmp_path.iterdir()) == [active]
    assert len(open_source(active)) == frames_kept


def test_a_disk_that_refuses_the_first_frame_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    RefusingDisk(monkeypatch).error = errno.ENOSPC
    with (
        feeding() as (endpoint, _),
        recording(RecordJob(tmp_path / "a.mcap", (endpoint,))) as (_, notices, end),
        pytest.raises(DeltalightError, match=r"cannot be written \(No space left on device\)"),
    ):
        end.result(PATIENCE_S)
    assert not notices
    assert not list(tmp_path.iterdir())


def test_a_file_that_somebody_removes_is_a_sentence(tmp_path: Path) -> None:
    with (
        feeding() as (endpoint, _),
        recording(RecordJob(tmp_path / "a.mcap", (endpoint,))) as (_, _, end),
    ):
        wait_for((tmp_path / "a.mcap.active").exists)
        (tmp_path / "a.mcap.active").unlink()
        with pytest.raises(DeltalightError, match=r"a\.mcap\.active no longer exists") as caught:
            end.result(PATIENCE_S)
    assert "\n" not in str(caught.value)


def test_little_space_is_told_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage)
    monkeypatch.setattr(recorder, "STEADY_AFTER_S", 0.1)
    monkeypatch.setattr(recorder, "CHECK_PERIOD_S", 0.1)
    with (
        feeding() as (endpoint, _),
        recording(RecordJob(tmp_path / "a.mcap", (endpoint,), duration_s=1.0)) as (_, notices, end),
    ):
        end.result(PATIENCE_S)
    assert len(notices) == 1
    assert "room for 0 s more" in notices[0]
