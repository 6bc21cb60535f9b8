"""What a viewer writes of the composites that it receives."""

from pathlib import Path

import cv2
import pytest

from services import ports
from services.collector import CompositeCollector
from tests.services.live_samples import StandInStream


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
