"""One message of the live stream (`WS /live`): a header that describes the picture, then the picture.

The models here define the header: the service packs with them, the Python client reads with them, and the dashboard's
types are generated from the OpenAPI description, whose component `LiveHeader` they are.
"""

import json
import struct
import time
from typing import Any, Literal, Self

from pydantic import BaseModel, Field

from deltalight.protocol.camera_model import DistortionModel
from deltalight.protocol.documents import validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import CompositeMessage
from deltalight.protocol.quality import Quality
from deltalight.protocol.scene_fields import ShownView

_LENGTH = struct.Struct("<I")

Row = tuple[float, float, float, float]


class ShownScene(BaseModel):
    """The scene that a picture shows."""

    id: str
    revision: int


class LiveCamera(BaseModel):
    """The camera at the picture's size."""

    width: int
    height: int
    matrix: list[float] = Field(min_length=9, max_length=9, description="Intrinsic matrix, row by row.")
    distortion_model: DistortionModel
    distortion: list[float]


class PictureHeader(BaseModel):
    """What a header says of the picture, the same for all viewers."""

    number: int = Field(description="Number of pictures so far.")
    frame_id: int = Field(description="The camera's frame.")
    capture_ns: int = Field(description="Capture time, ns since 1970 by the node's clock.")
    frames_per_s: float | None = Field(description="Rate of pictures; null before the second one.")
    status: Literal["ok", "no_pose"] = Field(description="`no_pose` = the camera's picture, unchanged.")
    render_ms: float = Field(
        description="Time from the frame's arrival at the renderer to its picture, including waiting."
    )
    drops: dict[str, int] = Field(description="Frames lost so far, by cause.")
    pass_times_ms: dict[str, float] = Field(description="Time of each pass.")
    reused_pass_times_ms: dict[str, float] = Field(
        description="Passes whose results were reused, with the times of their last run."
    )
    lights: list[dict[str, Any]] = Field(description="Lights used for the picture.")
    camera: LiveCamera = Field(description="Matrix that projects points in camera space onto this picture.")
    world_from_camera: tuple[Row, Row, Row, Row] | None = Field(description="null if there is no pose.")
    node: str | None = Field(
        default=None, description="Node of the camera, if the room has several; else null."
    )
    view: ShownView = Field(
        description="View in the picture: the requested one, or the scene's own until the first picture of that "
        "view."
    )
    scene: ShownScene | None = Field(description="null if another program set the server's scene.")
    renderer: str
    quality: Quality | None = Field(
        description="Quality at which it was rendered; null = nothing was rendered."
    )
    scale: float = Field(description="Fraction of the width and height that was rendered, then upscaled.")
    codec: str = Field(
        "jpeg",
        description="Codec of the picture: `jpeg`, or H.264 as in RFC 6381, such as `avc1.64001e`.",
    )
    keyframe: bool = Field(
        default=True,
        description="Whether it decodes without the pictures before it (a keyframe). The header of any other "
        "picture omits what has not changed since the previous message.",
    )

    @classmethod
    def of(
        cls,
        message: CompositeMessage,
        *,
        number: int,
        frames_per_s: float | None,
        renderer: str,
        node: str | None = None,
    ) -> Self:
        """Describes a composite; `node` names its camera, where there are several.

        Raises:
            DeltalightError: its camera is invalid.
        """
        scene = {"id": message.scene_id, "revision": message.scene_revision}
        own = {
            "number": number,
            "frames_per_s": frames_per_s,
            "scene": None if message.scene_id is None else scene,
            "render_ms": (message.rendered_ns - message.received_ns) / 1e6,
            "renderer": renderer,
            "node": node,
        }
        return validate(cls, {**dict(message), **own}, "the composite")


class ViewerHeader(BaseModel):
    """What a header says to one viewer at the moment of sending."""

    age_ms: float = Field(description="Time since the frame was captured.")
    skipped: int = Field(description="Pictures skipped because this viewer was too slow.")


class LiveHeader(PictureHeader, ViewerHeader):
    """The JSON header of a message of `WS /live`."""


def pack(picture_header: bytes, viewer_header: ViewerHeader, coded: bytes) -> bytes:
    """Returns the message: little-endian uint32 length of the JSON header, the header, the coded picture.

    `picture_header` is the JSON text of a `PictureHeader`, or of a part of one, encoded once for all viewers.
    """
    header = viewer_header.model_dump_json().encode()[:-1] + b"," + picture_header[1:]
    return _LENGTH.pack(len(header)) + header + coded


def unpack(message: bytes, before: LiveHeader | None = None) -> tuple[LiveHeader, bytes]:
    """Returns the header and the coded picture of a message; `before` is the header of the one before it.

    Raises:
        DeltalightError: it is malformed.
    """
    try:
        (length,) = _LENGTH.unpack_from(message)
        end = _LENGTH.size + length
        header = json.loads(message[_LENGTH.size : end])
        if before is not None and not header.get("keyframe", before.keyframe):
            header = before.model_dump() | header
        return LiveHeader.model_validate(header), message[end:]
    except (struct.error, ValueError, AttributeError) as fault:
        raise DeltalightError("The service sent a live picture without a valid header; update it.") from fault


def age_ms(message: CompositeMessage) -> float:
    """Returns the time since the picture's capture, by this host's clock, ms."""
    return (time.time_ns() - message.capture_ns - message.clock_offset_ns) / 1e6
