"""Common parts of live cameras: their calibration folder, the host's clocks, and failures."""

import threading
import time
from abc import abstractmethod
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from deltalight.protocol.board import BoardSpec, load_board_yaml
from deltalight.protocol.calibration import Extrinsics, load_extrinsics_yaml
from deltalight.protocol.camera_model import CameraModel, camera_from_info, load_camera_yaml
from deltalight.protocol.documents import read_mapping
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.response_table import load_response_table
from deltalight.sensor_node.cameras.base import Camera, EndOfStream, StaleFrameError
from deltalight.sensor_node.cameras.settings import CameraSettings

MM = 0.001
# One is filled while the other is decoded: with a single one drivers lose every second frame.
DRIVER_BUFFERS = 2
# A capture time of the driver that is further than this from now is by another clock than ours.
PLAUSIBLE_AGE_NS = 5_000_000_000
# Horizontal field of view of usual webcams lies between 55 and 80 degrees; only calibration starts from it.
NOMINAL_FIELD_RAD = np.radians(65.0)


class CameraFailure(DeltalightError):  # noqa: N818 - the camera's, not the program's
    """A live camera cannot be opened, or stopped delivering pictures; it may come back."""


@dataclass(frozen=True)
class LiveCalibration:
    """Contents of a live camera's calibration folder; None for missing parts.

    `depth_camera` is the depth image's own camera (None: registered to colour), `depth_scale` metres per step.
    """

    camera: CameraModel | None = None
    response: Float32[np.ndarray, "256 3"] | None = None
    depth_camera: CameraModel | None = None
    depth_scale: float = MM
    depth_noise_m: float | None = None
    extrinsics: Extrinsics = field(default_factory=Extrinsics)
    board: BoardSpec | None = None


def load_calibration(folder: Path | None, board: BoardSpec | None = None) -> LiveCalibration:
    """Reads a calibration folder (YAML files in it, or in its `calibration` as `deltalight calibrate` writes them).

    `board` replaces its board.yaml.

    Raises:
        DeltalightError: there is no such folder, or a file in it is wrong.
    """
    if folder is None:
        return LiveCalibration(board=board)
    if not folder.is_dir():
        raise DeltalightError(f"the calibration folder {folder} does not exist; run `deltalight calibrate`.")
    place = folder / "calibration" if (folder / "calibration").is_dir() else folder
    camera, depth, room = place / "rgb.yaml", place / "depth.yaml", place / "board.yaml"
    responses = [path for path in (folder / "response.txt", place / "response.txt") if path.is_file()]
    info = read_mapping(depth) if depth.is_file() else {}
    extrinsics = place / "extrinsics.yaml"
    return LiveCalibration(
        camera=load_camera_yaml(camera) if camera.is_file() else None,
        response=load_response_table(responses[0]) if responses else None,
        depth_camera=camera_from_info(info, depth) if "camera_matrix" in info else None,
        depth_scale=_positive(info, "depth_scale", depth) or MM,
        depth_noise_m=_positive(info, "noise_sigma_m", depth),
        extrinsics=load_extrinsics_yaml(extrinsics) if extrinsics.is_file() else Extrinsics(),
        board=board or (load_board_yaml(room) if room.is_file() else None),
    )


def _positive(info: dict[str, object], key: str, path: Path) -> float | None:
    value = info.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 1e3:
        raise DeltalightError(f"{path}: `{key}` is {value!r}; write a positive number of metres.")
    return float(value)


def colour_camera(
    source: str, known: CameraModel | None, settings: CameraSettings, *, calibrated: bool
) -> CameraModel:
    """Returns the colour camera at its capture size; without calibration a nominal one, if allowed.

    Raises:
        DeltalightError: there is no calibration, or its aspect ratio differs.
    """
    width, height = capture_size(known, settings)
    if known is None and calibrated:
        raise DeltalightError(
            f"{source} has no calibration; run `deltalight calibrate camera`, then name the folder that holds "
            "rgb.yaml with --calibration (in Python: `calibration`)."
        )
    if known is None:
        focal = width / 2 / np.tan(NOMINAL_FIELD_RAD / 2)
        centre = (width - 1) / 2, (height - 1) / 2
        return CameraModel(width, height, np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]]))
    if width * known.height != height * known.width:
        raise DeltalightError(
            f"{source} is calibrated for {known.width}x{known.height}, which {width}x{height} is not a scaled "
            "copy of; leave width and height out or calibrate at that size."
        )
    return known.resized(width, height)


def capture_size(known: CameraModel | None, settings: CameraSettings) -> tuple[int, int]:
    """Returns (width, height) of capture: as set, else as calibrated, else 1280x720."""
    default = (1280, 720) if known is None else (known.width, known.height)
    return settings.width or default[0], settings.height or default[1]


class HostClock:
    """Converts times of CLOCK_MONOTONIC into ns since 1970.

    `stamp` rises steadily even if the wall clock is set: it is the camera's own clock. `now` is the same moment by
    the host's current wall clock.
    """

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def stamp(self, monotonic_ns: int) -> int:
        """Returns the time of a frame by the camera's own clock, in ns since 1970."""
        return monotonic_ns + self._offset_ns

    @staticmethod
    def now(monotonic_ns: int) -> int:
        """Returns the same moment in ns since 1970 by the host's current clock."""
        return time.time_ns() - (time.monotonic_ns() - monotonic_ns)

    @staticmethod
    def plausible(driver_ns: int, grabbed_ns: int) -> int:
        """Returns the driver's capture time if it is of this clock and recent, else when the frame was grabbed."""
        return driver_ns if 0 <= grabbed_ns - driver_ns < PLAUSIBLE_AGE_NS else grabbed_ns


class LiveCamera(Camera):
    """A camera that captures now; `remark` says which settings it could not apply."""

    def __init__(self, source: str) -> None:
        self.source, self.remark = source, ""
        self.clock = HostClock()
        self._capture_monotonic_ns = time.monotonic_ns()
        self._interrupted = threading.Event()

    @abstractmethod
    def capture(self) -> SensorFrame:
        """Waits for the next frame and notes when it was captured (`note_capture`).

        Raises:
            CameraFailure: it gives none.
        """

    def read(self) -> SensorFrame:
        """Waits for the next frame of the device; it buffers few, so keep reading."""
        if self._interrupted.is_set():
            raise EndOfStream
        try:
            return self.capture()
        except CameraFailure:
            if self._interrupted.is_set():
                raise EndOfStream from None
            raise

    def read_latest(self, max_age_s: float) -> SensorFrame:
        """Returns the newest frame, skipping older ones that the driver still buffers."""
        for _ in range(DRIVER_BUFFERS + 1):
            frame = self.read()
            age_s = (time.monotonic_ns() - self._capture_monotonic_ns) / 1e9
            if age_s <= max_age_s:
                return frame
        raise StaleFrameError(
            f"the newest frame of {self.source} is {age_s:.2f} s old, {max_age_s:g} s are allowed; check its cable."
        )

    def note_capture(self, monotonic_ns: int) -> None:
        """Notes when the newest frame was captured, by CLOCK_MONOTONIC; `capture` calls it for each."""
        self._capture_monotonic_ns = monotonic_ns

    @property
    def timestamp_ns(self) -> int:
        """The same moment by the camera's own clock, which is what frames carry."""
        return self.clock.stamp(self._capture_monotonic_ns)

    @property
    def capture_ns(self) -> int:
        """Capture time of the last returned frame, in ns since 1970 by this host's current clock."""
        return self.clock.now(self._capture_monotonic_ns)

    def interrupt(self) -> None:
        """Makes later `read`s end; one that waits for the driver ends with its frame or the driver's time-out."""
        self._interrupted.set()
