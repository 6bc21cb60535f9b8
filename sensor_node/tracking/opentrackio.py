"""OpenTrackIO 1.0.1 (SMPTE RIS OSVP, https://www.opentrackio.org): packets, samples, and their coordinates.

Facts of the standard that this follows: the 16-byte packet header and its Fletcher-16 checksum (modulus 256),
segments, multicast groups 239.135.1.<source number> at port 55555 (section "Transport recommendations"); a
right-handed stage in metres with z up, y forward and x to camera-right of a camera at rest; rotations in degrees,
intrinsic about z (pan), x (tilt), y (roll) (field `transforms`), "clockwise" seen along the axis, so right-handed;
lenses of OpenLensIO.
"""

import json
import math
import struct
from dataclasses import dataclass
from functools import reduce
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict, Field

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.documents import validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.poses import rigid_matrix
from deltalight.sensor_node.tracking.cbor import decode_cbor

PORT = 55555
MULTICAST_PREFIX = "239.135.1."
SOURCE_NUMBERS = (1, 200)  # others are reserved
IDENTIFIER = b"OTrk"
HEADER = struct.Struct(">4sBBHIHH")
CHECKED_BYTES = HEADER.size - 2
JSON, CBOR = 1, 2
LAST_SEGMENT = 0x8000
MAX_SAMPLE_BYTES = 1 << 20
UNDISTORTED_TO_DISTORTED = "Brown-Conrady U-D"  # OpenCV's direction; the other one has no form in OpenCV
# A camera's optical frame is x right, y down, z forward; OpenTrackIO's sensor is x right, y forward, z up.
SENSOR_FROM_OPTICAL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])

Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
Degrees = Annotated[float, Field(ge=-1e6, le=1e6)]
Millimetres = Annotated[float, Field(ge=-1e4, le=1e4)]
Term = Annotated[float, Field(ge=-1e12, le=1e12)]


class _Part(BaseModel):
    """A part of a sample; what is not read here is ignored, as the standard wants it."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Translation(_Part):
    """Metres on the stage."""

    x: Metres
    y: Metres
    z: Metres


class Rotation(_Part):
    """Degrees."""

    pan: Degrees
    tilt: Degrees
    roll: Degrees


class Transform(_Part):
    """One member of the chain from the stage to the sensor."""

    translation: Translation
    rotation: Rotation


class Offset(_Part):
    """Of the principal point from the middle of the sensor, millimetres, x right and y down."""

    x: Millimetres
    y: Millimetres


class Distortion(_Part):
    """Coefficients of OpenLensIO."""

    model: str = "Brown-Conrady D-U"
    radial: tuple[Term, ...] = Field(min_length=1, max_length=6)
    tangential: tuple[Term, ...] = Field(default=(), max_length=2)


class Lens(_Part):
    """What a sample tells about the lens."""

    pinholeFocalLength: float | None = Field(default=None, gt=0, le=1e5)  # noqa: N815 - the standard's name
    projectionOffset: Offset | None = None  # noqa: N815
    entrancePupilOffset: Annotated[float, Field(ge=-10, le=10)] | None = None  # noqa: N815
    distortion: tuple[Distortion, ...] | None = None


class Dimensions(_Part):
    """Of the active sensor, millimetres."""

    width: float = Field(gt=0, le=1e4)
    height: float = Field(gt=0, le=1e4)


class StaticCamera(_Part):
    """What seldom changes about the camera."""

    activeSensorPhysicalDimensions: Dimensions | None = None  # noqa: N815


class Static(_Part):
    """What is sent every few seconds."""

    camera: StaticCamera | None = None


class Sample(_Part):
    """One sample, as far as it is used."""

    sourceNumber: int | None = None  # noqa: N815
    transforms: tuple[Transform, ...] | None = Field(default=None, min_length=1, max_length=64)
    lens: Lens | None = None
    static: Static | None = None

    @property
    def stage_from_camera(self) -> Float64[np.ndarray, "4 4"] | None:
        """The pose of the camera's centre of projection, in its optical frame; None without transforms."""
        if self.transforms is None:
            return None
        sensor = reduce(np.matmul, map(_matrix, self.transforms))
        pupil_m = (self.lens and self.lens.entrancePupilOffset) or 0.0
        forward = rigid_matrix(SENSOR_FROM_OPTICAL, (0.0, pupil_m, 0.0))
        return np.asarray(sensor @ forward)


def _matrix(transform: Transform) -> Float64[np.ndarray, "4 4"]:
    turned, moved = transform.rotation, transform.translation
    pan, tilt, roll = (math.radians(angle) for angle in (turned.pan, turned.tilt, turned.roll))
    (cp, sp), (ct, st), (cr, sr) = ((math.cos(angle), math.sin(angle)) for angle in (pan, tilt, roll))
    about_z = np.array([[cp, -sp, 0], [sp, cp, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    about_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return rigid_matrix(about_z @ about_x @ about_y, (moved.x, moved.y, moved.z))


def tracked_lens(sample: Sample, camera: CameraModel) -> CameraModel | None:
    """Returns a camera of the same size with the sample's lens; None where the sample does not tell it whole.

    With F in millimetres, f = F w_px / w_mm and OpenCV's k1 = l1 F^2, k4 = l2 F^2, k2 = l3 F^4, k5 = l4 F^4, ...,
    p = q F^2 ("Conversion of OpenCV to OpenTrackIO", SMPTE RIS OSVP, 2025-09-02).

    Raises:
        DeltalightError: the distortion is given in the direction that OpenCV has no form for.
    """
    lens, static = sample.lens, sample.static
    size = None if static is None or static.camera is None else static.camera.activeSensorPhysicalDimensions
    if lens is None or lens.pinholeFocalLength is None or size is None:
        return None
    focal, offset = lens.pinholeFocalLength, lens.projectionOffset or Offset(x=0, y=0)
    scales = camera.width / size.width, camera.height / size.height  # pixels a millimetre
    centre = (
        camera.width / 2 - 0.5 + offset.x * scales[0],  # pixel centres are integers here
        camera.height / 2 - 0.5 + offset.y * scales[1],
    )
    matrix = np.array([[focal * scales[0], 0, centre[0]], [0, focal * scales[1], centre[1]], [0, 0, 1]])
    return CameraModel(camera.width, camera.height, matrix, "plumb_bob", _terms(lens, focal))


def _terms(lens: Lens, focal: float) -> Float64[np.ndarray, " k"]:
    if not lens.distortion:
        return np.zeros(0)
    given = next((each for each in lens.distortion if each.model == UNDISTORTED_TO_DISTORTED), None)
    if given is None:
        raise DeltalightError(
            f"the tracker's lens is not used: its distortion must be given as {UNDISTORTED_TO_DISTORTED}; set the"
            " tracking system so, or calibrate the lens here."
        )
    powers = focal ** np.array([2, 2, 4, 4, 6, 6])
    l1, l2, l3, l4, l5, l6 = np.pad(np.array(given.radial), (0, 6 - len(given.radial))) * powers
    p1, p2 = np.pad(np.array(given.tangential), (0, 2 - len(given.tangential))) * focal**2
    return np.array([l1, l3, p1, p2, l5, l2, l4, l6])


@dataclass
class PacketReader:
    """Turns packets into samples; puts segments together.

    Packets that are repeated, foreign or damaged are left out; `fault` is what was wrong with the last one, if
    anything.
    """

    fault: str = ""
    _sequence: int | None = None
    _encoding: int = 0
    _payload: bytes = b""

    def add(self, packet: bytes) -> Sample | None:
        """Takes a packet; returns the sample that it completes."""
        try:
            sample = self._add(packet)
        except DeltalightError as error:
            self.fault, self._payload = str(error), b""
            return None
        if sample is not None:
            self.fault = ""
        return sample

    def _add(self, packet: bytes) -> Sample | None:
        if len(packet) < HEADER.size or not packet.startswith(IDENTIFIER):
            raise DeltalightError("a packet is none of OpenTrackIO; send nothing else to this port.")
        _, _, encoding, sequence, offset, length, checksum = HEADER.unpack_from(packet)
        payload = packet[HEADER.size :]
        if len(payload) != length & ~LAST_SEGMENT or checksum != fletcher16(packet[:CHECKED_BYTES] + payload):
            raise DeltalightError("a packet of OpenTrackIO arrived damaged.")
        if sequence == self._sequence:
            return None  # the same again
        is_next = self._sequence is not None and sequence == (self._sequence + 1) % 0x10000
        self._sequence = sequence
        if offset == 0:
            self._payload, self._encoding = payload, encoding
        elif is_next and offset == len(self._payload) and encoding == self._encoding:
            self._payload += payload
        else:
            raise DeltalightError("a part of an OpenTrackIO sample was lost on the way.")
        if len(self._payload) > MAX_SAMPLE_BYTES:
            raise DeltalightError(f"a sample of OpenTrackIO is longer than {MAX_SAMPLE_BYTES} bytes.")
        if not length & LAST_SEGMENT:
            return None
        whole, self._payload = self._payload, b""
        return _sample(whole, encoding)


def _sample(payload: bytes, encoding: int) -> Sample:
    name = "a sample of OpenTrackIO"
    values: Any
    if encoding == JSON:
        try:
            values = json.loads(payload)
        except (ValueError, RecursionError) as fault:
            raise DeltalightError(f"{name} is no JSON.") from fault
    elif encoding == CBOR:
        values = decode_cbor(payload)
    else:
        raise DeltalightError(f"{name} is coded as {encoding:#04x}; send JSON (1) or CBOR (2).")
    if not isinstance(values, dict):
        raise DeltalightError(f"{name} is not an object.")
    return validate(Sample, values, name)


def fletcher16(data: bytes) -> int:
    """Returns the checksum of a packet: Fletcher's, modulus 256, the second sum in the high byte."""
    values = np.frombuffer(data, np.uint8).astype(np.uint64)
    first = values.sum() & np.uint64(0xFF)
    second = (values * np.arange(len(values), 0, -1, dtype=np.uint64)).sum() & np.uint64(0xFF)
    return int(second) << 8 | int(first)
