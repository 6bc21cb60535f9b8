"""A camera beside which another device measures, and whose frames carry what that found."""

from abc import abstractmethod
from contextlib import AbstractContextManager, ExitStack

from deltalight.protocol.frames import SensorFrame
from deltalight.sensor_node.cameras.base import Camera, ImuSample


class AccompaniedCamera(Camera):
    """Opens the `device` first, then the camera, and closes both; all but the frames is the camera's."""

    def __init__(self, camera: Camera, device: AbstractContextManager[object]) -> None:
        self._camera, self._device = camera, device
        self._stack = ExitStack()

    @abstractmethod
    def _completed(self, frame: SensorFrame) -> SensorFrame:
        """Returns the camera's newest frame with what the device found."""

    def _opened(self) -> None:
        """Takes over what the device tells of the camera, once both are open; what this raises closes them again."""

    def open(self) -> None:
        """Opens both.

        Raises:
            DeltalightError: one of them cannot be opened.
        """
        with ExitStack() as stack:
            stack.enter_context(self._device)
            stack.enter_context(self._camera)
            camera = self._camera
            self.camera, self.board, self.extrinsics = camera.camera, camera.board, camera.extrinsics
            self.depth_scale, self.exposure_is_measured = camera.depth_scale, camera.exposure_is_measured
            self.notes = camera.notes
            self._opened()
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Closes both."""
        self._stack.close()

    def read(self) -> SensorFrame:
        """Waits for the camera's next frame."""
        return self._completed(self._camera.read())

    def read_latest(self, max_age_s: float) -> SensorFrame:
        """Returns the camera's newest frame at once."""
        return self._completed(self._camera.read_latest(max_age_s))

    def imu_samples(self) -> list[ImuSample]:
        """Returns what the camera's inertial unit measured since the last call."""
        return self._camera.imu_samples()

    def interrupt(self) -> None:
        """Ends a waiting `read`."""
        self._camera.interrupt()

    def set_exposure(self, seconds: float) -> None:
        """Locks the camera's exposure."""
        self._camera.set_exposure(seconds)

    @property
    def capture_ns(self) -> int:
        """Capture time of the camera's frame, in ns since 1970 by this host's clock."""
        return self._camera.capture_ns
