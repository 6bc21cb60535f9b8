"""Frames from sensor nodes: the endpoints that are read, and pairing of their streams into complete frames.

A colour frame triggers; pose and lamps are those of the same frame, the depth the nearest in capture time within a
tolerance, radiance map and lights the latest. Frames without a partner, or overtaken by a newer frame, are counted.
"""

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from pydantic import Field

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.codecs import decode_color, decode_depth, decode_response
from deltalight.protocol.documents import StrictModel, validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import BoardPose, DepthImage, LampPose, ViewFrame
from deltalight.protocol.keys import Keys
from deltalight.protocol.light_codecs import lamp_poses, radiance_map, sky_lights
from deltalight.protocol.messages import (
    ColorMessage,
    DepthMessage,
    LampsMessage,
    LightsMessage,
    Message,
    MessageBase,
    PoseMessage,
    RadianceMessage,
)
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.subscriber import ReceivedMultipart

MAX_ENDPOINTS = 16
EARLIER_SOURCES = "earlier_sources"
TOPICS = ("color", "clean_depth", "pose", "radiance", "lights", "lamps")
KEPT_MESSAGES = 8  # per stream; a renderer that falls behind further drops frames anyway

Built = TypeVar("Built")
Kind = TypeVar("Kind", bound=MessageBase)


class SourceRequest(StrictModel):
    """Endpoints to read frames from; null = those that were configured."""

    endpoints: tuple[str, ...] | None = Field(min_length=1, max_length=MAX_ENDPOINTS)


class FrameReceiver:
    """Receives the streams of the `configured` endpoints until `use` selects others.

    `keys` are required if an endpoint leaves the host.

    Raises:
        DeltalightError: an endpoint leaves the host without keys, or is malformed.
    """

    def __init__(self, configured: Sequence[str], keys: Keys | None = None) -> None:
        self._configured = self._endpoints = tuple(configured)
        self._keys = keys
        self._earlier_drops = 0
        self._receiver = Receiver(self._configured, TOPICS, keys=keys)

    @property
    def endpoints(self) -> tuple[str, ...]:
        """The endpoints being read."""
        return self._endpoints

    def use(self, endpoints: Sequence[str] | None) -> bool:
        """Switches to these endpoints (None: the configured ones); returns whether that is a change.

        A change drops waiting messages.

        Raises:
            DeltalightError: as the class; nothing changes then.
        """
        wanted = self._configured if endpoints is None else tuple(endpoints)
        if wanted == self._endpoints:
            return False
        receiver = Receiver(wanted, TOPICS, keys=self._keys)
        before, self._receiver, self._endpoints = self._receiver, receiver, wanted
        self._earlier_drops += sum(before.drops.values())
        before.close()
        return True

    def latest(self, timeout_s: float) -> dict[str, ReceivedMultipart] | None:
        """Returns the newest message of every topic (`Receiver.latest`)."""
        return self._receiver.latest(timeout_s)

    @property
    def drops(self) -> dict[str, int]:
        """Number of messages of each topic that a newer one replaced before they were taken.

        Those of earlier sources are one number, because the number of their names is unbounded.
        """
        earlier = {EARLIER_SOURCES: self._earlier_drops} if self._earlier_drops else {}
        return {**earlier, **self._receiver.drops}

    def close(self) -> None:
        """Stops receiving."""
        self._receiver.close()


class PairingSettings(StrictModel):
    """How streams are paired."""

    together_ms: float = Field(
        default=10.0,
        ge=0,
        le=1000,
        description="How long a frame waits for those of the room's other cameras that are due, ms.",
    )
    depth_tolerance_ms: float = Field(
        default=20.0,
        ge=0,
        le=1000,
        description="Largest difference in capture time between colour and depth, ms.",
    )
    patience_ms: float = Field(
        default=250.0, ge=0, le=5000, description="How long a colour frame waits for its pose and depth, ms."
    )


@dataclass(frozen=True)
class AssembledFrame:
    """The renderer's input, and the header of its colour frame."""

    view: ViewFrame
    color: ColorMessage
    received_ns: int


@dataclass(frozen=True)
class _Held(Generic[Kind]):
    message: Kind
    parts: Sequence[memoryview]
    received_ns: int


class FrameAssembler:
    """Takes decoded messages in any order and returns the newest complete frame.

    `needs_depth`: the scene's real geometry comes from depth. Payloads are decoded for the selected frame only.
    `counts`, which several may share, counts the others: `superseded` (overtaken by a newer frame), `unpaired_pose`
    (passed through when the wait for a pose timed out), `unpaired_depth` (dropped: no depth near its time).
    """

    def __init__(
        self,
        settings: PairingSettings | None = None,
        *,
        needs_depth: bool = True,
        counts: Counter[str] | None = None,
    ) -> None:
        self.needs_depth = needs_depth
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._settings = settings or PairingSettings()
        self._colors: deque[_Held[ColorMessage]] = deque()
        self._depths: deque[_Held[DepthMessage]] = deque(maxlen=KEPT_MESSAGES)
        self._poses: deque[_Held[PoseMessage]] = deque(maxlen=KEPT_MESSAGES)
        self._lamps: deque[LampsMessage] = deque(maxlen=KEPT_MESSAGES)
        self._radiance = _Repeated(radiance_map)
        self._lights = _Repeated(sky_lights)
        self._reference_exposure_s: float | None = None  # of the first frame, as for recordings
        self._camera = _Unchanged(CameraModel.from_dict)
        self._depth_camera = _Unchanged(CameraModel.from_dict)
        self._board = _Unchanged(_board_spec)

    def add(self, message: Message, parts: Sequence[memoryview], received_ns: int) -> None:
        """Stores a message until its partners arrive; ignores streams other than `TOPICS`."""
        match message:
            case ColorMessage():
                self._colors.append(_Held(message, parts, received_ns))
                self._drop_colors(len(self._colors) - KEPT_MESSAGES)
            case DepthMessage(stream="clean_depth"):
                self._depths.append(_Held(message, parts, received_ns))
            case PoseMessage():
                self._poses.append(_Held(message, parts, received_ns))
            case LampsMessage():
                self._lamps.append(message)
            case RadianceMessage():
                self._radiance.add(_Held(message, parts, received_ns))
            case LightsMessage():
                self._lights.add(_Held(message, parts, received_ns))

    def take(self, now_ns: int) -> AssembledFrame | None:
        """Returns the newest complete frame, or the newest that has waited too long; drops older ones.

        Raises:
            DeltalightError: the selected frame's payload is broken; the frame is dropped, and the next call
                continues.
        """
        expired_ns = now_ns - int(1e6 * self._settings.patience_ms)
        for index in reversed(range(len(self._colors))):
            color = self._colors[index]
            pose, depth = self._pose_of(color.message), self._depth_of(color.message)
            complete = pose is not None and (depth is not None or not self.needs_depth)
            if color.received_ns <= expired_ns and depth is None and self.needs_depth and self._depths:
                self._colors.remove(color)
                self.counts["unpaired_depth"] += 1
                return None
            if complete or color.received_ns <= expired_ns:
                self._drop_colors(index)
                self._colors.popleft()
                return self._build(color, pose, depth)
        return None

    def _drop_colors(self, count: int) -> None:
        for _ in range(count):
            self._colors.popleft()
            self.counts["superseded"] += 1

    def _pose_of(self, color: ColorMessage) -> _Held[PoseMessage] | None:
        """Returns the pose of this very frame; the capture time distinguishes the rounds of a looped recording."""
        poses = (held for held in self._poses if _identity(held.message) == _identity(color))
        return next(poses, None)

    def _depth_of(self, color: ColorMessage) -> _Held[DepthMessage] | None:
        own = [held for held in self._depths if held.message.node == color.node]
        nearest = min(own, key=lambda held: abs(held.message.capture_ns - color.capture_ns), default=None)
        if nearest is None:
            return None
        apart_ms = abs(nearest.message.capture_ns - color.capture_ns) / 1e6
        return nearest if apart_ms <= self._settings.depth_tolerance_ms else None

    def _lamps_of(self, color: ColorMessage) -> tuple[LampPose, ...]:
        own = (message for message in self._lamps if _identity(message) == _identity(color))
        return next((lamp_poses(message) for message in own), ())

    def _build(
        self, color: _Held[ColorMessage], pose: _Held[PoseMessage] | None, depth: _Held[DepthMessage] | None
    ) -> AssembledFrame:
        self.counts["unpaired_pose"] += pose is None
        header = color.message
        if self._reference_exposure_s is None:
            self._reference_exposure_s = header.exposure_s
        view = ViewFrame(
            frame_id=header.frame_id,
            timestamp_ns=header.capture_ns,
            color=decode_color(color.parts[0], header.encoding, header.shape),
            camera=_of_size(self._camera(header.camera), header.shape),
            response=decode_response(color.parts[1]) if header.has_response else None,
            exposure_scale=(header.exposure_s or 1.0) / (self._reference_exposure_s or 1.0),
            exposure_s=header.exposure_s or self._reference_exposure_s,
            pose=None if pose is None else _board_pose(pose.message),
            depth=None if depth is None else self._depth_image(depth),
            board=None if pose is None or pose.message.board is None else self._board(pose.message.board),
            radiance_map=self._radiance.at(header),
            lamps=self._lamps_of(header),
            sky_lights=self._lights.at(header),
        )
        return AssembledFrame(view, header, color.received_ns)

    def _depth_image(self, depth: _Held[DepthMessage]) -> DepthImage:
        header = depth.message
        depth_m, valid = decode_depth(depth.parts[0], header.encoding, header.shape, header.depth_scale_m)
        camera = _of_size(self._depth_camera(header.camera), header.shape)
        return DepthImage(depth_m, valid, camera, header.noise_sigma_m)


class _Repeated(Generic[Kind, Built]):
    """Messages that hold until the next one of their node and are sent repeatedly, for late subscribers."""

    def __init__(self, decode: Callable[[Kind, Sequence[memoryview]], Built]) -> None:
        self._decode = decode
        self._held: deque[_Held[Kind]] = deque(maxlen=KEPT_MESSAGES)
        self._last: tuple[_Held[Kind], Built] | None = None

    def add(self, new: _Held[Kind]) -> None:
        """Stores a message, unless it is the repetition of one."""
        if all(_identity(held.message) != _identity(new.message) for held in self._held):
            self._held.append(new)

    def at(self, color: ColorMessage) -> Built | None:
        """Returns what the newest message not later than a frame holds; before the first one, the first.

        The same object as long as it is the same message.
        """
        own = [held for held in self._held if held.message.node == color.node]
        if not own:
            return None
        earlier = [held for held in own if held.message.capture_ns <= color.capture_ns]
        newest = max(earlier, key=_captured) if earlier else min(own, key=_captured)
        if self._last is None or self._last[0] is not newest:
            self._last = newest, self._decoded(newest)
        return self._last[1]

    def _decoded(self, held: _Held[Kind]) -> Built:
        try:
            return self._decode(held.message, held.parts)
        except DeltalightError:
            self._held.remove(held)  # so that it costs one frame, and not every frame that would use it
            raise


class _Unchanged(Generic[Built]):
    """Builds an object from plain data, and reuses it while the data stays equal.

    A camera model caches its rays, and neither camera nor board change from frame to frame.
    """

    def __init__(self, build: Callable[[Mapping[str, object]], Built]) -> None:
        self._build = build
        self._last: tuple[Mapping[str, object], Built] | None = None

    def __call__(self, data: Mapping[str, object]) -> Built:
        if self._last is None or self._last[0] != data:
            self._last = (data, self._build(data))
        return self._last[1]


def _captured(held: _Held[Kind]) -> int:
    return held.message.capture_ns


def _identity(message: MessageBase) -> tuple[str, int, int]:
    return message.node, message.frame_id, message.capture_ns


def _board_pose(message: PoseMessage) -> BoardPose | None:
    if message.world_from_camera is None:
        return None
    return BoardPose(
        np.array(message.world_from_camera),
        message.reprojection_error_px,
        None if message.alternative is None else np.array(message.alternative),
    )


def _of_size(camera: CameraModel, shape: Sequence[int]) -> CameraModel:
    """Returns the camera if it is the one of a picture of this shape: the renderer allocates by the camera."""
    if (camera.height, camera.width) != tuple(shape[:2]):
        raise DeltalightError(
            f"A camera of {camera.width}x{camera.height} pixels came with a picture of {shape[1]}x{shape[0]}; "
            "send the camera at the picture's size."
        )
    return camera


def _board_spec(data: Mapping[str, object]) -> BoardSpec:
    return validate(BoardSpec, data, "the board of the pose message")
