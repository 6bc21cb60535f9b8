"""The loop of a sensor node: captures, cleans, finds the pose, publishes."""

import threading
import time
from pathlib import Path
from typing import Literal

from pydantic import Field

from protocol.documents import StrictModel
from protocol.envelope import encode
from protocol.messages import Name, StatsMessage
from protocol.source import open_source
from protocol.transport import Publisher
from sensor_node.cameras.base import Camera
from sensor_node.cameras.replay import ReplayCamera
from sensor_node.cameras.synthetic import SyntheticCamera
from sensor_node.capture import POLL_S, CapturedFrame, CaptureThread, ServerClock
from sensor_node.depth import DepthSettings
from sensor_node.frame_messages import Stamps, color_multipart, depth_multipart, pose_multipart
from sensor_node.view_frames import ViewFrameBuilder

SYNTHETIC = "synthetic"
STATS_PERIOD_S = 1.0


class NodeConfig(StrictModel):
    """Settings of a sensor node."""

    name: Name = Field(default="camera", description="Name of the node; its topics end with it.")
    source: str = Field(
        default=SYNTHETIC, description="Dataset folder, .mcap recording, or `synthetic`: a made-up scene."
    )
    endpoint: str = Field(default="tcp://127.0.0.1:5601", description="Where the streams are published.")
    clock_endpoint: str | None = Field(
        default=None, description="Control endpoint of the server whose clock to follow; null = none."
    )
    realtime: bool = Field(default=True, description="Obey the recorded times; else as fast as possible.")
    loop: bool = Field(default=True, description="Begin again at the end of the source.")
    color_encoding: Literal["jpeg", "raw"] = Field(
        default="jpeg", description="Code of colour pictures; JPEGs of the source go out as they are."
    )
    jpeg_quality: int = Field(default=90, ge=1, le=100, description="Quality of JPEGs that are made here.")
    stale_after_s: float = Field(
        default=0.5, gt=0, le=60, description="Age of the newest frame from which the stream is stale, s."
    )
    lost_after_s: float = Field(
        default=5.0, gt=0, le=600, description="Age of the newest frame from which the camera is lost, s."
    )
    depth: DepthSettings = Field(default=DepthSettings(), description="Depth clean-up.")


def open_camera(config: NodeConfig) -> Camera:
    """Return the camera that a configuration names, not opened yet.

    Raises:
        DeltalightError: there is no such source, or it cannot be read.
    """
    if config.source == SYNTHETIC:
        return SyntheticCamera(realtime=config.realtime, loop=config.loop)
    return ReplayCamera(open_source(Path(config.source)), realtime=config.realtime, loop=config.loop)


def run_node(config: NodeConfig, stop: threading.Event) -> None:
    """Publish frames until `stop` is set or the source ends; returns within a second of `stop`.

    For each frame: raw depth, clean depth, pose, then colour, all with its `frame_id` and capture time; so
    whoever has the colour has had the rest. Statistics go out once a second.

    Raises:
        DeltalightError: the source or the endpoint cannot be used, or a frame of the source is broken.
    """
    camera = open_camera(config)
    publisher = Publisher(config.endpoint)
    try:
        clock = ServerClock(config.name, config.clock_endpoint)
        try:
            with camera, CaptureThread(camera, keep_all=not config.realtime) as capture:
                _Node(config, camera, publisher, clock).run(capture, stop)
        finally:
            clock.close()
    finally:
        publisher.close()


class _Node:
    """What happens to each frame, and the statistics."""

    def __init__(self, config: NodeConfig, camera: Camera, publisher: Publisher, clock: ServerClock) -> None:
        self._config, self._camera, self._publisher, self._clock = config, camera, publisher, clock
        self._builder = ViewFrameBuilder(camera, config.depth)
        self._newest_ns: int | None = None
        self._started_ns = self._period_ns = time.time_ns()
        self._frames = self._without_board = 0

    def run(self, capture: CaptureThread, stop: threading.Event) -> None:
        """Publish what is captured until `stop` or the end."""
        while not stop.is_set() and not capture.ended:
            captured = capture.take(POLL_S)
            if captured is not None:
                self._publish(captured)
            if time.time_ns() - self._period_ns >= STATS_PERIOD_S * 1e9:
                self._send_stats(capture.drops)
        if capture.error is not None:
            raise capture.error
        self._send_stats(capture.drops, is_ending=True)

    def _publish(self, captured: CapturedFrame) -> None:
        config, frame = self._config, captured.frame
        offset_ns, bound_ns = self._clock.at(captured.capture_ns)
        stamps = Stamps(
            node=config.name,
            frame_id=frame.frame_id,
            capture_ns=captured.capture_ns,
            clock_offset_ns=offset_ns,
            clock_bound_ns=bound_ns,
        )
        if frame.depth is not None:
            raw = depth_multipart(frame.depth, stamps, "depth", self._camera.depth_scale)
            self._publisher.send(raw)
        view = self._builder(frame)
        if view.depth is not None:
            self._publisher.send(depth_multipart(view.depth, stamps, "clean_depth"))
        self._publisher.send(pose_multipart(view.pose, view.board, stamps))
        self._publisher.send(color_multipart(frame, stamps, config.color_encoding, config.jpeg_quality))
        self._newest_ns = captured.capture_ns
        self._frames += 1
        self._without_board += view.pose is None

    def _send_stats(self, drops: int, *, is_ending: bool = False) -> None:
        now_ns = time.time_ns()
        elapsed_s = max((now_ns - self._period_ns) / 1e9, 1e-3)
        offset_ns, bound_ns = self._clock.at(now_ns)
        state, detail = self._state(now_ns)
        message = StatsMessage(
            node=self._config.name,
            capture_ns=now_ns,
            clock_offset_ns=offset_ns,
            clock_bound_ns=bound_ns,
            state="stopping" if is_ending else state,
            detail=detail,
            rates={
                "fps": self._frames / elapsed_s,
                "without_board": self._without_board / elapsed_s,
            },
            drops={"capture": drops},
        )
        self._publisher.send(encode(message))
        self._period_ns, self._frames, self._without_board = now_ns, 0, 0

    def _state(self, now_ns: int) -> tuple[Literal["starting", "running", "waiting", "degraded"], str]:
        """State on the wire with a sentence that begins with live, stale or lost."""
        age_s = (now_ns - (self._newest_ns or self._started_ns)) / 1e9
        if age_s >= self._config.lost_after_s:
            return "degraded", f"lost: no frame for {age_s:.1f} s"
        if self._newest_ns is None:
            return "starting", "no frame yet"
        if age_s >= self._config.stale_after_s:
            return "waiting", f"stale: the newest frame is {age_s:.1f} s old"
        return "running", "live"
