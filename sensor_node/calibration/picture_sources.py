"""Pictures for a calibration, from files, a dataset folder, a recording or a live camera, and the views in them."""

import re
import statistics
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, suppress
from itertools import count, pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.dataset_lists import ListEntry, read_list
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.pictures import decode_rgb, read_bytes
from deltalight.protocol.ros_bag_names import refuse_bag
from deltalight.protocol.source import is_recording_name, open_source
from deltalight.sensor_node.calibration.targets import Target
from deltalight.sensor_node.calibration.views import Picture, ViewCollector

Eye = Literal["rgb", "fisheye"]
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
# Pictures in faster succession were filmed, slower ones were taken one by one.
FILM_PERIOD_NS = 500_000_000
# More views do not improve a lens; the time of a fit grows with their cube.
MOST_VIEWS = 60


class Series(NamedTuple):
    """Pictures of one camera, decoded on demand; `total` is None for an endless camera.

    `folder` holds the pictures; `board` is the one that a recording describes.
    """

    pictures: Generator[Picture]
    total: int | None
    moving: bool
    folder: Path | None = None
    board: BoardSpec | None = None


def open_series(source: str, eye: Eye) -> Series:
    """Opens the pictures of one eye.

    Args:
        source: a folder of pictures, a pattern such as `shots/left*.jpg`, a dataset folder, an .mcap recording, or a
            camera such as `uvc:0`.
        eye: which camera's pictures of a dataset or recording.

    Raises:
        DeltalightError: there is no such source, or it has no pictures of that eye.
    """
    from deltalight.sensor_node.cameras.open import is_live

    if is_live(source):
        return Series(_live(source, eye), None, moving=True)
    path = Path(source)
    if any(sign in path.name for sign in "*?["):
        return _files(sorted(path.parent.glob(path.name), key=_natural), source, path.parent)
    if is_recording_name(source):
        frames = open_source(path)
        film = _is_film(frames.timestamps_ns)
        return Series(_of_frames(iter(frames), eye), len(frames), film, board=frames.board)
    refuse_bag(path)
    if path.is_file():
        raise DeltalightError(f"{path} is one file; give the folder of the pictures, or an .mcap recording.")
    if not path.is_dir():
        raise DeltalightError(
            f"there is no folder, recording or camera '{source}'; give a folder of pictures, an .mcap recording "
            "or a camera such as uvc:0."
        )
    listed = path / f"{eye}.txt"
    if listed.is_file():
        return _listed(read_list(listed), path)
    found = [each for each in path.iterdir() if each.suffix.lower() in PICTURE_SUFFIXES]
    return _files(sorted(found, key=_natural), source, path)


def _files(paths: Sequence[Path], source: str, folder: Path) -> Series:
    if not paths:
        raise DeltalightError(
            f"'{source}' holds no pictures; give a folder or pattern of .png or .jpg files, or a dataset folder."
        )
    pictures = (
        Picture(path.name, decode_rgb(read_bytes(path), str(path)), moment)
        for moment, path in enumerate(paths)
    )
    return Series(pictures, len(paths), moving=False, folder=folder)


def _listed(entries: Sequence[ListEntry], folder: Path) -> Series:
    pictures = (
        Picture(entry.path.name, decode_rgb(read_bytes(entry.path), str(entry.path)), entry.timestamp_ns)
        for entry in entries
    )
    film = _is_film(sorted({entry.timestamp_ns for entry in entries}))
    return Series(pictures, len(entries), film, folder)


def _is_film(timestamps_ns: Sequence[int]) -> bool:
    periods = [after - before for before, after in pairwise(timestamps_ns)]
    return bool(periods) and statistics.median(periods) < FILM_PERIOD_NS


def _of_frames(frames: Iterable[SensorFrame], eye: Eye) -> Generator[Picture]:
    shown = None
    for frame in frames:
        if eye == "rgb":
            yield Picture(f"frame {frame.frame_id}", frame.color, frame.timestamp_ns)
        elif frame.fisheye is not None and frame.fisheye is not shown:
            shown = frame.fisheye
            coded = [picture for picture in shown.pictures if picture.dtype == np.uint8]
            for number, picture in enumerate(coded):
                yield Picture(
                    f"fish-eye of frame {frame.frame_id}, exposure {number}", picture, shown.timestamp_ns
                )


def _live(source: str, eye: Eye) -> Generator[Picture]:
    from deltalight.sensor_node.cameras.base import EndOfStream
    from deltalight.sensor_node.cameras.open import open_camera

    def frames() -> Generator[SensorFrame]:
        with open_camera(source, calibrated=False, depth=False) as camera:
            for _ in count():
                try:
                    yield camera.read()
                except EndOfStream:
                    return

    with closing(frames()) as captured:
        for frame in captured:
            # a fish-eye camera opened alone delivers its pictures as colour
            own = "rgb" if frame.fisheye is None else eye
            yield from _of_frames([frame], own)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Returns a sort key by which shot2 comes before shot10."""
    return [(int(word), "") if word.isdecimal() else (-1, word) for word in re.split(r"(\d+)", path.name)]


def collect_views(
    series: Series, target: Target, *, enough: int, tell: Callable[[ViewCollector, bool], None]
) -> ViewCollector:
    """Examines all pictures of a series, or a live camera's until there are `enough` views or Ctrl-C.

    Args:
        series: the pictures.
        target: what to look for.
        enough: views at which a live series ends.
        tell: called after each picture with the collector and whether the picture was taken as a view.
    """
    collector = ViewCollector(target, moving=series.moving)
    live = series.total is None
    # Closing releases a camera before the long fit begins.
    with suppress(*(KeyboardInterrupt,) if live else ()), closing(series.pictures):
        for picture in series.pictures:
            tell(collector, collector.add(picture))
            if live and len(collector.views) >= enough:
                break
    # Evenly over the series, so that none of its parts is lost.
    step = -(-len(collector.views) // MOST_VIEWS)
    collector.views = collector.views[:: max(step, 1)]
    return collector
