"""The messages of the wire: one validated model each, whose fields are the header (SPEC.md, section 3).

A model holds everything but the bulk data; pictures and depth travel as raw parts behind the header. `part_rules` of
a message states which parts follow it and how long each must be.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

from deltalight.protocol.message_fields import (
    MAX_EXPOSURES,
    MAX_LAMPS,
    MAX_LIGHTS,
    MAX_REGIONS,
    Count,
    Counts,
    DepthShape,
    Durations,
    Edge,
    LightList,
    Name,
    Nanoseconds,
    PictureShape,
    PlainDict,
    Rates,
    RegionEdges,
    ResidualSize,
    RigidMatrix,
    Seconds,
    Sentence,
    Strengths,
    UnitVector,
)
from deltalight.protocol.quality import Quality
from deltalight.protocol.scene_fields import LightCount, PeakThreshold, ShownView, SmoothingTime, SplitKind

SCHEMA_VERSION: Final = 9
OLDEST_SCHEMA_VERSION: Final = 8  # that is read: hosts can be upgraded one after another (SPEC.md, section 9)
MAX_HEADER_BYTES = 64 * 1024
MAX_PART_BYTES = 64 * 1024 * 1024
MAX_UNPACKED_BYTES = 256 * 1024 * 1024  # of all parts together; 24 compressed pictures could take 1.6 GB
MAX_PAYLOAD_BYTES = 4 * 1024 * 1024
RESPONSE_SHAPE = (256, 3)
MAX_OTHERS = len(get_args(ShownView)) - 1
MAX_CAMERAS = 8  # of a room

DType = Literal["uint8", "uint16", "float32"]
Stream = Literal[
    "color",
    "depth",
    "clean_depth",
    "fisheye",
    "radiance",
    "lights",
    "pose",
    "lamps",
    "composite",
    "cameras",
    "stats",
    "request",
    "reply",
]
ITEM_SIZE: dict[DType, int] = {"uint8": 1, "uint16": 2, "float32": 4}


@dataclass(frozen=True)
class PartRule:
    """One raw part: `shape` of little-endian `dtype` in C order, or a code that unpacks to it."""

    name: str
    shape: tuple[int, ...]
    dtype: DType
    compressed: bool = False

    @property
    def raw_bytes(self) -> int:
        """Length of the uncompressed part, in bytes."""
        return math.prod(self.shape) * ITEM_SIZE[self.dtype]


RESPONSE_RULE = PartRule("response", RESPONSE_SHAPE, "float32")


class MessageBase(BaseModel):
    """Fields that every message carries; times are nanoseconds since 1970 by the sender's clock.

    `capture_ns + clock_offset_ns` is the capture time by the render server's clock, wrong by at most
    `clock_bound_ns`; a bound of None says that the clocks were never compared.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    schema_version: Annotated[int, Field(ge=OLDEST_SCHEMA_VERSION, le=SCHEMA_VERSION)] = SCHEMA_VERSION
    node: Name
    stream: Stream
    frame_id: Count
    capture_ns: Nanoseconds
    clock_offset_ns: Annotated[int, Field(ge=-(2**62), le=2**62)] = 0
    clock_bound_ns: Nanoseconds | None = None

    @property
    def topic(self) -> str:
        """Topic of the message: `<stream>.<node>`."""
        return f"{self.stream}.{self.node}"

    def part_rules(self) -> tuple[PartRule, ...]:
        """The raw parts that follow the header, in order."""
        return ()

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        rules = self.part_rules()
        for rule in rules:
            if rule.raw_bytes > MAX_PART_BYTES:
                raise ValueError(f"{rule.name} of shape {rule.shape} is larger than {MAX_PART_BYTES} bytes")
        unpacked = sum(rule.raw_bytes for rule in rules)
        if unpacked > MAX_UNPACKED_BYTES:
            raise ValueError(
                f"its {len(rules)} parts unpack to {unpacked} bytes and {MAX_UNPACKED_BYTES} are allowed: "
                "send fewer or smaller pictures"
            )
        return self


class ColorMessage(MessageBase):
    """A colour picture as captured, RGB, camera-coded; parts: picture, then the response if `has_response`.

    Without a response (float32 256x3, camera code to linear) the code is sRGB. `exposure_s` None is the
    reference exposure. `camera` is `CameraModel.to_dict()`.
    """

    stream: Literal["color"] = "color"
    encoding: Literal["jpeg", "raw"]
    shape: PictureShape
    dtype: Literal["uint8"] = "uint8"
    camera: PlainDict
    has_response: bool = False
    exposure_s: Seconds | None = None

    def part_rules(self) -> tuple[PartRule, ...]:
        """The picture, and the camera response if there is one."""
        picture = PartRule("picture", self.shape, self.dtype, self.encoding == "jpeg")
        return (picture, RESPONSE_RULE) if self.has_response else (picture,)


class DepthMessage(MessageBase):
    """Depth along the optical axis in steps of `depth_scale_m`, 0 = unknown; one part.

    Stream `depth` is as captured, `clean_depth` is registered to colour and cleaned. `noise_sigma_m` is the
    standard deviation at 1 m (it grows with the square of the distance), None = unknown. `camera` is the
    depth's own.
    """

    stream: Literal["depth", "clean_depth"] = "depth"
    encoding: Literal["blosc2", "raw"]
    shape: DepthShape
    dtype: Literal["uint16"] = "uint16"
    depth_scale_m: Annotated[float, Field(ge=1e-6, le=1.0)]
    camera: PlainDict
    noise_sigma_m: Annotated[float, Field(gt=0, le=10.0)] | None = None

    def part_rules(self) -> tuple[PartRule, ...]:
        """The depth image."""
        return (PartRule("depth", self.shape, self.dtype, self.encoding == "blosc2"),)


class FisheyeMessage(MessageBase):
    """A fish-eye picture or exposure bracket, RGB; parts: a picture for each of `exposures_s`, then the response.

    uint8 is camera-coded, by the response if `has_response`, else sRGB; float32 is linear (raw only). An exposure
    of None is the reference exposure. `camera` is a fish-eye calibration without its response.
    """

    stream: Literal["fisheye"] = "fisheye"
    encoding: Literal["jpeg", "raw"]
    shape: PictureShape
    dtype: Literal["uint8", "float32"] = "uint8"
    camera: PlainDict
    has_response: bool = False
    exposures_s: Annotated[
        tuple[Seconds | None, ...], Field(strict=False, min_length=1, max_length=MAX_EXPOSURES)
    ] = (None,)

    def part_rules(self) -> tuple[PartRule, ...]:
        """One picture for each exposure, and the camera response if there is one."""
        compressed = self.encoding == "jpeg"
        pictures = tuple(
            PartRule(f"picture {i}", self.shape, self.dtype, compressed) for i in range(len(self.exposures_s))
        )
        return (*pictures, RESPONSE_RULE) if self.has_response else pictures

    @model_validator(mode="after")
    def _jpeg_is_bytes(self) -> Self:
        if self.encoding == "jpeg" and self.dtype != "uint8":
            raise ValueError("a jpeg picture has dtype uint8")
        return self


class RadianceMessage(MessageBase):
    """The radiance that a fish-eye camera sees; current until the next one, and repeated for late subscribers.

    Parts: linear R G B on the `size` x `size` grid of the hemisphere (`deltalight.protocol.hemisphere`), which of it
    was seen (0 or 1), the picture for display (jpeg), then the response of the fish-eye camera if `has_response`.
    `camera` is as in `FisheyeMessage`; the pose is that of the time of the map, `capture_ns`.
    """

    stream: Literal["radiance"] = "radiance"
    encoding: Literal["blosc2", "raw"]
    size: Edge
    picture_shape: PictureShape
    clipped_share: Annotated[float, Field(ge=0, le=1)]
    world_from_fisheye: RigidMatrix
    camera: PlainDict
    has_response: bool = False

    def part_rules(self) -> tuple[PartRule, ...]:
        """The map, its mask, the picture, and the camera response if there is one."""
        compressed = self.encoding == "blosc2"
        rules = (
            PartRule("radiance", (self.size, self.size, 3), "float32", compressed),
            PartRule("seen", (self.size, self.size), "uint8", compressed),
            PartRule("picture", self.picture_shape, "uint8", compressed=True),
        )
        return (*rules, RESPONSE_RULE) if self.has_response else rules


class LightEntry(BaseModel):
    """A distant light (`SkyLights.lights`): where it is, and its irradiance R G B across the beam."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    id: Count
    to_light: UnitVector
    irradiance: Strengths
    angular_radius_rad: Annotated[float, Field(ge=0, le=1.6)]


class LightsMessage(MessageBase):
    """Lights cut from a node's radiance maps and tracked over time; they hold until the next, and are repeated.

    Parts: the residual, linear R G B on the `size` x `size` octahedral grid in world axes
    (`deltalight.protocol.octahedral`), and the fraction of each texel that was seen. `count`, `split`, `threshold`
    and `smoothing_s` are the settings of the cut (`LightCut`); `radiance_frame_id` and `radiance_capture_ns` name the
    `radiance` message that was cut last, `regions` are the rows and columns (top, bottom, left, right) of its map.
    """

    stream: Literal["lights"] = "lights"
    encoding: Literal["blosc2", "raw"]
    size: ResidualSize
    count: LightCount
    split: SplitKind
    threshold: PeakThreshold
    smoothing_s: SmoothingTime
    radiance_frame_id: Count
    radiance_capture_ns: Nanoseconds
    world_from_fisheye: RigidMatrix
    lights: Annotated[tuple[LightEntry, ...], Field(strict=False, max_length=MAX_LIGHTS)]
    regions: Annotated[tuple[RegionEdges, ...], Field(strict=False, max_length=MAX_REGIONS)] = ()

    def part_rules(self) -> tuple[PartRule, ...]:
        """The residual, and what of it was seen."""
        compressed = self.encoding == "blosc2"
        return (
            PartRule("residual", (self.size, self.size, 3), "float32", compressed),
            PartRule("seen", (self.size, self.size), "float32", compressed),
        )


class PoseMessage(MessageBase):
    """Pose of the camera for the colour frame `frame_id`: point_world = world_from_camera @ point_camera.

    `alternative` is the other solution of a planar board; `board` describes the board (`BoardSpec` as plain
    data).
    """

    stream: Literal["pose"] = "pose"
    status: Literal["ok", "no_board"]
    world_from_camera: RigidMatrix | None = None
    alternative: RigidMatrix | None = None
    reprojection_error_px: Annotated[float, Field(ge=0, le=1e5)] | None = None
    board: PlainDict | None = None

    @model_validator(mode="after")
    def _status_agrees(self) -> Self:
        if (self.status == "ok") != (self.world_from_camera is not None):
            raise ValueError("world_from_camera must be given where status is ok, and only there")
        return self


class LampEntry(BaseModel):
    """A marker on a lamp: point_world = world_from_marker @ point_marker."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    marker: Count
    world_from_marker: RigidMatrix


class LampsMessage(MessageBase):
    """Lamps whose markers the colour frame `frame_id` shows; the others are left out."""

    stream: Literal["lamps"] = "lamps"
    lamps: Annotated[tuple[LampEntry, ...], Field(strict=False, max_length=MAX_LAMPS)]


class OtherPicture(BaseModel):
    """Another view of a composite's frame, with the pose that it was made with; None: it is not the camera's."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    view: ShownView
    world_from_camera: RigidMatrix | None = None


class CompositeMessage(MessageBase):
    """The finished picture of the colour frame `frame_id` (sRGB, RGB order); parts: it, then those of `others`.

    `node` is the render server; once a second camera has reported, it is the node whose frame the picture shows.
    `capture_ns` and the clock fields are those of that frame; `received_ns` and `rendered_ns` are by the server's
    clock. `scene_id` and `scene_revision` are those of the request that set the frame's scene. `camera`
    (`CameraModel.to_dict()` at the picture's size) and pose are those that it was rendered with. `quality` is that of
    `method.quality` (None if nothing was rendered); `scale` the part of its width that was, before it was enlarged.
    `pass_times_ms` are those of the passes that ran, `reused_pass_times_ms` of the others when they last ran.
    `view` is what the picture shows; `others` are further views of the frame, which somebody asked for.
    """

    stream: Literal["composite"] = "composite"
    encoding: Literal["jpeg", "raw"]
    shape: PictureShape
    dtype: Literal["uint8"] = "uint8"
    status: Literal["ok", "no_pose"]
    scene_id: Name | None = None
    scene_revision: Count | None = None
    camera: PlainDict
    world_from_camera: RigidMatrix | None = None
    received_ns: Nanoseconds
    rendered_ns: Nanoseconds
    pass_times_ms: Durations = Field(default_factory=dict)
    reused_pass_times_ms: Durations = Field(default_factory=dict)
    lights: LightList = ()
    drops: Counts = Field(default_factory=dict)
    quality: Quality | None = None
    scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    view: ShownView = "composite"
    others: Annotated[tuple[OtherPicture, ...], Field(strict=False, max_length=MAX_OTHERS)] = ()

    def part_rules(self) -> tuple[PartRule, ...]:
        """The picture, and those of other views."""
        names = ("picture", *(f"picture {other.view}" for other in self.others))
        return tuple(PartRule(name, self.shape, self.dtype, self.encoding == "jpeg") for name in names)

    @model_validator(mode="after")
    def _views_differ(self) -> Self:
        views = [self.view, *(other.view for other in self.others)]
        if len(set(views)) < len(views):
            raise ValueError("each view may appear only once")
        return self

    @model_validator(mode="after")
    def _scene_has_a_revision(self) -> Self:
        if self.scene_id is not None and self.scene_revision is None:
            raise ValueError("scene_revision must be given where scene_id is")
        return self


CameraStatus = Literal["live", "silent", "other_board", "other_time"]


class CameraEntry(BaseModel):
    """A camera of a room: the node that it belongs to, and its newest frame.

    `received_ns` is by the server's clock. Only frames of those that are `live` are rendered; the others are silent,
    see another board, or are not of the same time as those of the first.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    node: Name
    status: CameraStatus
    frame_id: Count
    capture_ns: Nanoseconds
    received_ns: Nanoseconds


class CamerasMessage(MessageBase):
    """The cameras of the render server `node`, in the order of their first frames."""

    stream: Literal["cameras"] = "cameras"
    frame_id: Count = 0
    cameras: Annotated[tuple[CameraEntry, ...], Field(strict=False, max_length=MAX_CAMERAS)]

    @model_validator(mode="after")
    def _nodes_differ(self) -> Self:
        if len({camera.node for camera in self.cameras}) < len(self.cameras):
            raise ValueError("each node may appear only once")
        return self


ProcessState = Literal["starting", "running", "waiting", "degraded", "stopping"]


class StatsMessage(MessageBase):
    """State of a process: rates in 1/s and drops by topic, a state, and a sentence for display."""

    stream: Literal["stats"] = "stats"
    frame_id: Count = 0
    state: ProcessState
    detail: Sentence = ""
    rates: Rates = Field(default_factory=dict)
    drops: Counts = Field(default_factory=dict)


class ControlMessage(MessageBase):
    """Common fields of request and reply.

    With `payload_bytes` the payload is a part (JSON text) instead of a field.
    """

    frame_id: Count = 0
    capture_ns: Nanoseconds = 0
    id: Name
    payload: PlainDict = Field(default_factory=dict)
    payload_bytes: Annotated[int, Field(ge=1, le=MAX_PAYLOAD_BYTES)] | None = None

    def part_rules(self) -> tuple[PartRule, ...]:
        """The payload, if it is long."""
        return () if self.payload_bytes is None else (PartRule("payload", (self.payload_bytes,), "uint8"),)

    @model_validator(mode="after")
    def _payload_once(self) -> Self:
        if self.payload and self.payload_bytes is not None:
            raise ValueError("payload must be empty where payload_bytes is given")
        return self


class ControlRequest(ControlMessage):
    """A command: `op` with `payload`.

    A repeated `id`, or a repeated `revision` of one op and scene, is not executed twice.
    """

    stream: Literal["request"] = "request"
    op: Name
    scene_id: Name | None = None
    revision: Count | None = None


class ControlReply(ControlMessage):
    """The answer to the request of the same `id`; `error` is one sentence if `ok` is false."""

    stream: Literal["reply"] = "reply"
    ok: bool
    error: Sentence | None = None

    @model_validator(mode="after")
    def _error_agrees(self) -> Self:
        if self.ok != (self.error is None):
            raise ValueError("error must be given where ok is false, and only there")
        return self


Message = (
    ColorMessage
    | DepthMessage
    | FisheyeMessage
    | RadianceMessage
    | LightsMessage
    | PoseMessage
    | LampsMessage
    | CompositeMessage
    | CamerasMessage
    | StatsMessage
    | ControlRequest
    | ControlReply
)
MESSAGE_TYPES: Mapping[str, type[Message]] = {
    stream: kind for kind in get_args(Message) for stream in get_args(kind.model_fields["stream"].annotation)
}
