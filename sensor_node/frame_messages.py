"""The messages in which a sensor node publishes one frame."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, TypedDict

import numpy as np

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.codecs import encode_array, encode_color, encode_depth
from deltalight.protocol.envelope import EnvelopeError, encode, refusing
from deltalight.protocol.fisheye_lens import describe_calibration
from deltalight.protocol.frames import (
    BoardPose,
    DepthImage,
    FisheyePictures,
    LampPose,
    RadianceMap,
    SensorFrame,
)
from deltalight.protocol.message_fields import matrix_rows
from deltalight.protocol.messages import (
    ColorMessage,
    DepthMessage,
    FisheyeMessage,
    LampEntry,
    LampsMessage,
    LightEntry,
    LightsMessage,
    PoseMessage,
    RadianceMessage,
)
from deltalight.protocol.sky_lights import SkyLights, TrackedLight

# Depth without a step of its own is sent in this step times the least power of two that fits its range.
FINEST_DEPTH_STEP_M = 0.0001
DEPTH_STEPS = 65535


class Stamps(TypedDict):
    """Header fields that all messages of one frame share."""

    node: str
    frame_id: int
    capture_ns: int
    clock_offset_ns: int
    clock_bound_ns: int | None


def depth_multipart(
    depth: DepthImage, stamps: Stamps, stream: Literal["depth", "clean_depth"], step_m: float | None = None
) -> list[bytes]:
    """Returns the depth message; `step_m` is the step of the stored depth, None = as fine as its range allows."""
    step_m = step_m or fitting_step_m(depth)
    height, width = depth.depth_m.shape
    with refusing(stream):
        message = DepthMessage(
            **stamps,
            stream=stream,
            encoding="blosc2",
            shape=(height, width),
            depth_scale_m=step_m,
            camera=depth.camera.to_dict(),
            noise_sigma_m=depth.noise_sigma_m,
        )
    return encode(message, [encode_depth(depth.depth_m, depth.valid, "blosc2", step_m)])


def fitting_step_m(depth: DepthImage) -> float:
    """Returns the finest step in metres in which 16 bits hold the farthest known depth."""
    farthest = float(depth.depth_m.max(initial=0.0, where=depth.valid & np.isfinite(depth.depth_m)))
    octaves = math.ceil(math.log2(max(farthest / (FINEST_DEPTH_STEP_M * DEPTH_STEPS), 1.0)))
    return FINEST_DEPTH_STEP_M * 2.0**octaves


def pose_multipart(pose: BoardPose | None, board: BoardSpec | None, stamps: Stamps) -> list[bytes]:
    """Returns the pose message, which states if no pose is known."""
    described = None if board is None else _described(board)
    if pose is None:
        return encode(PoseMessage(**stamps, status="no_board", board=described))
    message = PoseMessage(
        **stamps,
        status="ok",
        world_from_camera=matrix_rows(pose.world_from_camera),
        alternative=None if pose.alternative is None else matrix_rows(pose.alternative),
        reprojection_error_px=pose.reprojection_error_px,
        board=described,
    )
    return encode(message)


@lru_cache(maxsize=1)
def _described(board: BoardSpec) -> dict[str, object]:
    """Returns a board's fields; a node sends the same with each frame."""
    return board.model_dump(mode="json", exclude_none=True)


def color_multipart(
    frame: SensorFrame, stamps: Stamps, encoding: Literal["jpeg", "raw"], jpeg_quality: int
) -> list[bytes]:
    """Returns the colour message; JPEG bytes of the frame are sent unchanged.

    Raises:
        EnvelopeError: the picture is too large for a message.
    """
    recorded = frame.color_jpeg if encoding == "jpeg" else None
    picture = recorded or encode_color(frame.color, encoding, jpeg_quality)
    height, width = frame.color.shape[:2]
    with refusing("color"):
        message = ColorMessage(
            **stamps,
            encoding=encoding,
            shape=(height, width, 3),
            camera=frame.camera.to_dict(),
            has_response=frame.response is not None,
            exposure_s=frame.exposure_s,
        )
    return encode(message, [picture] if frame.response is None else [picture, frame.response])


def fisheye_multipart(
    fisheye: FisheyePictures, stamps: Stamps, encoding: Literal["jpeg", "raw"], jpeg_quality: int
) -> list[bytes]:
    """Returns the message of fish-eye pictures; linear ones are sent raw. The stamps are those of their own capture.

    Raises:
        EnvelopeError: the pictures differ in size or kind, or are too many or too large for a message.
    """
    first = fisheye.pictures[0]
    if any(picture.shape != first.shape or picture.dtype != first.dtype for picture in fisheye.pictures):
        raise EnvelopeError("the pictures of a fish-eye bracket differ in size or kind: use one for all")
    is_linear = first.dtype == np.float32
    code: Literal["jpeg", "raw"] = "raw" if is_linear else encoding
    camera, response = describe_calibration(fisheye.calibration)
    height, width = first.shape[:2]
    with refusing("fisheye"):
        message = FisheyeMessage(
            **stamps,
            encoding=code,
            shape=(height, width, 3),
            dtype="float32" if is_linear else "uint8",
            camera=camera,
            has_response=response is not None,
            exposures_s=fisheye.exposures_s,
        )
    parts = [
        encode_array(picture, "raw") if is_linear else encode_color(picture, code, jpeg_quality)
        for picture in fisheye.pictures
    ]
    return encode(message, parts if response is None else [*parts, response])


def radiance_multipart(radiance: RadianceMap, stamps: Stamps, jpeg_quality: int) -> list[bytes]:
    """Returns the message of a radiance map.

    The stamps are those of the map's first frame, even when it is repeated for late subscribers: by them a receiver
    recognises a map that it already has.
    """
    camera, response = describe_calibration(radiance.calibration)
    height, width = radiance.picture.shape[:2]
    message = RadianceMessage(
        **stamps,
        encoding="blosc2",
        size=len(radiance.radiance),
        picture_shape=(height, width, 3),
        clipped_share=float(radiance.clipped_share),
        world_from_fisheye=matrix_rows(radiance.world_from_fisheye),
        camera=camera,
        has_response=response is not None,
    )
    parts = [
        encode_array(radiance.radiance, "blosc2"),
        encode_array(radiance.seen.astype(np.uint8), "blosc2"),
        encode_color(radiance.picture, "jpeg", jpeg_quality),
    ]
    return encode(message, parts if response is None else [*parts, response])


def lights_multipart(sky: SkyLights, stamps: Stamps, radiance: Stamps) -> list[bytes]:
    """Returns the message of lights; `radiance` are the stamps of the map that was cut last.

    The stamps are those of the first frame with these lights, even when they are repeated for late subscribers.
    """
    message = LightsMessage(
        **stamps,
        **dict(sky.cut),
        encoding="blosc2",
        size=len(sky.residual),
        radiance_frame_id=radiance["frame_id"],
        radiance_capture_ns=radiance["capture_ns"],
        world_from_fisheye=matrix_rows(sky.world_from_fisheye),
        lights=tuple(map(_light_entry, sky.lights)),
        regions=tuple((each.top, each.bottom, each.left, each.right) for each in sky.regions),
    )
    return encode(message, [encode_array(sky.residual, "blosc2"), encode_array(sky.seen, "blosc2")])


def _light_entry(light: TrackedLight) -> LightEntry:
    x, y, z = light.to_light.tolist()
    red, green, blue = light.irradiance.tolist()
    return LightEntry(
        id=light.identity,
        to_light=(x, y, z),
        irradiance=(red, green, blue),
        angular_radius_rad=light.angular_radius_rad,
    )


def lamps_multipart(lamps: Sequence[LampPose], stamps: Stamps) -> list[bytes]:
    """Returns the message of the lamps that one colour frame shows."""
    entries = (
        LampEntry(marker=int(lamp.marker), world_from_marker=matrix_rows(lamp.world_from_marker))
        for lamp in lamps
    )
    return encode(LampsMessage(**stamps, lamps=tuple(entries)))
