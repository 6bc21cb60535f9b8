"""Messages and calibrations of the OAK SDK's own types, as a device would send them."""

from datetime import timedelta
from typing import Any

import numpy as np
import pytest

from deltalight.sensor_node.cameras.oak_frames import Pairing
from deltalight.sensor_node.cameras.oak_sdk import load_depthai

pytest.importorskip("depthai", reason="the OAK SDK is not installed")
dai = load_depthai()

WIDTH, HEIGHT, FULL = 64, 36, (4056, 3040)
SENSOR: list[list[float]] = [[3000.0, 0, 2030], [0, 3010, 1510], [0, 0, 1]]
LENS = [-0.3, 0.2, 0.001, -0.002, 0.05, -0.25, 0.15, 0.04, 0, 0, 0, 0, 0, 0]
PERIOD_MS = 5
WAIT_S = 20.0


def calibration() -> Any:  # noqa: ANN401 - of the SDK
    """A calibration as an OAK-D holds it: colour, a stereo pair 7.5 cm apart."""
    handler, sockets = dai.CalibrationHandler(), dai.CameraBoardSocket
    handler.setCameraIntrinsics(sockets.CAM_A, SENSOR, dai.Size2f(*FULL))
    handler.setDistortionCoefficients(sockets.CAM_A, LENS)
    for socket in (sockets.CAM_B, sockets.CAM_C):
        handler.setCameraIntrinsics(
            socket, [[800.0, 0, 640], [0, 800, 400], [0, 0, 1]], dai.Size2f(1280, 800)
        )
    same = np.eye(3).tolist()
    handler.setCameraExtrinsics(sockets.CAM_B, sockets.CAM_C, same, [-7.5, 0, 0], [-7.5, 0, 0])
    handler.setStereoLeft(sockets.CAM_B, same)
    handler.setStereoRight(sockets.CAM_C, same)
    return handler


def transformation() -> Any:  # noqa: ANN401
    """What the device does to a picture of the sensor: crop to 16:9, scale."""
    changed = dai.ImgTransformation(*FULL, SENSOR, dai.CameraModel.Perspective, LENS)
    changed.addCrop(0, 379, 4056, 2282)
    return changed.addScale(WIDTH / 4056, HEIGHT / 2282)


def color_message(number: int, time_ms: float, exposure_us: int = 8000, iso: int = 400) -> Any:  # noqa: ANN401
    frame = dai.ImgFrame()
    frame.setType(dai.ImgFrame.Type.RGB888i).setSize(WIDTH, HEIGHT)
    frame.setFrame(np.full((HEIGHT, WIDTH, 3), (number % 200, 10, 250), np.uint8))
    frame.setTransformation(transformation())
    settings = frame.cam
    settings.exposureTimeUs, settings.sensitivityIso = exposure_us, iso
    frame.cam = settings
    return _stamped(frame, number, time_ms)


def depth_message(number: int, time_ms: float, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Any:  # noqa: ANN401
    frame = dai.ImgFrame()
    frame.setType(dai.ImgFrame.Type.RAW16).setSize(*size)
    steps = np.full(size[::-1], 1000 + number, np.uint16)
    steps[0, 0] = 0
    frame.setFrame(steps)
    return _stamped(frame, number, time_ms)


def _stamped(message: Any, number: int, time_ms: float) -> Any:  # noqa: ANN401
    message.setSequenceNum(number)
    message.setTimestamp(timedelta(milliseconds=time_ms))
    return message


def imu_message() -> Any:  # noqa: ANN401
    packet, message = dai.IMUPacket(), dai.IMUData()
    force, rate = packet.acceleroMeter, packet.gyroscope
    force.x, force.y, force.z, rate.z = 0.1, -9.8, 0.2, 1.5
    packet.acceleroMeter, packet.gyroscope = force, rate
    message.packets = [packet]
    return message


def drained(pairing: Pairing) -> list[tuple[int, int | None]]:
    pairs = iter(pairing.next, None)
    return [(color.getSequenceNum(), depth and depth.getSequenceNum()) for color, depth in pairs]
