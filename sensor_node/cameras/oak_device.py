"""Access to an OAK device: opens it, builds its pipeline, sends it controls."""

from dataclasses import dataclass, field
from typing import Any

from deltalight.protocol.documents import nearest
from deltalight.protocol.errors import DeltalightError
from deltalight.sensor_node.cameras.live import CameraFailure
from deltalight.sensor_node.cameras.oak_frames import SUBPIXEL_BITS
from deltalight.sensor_node.cameras.oak_sdk import load_depthai
from deltalight.sensor_node.cameras.settings import CameraSettings

# Half of the stereo cameras' 1280x800: what the device matches at 30 per second; depth from 0.35 m on.
STEREO_SIZE = (640, 400)
# Short queues, so that messages are recent.
QUEUE_SIZE = 4
JPEG_QUALITY = 95
IMU_RATE_HZ = 200


@dataclass
class OakStreams:
    """Outputs of a running device: queues of the SDK, and its calibration.

    `corrected`: the colour's distortion is removed, as alignment of depth requires. `depth` is None without a stereo
    pair, `imu` without an IMU.
    """

    color: Any
    calibration: Any
    color_socket: Any
    corrected: bool
    depth: Any = None
    imu: Any = None
    stereo_sockets: tuple[Any, Any] | None = None
    remarks: list[str] = field(default_factory=list)


class OakDevice:
    """A device by its id (empty: the first that is free)."""

    def __init__(self, device_id: str) -> None:
        self._id = device_id
        self._device: Any = None
        self._pipeline: Any = None
        self._control: Any = None

    def open(self, settings: CameraSettings, size: tuple[int, int], *, with_depth: bool) -> OakStreams:
        """Boots the device and starts its pipeline; takes a few seconds.

        Raises:
            CameraFailure: no such device, no permission, in use, or it does not boot.
            DeltalightError: the settings ask for what it cannot do.
        """
        dai = load_depthai()
        info = self._find(dai)
        try:
            self._device = dai.Device(info)
            self._device.setMaxReconnectionAttempts(0)  # this project reconnects itself, with a visible state
            self._pipeline = dai.Pipeline(self._device)
            streams = self._build(dai, settings, size, with_depth=with_depth)
            self._pipeline.start()
        except RuntimeError as error:
            self.close()
            raise CameraFailure(
                f"the OAK {info.deviceId} does not start ({error}); unplug it and plug it in again."
            ) from error
        except DeltalightError:
            self.close()
            raise
        return streams

    def close(self) -> None:
        """Stops the pipeline and releases the device."""
        if self._pipeline is not None:
            self._pipeline.stop()
            self._pipeline.wait()
        if self._device is not None:
            self._device.close()
        self._pipeline = self._device = self._control = None

    @property
    def is_running(self) -> bool:
        """Whether the pipeline still runs and the device is still connected."""
        return self._pipeline is not None and self._pipeline.isRunning() and not self._device.isClosed()

    def send(self, control: Any) -> None:  # noqa: ANN401 - a CameraControl of the SDK
        """Sends a control to the colour camera."""
        self._control.send(control)

    def _find(self, dai: Any) -> Any:  # noqa: ANN401 - a DeviceInfo of the SDK
        found = {info.deviceId or info.name: info for info in dai.Device.getAllAvailableDevices()}
        if not found:
            raise CameraFailure("no OAK device found; see `deltalight doctor` for what is missing.")
        if not self._id:
            return next(iter(found.values()))
        names = {info.name: info for info in found.values()}
        if self._id not in found | names:
            hint = nearest(self._id, found) or next(iter(found))
            raise CameraFailure(f"there is no OAK `{self._id}`; the nearest is `{hint}`.")
        return (found | names)[self._id]

    def _build(
        self,
        dai: Any,  # noqa: ANN401
        settings: CameraSettings,
        size: tuple[int, int],
        *,
        with_depth: bool,
    ) -> OakStreams:
        sockets, pipeline, device = dai.CameraBoardSocket, self._pipeline, self._device
        connected = device.getConnectedCameras()
        with_depth = with_depth and sockets.CAM_B in connected and sockets.CAM_C in connected
        calibration = device.readCalibration()
        camera = pipeline.create(dai.node.Camera).build(sockets.CAM_A)
        self._control = camera.inputControl.createInputQueue()
        self._start_controls(dai, camera.initialControl, settings, calibration)
        is_slow = device.getUsbSpeed().name not in ("SUPER", "SUPER_PLUS")
        kind = dai.ImgFrame.Type.NV12 if is_slow else dai.ImgFrame.Type.RGB888i
        color = camera.requestOutput(size, kind, fps=settings.fps, enableUndistortion=with_depth)
        streams = OakStreams(
            color=self._encoded(dai, color, settings.fps) if is_slow else _queue(color),
            calibration=calibration,
            color_socket=sockets.CAM_A,
            corrected=with_depth,
        )
        if is_slow:
            streams.remarks.append("colour comes as JPEG, because it is not on USB 3")
        if with_depth:
            streams.depth = _queue(self._aligned_depth(dai, color, settings))
            if settings.neural_depth is None:  # of the network's noise nothing is known
                streams.stereo_sockets = sockets.CAM_B, sockets.CAM_C
        if device.getConnectedIMU() not in ("", "NONE"):
            streams.imu = _queue(self._imu(dai), size=QUEUE_SIZE * IMU_RATE_HZ)
        return streams

    def _start_controls(self, dai: Any, control: Any, settings: CameraSettings, calibration: Any) -> None:  # noqa: ANN401
        if settings.white_balance_k is not None:
            control.setManualWhiteBalance(settings.white_balance_k)
        # The factory calibration applies to one position of a lens that moves; 0 = it does not move.
        position = calibration.getLensPosition(dai.CameraBoardSocket.CAM_A)
        if position > 0:
            control.setManualFocus(position)

    def _encoded(self, dai: Any, color: Any, fps: float) -> Any:  # noqa: ANN401
        """Adds a JPEG encoder on the device: a tenth of the bytes, which USB 2 and Ethernet can carry."""
        profile = dai.VideoEncoderProperties.Profile.MJPEG
        encoder = self._pipeline.create(dai.node.VideoEncoder)
        encoder.build(color, frameRate=fps, profile=profile, quality=JPEG_QUALITY)
        return _queue(encoder.out)

    def _aligned_depth(self, dai: Any, color: Any, settings: CameraSettings) -> Any:  # noqa: ANN401
        """Adds depth in mm, aligned to the colour camera; temporal filters are the node's task.

        Raises:
            DeltalightError: the settings ask for a network that the device cannot run.
        """
        is_rvc4 = self._device.getPlatform() == dai.Platform.RVC4
        if settings.neural_depth is not None and not is_rvc4:
            raise DeltalightError(
                "This OAK cannot run NeuralDepth, which needs an OAK 4 (RVC4); take neural_depth out of the settings."
            )
        left, right = (
            self._pipeline.create(dai.node.Camera).build(socket)
            for socket in (dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C)
        )
        if settings.neural_depth is not None:
            matcher = self._neural_depth(dai, left, right, settings)
        else:
            matcher = self._stereo_depth(dai, left, right, settings.fps)
        if is_rvc4:
            align = self._pipeline.create(dai.node.ImageAlign)
            matcher.depth.link(align.input)
            color.link(align.inputAlignTo)
            return align.outputAligned
        color.link(matcher.inputAlignTo)
        return matcher.depth

    def _stereo_depth(self, dai: Any, left: Any, right: Any, fps: float) -> Any:  # noqa: ANN401
        pair = (camera.requestOutput(STEREO_SIZE, fps=fps) for camera in (left, right))
        stereo = self._pipeline.create(dai.node.StereoDepth).build(*pair)
        stereo.setLeftRightCheck(True)
        stereo.setSubpixel(True)
        stereo.setSubpixelFractionalBits(SUBPIXEL_BITS)
        stereo.initialConfig.postProcessing.temporalFilter.enable = False
        return stereo

    def _neural_depth(self, dai: Any, left: Any, right: Any, settings: CameraSettings) -> Any:  # noqa: ANN401
        """Adds the device's own network, which rectifies and scales the whole pictures itself."""
        model = getattr(dai.DeviceModelZoo, f"NEURAL_DEPTH_{str(settings.neural_depth).upper()}")
        pair = (camera.requestFullResolutionOutput(fps=settings.fps) for camera in (left, right))
        return self._pipeline.create(dai.node.NeuralDepth).build(*pair, model)

    def _imu(self, dai: Any) -> Any:  # noqa: ANN401
        imu = self._pipeline.create(dai.node.IMU)
        imu.enableIMUSensor([dai.IMUSensor.ACCELEROMETER_RAW, dai.IMUSensor.GYROSCOPE_RAW], IMU_RATE_HZ)
        imu.setBatchReportThreshold(1)
        imu.setMaxBatchReports(10)
        return imu.out


def _queue(output: Any, size: int = QUEUE_SIZE) -> Any:  # noqa: ANN401 - an Output of the SDK
    """Creates a queue in which a new message replaces the oldest if nobody reads."""
    return output.createOutputQueue(maxSize=size, blocking=False)
