"""Sources of frames that can be replayed: a dataset folder or a recording, behind one interface."""

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import exists
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.ros_bag_names import refuse_bag
from deltalight.protocol.scene import SceneDocument

RECORDING_SUFFIXES = (".mcap", ".mcap.active")  # or in capitals, as other systems may name files


class Source(Protocol):
    """A sequence of frames with metadata of the cameras and the room.

    `notes` are sentences, each said once, about missing optional parts and what is used instead; `depth_scale` is the
    step of the stored depth in metres (None if not stored in steps); `scene` is the attached scene document.
    """

    @property
    def camera(self) -> CameraModel:
        """Colour camera."""

    @property
    def board(self) -> BoardSpec | None:
        """Marker board, if described."""

    @property
    def extrinsics(self) -> Extrinsics:
        """Transforms between the sensors."""

    @property
    def depth_scale(self) -> float | None:
        """Metres per step of the stored depth."""

    @property
    def notes(self) -> list[str]:
        """Sentences about missing optional parts."""

    @property
    def scene(self) -> SceneDocument | None:
        """Attached scene document."""

    @property
    def timestamps_ns(self) -> list[int]:
        """Capture time of every frame."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> SensorFrame: ...

    def __iter__(self) -> Iterator[SensorFrame]: ...


def is_recording_name(name: str) -> bool:
    """Whether a file is called as recordings are."""
    return name.lower().endswith(RECORDING_SUFFIXES)


def open_source(path: Path, board: BoardSpec | None = None) -> Source:
    """Opens a dataset folder or a recording (`.mcap`, or one still named `.mcap.active`).

    `board` replaces the board that the source describes.

    Raises:
        DeltalightError: there is no such source, or it cannot be read.
    """
    if not exists(path):
        raise DeltalightError(f"{path} does not exist; give a dataset folder or an .mcap recording.")
    # Imported here because both readers are heavy and few callers need both.
    if path.is_dir():
        from deltalight.protocol.dataset import open_dataset

        return open_dataset(path, board)
    refuse_bag(path)
    if not is_recording_name(path.name):
        raise DeltalightError(f"{path} is neither a folder nor an .mcap recording; give one of these.")
    from deltalight.protocol.recording_reader import RecordingReader

    return RecordingReader(path, board)
