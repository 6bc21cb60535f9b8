"""Conversion of the OAK SDK's messages and calibration to this project's frames and camera models."""

from collections import deque
from datetime import timedelta
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.protocol.pictures import decode_rgb, depth_from_steps
from deltalight.sensor_node.cameras.base import ImuSample
from deltalight.sensor_node.cameras.live import MM

Message = Any  # of the SDK, which is optional
Lens = Literal["plumb_bob", "equidistant"]

# Lens models of the SDK and ours. Its coefficients are in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6 s1..s4 tx ty, or
# k1..k4 of the equidistant fish-eye.
_MODELS: dict[str, Lens] = {"Perspective": "plumb_bob", "Fisheye": "equidistant"}
# Stereo matching repeats to about one step of the subpixel disparity: three bits on the device.
SUBPIXEL_BITS = 3
# Frames that colour waits for its depth: stereo matching takes two to three periods.
LONGEST_WAIT_FRAMES = 5


def nanoseconds(time: timedelta) -> int:
    """Returns a time of the SDK in ns: CLOCK_MONOTONIC of the host, to the microsecond."""
    return time // timedelta(microseconds=1) * 1000


def camera_from_calibration(handler: Any, socket: Any, width: int, height: int) -> CameraModel:  # noqa: ANN401
    """Returns the camera of uncorrected pictures of a size that is cropped to its shape, then scaled.

    Raises:
        DeltalightError: the device was not calibrated, or its lens model is not supported.
    """
    if not handler.hasCameraCalibration(socket):
        raise DeltalightError(
            f"the OAK holds no calibration of {socket.name}; calibrate it and give rgb.yaml."
        )
    matrix, full_width, full_height = handler.getDefaultIntrinsics(socket)
    model = _lens(handler.getDistortionModel(socket))
    distortion = np.array(handler.getDistortionCoefficients(socket), np.float64)
    cropped_height = min(full_height, round(full_width * height / width))
    cropped_width = min(full_width, round(cropped_height * width / height))
    cropped = np.array(matrix, np.float64)
    cropped[:2, 2] -= (full_width - cropped_width) / 2, (full_height - cropped_height) / 2
    return CameraModel(cropped_width, cropped_height, cropped, model, distortion).resized(width, height)


def camera_from_picture(message: Message, *, corrected: bool) -> CameraModel | None:
    """Returns the camera that a picture reports; None if it reports none.

    `corrected` pictures were undistorted on the device; the camera they carry is the sensor's.
    """
    transformation = message.getTransformation()
    matrix = np.array(transformation.getIntrinsicMatrix(), np.float64)
    if not transformation.isValid() or matrix[0, 0] <= 1:
        return None
    matrix[0, 1] = 0.0  # rounding of single precision
    distortion = np.array(transformation.getDistortionCoefficients(), np.float64)
    width, height = transformation.getSize()
    if corrected or not distortion.size:
        return CameraModel(width, height, matrix)
    return CameraModel(width, height, matrix, _lens(transformation.getDistortionModel()), distortion)


def _lens(model: Any) -> Lens:  # noqa: ANN401 - an enumeration of the SDK
    if model.name not in _MODELS:
        raise DeltalightError(f"the OAK's lens model {model.name} is not known here; give rgb.yaml.")
    return _MODELS[model.name]


def depth_noise_m(handler: Any, left: Any, right: Any, stereo_size: tuple[int, int]) -> float | None:  # noqa: ANN401
    """Returns the noise of stereo depth at 1 m: that of the disparity over focal length times baseline.

    z = f b / d, so sigma_z = z^2 sigma_d / (f b).
    """
    if not (handler.hasCameraCalibration(left) and handler.hasCameraCalibration(right)):
        return None
    focal_px = handler.getCameraIntrinsics(left, *stereo_size)[0][0]
    baseline_m = abs(handler.getBaselineDistance(left, right, False)) / 100
    return float(2.0**-SUBPIXEL_BITS / (focal_px * baseline_m)) if baseline_m > 0 else None


def picture_of(message: Message, name: str) -> tuple[UInt8[np.ndarray, "h w 3"], bytes | None]:
    """Returns the RGB picture of an ImgFrame or of an EncodedFrame (MJPEG), with the JPEG's bytes of the latter."""
    if hasattr(message, "getBitrate"):
        data = bytes(message.getData())
        return decode_rgb(data, name), data
    if message.getType().name == "RGB888i":
        return np.array(message.getFrame()), None
    return np.asarray(cv2.cvtColor(message.getCvFrame(), cv2.COLOR_BGR2RGB)), None


def depth_of(message: Message, camera: CameraModel, noise_sigma_m: float | None) -> DepthImage:
    """Returns the depth of a 16-bit ImgFrame in mm that is aligned with `camera`, possibly at another size."""
    steps = np.asarray(message.getFrame(), np.uint16)
    height, width = steps.shape
    own = camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)
    return depth_from_steps(steps, MM, own, noise_sigma_m)


def exposure_of(message: Message) -> float | None:
    """Returns the exposure of a picture as reported by the sensor, in seconds."""
    seconds: float = message.getExposureTime().total_seconds()
    return seconds if seconds > 0 else None


def imu_samples(message: Message, stamp: Any) -> list[ImuSample]:  # noqa: ANN401 - ns -> ns
    """Returns the readings of an IMUData message; `stamp` converts CLOCK_MONOTONIC to the time of the frames."""
    samples = []
    for packet in message.packets:
        force, rate = packet.acceleroMeter, packet.gyroscope
        samples.append(
            ImuSample(
                stamp(nanoseconds(force.getTimestamp())),
                np.array([force.x, force.y, force.z], np.float64),
                np.array([rate.x, rate.y, rate.z], np.float64),
            )
        )
    return samples


class Pairing:
    """Pairs pictures with depth by capture time; a picture without depth continues alone.

    The SDK's own synchronisation drops both when they are slightly too far apart, so that nothing may arrive at all.
    `unpaired` counts the pictures without depth.
    """

    def __init__(self, tolerance_ns: int) -> None:
        self.unpaired = 0
        self._tolerance_ns = tolerance_ns
        self._pictures: deque[tuple[int, Message]] = deque()
        self._depths: deque[tuple[int, Message]] = deque(maxlen=2 * LONGEST_WAIT_FRAMES)

    def add_picture(self, message: Message) -> None:
        """Adds a picture."""
        self._pictures.append((nanoseconds(message.getTimestamp()), message))

    def add_depth(self, message: Message) -> None:
        """Adds a depth image."""
        self._depths.append((nanoseconds(message.getTimestamp()), message))

    def next(self) -> tuple[Message, Message | None] | None:
        """Returns the oldest picture with its depth, once it is certain whether there is any."""
        if not self._pictures:
            return None
        time_ns, picture = self._pictures[0]
        # Depth within the tolerance, half a period, is the nearest: the next one is farther.
        while self._depths and self._depths[0][0] < time_ns - self._tolerance_ns:
            self._depths.popleft()
        if not self._depths and len(self._pictures) <= LONGEST_WAIT_FRAMES:
            return None
        self._pictures.popleft()
        if self._depths and self._depths[0][0] <= time_ns + self._tolerance_ns:
            return picture, self._depths.popleft()[1]
        self.unpaired += 1
        return picture, None
