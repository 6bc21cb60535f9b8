"""The fish-eye pictures of a dataset folder (docs/formats.md 1)."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from deltalight.protocol.dataset_lists import FisheyeEntry, format_timestamp
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeCalibration, load_fisheye_yaml, save_fisheye_yaml
from deltalight.protocol.frames import FisheyePictures
from deltalight.protocol.pictures import decode_rgb, encode_png, read_bytes
from deltalight.protocol.radiance_files import LINEAR_SUFFIXES, read_linear, write_exr
from deltalight.protocol.response_table import load_response_table

CALIBRATION_FILE = "calibration/fisheye.yaml"
RESPONSE_FILE = "fisheye_response.txt"
LIST_FILE = "fisheye.txt"
LIST_HEADER = "# timestamp filename [exposure_s]"


def load_fisheye_calibration(folder: Path) -> FisheyeCalibration | None:
    """Reads calibration/fisheye.yaml of a dataset folder, None without it.

    Fisheye_response.txt overrides its response.

    Raises:
        DeltalightError: one of the files is wrong.
    """
    path = folder / CALIBRATION_FILE
    if not path.is_file():
        return None
    calibration = load_fisheye_yaml(path)
    response = folder / RESPONSE_FILE
    return replace(calibration, response=load_response_table(response)) if response.is_file() else calibration


class FisheyeFolder:
    """The current fish-eye pictures at any time; keeps the last ones decoded."""

    def __init__(self, entries: Sequence[FisheyeEntry], calibration: FisheyeCalibration) -> None:
        self.calibration = calibration
        self._entries = entries
        self._times = [entry.timestamp_ns for entry in entries]
        self._kept: tuple[int, FisheyePictures] | None = None

    def at(self, timestamp_ns: int) -> FisheyePictures:
        """Returns the newest pictures not later than a time, else the first ones.

        The same object while they are current.

        Raises:
            DeltalightError: a picture is unreadable, has not the calibration's size, or is linear in a bracket of
                coded ones.
        """
        index = max(bisect_right(self._times, timestamp_ns) - 1, 0)
        if self._kept is None or self._kept[0] != index:
            self._kept = index, self._decode(self._entries[index])
        return self._kept[1]

    def _decode(self, entry: FisheyeEntry) -> FisheyePictures:
        pictures = tuple(self._read(path) for path in entry.paths)
        if len({picture.dtype for picture in pictures}) > 1:
            raise DeltalightError(
                f"the fish-eye bracket of {entry.paths[0]} mixes linear and coded pictures; use one kind."
            )
        return FisheyePictures(entry.timestamp_ns, pictures, entry.exposures_s, self.calibration)

    def _read(self, path: Path) -> UInt8[np.ndarray, "h w 3"] | Float32[np.ndarray, "h w 3"]:
        is_linear = path.suffix.lower() in LINEAR_SUFFIXES
        picture = read_linear(path) if is_linear else decode_rgb(read_bytes(path), str(path))
        height, width = picture.shape[:2]
        lens = self.calibration.lens
        if (width, height) != (lens.width, lens.height):
            raise DeltalightError(
                f"{path} has {width}x{height} pixels but {CALIBRATION_FILE} says {lens.width}x{lens.height}; "
                "correct the calibration or the picture."
            )
        return picture


class FisheyeFolderWriter:
    """Writes fish-eye pictures into a dataset folder, coded ones as PNG and linear ones as OpenEXR.

    The folder is complete after every `add`: its calibration is written first, the lines of the list last.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._last: FisheyePictures | None = None
        self._count = 0

    def add(self, pictures: FisheyePictures) -> None:
        """Appends pictures; the last ones written are recognised by their time and not written again.

        Raises:
            DeltalightError: they are earlier than the last ones or of another calibration, or a bracket lacks
                exposures.
        """
        if self._last is not None and pictures.timestamp_ns == self._last.timestamp_ns:
            return
        self._check(pictures)
        if self._last is None:
            (self._folder / "fisheye").mkdir()
            save_fisheye_yaml(self._folder / CALIBRATION_FILE, pictures.calibration)
        lines = [
            self._write(f"fisheye/{self._count:06d}-{number}", picture, exposure_s, pictures.timestamp_ns)
            for number, (picture, exposure_s) in enumerate(
                zip(pictures.pictures, pictures.exposures_s, strict=True)
            )
        ]
        with (self._folder / LIST_FILE).open("a", encoding="utf-8") as file:
            file.write("".join(lines) if self._count else LIST_HEADER + "\n" + "".join(lines))
        self._last = pictures
        self._count += 1

    def _check(self, pictures: FisheyePictures) -> None:
        if len(pictures.pictures) > 1 and None in pictures.exposures_s:
            raise DeltalightError("a fish-eye bracket lacks exposures; give the exposure of each picture.")
        if self._last is None:
            return
        if pictures.timestamp_ns < self._last.timestamp_ns:
            raise DeltalightError("a fish-eye picture is earlier than the one before; write them in order.")
        if pictures.calibration != self._last.calibration:
            raise DeltalightError("the fish-eye calibration changed within the sequence; write two folders.")

    def _write(self, stem: str, picture: np.ndarray, exposure_s: float | None, timestamp_ns: int) -> str:
        name = f"{stem}.{'exr' if picture.dtype == np.float32 else 'png'}"
        if picture.dtype == np.float32:
            write_exr(self._folder / name, picture)
        else:
            (self._folder / name).write_bytes(encode_png(picture))
        exposure = "" if exposure_s is None else f" {exposure_s!r}"
        return f"{format_timestamp(timestamp_ns)} {name}{exposure}\n"
