"""Fish-eye pictures from any camera, captured in a thread: single pictures, or an exposure bracket in turn."""

import threading
import time
from dataclasses import replace
from types import TracebackType
from typing import Self

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeCalibration
from deltalight.protocol.frames import FisheyePictures, SensorFrame
from deltalight.sensor_node.cameras.accompanied import AccompaniedCamera
from deltalight.sensor_node.cameras.base import Camera, EndOfStream, StreamState

# A reported exposure counts as the requested one within 5 % or two lines of a usual rolling shutter (15 us each).
SAME_EXPOSURE, SAME_EXPOSURE_S = 0.05, 30e-6
# Frames to wait for a camera that reports its exposures: the slowest known ones take ten to respond.
LONGEST_SETTLE = 15
RETRY_S = 1.0


class FisheyeCapture:
    """Holds the newest fish-eye pictures of a camera; use it as a context manager.

    A frame with fish-eye pictures of its own (a replay) supplies those; of any other frame the colour is used. With
    `exposures_s` the camera takes these exposures in turn, each once the change has reached the frames.

    Args:
        camera: not opened yet; this opens and closes it.
        calibration: lens of the camera; may be None if the frames carry their own.
        exposures_s: the bracket; empty = pictures as they come.
        settle_frames: frames to skip after a change, if the camera does not report its exposures.
    """

    def __init__(
        self,
        camera: Camera,
        calibration: FisheyeCalibration | None,
        *,
        exposures_s: tuple[float, ...] = (),
        settle_frames: int = 3,
    ) -> None:
        self._camera, self._calibration = camera, calibration
        self._exposures_s, self._settle_frames = exposures_s, settle_frames
        self._newest: FisheyePictures | None = None
        self._fault = ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fisheye", daemon=True)

    def __enter__(self) -> Self:
        """Opens the camera and starts capture.

        Raises:
            DeltalightError: the camera cannot be opened.
        """
        self._camera.open()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops and closes the camera."""
        self._closing.set()
        self._camera.interrupt()
        self._thread.join()
        self._camera.close()

    def newest(self) -> FisheyePictures | None:
        """Returns the newest pictures (the same object until there are newer ones); None if there are none yet."""
        return self._newest

    @property
    def state(self) -> StreamState | None:
        """State of the camera; `stale` if its pictures cannot be used."""
        state = self._camera.state
        is_well = state is None or state.name == "live"
        return StreamState("stale", self._fault) if is_well and self._fault else state

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._newest, self._fault = self._take(), ""
            except EndOfStream:
                return
            except DeltalightError as error:  # the old pictures remain, and `state` gives the reason
                self._fault = str(error)
                self._closing.wait(RETRY_S)

    def _take(self) -> FisheyePictures:
        if not self._exposures_s:
            frame = self._camera.read()
            return frame.fisheye or self._pictures([frame])
        return self._pictures([self._exposed(exposure_s) for exposure_s in self._exposures_s])

    def _exposed(self, exposure_s: float) -> SensorFrame:
        """Sets an exposure and returns the first frame that has it."""
        self._camera.set_exposure(exposure_s)
        if not self._camera.exposure_is_measured:
            changed_ns = time.time_ns()
            frame = self._camera.read()
            while self._camera.capture_ns < changed_ns:  # queued before the change
                frame = self._camera.read()
            for _ in range(self._settle_frames):
                frame = self._camera.read()
            return frame if frame.exposure_s is not None else replace(frame, exposure_s=exposure_s)
        tolerance_s = max(SAME_EXPOSURE * exposure_s, SAME_EXPOSURE_S)
        for _ in range(LONGEST_SETTLE):
            frame = self._camera.read()
            if frame.exposure_s is not None and abs(frame.exposure_s - exposure_s) <= tolerance_s:
                break
        return frame

    def _pictures(self, frames: list[SensorFrame]) -> FisheyePictures:
        calibration = self._calibration
        if calibration is None:
            raise DeltalightError(
                "the fish-eye camera has no calibration; run `deltalight calibrate fisheye`."
            )
        lens, size = calibration.lens, frames[0].color.shape[1::-1]
        if size != (lens.width, lens.height):
            raise DeltalightError(
                f"the fish-eye camera gives {size[0]}x{size[1]} but its calibration says {lens.width}x"
                f"{lens.height}; set its width and height to these."
            )
        return FisheyePictures(
            timestamp_ns=frames[-1].timestamp_ns,
            pictures=tuple(frame.color for frame in frames),
            exposures_s=tuple(frame.exposure_s for frame in frames),
            calibration=calibration,
        )


class CameraWithFisheye(AccompaniedCamera):
    """A camera whose frames carry the newest fish-eye pictures of another one."""

    def __init__(self, camera: Camera, fisheye: FisheyeCapture) -> None:
        super().__init__(camera, fisheye)
        self._fisheye = fisheye

    @property
    def state(self) -> StreamState | None:
        """The camera's state; while that is live, the fish-eye camera's if it is not."""
        state, fisheye = self._camera.state, self._fisheye.state
        is_well = state is None or state.name == "live"
        if not is_well or fisheye is None or fisheye.name == "live":
            return state
        return StreamState("stale", f"the fish-eye pictures are old: {fisheye.detail}")

    def _completed(self, frame: SensorFrame) -> SensorFrame:
        newest = self._fisheye.newest()
        return frame if newest is None else replace(frame, fisheye=newest)
