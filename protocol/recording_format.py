"""Contents of a recording (docs/formats.md 2): topics, Deltalight's own messages, and Foxglove's beside them.

Every frame is a group of messages with one log time, the capture time: picture, depth and calibration as Foxglove
displays them, and last a `FrameRecord`, which completes the group. A relit picture may follow later, with the same
log time. The first group begins with a `SessionRecord` and,
if a scene document is attached, what Foxglove displays of it.
Fish-eye pictures have groups of their own (`recording_fisheye`).
"""

from typing import Annotated, Any, Self

import msgpack
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.poses import rigid_matrix, rotation_from_wxyz, wxyz_from_rotation

SCHEMA_VERSION = 1
SCENE_ATTACHMENT = "scene.json"
COLOR_TOPIC, COLOR_CAMERA_TOPIC = "/color/image", "/color/calibration"
DEPTH_TOPIC, DEPTH_CAMERA_TOPIC = "/depth/image", "/depth/calibration"
FISHEYE_TOPIC, FISHEYE_LINEAR_TOPIC = "/fisheye/image", "/fisheye/linear"
FISHEYE_CAMERA_TOPIC = "/fisheye/calibration"
POSE_TOPIC = "/tf"
SCENE_TOPIC = "/scene"
COMPOSITE_TOPIC = "/composite"
SESSION_TOPIC, FRAME_TOPIC = "/deltalight/session", "/deltalight/frame"
FISHEYE_RECORD_TOPIC = "/deltalight/fisheye"
FOXGLOVE_TOPICS: dict[str, Any] = {
    COLOR_TOPIC: CompressedImage,
    COLOR_CAMERA_TOPIC: CameraCalibration,
    DEPTH_TOPIC: RawImage,
    DEPTH_CAMERA_TOPIC: CameraCalibration,
    FISHEYE_TOPIC: CompressedImage,
    FISHEYE_LINEAR_TOPIC: RawImage,
    FISHEYE_CAMERA_TOPIC: CameraCalibration,
    POSE_TOPIC: FrameTransform,
    SCENE_TOPIC: SceneUpdate,
    COMPOSITE_TOPIC: CompressedImage,
}
WORLD_FRAME, COLOR_FRAME, DEPTH_FRAME, FISHEYE_FRAME = "world", "camera", "depth_camera", "fisheye_camera"
RESPONSE_BYTES = 256 * 3 * 4
Response = Annotated[
    bytes,
    Field(
        min_length=RESPONSE_BYTES,
        max_length=RESPONSE_BYTES,
        description="256 x 3 little-endian 32-bit floats, linear R G B; null = sRGB.",
    ),
]
Seconds = Annotated[float, Field(gt=0)]
Matrix16 = Annotated[list[float], Field(min_length=16, max_length=16)]
Metres = Annotated[float, Field(gt=0, lt=1e3)]


class _Record(BaseModel):
    """A message of Deltalight's own, packed with msgpack."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    schema_version: int = SCHEMA_VERSION

    def packed(self) -> bytes:
        """Returns the message as msgpack."""
        return bytes(msgpack.packb(self.model_dump()))

    @classmethod
    def unpacked(cls, data: bytes, name: str) -> Self:
        """Reads the message of a recording called `name`.

        Raises:
            DeltalightError: another schema version, or a malformed message.
        """
        try:
            values = msgpack.unpackb(data)
            version = values["schema_version"]
            if version != SCHEMA_VERSION:
                raise DeltalightError(
                    f"{name} has schema version {version!r:.60} and this program reads {SCHEMA_VERSION}; "
                    "use the program that recorded it."
                )
            return cls.model_validate(values)
        except (ValueError, TypeError, KeyError, msgpack.UnpackException, ValidationError) as error:
            raise DeltalightError(f"{name} holds a malformed {cls.__name__}; record it again.") from error


class SessionRecord(_Record):
    """Data of the whole recording: the board and the sensors' transforms (4x4 by rows)."""

    board: BoardSpec | None = None
    extrinsics: dict[str, list[list[float]]] = Field(default_factory=dict)
    depth_scale: Metres | None = Field(default=None, description="Metres for each step of 16-bit depth.")


class DepthRecord(BaseModel):
    """How to decode the depth image of a frame."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    camera: dict[str, Any] = Field(description="Depth camera, as for the colour camera.")
    timestamp_ns: int | None = Field(description="Capture time of the depth image.")
    scale: Metres | None = Field(description="Metres for each step; null = 32-bit floats in metres.")
    noise_sigma_m: Annotated[float, Field(ge=0)] | None = Field(description="Noise at 1 m, metres.")


class FrameRecord(_Record):
    """Data of a frame besides its pictures; written last."""

    frame_id: int = Field(ge=0)
    timestamp_ns: int = Field(ge=0, description="Capture time of the colour picture.")
    camera: dict[str, Any] = Field(description="Colour camera: width, height, matrix, distortion.")
    exposure_s: Seconds | None = None
    response: Response | None = None
    world_from_camera: Matrix16 | None = Field(default=None, description="Given pose, 4x4 by rows.")
    depth: DepthRecord | None = None
    fisheye_ns: Annotated[int, Field(ge=0)] | None = Field(
        default=None, description="Capture time of the fish-eye pictures that hold; null = none."
    )


class FisheyeRecord(_Record):
    """Data of fish-eye pictures besides their pixels; written last."""

    timestamp_ns: int = Field(ge=0, description="Capture time.")
    exposures_s: list[Seconds | None] = Field(
        min_length=1, description="One for each picture, in their order."
    )
    calibration: dict[str, Any] = Field(description="Lens and vignetting.")
    response: Response | None = None


OWN_TOPICS: dict[str, type[_Record]] = {
    SESSION_TOPIC: SessionRecord,
    FRAME_TOPIC: FrameRecord,
    FISHEYE_RECORD_TOPIC: FisheyeRecord,
}


def timestamp_fields(timestamp_ns: int) -> dict[str, int]:
    """Returns the fields of a protobuf timestamp."""
    return {"seconds": timestamp_ns // 10**9, "nanos": timestamp_ns % 10**9}


def calibration_message(camera: CameraModel, frame: str, timestamp_ns: int) -> CameraCalibration:
    """Describes a camera for Foxglove; unsupported lens models become a pinhole."""
    name, coefficients = _foxglove_lens(camera)
    matrix = camera.matrix
    return CameraCalibration(
        timestamp=timestamp_fields(timestamp_ns),
        frame_id=frame,
        width=camera.width,
        height=camera.height,
        distortion_model=name,
        D=coefficients,
        K=matrix.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
    )


def _foxglove_lens(camera: CameraModel) -> tuple[str, list[float]]:
    coefficients: list[float] = camera.to_dict()["distortion"]
    if camera.distortion_model == "equidistant":
        return "kannala_brandt", coefficients or [0.0] * 4
    if len(coefficients) <= 5:
        return "plumb_bob", coefficients + [0.0] * (5 - len(coefficients))
    return ("rational_polynomial", coefficients) if len(coefficients) == 8 else ("plumb_bob", [0.0] * 5)


def transform_message(
    parent_from_child: Float64[np.ndarray, "4 4"], parent: str, child: str, timestamp_ns: int
) -> FrameTransform:
    """Describes a rigid transform for Foxglove."""
    message = FrameTransform(
        timestamp=timestamp_fields(timestamp_ns), parent_frame_id=parent, child_frame_id=child
    )
    x, y, z = parent_from_child[:3, 3].tolist()
    message.translation.x, message.translation.y, message.translation.z = x, y, z
    rotation = message.rotation
    rotation.w, rotation.x, rotation.y, rotation.z = wxyz_from_rotation(parent_from_child[:3, :3])
    return message


def matrix_of(message: FrameTransform) -> Float64[np.ndarray, "4 4"]:
    """Returns the transform that a message of `transform_message` describes: parent_from_child."""
    place, turn = message.translation, message.rotation
    rotation = rotation_from_wxyz((turn.w, turn.x, turn.y, turn.z))
    return rigid_matrix(rotation, np.array([place.x, place.y, place.z]))
