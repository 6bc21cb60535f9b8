"""OAK cameras (depthai 3): colour, stereo depth aligned to it, IMU."""

from datetime import timedelta
from typing import Any

import numpy as np

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.sensor_node.cameras.base import EndOfStream, ImuSample
from deltalight.sensor_node.cameras.driver import CameraDriver, CameraRequest
from deltalight.sensor_node.cameras.live import MM, CameraFailure, LiveCalibration, LiveCamera, capture_size
from deltalight.sensor_node.cameras.oak_device import STEREO_SIZE, OakDevice, OakStreams
from deltalight.sensor_node.cameras.oak_discovery import find_cameras
from deltalight.sensor_node.cameras.oak_frames import (
    Pairing,
    camera_from_calibration,
    camera_from_picture,
    depth_noise_m,
    depth_of,
    exposure_of,
    imu_samples,
    nanoseconds,
    picture_of,
)
from deltalight.sensor_node.cameras.oak_sdk import load_depthai
from deltalight.sensor_node.cameras.settings import CameraSettings

# How often a waiting read checks for `interrupt` and for a lost device.
POLL = timedelta(seconds=0.1)
# Automatic exposure and white balance settle within a second.
SETTLE_S = 1.0
# Sensitivity of an exposure given by the settings, so that pictures are equally bright at every start.
DEFAULT_ISO = 100


class OakCamera(LiveCamera):
    """An OAK by its id (empty: the first found). Its own calibration applies unless the folder has rgb.yaml.

    With stereo depth, the device undistorts colour, and aligns depth to it; otherwise colour comes as the sensor sees
    it, with the full lens model. `exposure_s` of each frame is reported by the sensor.
    """

    exposure_is_measured = True

    def __init__(
        self,
        device_id: str,
        settings: CameraSettings,
        calibration: LiveCalibration,
        *,
        with_depth: bool = True,
        device: OakDevice | None = None,
    ) -> None:
        super().__init__(f"oak:{device_id}" if device_id else "oak")
        load_depthai()
        self.board, self.extrinsics = calibration.board, calibration.extrinsics
        self.unpaired = 0
        self._settings, self._known, self._with_depth = settings, calibration, with_depth
        self._device = device or OakDevice(device_id)
        self._streams: OakStreams | None = None
        self._iso = DEFAULT_ISO

    def open(self) -> None:
        """Boots the device, reads its lens from the first picture, and locks exposure and white balance as set.

        Raises:
            CameraFailure: it is absent or does not start.
            DeltalightError: its calibration is missing or unusable.
        """
        self.close()
        self._interrupted.clear()
        size = capture_size(self._known.camera, self._settings)
        self._streams = streams = self._device.open(self._settings, size, with_depth=self._with_depth)
        self._pairing = Pairing(round(0.5e9 / self._settings.fps))
        self.remark = "; ".join(streams.remarks)
        self.depth_scale = MM if streams.depth is not None else None
        try:
            self._learn_lens(streams, size)
            self._lock()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Releases the device."""
        if self._streams is not None:
            self.unpaired += self._pairing.unpaired
        self._streams = None
        self._device.close()

    def set_exposure(self, seconds: float) -> None:
        """Locks the exposure, at the sensitivity (ISO) of the newest picture."""
        control = load_depthai().CameraControl()
        control.setManualExposure(round(seconds * 1e6), self._iso)
        self._device.send(control)

    def capture(self) -> SensorFrame:
        """Waits for the next picture, with its depth if that arrives in time."""
        picture, depth = self._pair()
        self.note_capture(nanoseconds(picture.getTimestamp()))
        self._iso = picture.getSensitivity() or self._iso
        color, jpeg = picture_of(picture, self.source)
        return SensorFrame(
            frame_id=picture.getSequenceNum(),
            timestamp_ns=self.timestamp_ns,
            color=color,
            camera=self.camera,
            response=self._known.response,
            exposure_s=exposure_of(picture),
            depth=None if depth is None else depth_of(depth, self.camera, self._noise_m),
            depth_timestamp_ns=None if depth is None else self.clock.stamp(nanoseconds(depth.getTimestamp())),
            color_jpeg=jpeg,
        )

    def imu_samples(self) -> list[ImuSample]:
        """Returns the IMU's measurements since the last call, at most the last seconds."""
        queue = None if self._streams is None else self._streams.imu
        if queue is None or queue.isClosed():
            return []
        return [sample for message in queue.tryGetAll() for sample in imu_samples(message, self.clock.stamp)]

    def _learn_lens(self, streams: OakStreams, size: tuple[int, int]) -> None:
        self._noise_m = self._known.depth_noise_m
        if self._noise_m is None and streams.stereo_sockets is not None:
            self._noise_m = depth_noise_m(streams.calibration, *streams.stereo_sockets, STEREO_SIZE)
        picture, _ = self._pair()
        own = camera_from_picture(picture, corrected=streams.corrected)
        if streams.corrected and self._known.camera is not None and self._known.camera.has_distortion:
            raise DeltalightError(
                f"{self.source} removes its lens's distortion itself, so that an rgb.yaml with distortion does not "
                "fit; take rgb.yaml out of the calibration folder."
            )
        if self._known.camera is not None:
            self.camera = self._known.camera.resized(*size)
        elif own is not None and streams.corrected:
            self.camera = own
        else:
            self.camera = camera_from_calibration(streams.calibration, streams.color_socket, *size)
        given = np.shape(picture_of(picture, self.source)[0])[1::-1]
        if given != (self.camera.width, self.camera.height):
            raise DeltalightError(
                f"{self.source} gives {given[0]}x{given[1]} where {self.camera.width}x{self.camera.height} was "
                "asked for; set width and height to a size it has."
            )

    def _lock(self) -> None:
        settings, dai = self._settings, load_depthai()
        if settings.exposure_s is not None:
            self.set_exposure(settings.exposure_s)
        if not settings.lock or None not in (settings.exposure_s, settings.white_balance_k):
            return
        for _ in range(round(SETTLE_S * settings.fps)):
            self._pair()
        control = dai.CameraControl()
        if settings.exposure_s is None:
            control.setAutoExposureLock(True)
        if settings.white_balance_k is None:
            control.setAutoWhiteBalanceLock(True)
        self._device.send(control)

    def _pair(self) -> tuple[Any, Any]:
        """Waits for the next picture and its depth (messages of the SDK)."""
        dai, streams = load_depthai(), self._streams
        while streams is not None and not self._interrupted.is_set():
            queues = [streams.color] if streams.depth is None else [streams.color, streams.depth]
            try:
                dai.MessageQueue.waitAny(queues, POLL)
                paired = self._collect(streams)
            except (dai.MessageQueue.QueueException, RuntimeError) as error:
                raise CameraFailure(
                    f"{self.source} was unplugged or its connection broke ({error})."
                ) from error
            if paired is not None:
                return paired
            if not self._device.is_running:
                raise CameraFailure(f"{self.source} was unplugged or its connection broke.")
        raise EndOfStream

    def _collect(self, streams: OakStreams) -> tuple[Any, Any] | None:
        if streams.depth is None:
            picture = streams.color.tryGet()
            return None if picture is None else (picture, None)
        for picture in streams.color.tryGetAll():
            self._pairing.add_picture(picture)
        for depth in streams.depth.tryGetAll():
            self._pairing.add_depth(depth)
        return self._pairing.next()


def make_camera(request: CameraRequest) -> OakCamera:
    """The camera that a request names by its id; the first one where it names none.

    Raises:
        DeltalightError: the SDK is not installed.
    """
    return OakCamera(request.device, request.settings, request.calibration, with_depth=request.depth)


DRIVER = CameraDriver("OAK", make_camera, find_cameras)
