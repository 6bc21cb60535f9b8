"""Fish-eye pictures in ROS bags: images on topics of their own, and what ROS has no message for as JSON.

A bracket is a group of messages of one time: its pictures in order (PNG, or 32-bit floats where they are linear), and
last the description, which completes the group.
"""

import base64
import json
from bisect import bisect_right
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from pydantic import Field

from deltalight.protocol.documents import StrictModel, validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import calibration_of, describe_calibration
from deltalight.protocol.frames import FisheyePictures
from deltalight.protocol.pictures import decode_rgb, encode_png

FISHEYE = "/deltalight/fisheye"
CODED, LINEAR, RECORD = f"{FISHEYE}/image_raw/compressed", f"{FISHEYE}/image_raw", f"{FISHEYE}/description"
FISHEYE_TOPICS = (CODED, LINEAR, RECORD)
FISHEYE_FRAME = "fisheye_camera_optical_frame"
MOST_BRACKETS = 4  # kept decoded while a bag is read
LINEAR_ENCODING = "32FC3"


class FisheyeDescription(StrictModel):
    """What belongs to fish-eye pictures beside their pixels; `response` is base64 of 256 x 3 32-bit floats."""

    timestamp_ns: int = Field(ge=0)
    exposures_s: list[float | None] = Field(min_length=1)
    calibration: dict[str, Any]
    response: str | None = None


class MessageSink(Protocol):
    """A bag that is being written."""

    def make(self, kind: str, *values: object) -> Any:  # noqa: ANN401 - classes made at run time
        """Returns a message."""

    def header(self, time_ns: int, frame: str) -> Any:  # noqa: ANN401
        """Returns a header."""

    def write(self, topic: str, time_ns: int, message: Any) -> None:  # noqa: ANN401
        """Appends a message."""

    def image(self, header: object, encoding: str, picture: np.ndarray) -> Any:  # noqa: ANN401
        """Returns an uncompressed picture."""


def write_fisheye(bag: MessageSink, pictures: FisheyePictures, now_ns: int) -> None:
    """Appends a bracket at the time of the frame with which it is new."""
    header = bag.header(pictures.timestamp_ns, FISHEYE_FRAME)
    for picture in pictures.pictures:
        if picture.dtype == np.uint8:
            data = np.frombuffer(encode_png(picture), np.uint8)
            bag.write(CODED, now_ns, bag.make("sensor_msgs/msg/CompressedImage", header, "png", data))
        else:
            bag.write(LINEAR, now_ns, bag.image(header, LINEAR_ENCODING, picture.astype("<f4")))
    calibration, response = describe_calibration(pictures.calibration)
    described = FisheyeDescription(
        timestamp_ns=pictures.timestamp_ns,
        exposures_s=list(pictures.exposures_s),
        calibration=calibration,
        response=None if response is None else base64.b64encode(response).decode(),
    )
    bag.write(RECORD, now_ns, bag.make("std_msgs/msg/String", described.model_dump_json()))


class FisheyeReader:
    """The fish-eye pictures of a bag that is read in order of time."""

    def __init__(self, name: str, rows: Callable[[Any, "np.dtype[Any]", int, str], np.ndarray]) -> None:
        self._name, self._rows = name, rows
        self._group: list[np.ndarray] = []
        self._complete: list[tuple[int, FisheyePictures]] = []

    def add(self, topic: str, message: Any, now_ns: int) -> None:  # noqa: ANN401
        """Takes a message of one of FISHEYE_TOPICS.

        Raises:
            DeltalightError: it was not written by `write_fisheye`.
        """
        if topic == RECORD:
            self._complete.append((now_ns, self._pictures(message.data)))
            del self._complete[:-MOST_BRACKETS]
            self._group = []
        elif topic == CODED:
            self._group.append(decode_rgb(bytes(message.data), self._name))
        else:
            self._group.append(self._rows(message, np.dtype("<f4"), 3, self._name))

    def at(self, time_ns: int) -> FisheyePictures | None:
        """Returns the newest pictures that came up to a time; before the first, the first."""
        index = bisect_right(self._complete, time_ns, key=lambda each: each[0])
        return self._complete[max(index, 1) - 1][1] if self._complete else None

    def _pictures(self, text: str) -> FisheyePictures:
        try:
            values, response = json.loads(text), None
            record = validate(FisheyeDescription, values, self._name)
            if record.response is not None:
                response = base64.b64decode(record.response, validate=True)
        except (ValueError, TypeError) as fault:
            raise self._fault() from fault
        if len(record.exposures_s) != len(self._group):
            raise self._fault()
        calibration = calibration_of(record.calibration, response)
        return FisheyePictures(
            record.timestamp_ns, tuple(self._group), tuple(record.exposures_s), calibration
        )

    def _fault(self) -> DeltalightError:
        return DeltalightError(f"The fish-eye pictures {self._name} are incomplete; export the bag again.")
