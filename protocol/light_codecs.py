"""Decoding of light messages: fish-eye pictures, radiance maps, lights, lamps (SPEC.md, section 3)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from deltalight.protocol.codecs import decode_array, decode_color, decode_raw
from deltalight.protocol.envelope import EnvelopeError
from deltalight.protocol.fisheye_lens import FisheyeCalibration, calibration_of
from deltalight.protocol.frames import FisheyePictures, LampPose, RadianceMap
from deltalight.protocol.messages import FisheyeMessage, LampsMessage, LightsMessage, RadianceMessage
from deltalight.protocol.scene_lights import LightCut
from deltalight.protocol.sky_lights import Region, SkyLights, TrackedLight

Parts = Sequence[memoryview]


def fisheye_pictures(message: FisheyeMessage, parts: Parts) -> FisheyePictures:
    """Returns the pictures of a message; their time is its capture time.

    Raises:
        DeltalightError: a picture cannot be decoded, or the calibration is invalid.
    """
    pictures = tuple(_picture(message, part) for part in parts[: len(message.exposures_s)])
    return FisheyePictures(message.capture_ns, pictures, message.exposures_s, _calibration(message, parts))


def radiance_map(message: RadianceMessage, parts: Parts) -> RadianceMap:
    """Returns the map of a message; its time is its capture time.

    Raises:
        DeltalightError: a part cannot be decoded or holds impossible values, or the calibration is invalid.
    """
    size = message.size
    radiance = decode_array(parts[0], message.encoding, (size, size, 3), "float32")
    seen = decode_array(parts[1], message.encoding, (size, size), "uint8")
    if seen.max() > 1:
        raise EnvelopeError("the mask of a radiance map holds other values than 0 and 1: correct it")
    return RadianceMap(
        timestamp_ns=message.capture_ns,
        radiance=_require_radiance(radiance),
        seen=seen.astype(bool),
        world_from_fisheye=np.array(message.world_from_fisheye),
        clipped_share=message.clipped_share,
        picture=decode_color(parts[2], "jpeg", message.picture_shape),
        calibration=_calibration(message, parts),
    )


def sky_lights(message: LightsMessage, parts: Parts) -> SkyLights:
    """Returns the lights of a message.

    Raises:
        DeltalightError: a part cannot be decoded or holds impossible values.
    """
    size = message.size
    residual = decode_array(parts[0], message.encoding, (size, size, 3), "float32")
    seen = decode_array(parts[1], message.encoding, (size, size), "float32")
    if not ((seen >= 0) & (seen <= 1)).all():
        raise EnvelopeError("the seen fractions of a residual are not all between 0 and 1: correct them")
    return SkyLights(
        cut=LightCut(
            count=message.count,
            split=message.split,
            threshold=message.threshold,
            smoothing_s=message.smoothing_s,
        ),
        world_from_fisheye=np.array(message.world_from_fisheye),
        lights=tuple(
            TrackedLight(
                light.id, np.array(light.to_light), np.array(light.irradiance), light.angular_radius_rad
            )
            for light in message.lights
        ),
        regions=tuple(Region(*edges) for edges in message.regions),
        residual=_require_radiance(residual),
        seen=seen[..., None],
    )


def lamp_poses(message: LampsMessage) -> tuple[LampPose, ...]:
    """Returns the lamps of a message."""
    return tuple(LampPose(lamp.marker, np.array(lamp.world_from_marker)) for lamp in message.lamps)


def _calibration(message: FisheyeMessage | RadianceMessage, parts: Parts) -> FisheyeCalibration:
    return calibration_of(message.camera, bytes(parts[-1]) if message.has_response else None)


def _picture(message: FisheyeMessage, part: memoryview) -> np.ndarray:
    if message.dtype == "float32":
        return _require_radiance(decode_raw(part, message.shape, "float32"))
    return decode_color(part, message.encoding, message.shape)


def _require_radiance(values: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    if not np.isfinite(values).all() or (values < 0).any():
        raise EnvelopeError("the part holds negative or non-finite radiance: send zero or more")
    return values
