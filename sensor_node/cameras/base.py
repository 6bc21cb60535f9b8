"""The interface of every camera."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame


class EndOfStream(Exception):  # noqa: N818 - an end, not an error
    """The camera has no further frames."""


class StaleFrameError(DeltalightError):
    """The newest frame of a camera is older than the caller allows."""


@dataclass(frozen=True)
class StreamState:
    """Health of a live camera's stream, with a sentence for the user."""

    name: Literal["live", "stale", "lost"]
    detail: str


@dataclass(frozen=True, eq=False)
class ImuSample:
    """One reading of an inertial unit, in its own axes; `timestamp_ns` as of the camera's frames."""

    timestamp_ns: int
    acceleration_m_s2: Float64[np.ndarray, "3"]
    angular_rate_rad_s: Float64[np.ndarray, "3"]


class Camera(ABC):
    """A source of frames in real time (or as fast as requested); use it as a context manager.

    One thread uses a camera. `timestamp_ns` of a frame is its capture time by the camera's own clock; `capture_ns` is
    the same moment by this host's clock. `depth_scale` is metres per step of the depth, None if it does not come in
    steps. A live camera may know these, and `camera`, only once it is open. `exposure_is_measured`: each frame's
    `exposure_s` is what the sensor did, not what was requested. `notes` are sentences about missing optional parts
    and what is used instead, complete once it is open.
    """

    camera: CameraModel
    board: BoardSpec | None = None
    extrinsics: Extrinsics = Extrinsics()
    depth_scale: float | None = None
    exposure_is_measured: bool = False
    notes: Sequence[str] = ()

    @abstractmethod
    def open(self) -> None:
        """Starts capture."""

    @abstractmethod
    def close(self) -> None:
        """Stops capture and releases the device; idempotent."""

    @abstractmethod
    def read(self) -> SensorFrame:
        """Waits for the next frame and returns it, without skipping any.

        Raises:
            EndOfStream: there are no further frames.
        """

    @abstractmethod
    def read_latest(self, max_age_s: float) -> SensorFrame:
        """Returns the newest frame at once, skipping older ones.

        Raises:
            StaleFrameError: the newest frame is older than `max_age_s` seconds.
            EndOfStream: there are no further frames.
        """

    @property
    @abstractmethod
    def capture_ns(self) -> int:
        """Capture time of the last returned frame, in ns since 1970 by this host's clock."""

    @abstractmethod
    def interrupt(self) -> None:
        """Makes a waiting `read`, and later ones, end at once with EndOfStream; callable from any thread."""

    @property
    def state(self) -> StreamState | None:
        """State of a live camera's stream; None if only the age of the frames tells."""
        return None

    def imu_samples(self) -> list[ImuSample]:
        """Returns the inertial unit's measurements since the last call, at most the last seconds."""
        return []

    def set_exposure(self, seconds: float) -> None:
        """Locks the exposure; it takes effect some frames later.

        Raises:
            DeltalightError: the exposure of this camera cannot be set.
        """
        raise DeltalightError(
            f"this camera's exposure cannot be set to {seconds:g} s; take pictures as they come, no bracket."
        )

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
