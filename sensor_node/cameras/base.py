"""The interface of every camera."""

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self

from protocol.board import BoardSpec
from protocol.calibration import Extrinsics
from protocol.camera_model import CameraModel
from protocol.errors import DeltalightError
from protocol.frames import SensorFrame


class EndOfStream(Exception):  # noqa: N818 - an end, not an error
    """The camera has no further frames."""


class StaleFrameError(DeltalightError):
    """The newest frame of a camera is older than the caller allows."""


class Camera(ABC):
    """A source of frames in real time (or as fast as asked for); use it as a context manager.

    One thread uses a camera. `timestamp_ns` of a frame is when it was captured, by the camera's own clock;
    `capture_ns` is the same moment by this host's clock. `depth_scale` is metres for each step of the depth,
    None where it does not come in steps.
    """

    camera: CameraModel
    board: BoardSpec | None = None
    extrinsics: Extrinsics = Extrinsics()
    depth_scale: float | None = None

    @abstractmethod
    def open(self) -> None:
        """Start capture."""

    @abstractmethod
    def close(self) -> None:
        """Stop capture and give the device back; may be called twice."""

    @abstractmethod
    def read(self) -> SensorFrame:
        """Wait for the next frame and return it; none is left out.

        Raises:
            EndOfStream: there are no further frames.
        """

    @abstractmethod
    def read_latest(self, max_age_s: float) -> SensorFrame:
        """Return the newest frame at once, leaving out those before it.

        Raises:
            StaleFrameError: the newest frame is older than `max_age_s` seconds.
            EndOfStream: there are no further frames.
        """

    @property
    @abstractmethod
    def capture_ns(self) -> int:
        """When the frame returned last was captured, in ns since 1970 by this host's clock."""

    @abstractmethod
    def interrupt(self) -> None:
        """Make a waiting `read`, and later ones, end at once with EndOfStream; any thread may call it."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
