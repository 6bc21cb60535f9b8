"""Fish-eye pictures in recordings (docs/formats.md 2).

Pictures that are new with a frame are a group of messages before the frame's own, at the frame's log time: each
exposure and the calibration as Foxglove displays them, and last a `FisheyeRecord`, which completes the group. Frames
that use them refer to their time by `FrameRecord.fisheye_ns`.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]

from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeLens, calibration_of, describe_calibration
from deltalight.protocol.frames import FisheyePictures
from deltalight.protocol.pictures import decode_rgb, encode_png
from deltalight.protocol.recording_format import (
    FISHEYE_CAMERA_TOPIC,
    FISHEYE_FRAME,
    FISHEYE_LINEAR_TOPIC,
    FISHEYE_RECORD_TOPIC,
    FISHEYE_TOPIC,
    FisheyeRecord,
    calibration_message,
    timestamp_fields,
)

Messages = Sequence[tuple[str, bytes]]


def fisheye_messages(pictures: FisheyePictures) -> Iterator[tuple[str, bytes]]:
    """Yields the group (topic, message) of fish-eye pictures in its order."""
    for picture in pictures.pictures:
        yield _picture_message(picture, pictures.timestamp_ns)
    camera = _camera_message(pictures.calibration.lens, pictures.timestamp_ns)
    yield FISHEYE_CAMERA_TOPIC, camera.SerializeToString()
    description, response = describe_calibration(pictures.calibration)
    record = FisheyeRecord(
        timestamp_ns=pictures.timestamp_ns,
        exposures_s=list(pictures.exposures_s),
        calibration=description,
        response=response,
    )
    yield FISHEYE_RECORD_TOPIC, record.packed()


def _picture_message(picture: np.ndarray, timestamp_ns: int) -> tuple[str, bytes]:
    stamp = timestamp_fields(timestamp_ns)
    if picture.dtype == np.uint8:
        image = CompressedImage(
            timestamp=stamp, frame_id=FISHEYE_FRAME, data=encode_png(picture), format="png"
        )
        return FISHEYE_TOPIC, image.SerializeToString()
    values = picture.astype("<f4")
    height, width = values.shape[:2]
    raw = RawImage(
        timestamp=stamp,
        frame_id=FISHEYE_FRAME,
        width=width,
        height=height,
        encoding="32FC3",
        step=values.strides[0],
        data=values.tobytes(),
    )
    return FISHEYE_LINEAR_TOPIC, raw.SerializeToString()


def _camera_message(lens: FisheyeLens, timestamp_ns: int) -> CameraCalibration:
    if isinstance(lens, EquidistantLens):
        return calibration_message(lens.camera, FISHEYE_FRAME, timestamp_ns)
    # Foxglove knows no such lens; a matrix of zeros marks the camera as not calibrated.
    return CameraCalibration(
        timestamp=timestamp_fields(timestamp_ns),
        frame_id=FISHEYE_FRAME,
        width=lens.width,
        height=lens.height,
        K=[0.0] * 9,
        R=np.eye(3).ravel().tolist(),
        P=[0.0] * 12,
    )


class FisheyeTrack:
    """The fish-eye pictures of a recording by log time; keeps the last ones decoded.

    Args:
        times_ns: log times of the groups.
        messages_at: returns the readable messages (topic, data) of a log time, in their order.
        name: of the recording, for errors.
    """

    def __init__(self, times_ns: Sequence[int], messages_at: Callable[[int], Messages], name: str) -> None:
        self._times = sorted(times_ns)
        self._messages_at, self._name = messages_at, name
        self._kept: tuple[int, FisheyePictures] | None = None

    def at(self, time_ns: int) -> FisheyePictures | None:
        """Returns the newest complete pictures recorded up to a log time, else the first ones (docs/formats.md 1).

        Raises:
            DeltalightError: a group was not written by `fisheye_messages`.
        """
        while self._times:
            index = max(bisect_right(self._times, time_ns), 1)
            start = self._times[index - 1]
            if self._kept is None or self._kept[0] != start:
                pictures = self._decode(start)
                if pictures is None:
                    del self._times[index - 1]
                    continue
                self._kept = start, pictures
            return self._kept[1]
        return None

    def _decode(self, time_ns: int) -> FisheyePictures | None:
        messages = self._messages_at(time_ns)
        packed = [data for topic, data in messages if topic == FISHEYE_RECORD_TOPIC]
        images = [message for message in messages if message[0] in (FISHEYE_TOPIC, FISHEYE_LINEAR_TOPIC)]
        if not packed:
            return None
        record = FisheyeRecord.unpacked(packed[-1], self._name)
        if len(images) != len(record.exposures_s):
            return None
        calibration = calibration_of(record.calibration, record.response)
        size = (calibration.lens.height, calibration.lens.width)
        pictures = tuple(self._picture(topic, data, size) for topic, data in images)
        return FisheyePictures(record.timestamp_ns, pictures, tuple(record.exposures_s), calibration)

    def _picture(self, topic: str, data: bytes, size: tuple[int, int]) -> np.ndarray:
        try:
            if topic == FISHEYE_TOPIC:
                picture = decode_rgb(CompressedImage.FromString(data).data, f"{self._name} (fish-eye)")
            else:
                image = RawImage.FromString(data)
                picture = np.frombuffer(image.data, "<f4").reshape(image.height, image.width, 3)
        except (ValueError, DecodeError) as error:
            raise DeltalightError(
                f"{self._name} holds a malformed fish-eye picture; record it again."
            ) from error
        if picture.shape[:2] != size:
            raise DeltalightError(
                f"{self._name} has a fish-eye picture whose size differs from its lens's; record it again."
            )
        return picture
