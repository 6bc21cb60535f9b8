"""A camera whose frames carry the pose that a tracking system gives."""

import time
from contextlib import ExitStack
from dataclasses import replace

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.sensor_node.cameras.base import Camera, ImuSample, StreamState
from deltalight.sensor_node.tracking.opentrackio import tracked_lens
from deltalight.sensor_node.tracking.receiver import TrackingReceiver, TrackingSettings

LENS_TIMEOUT_S = 6.0  # producers send what seldom changes about every 2 s


class TrackedCamera(Camera):
    """A camera with poses of OpenTrackIO; frames whose moment the tracker says nothing of have none of it."""

    def __init__(self, camera: Camera, settings: TrackingSettings) -> None:
        self._camera, self._settings = camera, settings
        self._tracker = TrackingReceiver(settings)
        self._stack = ExitStack()

    def open(self) -> None:
        """Open both, and wait for the lens if the tracker shall give it.

        Raises:
            DeltalightError: one of them cannot be opened, or no packet tells the lens.
        """
        with ExitStack() as stack:
            stack.enter_context(self._tracker)
            stack.enter_context(self._camera)
            camera = self._camera
            self.camera, self.board, self.extrinsics = camera.camera, camera.board, camera.extrinsics
            self.depth_scale, self.exposure_is_measured = camera.depth_scale, camera.exposure_is_measured
            self.notes = camera.notes
            if self._settings.lens:
                self._take_lens()
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Close both."""
        self._stack.close()

    def read(self) -> SensorFrame:
        """Wait for the camera's next frame."""
        return self._with_pose(self._camera.read())

    def read_latest(self, max_age_s: float) -> SensorFrame:
        """Return the camera's newest frame at once."""
        return self._with_pose(self._camera.read_latest(max_age_s))

    def imu_samples(self) -> list[ImuSample]:
        """Return what the camera's inertial unit measured since the last call."""
        return self._camera.imu_samples()

    def interrupt(self) -> None:
        """End a waiting `read`."""
        self._camera.interrupt()

    def set_exposure(self, seconds: float) -> None:
        """Lock the camera's exposure."""
        self._camera.set_exposure(seconds)

    @property
    def capture_ns(self) -> int:
        """Capture time of the camera's frame, in ns since 1970 by this host's clock."""
        return self._camera.capture_ns

    @property
    def tracking_port(self) -> int:
        """UDP port at which poses are received."""
        return self._tracker.port

    @property
    def state(self) -> StreamState | None:
        """The camera's state; while that is live, what is wrong with the tracker."""
        state, remark = self._camera.state, self._tracker.remark(time.time_ns())
        if not remark or (state is not None and state.name != "live"):
            return state
        return StreamState("stale", remark)

    def _take_lens(self) -> None:
        sample = self._tracker.with_lens(LENS_TIMEOUT_S)
        lens = None if sample is None else tracked_lens(sample, self._camera.camera)
        if lens is None:
            raise DeltalightError(
                "The tracker does not tell the lens (pinholeFocalLength and activeSensorPhysicalDimensions); let it"
                " send them, or set lens = false in [node.tracking] and calibrate the camera."
            )
        self.camera = lens

    def _with_pose(self, frame: SensorFrame) -> SensorFrame:
        pose, depth = self._tracker.at(self._camera.capture_ns), frame.depth
        if not self._settings.lens:
            return replace(frame, world_from_camera=pose)
        if depth is not None and depth.camera == frame.camera:  # it is registered to colour
            depth = replace(depth, camera=self.camera)
        return replace(frame, world_from_camera=pose, camera=self.camera, depth=depth)
