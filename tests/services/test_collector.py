"""What a viewer writes of the composites that it receives."""

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.codecs import encode_color
from deltalight.protocol.envelope import encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import append_whole
from deltalight.protocol.publisher import Publisher
from deltalight.services import collector as collector_module
from deltalight.services import ports
from deltalight.services.collector import CompositeCollector, summarize
from tests.services.conftest import HEIGHT, WIDTH
from tests.services.live_samples import StandInStream, composite, report


@pytest.mark.parametrize("apart_s", [0.0, 1e-6, 0.001, 30.0])
def test_a_video_is_written_however_fast_or_slow_pictures_came(tmp_path: Path, apart_s: float) -> None:
    """Encoders refuse a rate of a thousand pictures a second, and rates whose fraction is long."""
    published, control = ports.private_ports(2)
    stream = StandInStream(published)
    collector = CompositeCollector(ports.endpoint(published), ports.endpoint(control), tmp_path)
    try:
        while collector.count < 2:
            collector.take(5.0, 2)
    finally:
        stream.close()
    collector.arrivals_s = [100.0, 100.0 + apart_s]
    collector.write_overview()
    collector.close()
    video = cv2.VideoCapture(str(tmp_path / "demo.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 2
    video.release()


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """The system refuses to let files grow further, as a full disk does.

    Python ignores the signal that comes with it; LLVM, where it was loaded, ends the process by it.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler or signal.SIG_IGN)


def test_a_line_that_the_disk_refuses_is_not_half_written(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    with path.open("wb", buffering=0) as file:
        append_whole(file, b"first\n")
        with (
            files_of_at_most(10),
            pytest.raises(DeltalightError, match=r"lines' cannot be written \(File too large\); free"),
        ):
            append_whole(file, b"second\n")
        assert path.read_bytes() == b"first\n"
        append_whole(file, b"third\n")
    assert path.read_bytes() == b"first\nthird\n"


def test_a_video_that_the_disk_refuses_is_not_half_written(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rig = Rig(tmp_path)
    try:
        rig.send_composites(2)
        rig.collector.write_overview()
        video = tmp_path / "demo.mp4"
        size = video.stat().st_size
        video.unlink()
        names = {path.name for path in tmp_path.iterdir()}
        for limit in (size - 1, size // 2):
            with (
                files_of_at_most(limit),
                pytest.raises(
                    DeltalightError, match=r"demo\.mp4' cannot be written \(it is not whole\); free"
                ),
            ):
                rig.collector._write_video()
            assert {path.name for path in tmp_path.iterdir()} == names
    finally:
        rig.close()
    assert capfd.readouterr().err == ""


class Rig:
    """A collector of a stand-in that publishes when it is told, beside a render server that may answer."""

    def __init__(self, out: Path | None) -> None:
        published, self.control = ports.private_ports(2)
        self.publisher = Publisher(ports.endpoint(published))
        self.collector = CompositeCollector(ports.endpoint(published), ports.endpoint(self.control), out)

    def send(self, message: object, *parts: bytes) -> None:
        self.publisher.send(encode(message, list(parts)))  # type: ignore[arg-type]

    def send_composites(self, number: int) -> None:
        jpeg = encode_color(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        while self.collector.count < number:  # a subscription takes a moment
            self.send(composite(self.collector.count + 1), jpeg)
            self.collector.take(0.02, number)

    def close(self) -> None:
        self.collector.close()
        self.publisher.close()


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    monkeypatch.setattr(collector_module, "CONTROL_TIMEOUT_S", 0.05)
    made = Rig(None)
    yield made
    made.close()


def test_a_finished_run_does_not_need_the_servers_answer(rig: Rig) -> None:
    rig.send_composites(2)
    rig.collector.arrivals_s = [rig.collector._began_s, rig.collector._began_s + 0.01]
    figures = summarize(rig.collector, {})
    assert figures["composites"] == 2
    assert "did not answer" in figures["renderer"]
    while rig.collector.renderer_name() != "llvmpipe":
        rig.send(report("render-server", "llvmpipe"))
        rig.collector.take(0.02, 2)
    assert summarize(rig.collector, {})["renderer"] == "llvmpipe"


def test_settled_figures_leave_out_the_first_half(rig: Rig) -> None:
    """The start, and a budget's first choice of size, say nothing of what follows."""
    rig.send_composites(6)
    rig.collector.arrivals_s = [
        rig.collector._began_s + each for each in (0, 0.05, 0.06, 0.07, 0.0725, 0.075)
    ]
    rig.collector.ages_ms = [900.0, 800.0, 700.0, 100.0, 110.0, 120.0]
    figures = summarize(rig.collector, {})
    assert figures["frames_per_s"] == pytest.approx(5 / 0.075)
    assert figures["settled_frames_per_s"] == pytest.approx(400)
    assert (figures["age_median_ms"], figures["settled_age_median_ms"]) == (410.0, 110.0)
