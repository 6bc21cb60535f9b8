"""A camera whose frames carry the pose that a tracking system gives."""

import time
from dataclasses import replace

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.sensor_node.cameras.accompanied import AccompaniedCamera
from deltalight.sensor_node.cameras.base import Camera, StreamState
from deltalight.sensor_node.tracking.opentrackio import tracked_lens
from deltalight.sensor_node.tracking.receiver import TrackingReceiver, TrackingSettings

LENS_TIMEOUT_S = 6.0  # producers send what seldom changes about every 2 s


class TrackedCamera(AccompaniedCamera):
    """A camera whose poses come from OpenTrackIO packets; a frame has no pose if no packet covers its time.

    If the settings take the lens from the tracker, opening waits for it.

    Raises:
        DeltalightError: no packet describes the lens.
    """

    def __init__(self, camera: Camera, settings: TrackingSettings) -> None:
        self._settings, self._tracker = settings, TrackingReceiver(settings)
        super().__init__(camera, self._tracker)

    @property
    def state(self) -> StreamState | None:
        """The camera's state; while that is live, what is wrong with the tracker."""
        state, remark = self._camera.state, self._tracker.remark(time.time_ns())
        if not remark or (state is not None and state.name != "live"):
            return state
        return StreamState("stale", remark)

    def _opened(self) -> None:
        if not self._settings.lens:
            return
        sample = self._tracker.with_lens(LENS_TIMEOUT_S)
        lens = None if sample is None else tracked_lens(sample, self._camera.camera)
        if lens is None:
            raise DeltalightError(
                "The tracker does not send the lens (pinholeFocalLength and activeSensorPhysicalDimensions); let it"
                " send them, or set lens = false in [node.tracking] and calibrate the camera."
            )
        self.camera = lens

    def _completed(self, frame: SensorFrame) -> SensorFrame:
        pose, depth = self._tracker.at(self._camera.capture_ns), frame.depth
        if not self._settings.lens:
            return replace(frame, world_from_camera=pose)
        if depth is not None and depth.camera == frame.camera:  # it is registered to colour
            depth = replace(depth, camera=self.camera)
        return replace(frame, world_from_camera=pose, camera=self.camera, depth=depth)
