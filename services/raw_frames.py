"""Reassembly of a sensor node's raw streams into the frames that its camera delivered.

Each colour picture gets the depth of its moment, the current fish-eye picture, and its pose if one was given. A pose
found by the marker board is kept apart, because it is found again when the frame is replayed.
"""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.codecs import decode_color, decode_depth, decode_response
from deltalight.protocol.documents import validate
from deltalight.protocol.frames import DepthImage, FisheyePictures, SensorFrame
from deltalight.protocol.light_codecs import fisheye_pictures
from deltalight.protocol.messages import (
    ColorMessage,
    DepthMessage,
    FisheyeMessage,
    Message,
    MessageBase,
    PoseMessage,
)

# A SUB socket subscribes one by one: colour last, so that a colour picture comes with its partners.
RAW_STREAMS = ("fisheye", "depth", "pose", "color")
DEPTH_TOLERANCE_NS = 20_000_000  # the pairing of recorded pictures (deltalight.protocol.dataset_lists)
WAITING_COLORS = 2  # a partner that has not come with the second colour picture after its own is lost
KEPT_MESSAGES = 8
KEPT_FISHEYES = 2  # the newest and the previous one, for colour pictures that still wait; brackets are large

Kind = TypeVar("Kind", bound=MessageBase)
Built = TypeVar("Built")


@dataclass(frozen=True)
class _Held(Generic[Kind]):
    message: Kind
    parts: Sequence[memoryview]


class RawFrameAssembler:
    """Takes the decoded messages of one node in order and returns its raw frames, oldest first.

    `node` is the node whose frames these are (None until its first colour picture); messages of others are counted in
    `foreign`. `board` is the first one that the node described. `missing` counts losses by stream: `color` by the
    numbers of the frames, `depth` and `pose` by the frames without. The very first colour picture is left out,
    because some of its partners may have been sent before the subscription.
    """

    def __init__(self, node: str | None = None) -> None:
        self.node = node
        self.board: BoardSpec | None = None
        self.missing: Counter[str] = Counter()
        self.foreign: Counter[str] = Counter()
        self._colors: deque[_Held[ColorMessage]] = deque()
        self._depths: deque[_Held[DepthMessage]] = deque(maxlen=KEPT_MESSAGES)
        self._poses: deque[PoseMessage] = deque(maxlen=KEPT_MESSAGES)
        self._fisheyes: deque[FisheyePictures] = deque(maxlen=KEPT_FISHEYES)
        self._fisheye_ns: int | None = None
        self._streams: set[str] = set()
        self._last_id: int | None = None
        self._last: dict[str, Any] = {}

    def add(self, message: Message, parts: Sequence[memoryview]) -> None:
        """Stores a message until its frame is complete.

        Raises:
            DeltalightError: the board or the fish-eye pictures of the message are broken.
        """
        if self.node is None and isinstance(message, ColorMessage):
            self.node = message.node
        if self.node is not None and message.node != self.node:
            self.foreign[message.node] += 1
            return
        match message:
            case ColorMessage():
                if message.stream in self._streams:
                    self._colors.append(_Held(message, parts))
            case DepthMessage(stream="depth"):
                self._depths.append(_Held(message, parts))
            case PoseMessage():
                self._poses.append(message)
                self._note_board(message)
            case FisheyeMessage():
                self._add_fisheye(message, parts)
        self._streams.add(message.stream)

    def take(self, *, is_idle: bool = False) -> SensorFrame | None:
        """Returns the oldest frame if it is complete or, if nothing more arrived (`is_idle`), as it is.

        Raises:
            DeltalightError: the payload of the frame is broken; the frame is dropped, and the next call continues.
        """
        if not self._colors:
            return None
        message = self._colors[0].message
        pose, depth = self._pose_of(message), self._depth_of(message)
        complete = self._is_there(pose, "pose") and self._is_there(depth, "depth")
        if not complete and not is_idle and len(self._colors) <= WAITING_COLORS:
            return None
        color = self._colors.popleft()
        self._count(message, pose, depth)
        if depth is not None:
            self._depths.remove(depth)
        return self._frame(color, pose, depth)

    def _is_there(self, partner: object, stream: str) -> bool:
        return partner is not None or stream not in self._streams

    def _count(
        self, color: ColorMessage, pose: PoseMessage | None, depth: _Held[DepthMessage] | None
    ) -> None:
        if self._last_id is not None and color.frame_id > self._last_id:  # otherwise the node restarted
            self.missing["color"] += color.frame_id - self._last_id - 1
        self._last_id = color.frame_id
        self.missing["pose"] += not self._is_there(pose, "pose")
        self.missing["depth"] += not self._is_there(depth, "depth")

    def _pose_of(self, color: ColorMessage) -> PoseMessage | None:
        wanted = (color.frame_id, color.capture_ns)
        return next((pose for pose in self._poses if (pose.frame_id, pose.capture_ns) == wanted), None)

    def _depth_of(self, color: ColorMessage) -> _Held[DepthMessage] | None:
        def apart_ns(held: _Held[DepthMessage]) -> int:
            return abs(held.message.capture_ns - color.capture_ns)

        nearest = min(self._depths, key=apart_ns, default=None)
        return nearest if nearest is not None and apart_ns(nearest) <= DEPTH_TOLERANCE_NS else None

    def _note_board(self, pose: PoseMessage) -> None:
        if pose.board is not None and self.board is None:
            self.board = validate(BoardSpec, pose.board, "the board of the pose message")

    def _frame(
        self, color: _Held[ColorMessage], pose: PoseMessage | None, depth: _Held[DepthMessage] | None
    ) -> SensorFrame:
        header = color.message
        jpeg = bytes(color.parts[0]) if header.encoding == "jpeg" else None
        return SensorFrame(
            frame_id=header.frame_id,
            timestamp_ns=header.capture_ns,
            color=decode_color(color.parts[0], header.encoding, header.shape),
            camera=self._same("color", CameraModel.from_dict(header.camera)),
            response=decode_response(color.parts[1]) if header.has_response else None,
            exposure_s=header.exposure_s,
            depth=None if depth is None else self._depth_image(depth),
            depth_timestamp_ns=None if depth is None else depth.message.capture_ns,
            world_from_camera=None if pose is None else _given_pose(pose),
            color_jpeg=jpeg,
            fisheye=self._fisheye_at(header.capture_ns),
            found_pose=None if pose is None else _found_pose(pose),
        )

    def _depth_image(self, depth: _Held[DepthMessage]) -> DepthImage:
        header = depth.message
        depth_m, valid = decode_depth(depth.parts[0], header.encoding, header.shape, header.depth_scale_m)
        camera = self._same("depth", CameraModel.from_dict(header.camera))
        return DepthImage(depth_m, valid, camera, header.noise_sigma_m)

    def _fisheye_at(self, capture_ns: int) -> FisheyePictures | None:
        """Returns the newest pictures that are not later; before the first, the first."""
        held = (pictures for pictures in reversed(self._fisheyes) if pictures.timestamp_ns <= capture_ns)
        return next(held, self._fisheyes[0] if self._fisheyes else None)

    def _add_fisheye(self, message: FisheyeMessage, parts: Sequence[memoryview]) -> None:
        """Decodes fish-eye pictures, unless they are a repetition for late subscribers."""
        if message.capture_ns == self._fisheye_ns:
            return
        self._fisheye_ns = message.capture_ns
        pictures = fisheye_pictures(message, parts)
        # A restarted replay stamps them by its first round, but recordings require rising times.
        earliest_ns = self._fisheyes[-1].timestamp_ns + 1 if self._fisheyes else 0
        self._fisheyes.append(replace(pictures, timestamp_ns=max(message.capture_ns, earliest_ns)))

    def _same(self, stream: str, made: Built) -> Built:
        """Returns the previous message's instance while it is equal, so that its rays are computed once."""
        if self._last.get(stream) != made:
            self._last[stream] = made
        return self._last[stream]  # type: ignore[no-any-return]


def _given_pose(pose: PoseMessage) -> np.ndarray | None:
    """Returns the pose if it was given with the frame: without a reprojection error, no board was searched."""
    return None if _is_found(pose) else _matrix(pose)


def _found_pose(pose: PoseMessage) -> np.ndarray | None:
    """Returns the pose if the node found it by the board."""
    return _matrix(pose) if _is_found(pose) else None


def _is_found(pose: PoseMessage) -> bool:
    return pose.reprojection_error_px is not None


def _matrix(pose: PoseMessage) -> np.ndarray | None:
    return None if pose.world_from_camera is None else np.array(pose.world_from_camera)
