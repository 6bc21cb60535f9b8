"""The messages of a frame, as recordings hold them (docs/formats.md 2) and live viewers receive them."""

from collections.abc import Iterator

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from jaxtyping import Float64

from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.frames import DepthImage, FisheyePictures, SensorFrame
from deltalight.protocol.pictures import (
    encode_png,
    exact_depth_scale,
    is_jpeg,
    known_depth,
    steps_from_depth,
)
from deltalight.protocol.recording_fisheye import fisheye_messages
from deltalight.protocol.recording_format import (
    COLOR_CAMERA_TOPIC,
    COLOR_FRAME,
    COLOR_TOPIC,
    COMPOSITE_TOPIC,
    DEPTH_CAMERA_TOPIC,
    DEPTH_FRAME,
    DEPTH_TOPIC,
    FISHEYE_FRAME,
    FRAME_TOPIC,
    POSE_TOPIC,
    WORLD_FRAME,
    DepthRecord,
    FrameRecord,
    calibration_message,
    timestamp_fields,
    transform_message,
)

TopicMessage = tuple[str, bytes]


class FrameMessages:
    """Turns frames into groups of messages; it knows what of the frames before still holds.

    Args:
        extrinsics: transforms between the sensors.
        depth_scale: metres a step, to which depth is rounded; None: an exact step, else 32-bit floats.
    """

    def __init__(self, extrinsics: Extrinsics | None = None, depth_scale: float | None = None) -> None:
        self._extrinsics = extrinsics or Extrinsics()
        self._depth_scale = self._usual_scale = depth_scale
        self._fisheye_ns: int | None = None

    def of(self, frame: SensorFrame) -> Iterator[TopicMessage]:
        """Yields the frame's messages (topic, data): new fish-eye pictures first, its record last."""
        if frame.fisheye is not None and frame.fisheye.timestamp_ns != self._fisheye_ns:
            yield from self._fisheye(frame.fisheye, frame.timestamp_ns)
            self._fisheye_ns = frame.fisheye.timestamp_ns
        now = frame.timestamp_ns
        yield COLOR_TOPIC, color_message(frame)
        yield COLOR_CAMERA_TOPIC, calibration_message(frame.camera, COLOR_FRAME, now).SerializeToString()
        scale = None
        if frame.depth is not None:
            scale = self._scale_for(frame.depth)
            yield from self._depth(frame.depth, scale, frame)
        pose = frame.found_pose if frame.world_from_camera is None else frame.world_from_camera
        if pose is not None:
            yield _transform(pose, WORLD_FRAME, COLOR_FRAME, now)
        if frame.composite is not None:
            yield COMPOSITE_TOPIC, composite_message(frame.composite, now)
        yield FRAME_TOPIC, _record(frame, scale).packed()

    def _depth(self, depth: DepthImage, scale: float | None, frame: SensorFrame) -> Iterator[TopicMessage]:
        now = frame.timestamp_ns
        values = (
            known_depth(depth).astype("<f4")
            if scale is None
            else steps_from_depth(depth, scale).astype("<u2")
        )
        name = COLOR_FRAME if depth.camera == frame.camera else DEPTH_FRAME
        message = RawImage(
            timestamp=timestamp_fields(now if frame.depth_timestamp_ns is None else frame.depth_timestamp_ns),
            frame_id=name,
            width=values.shape[1],
            height=values.shape[0],
            encoding="32FC1" if scale is None else "16UC1",
            step=values.strides[0],
            data=values.tobytes(),
        )
        yield DEPTH_TOPIC, message.SerializeToString()
        yield DEPTH_CAMERA_TOPIC, calibration_message(depth.camera, name, now).SerializeToString()
        if name == DEPTH_FRAME:
            depth_from_rgb = self._extrinsics.depth_from_rgb
            rgb_from_depth = np.eye(4) if depth_from_rgb is None else np.linalg.inv(depth_from_rgb)
            yield _transform(rgb_from_depth, COLOR_FRAME, DEPTH_FRAME, now)

    def _fisheye(self, pictures: FisheyePictures, now: int) -> Iterator[TopicMessage]:
        yield from fisheye_messages(pictures)
        own, probe = self._extrinsics.rgb_from_fisheye, self._extrinsics.world_from_fisheye
        parent, place = (WORLD_FRAME, probe) if own is None else (COLOR_FRAME, own)
        if place is not None:
            yield _transform(place, parent, FISHEYE_FRAME, now)

    def _scale_for(self, depth: DepthImage) -> float | None:
        if self._depth_scale is not None:
            return self._depth_scale
        # The last frame's exact step is most likely exact again.
        self._usual_scale = exact_depth_scale(depth, self._usual_scale)
        return self._usual_scale


def color_message(frame: SensorFrame) -> bytes:
    """Returns a frame's picture for Foxglove: its JPEG bytes if it has them, else PNG."""
    kind, data = ("jpeg", frame.color_jpeg) if frame.color_jpeg else ("png", encode_png(frame.color))
    return image_message(data, kind, frame.timestamp_ns)


def composite_message(picture: bytes, timestamp_ns: int) -> bytes:
    """Returns a relit picture, JPEG or PNG, for Foxglove; its frame is that of the camera."""
    return image_message(picture, "jpeg" if is_jpeg(picture) else "png", timestamp_ns)


def image_message(data: bytes, kind: str, timestamp_ns: int) -> bytes:
    """Returns a coded picture of the colour camera for Foxglove; `kind` is jpeg or png."""
    stamp = timestamp_fields(timestamp_ns)
    image = CompressedImage(timestamp=stamp, frame_id=COLOR_FRAME, data=data, format=kind)
    return bytes(image.SerializeToString())


def _transform(
    parent_from_child: Float64[np.ndarray, "4 4"], parent: str, child: str, now: int
) -> TopicMessage:
    return POSE_TOPIC, transform_message(parent_from_child, parent, child, now).SerializeToString()


def _record(frame: SensorFrame, depth_scale: float | None) -> FrameRecord:
    pose, depth = frame.world_from_camera, frame.depth
    return FrameRecord(
        frame_id=frame.frame_id,
        timestamp_ns=frame.timestamp_ns,
        camera=frame.camera.to_dict(),
        exposure_s=frame.exposure_s,
        response=None if frame.response is None else frame.response.astype("<f4").tobytes(),
        world_from_camera=None if pose is None else pose.ravel().tolist(),
        depth=None
        if depth is None
        else DepthRecord(
            camera=depth.camera.to_dict(),
            timestamp_ns=frame.depth_timestamp_ns,
            scale=depth_scale,
            noise_sigma_m=depth.noise_sigma_m,
        ),
        fisheye_ns=None if frame.fisheye is None else frame.fisheye.timestamp_ns,
    )
