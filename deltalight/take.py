"""Frames to relight: of a recording, a dataset folder or a live camera."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self, SupportsIndex, overload

from deltalight.protocol.counts import counted
from deltalight.protocol.documents import validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import require_path
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.source import Source, open_source
from deltalight.scene import Scene
from deltalight.sensor_node.cameras.base import Camera, EndOfStream
from deltalight.sensor_node.cameras.drivers import SYNTHETIC
from deltalight.sensor_node.cameras.open import is_live, open_camera
from deltalight.sensor_node.cameras.settings import CameraSettings
from deltalight.sensor_node.view_frames import ViewFrameBuilder

FRESH_S = 0.2  # age from which on a live camera's frame is skipped for a newer one


class Take(Sequence[ViewFrame]):
    """The frames of a recording or dataset folder, read on demand.

    A sequence: `take[3]` is a frame, `take[::10]` a take of every tenth. Each frame has colour (h, w, 3; uint8, as
    the camera encoded it), camera, pose (None if the marker board is out of view), clean depth and the light that a
    fish-eye camera saw, if there was one; see `deltalight.protocol.frames.ViewFrame`.

    Args:
        source: an opened recording or dataset folder.
        needs_depth: raise if there is no depth.
        needs_light: read fish-eye pictures and look for lamps with markers; without, frames are read faster.

    Raises:
        DeltalightError: the source cannot be read, or has no depth though it is needed.
    """

    def __init__(self, source: Source, *, needs_depth: bool = False, needs_light: bool = True) -> None:
        self._source = source
        self._frames = range(len(source))
        self._built = ViewFrameBuilder(source, needs_depth=needs_depth, needs_light=needs_light)

    @property
    def scene(self) -> Scene | None:
        """The scene in the recording, if any; a new copy each time."""
        return None if self._source.scene is None else Scene(self._source.scene)

    @property
    def notes(self) -> list[str]:
        """Sentences about what is missing and what is used instead, each said once."""
        return [*self._source.notes, *self._built.notes]

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: SupportsIndex) -> ViewFrame: ...

    @overload
    def __getitem__(self, index: slice) -> "Take": ...

    def __getitem__(self, index: SupportsIndex | slice) -> "ViewFrame | Take":
        if not isinstance(index, slice):
            return self._built(self._source[self._number(index)])
        part = object.__new__(Take)
        part._source, part._built, part._frames = self._source, self._built, self._frames[index]
        return part

    def _number(self, index: SupportsIndex) -> int:
        try:
            return self._frames[index]
        except IndexError:
            raise IndexError(
                f"The take has {counted(len(self), 'frame')}, counted from 0, and none at {index}."
            ) from None

    def __repr__(self) -> str:
        return f"<Take of {counted(len(self), 'frame')}>"


class LiveTake:
    """The frames of a camera, as they arrive: `with dl.open("uvc:0") as live: for frame in live: ...`.

    Args:
        camera: any camera; `with` opens it.
        newest: skip frames that arrived while the previous one was rendered.
    """

    def __init__(self, camera: Camera, *, newest: bool = False) -> None:
        self._camera, self._newest = camera, newest

    @property
    def notes(self) -> list[str]:
        """Sentences about what is missing and what is used instead; complete once the camera is open."""
        return list(self._camera.notes)

    def __enter__(self) -> Self:
        self._camera.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._camera.close()

    def __iter__(self) -> Iterator[ViewFrame]:
        """Yields frames until the camera ends."""
        build = ViewFrameBuilder(self._camera)
        while True:
            try:
                frame = self._camera.read_latest(FRESH_S) if self._newest else self._camera.read()
            except EndOfStream:
                return
            yield build(frame)


def open_take(source: str | Path | Camera, *, calibration: str | Path | None = None) -> Take | LiveTake:
    """Opens a take; this is `deltalight.open`.

    Args:
        source: a recording (.mcap), a dataset folder, `synthetic`, or a live camera: `uvc:0`, `oak`, `openni2:0`,
            `orbbec:0`, a plugin's name, or a `Camera` object.
        calibration: of a live camera: the folder that `deltalight calibrate ... --out FOLDER` wrote; None: what the
            camera itself knows.

    Raises:
        DeltalightError: there is no such source, it cannot be read, or its calibration is missing.
    """
    if not isinstance(source, Camera):
        require_path(source, "A recording, a dataset folder or a camera")
    live = isinstance(source, str) and is_live(source)
    if calibration is not None and not live:
        raise DeltalightError(
            f"{source} has its own calibration; `calibration` is for live cameras, leave it out."
        )
    if isinstance(source, Camera):
        return LiveTake(source)
    if isinstance(source, str) and (live or source == SYNTHETIC):
        settings = validate(CameraSettings, {"calibration": calibration}, "the camera's settings")
        return LiveTake(open_camera(source, settings), newest=live)
    if source == "":
        raise DeltalightError("the path is empty; name a dataset folder, an .mcap recording or a camera.")
    return Take(open_source(Path(source)))
