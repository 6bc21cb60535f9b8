"""A kind of live camera, as the registry and plugins know it (docs/plugins.md)."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from deltalight.sensor_node.cameras.base import Camera
from deltalight.sensor_node.cameras.live import LiveCalibration
from deltalight.sensor_node.cameras.settings import CameraSettings


@dataclass(frozen=True)
class FoundCamera:
    """A camera that is there; `source` is what opens it, `hint` says what keeps it from being opened."""

    name: str
    source: str
    kind: str
    details: str
    hint: str = ""

    def as_dict(self) -> dict[str, str]:
        """The camera as plain data."""
        return asdict(self)


@dataclass(frozen=True)
class MissingSupport:
    """Why no camera of some kind was found, and what to do about it."""

    kind: str
    details: str
    hint: str


@dataclass(frozen=True)
class Discovery:
    """What was found, and for which kinds nothing could be."""

    cameras: tuple[FoundCamera, ...] = ()
    missing: tuple[MissingSupport, ...] = ()


@dataclass(frozen=True)
class CameraRequest:
    """What a camera is made from.

    Attributes:
        source: what the user wrote, such as `uvc:0`; `device` is what follows the colon.
        settings: how to capture.
        calibration: what the calibration folder says of the camera.
        calibrated: False = without a calibration a nominal lens will do, so that it can be calibrated.
        depth: False = colour alone, as the sensor sees it.
    """

    source: str
    settings: CameraSettings
    calibration: LiveCalibration
    calibrated: bool = True
    depth: bool = True

    @property
    def device(self) -> str:
        """Which of the cameras of its kind; empty = the first."""
        return self.source.partition(":")[2]


@dataclass(frozen=True)
class CameraDriver:
    """Makes cameras of one kind, and finds those of this machine.

    Attributes:
        title: what people call such cameras.
        make: returns the camera, not opened yet; it is opened anew when it fails or stalls.
        find: looks for cameras without opening one, in the file system below a root; None where nothing can.
    """

    title: str
    make: Callable[[CameraRequest], Camera]
    find: Callable[[Path], Discovery] | None = None
