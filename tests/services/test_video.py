"""Video files: what another decoder finds in them is what was put in, at the same times."""

import builtins
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.services.exports import ExportFormat
from deltalight.services.exports.recording import export_as
from deltalight.services.video_file import video_file
from tests.services.conftest import RunCli
from tests.services.record_samples import PERIOD_NS, STARTED_NS, frames

WIDTH, HEIGHT, COUNT = 96, 64, 8
REC_709 = "ITU709"


def moving(number: int, width: int = WIDTH) -> np.ndarray:
    """Colours that fill the cube, moved along with each picture."""
    x, y = np.meshgrid(np.arange(width) + 3 * number, np.arange(HEIGHT))
    waves = [np.sin(x / 25 + phase) * np.cos(y / 30 - phase) for phase in (0.0, 2.0, 4.0)]
    return np.round(127.5 + 120 * np.stack(waves, axis=-1)).astype(np.uint8)


def psnr_db(one: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


def test_pictures_and_times_come_back(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    gap = [0, 1, 2, 3, 5, 6, 7, 8]  # a frame is missing
    times_ns = [STARTED_NS + step * PERIOD_NS for step in gap]
    with video_file(tmp_path / "take.mp4", times_ns) as video:
        for number, time_ns in enumerate(times_ns):
            video.add(moving(number), time_ns)
    with av.open(str(tmp_path / "take.mp4")) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
        tags = (context.color_primaries, context.color_trc, context.colorspace, context.color_range)
        assert tags == (1, 1, 1, 1)
        assert stream.guessed_rate == pytest.approx(30, rel=0.2)
        decoded = list(container.decode(stream))
    shown_s = [float(frame.pts * frame.time_base) for frame in decoded]
    np.testing.assert_allclose(np.diff(shown_s), np.diff(times_ns) / 1e9, atol=1e-4)
    # Older PyAV assumes BT.601, whatever the tags say.
    pictures = [frame.reformat(format="rgb24", src_colorspace=REC_709).to_ndarray() for frame in decoded]
    assert len(pictures) == COUNT
    assert min(psnr_db(moving(number), picture) for number, picture in enumerate(pictures)) > 38
    capture = cv2.VideoCapture(str(tmp_path / "take.mp4"))
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == COUNT


def test_odd_sizes_are_rounded_up_and_other_sizes_refused(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with video_file(tmp_path / "odd.mp4", [0]) as video:
        video.add(moving(0, 95), 0)
    with av.open(str(tmp_path / "odd.mp4")) as container:
        assert container.streams.video[0].width == 96
    with video_file(tmp_path / "b.mp4", [0, PERIOD_NS]) as video:
        video.add(moving(0), 0)
        with pytest.raises(DeltalightError, match="several sizes"):
            video.add(moving(1, 128), PERIOD_NS)
        with pytest.raises(DeltalightError, match="not later"):
            video.add(moving(1), 0)
    with pytest.raises(DeltalightError, match="no picture"), video_file(tmp_path / "c.mp4", []):
        pass
    assert sorted((path.name for path in tmp_path.iterdir()), reverse=True) == ["odd.mp4", "b.mp4"]


def test_relit_pictures_of_a_recording_are_exported(tmp_path: Path, cli: RunCli) -> None:
    pytest.importorskip("av")
    with RecordingWriter(tmp_path / "take.mcap") as writer:
        for frame in frames(4):
            writer.add(frame)
    done = cli("recordings", "export", tmp_path / "take.mcap", "--format", "mp4", "-o", tmp_path / "take.mp4")
    assert (done.returncode, done.stdout.split()[:2]) == (0, ["2", "frames,"]), done.stderr
    assert "Left out: 2 frames without a relit picture." in done.stderr
    with RecordingWriter(tmp_path / "bare.mcap") as writer:
        writer.add(replace(frames(1)[0], composite=None))
    with pytest.raises(DeltalightError, match="record with --composites"):
        export_as(ExportFormat.MP4, tmp_path / "bare.mcap", tmp_path / "b.mp4", None, lambda numbers: numbers)
    assert not (tmp_path / "b.mp4").exists()


def test_without_pyav_one_sentence_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    imported = builtins.__import__

    def refuse(name: str, *rest: object) -> object:
        if name == "av":
            raise ImportError(name)
        return imported(name, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", refuse)
    with (
        pytest.raises(DeltalightError, match=r"package av \(PyAV\).*pip install av"),
        video_file(tmp_path / "a.mp4", []),
    ):
        pass
