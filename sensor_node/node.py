"""The loop of a sensor node: captures, cleans, finds poses and light, publishes."""

import re
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Generic, Literal, TypeVar

import structlog
from pydantic import Field, field_serializer, field_validator

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.envelope import encode
from deltalight.protocol.frames import FisheyePictures, RadianceMap, SensorFrame, ViewFrame
from deltalight.protocol.keys import Keys
from deltalight.protocol.message_fields import Name, as_sentence
from deltalight.protocol.messages import StatsMessage
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.scene_lights import LightCut
from deltalight.protocol.sky_lights import SkyLights
from deltalight.sensor_node.announce import announced
from deltalight.sensor_node.cameras.base import Camera
from deltalight.sensor_node.cameras.drivers import SYNTHETIC
from deltalight.sensor_node.cameras.fisheye_capture import CameraWithFisheye
from deltalight.sensor_node.cameras.open import open_camera, open_fisheye
from deltalight.sensor_node.cameras.settings import CameraSettings, FisheyeSettings
from deltalight.sensor_node.capture import POLL_S, CapturedFrame, CaptureThread, ServerClock
from deltalight.sensor_node.depth import DepthSettings
from deltalight.sensor_node.fisheye import light_warnings
from deltalight.sensor_node.frame_messages import (
    Stamps,
    color_multipart,
    depth_multipart,
    fisheye_multipart,
    lamps_multipart,
    lights_multipart,
    pose_multipart,
    radiance_multipart,
)
from deltalight.sensor_node.health import Health
from deltalight.sensor_node.pose_filter import PoseFilter, PoseFilterSettings
from deltalight.sensor_node.tracking.receiver import TrackingSettings
from deltalight.sensor_node.tracking.tracked_camera import TrackedCamera
from deltalight.sensor_node.view_frames import ViewFrameBuilder

if TYPE_CHECKING:
    from deltalight.protocol.light_cutter import LightCutter

_log = structlog.get_logger(__name__)
STATS_PERIOD_S = 1.0
STREAMS = ("fisheye", "depth", "radiance", "lights", "clean_depth", "lamps", "pose", "color", "stats")
# Fish-eye pictures further than this from their frame are stamped by another clock (a loop restarted).
LONGEST_HOLD_NS = 60_000_000_000
# A late subscriber has the light after this time; at 1 MB per map it costs less than one stream of pictures.
REPEAT_S = 2.0

Item = TypeVar("Item")


class NodeConfig(StrictModel):
    """Settings of a sensor node."""

    name: Name = Field(default="camera", description="Name of the node; its topics end with it.")
    source: str = Field(
        default=SYNTHETIC,
        description="Camera (`uvc:0`, `oak`), dataset folder, .mcap recording, or `synthetic`: a made-up scene.",
    )
    endpoint: str = Field(default="tcp://127.0.0.1:5601", description="Where the streams are published.")
    clock_endpoint: str | None = Field(
        default=None, description="Control endpoint of the server whose clock to follow; null = none."
    )
    announce: bool = Field(
        default=True, description="Announce the node on the network, if other hosts can reach its endpoint."
    )
    realtime: bool = Field(
        default=True, description="Send frames at their recorded times; false = as fast as possible."
    )
    loop: bool = Field(default=True, description="Start again at the end of the source.")
    camera: CameraSettings = Field(default=CameraSettings(), description="Settings of a live camera.")
    fisheye: FisheyeSettings | None = Field(
        default=None, description="Camera that sees the light; null = the source's own, if any."
    )
    tracking: TrackingSettings | None = Field(
        default=None, description="Tracking system that provides the camera's pose; null = the marker board."
    )
    color_encoding: Literal["jpeg", "raw"] = Field(
        default="jpeg", description="Encoding of colour pictures; JPEGs from the source are sent unchanged."
    )
    jpeg_quality: int = Field(default=90, ge=1, le=100, description="Quality of JPEGs encoded here.")
    stale_after_s: float = Field(
        default=0.5,
        gt=0,
        le=60,
        description="Age of the newest frame at which the stream counts as stale, s.",
    )
    lost_after_s: float = Field(
        default=5.0,
        gt=0,
        le=600,
        description="Age of the newest frame at which the camera counts as lost, s.",
    )
    depth: DepthSettings = Field(default=DepthSettings(), description="Depth clean-up.")
    lights: LightCut = Field(
        default=LightCut(),
        description="How to split the fish-eye picture into lights; servers whose scene asks for the same use "
        "them.",
    )
    pose_filter: PoseFilterSettings | None = Field(
        default=None, description="Smooth the poses that the board gives; null = publish them as found."
    )

    @field_validator("camera")
    @classmethod
    def _one_place_for_replay(cls, camera: CameraSettings) -> CameraSettings:
        twice = sorted({"realtime", "loop"} & camera.model_fields_set)
        if twice:
            raise ValueError(f"write `{twice[0]}` into the node's settings, not into those of its camera")
        return camera

    @field_serializer("camera")
    def _only_live_settings(self, camera: CameraSettings) -> dict[str, object]:
        return camera.model_dump(mode="json", exclude={"realtime", "loop"})


def node_camera(config: NodeConfig) -> Camera:
    """Returns the camera that a configuration names, with its fish-eye camera, not opened yet.

    Raises:
        DeltalightError: there is no such source, it cannot be read, or its calibration is missing.
    """
    settings = config.camera.model_copy(update={"realtime": config.realtime, "loop": config.loop})
    camera = open_camera(config.source, settings)
    if config.tracking is not None:
        camera = TrackedCamera(camera, config.tracking)
    return (
        camera
        if config.fisheye is None
        else CameraWithFisheye(camera, open_fisheye(config.fisheye, config.camera.calibration))
    )


def run_node(
    config: NodeConfig, stop: threading.Event, keys: Keys | None = None, camera: Camera | None = None
) -> None:
    """Publishes frames until `stop` is set or the source ends; returns within a second of `stop`.

    For each frame: fish-eye pictures if new, raw depth, radiance and lights if new, clean depth, lamps, pose, then
    colour, all with its `frame_id` and capture time; so a receiver of the colour has received the rest. Statistics
    are sent once a second. `keys` are required if an endpoint leaves the host; `camera` replaces the configured
    source.

    Raises:
        DeltalightError: the source or the endpoint cannot be used, or a frame of the source is broken.
    """
    camera = node_camera(config) if camera is None else camera
    with ExitStack() as stack:
        publisher = Publisher(config.endpoint, keys=keys)
        stack.callback(publisher.close)
        clock = ServerClock(config.name, config.clock_endpoint, keys=keys)
        stack.callback(clock.close)
        stack.enter_context(camera)
        if config.announce:
            stack.enter_context(announced(config.name, publisher.endpoint, STREAMS, keys))
        capture = stack.enter_context(CaptureThread(camera, keep_all=not config.realtime))
        _log.info("sensor node runs", publish=publisher.endpoint, source=config.source)
        for note in camera.notes:
            _log.info(note)
        _Node(config, camera, publisher, clock).run(capture, stop)


class Repeater(Generic[Item]):
    """Sends one kind of message: when its object is new, and then unchanged every REPEAT_S."""

    def __init__(self) -> None:
        self._item: Item | None = None
        self._multipart: list[bytes] = []
        self._sent_s = 0.0

    def send(
        self,
        item: Item,
        made: Callable[[], list[bytes]],
        send: Callable[[list[bytes]], None],
        *,
        now: bool = False,
    ) -> bool:
        """Sends the message of `item`, created by `made`, if it is due or has to be sent `now`; whether it was."""
        now_s = time.monotonic()
        if item is not self._item:
            self._item, self._multipart = item, made()
        elif not now and now_s - self._sent_s < REPEAT_S:
            return False
        send(self._multipart)
        self._sent_s = now_s
        return True


class _Node:
    """Processes each frame, and keeps the statistics."""

    def __init__(self, config: NodeConfig, camera: Camera, publisher: Publisher, clock: ServerClock) -> None:
        self._config, self._camera, self._publisher, self._clock = config, camera, publisher, clock
        self._builder = ViewFrameBuilder(camera, config.depth)
        self._filter = None if config.pose_filter is None else PoseFilter(config.pose_filter)
        self._health = Health(camera, config.stale_after_s, config.lost_after_s)
        self._fisheye: Repeater[FisheyePictures] = Repeater()
        self._radiance: Repeater[RadianceMap] = Repeater()
        self._radiance_stamps: Stamps | None = None
        self._lights: Repeater[SkyLights] = Repeater()
        self._cutter: LightCutter | None = None
        self._sky: SkyLights | None = None
        self._light_remarks: list[str] = []
        self._heard = self._logged = ""
        self._period_s = time.monotonic()
        self._frames = self._without_board = 0

    def run(self, capture: CaptureThread, stop: threading.Event) -> None:
        """Publishes captured frames until `stop` or the end."""
        while not stop.is_set() and not capture.ended:
            captured = capture.take(POLL_S)
            if captured is not None:
                self._publish(captured)
            if time.monotonic() - self._period_s >= STATS_PERIOD_S:
                self._send_stats(capture.drops)
        if capture.error is not None:
            raise capture.error
        self._send_stats(capture.drops, is_ending=True)

    def _publish(self, captured: CapturedFrame) -> None:
        config, frame = self._config, captured.frame
        stamps = self._stamps(captured)
        self._send_fisheye(frame, stamps)
        if frame.depth is not None:
            self._publisher.send(depth_multipart(frame.depth, stamps, "depth", self._camera.depth_scale))
        view = self._filtered(self._builder(frame), frame)
        self._send_light(view, stamps)
        if view.depth is not None:
            self._publisher.send(depth_multipart(view.depth, stamps, "clean_depth"))
        if view.board is not None and view.board.lamp_markers:
            self._publisher.send(lamps_multipart(view.lamps, stamps))
        self._publisher.send(pose_multipart(view.pose, view.board, stamps))
        self._publisher.send(color_multipart(frame, stamps, config.color_encoding, config.jpeg_quality))
        self._health.note(view.pose)
        self._frames += 1
        self._without_board += view.pose is None

    def _stamps(self, captured: CapturedFrame) -> Stamps:
        offset_ns, bound_ns = self._clock.at(captured.capture_ns)
        return Stamps(
            node=self._config.name,
            frame_id=captured.frame.frame_id,
            capture_ns=captured.capture_ns,
            clock_offset_ns=offset_ns,
            clock_bound_ns=bound_ns,
        )

    def _filtered(self, view: ViewFrame, frame: SensorFrame) -> ViewFrame:
        """Smooths a pose that came from the board; one given with the frame is the truth."""
        if self._filter is None or frame.world_from_camera is not None:
            return view
        return replace(view, pose=self._filter(view.pose, frame.timestamp_ns))

    def _send_fisheye(self, frame: SensorFrame, stamps: Stamps) -> None:
        """Sends fish-eye pictures once, and repeats them for late subscribers."""
        config, pictures = self._config, frame.fisheye
        if pictures is None:
            return

        def made() -> list[bytes]:
            held_ns = frame.timestamp_ns - pictures.timestamp_ns
            own = stamps.copy()
            own["capture_ns"] -= held_ns if 0 <= held_ns <= LONGEST_HOLD_NS else 0
            return fisheye_multipart(pictures, own, config.color_encoding, config.jpeg_quality)

        self._fisheye.send(pictures, made, self._publisher.send)

    def _send_light(self, view: ViewFrame, stamps: Stamps) -> None:
        """Sends a radiance map once and its lights whenever they changed; repeats both for late subscribers."""
        radiance = view.radiance_map
        if radiance is None:
            return

        def made() -> list[bytes]:
            self._light_remarks = light_warnings(radiance)
            self._radiance_stamps = stamps
            return radiance_multipart(radiance, stamps, self._config.jpeg_quality)

        # Both together, so that no late subscriber cuts a map itself whose lights are about to come.
        with_map = self._radiance.send(radiance, made, self._publisher.send)
        self._send_lights(replace(view, timestamp_ns=stamps["capture_ns"]), stamps, now=with_map)

    def _send_lights(self, view: ViewFrame, stamps: Stamps, *, now: bool) -> None:
        if self._cutter is None:
            # Takes 0.6 s (scipy), of which nodes without a fish-eye camera have no use.
            from deltalight.protocol.light_cutter import LightCutter

            self._cutter = LightCutter(self._config.lights)
        sky = self._sky = self._cutter.update(view) or self._sky
        radiance_stamps = self._radiance_stamps
        assert sky is not None
        assert radiance_stamps is not None
        self._lights.send(
            sky, lambda: lights_multipart(sky, stamps, radiance_stamps), self._publisher.send, now=now
        )

    def _send_stats(self, drops: int, *, is_ending: bool = False) -> None:
        now_ns, elapsed_s = time.time_ns(), max(time.monotonic() - self._period_s, 1e-3)
        offset_ns, bound_ns = self._clock.at(now_ns)
        state, detail = self._health.state([self._clock.remark, *self._builder.notes, *self._light_remarks])
        self._log_state(state, detail)
        message = StatsMessage(
            node=self._config.name,
            capture_ns=now_ns,
            clock_offset_ns=offset_ns,
            clock_bound_ns=bound_ns,
            state="stopping" if is_ending else state,
            detail=as_sentence(detail),
            rates={"fps": self._frames / elapsed_s, "without_board": self._without_board / elapsed_s},
            drops={"capture": drops, "connections_refused": self._publisher.refused},
        )
        self._publisher.send(encode(message))
        self._period_s, self._frames, self._without_board = time.monotonic(), 0, 0

    def _log_state(self, state: str, detail: str) -> None:
        """Logs the state once two statistics agree on it and it differs in more than its numbers."""
        words = re.sub(r"[\d.]+", "", detail)
        if words == self._heard != self._logged:
            self._logged = words
            (_log.info if state == "running" else _log.warning)(detail)
        self._heard = words
