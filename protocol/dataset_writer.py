"""Writing a dataset folder (docs/formats.md 1)."""

from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.board import BoardSpec, save_board_yaml
from deltalight.protocol.calibration import Extrinsics, save_extrinsics_yaml
from deltalight.protocol.camera_model import CameraModel, save_camera_yaml
from deltalight.protocol.dataset_fisheye import FisheyeFolderWriter
from deltalight.protocol.dataset_lists import format_timestamp
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.protocol.pictures import encode_png, exact_depth_scale, is_jpeg, steps_from_depth
from deltalight.protocol.poses import wxyz_from_rotation

DEFAULT_DEPTH_SCALE = 0.001
HEADERS = {
    "rgb.txt": "# timestamp filename [exposure_s]",
    "depth.txt": "# timestamp filename",
    "composite.txt": "# timestamp filename (the relit picture of the frame)",
    "groundtruth.txt": "# timestamp tx ty tz qx qy qz qw (world_from_camera)",
}


class DatasetWriter:
    """Writes frames as a dataset folder; use it as a context manager.

    Each picture is written before its line is appended, so the folder is readable after a crash at any time. Colour
    is stored as the frame's JPEG bytes if it has them, else as PNG. Depth is stored in steps of `depth_scale` metres
    (default: the first frame's exact step, else 1 mm) as 16-bit PNG. Fish-eye pictures are stored without loss, once
    for all frames that share them.

    Raises:
        DeltalightError: the folder is not empty, or frames differ in camera or response, or the fish-eye pictures in
            calibration.
    """

    def __init__(
        self,
        path: Path,
        *,
        board: BoardSpec | None = None,
        extrinsics: Extrinsics | None = None,
        depth_scale: float | None = None,
    ) -> None:
        self.path = path
        self._board, self._extrinsics, self._depth_scale = board, extrinsics or Extrinsics(), depth_scale
        self._first: SensorFrame | None = None
        self._depth_camera: CameraModel | None = None
        self._fisheye = FisheyeFolderWriter(path)
        self._count = 0
        self._last_ns = -1

    def __enter__(self) -> Self:
        """Makes the folder."""
        if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            raise DeltalightError(f"{self.path} already exists; choose another folder.")
        (self.path / "rgb").mkdir(parents=True, exist_ok=True)
        (self.path / "calibration").mkdir(exist_ok=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Does nothing: every frame is complete when `add` returns."""

    def add(self, frame: SensorFrame) -> None:
        """Appends a frame; its line number becomes its frame_id."""
        if frame.timestamp_ns <= self._last_ns:
            raise DeltalightError(
                f"frame {frame.frame_id} is not later than the one before; write frames in order."
            )
        if self._first is None:
            self._begin(frame)
        self._require_same(frame)
        if frame.fisheye is not None:
            self._fisheye.add(frame.fisheye)
        self._add_color(frame)
        if frame.composite is not None:
            self._add_composite(frame.composite, frame.timestamp_ns)
        self._last_ns = frame.timestamp_ns
        self._count += 1

    def _begin(self, frame: SensorFrame) -> None:
        folder = self.path / "calibration"
        save_camera_yaml(folder / "rgb.yaml", frame.camera, "rgb")
        if self._board is not None:
            save_board_yaml(folder / "board.yaml", self._board)
        if self._extrinsics.to_dict():
            save_extrinsics_yaml(folder / "extrinsics.yaml", self._extrinsics)
        if frame.response is not None:
            np.savetxt(self.path / "response.txt", frame.response, fmt="%.9g")
        self._first = frame

    def _require_same(self, frame: SensorFrame) -> None:
        assert self._first is not None  # set by _begin
        same_response = (frame.response is None) == (self._first.response is None) and (
            frame.response is None or np.array_equal(frame.response, np.asarray(self._first.response))
        )
        if frame.camera != self._first.camera or not same_response:
            raise DeltalightError(
                f"frame {frame.frame_id} has a different camera or response from the first; write two folders."
            )

    def _add_color(self, frame: SensorFrame) -> None:
        suffix, data = ("jpg", frame.color_jpeg) if frame.color_jpeg else ("png", encode_png(frame.color))
        name = f"rgb/{self._count:06d}.{suffix}"
        (self.path / name).write_bytes(data)
        if frame.depth is not None:
            time = frame.timestamp_ns if frame.depth_timestamp_ns is None else frame.depth_timestamp_ns
            self._add_depth(frame.depth, time)
        if frame.world_from_camera is not None:
            self._append("groundtruth.txt", frame.timestamp_ns, _pose_words(frame.world_from_camera))
        exposure = "" if frame.exposure_s is None else f" {frame.exposure_s!r}"
        self._append("rgb.txt", frame.timestamp_ns, name + exposure)

    def _add_composite(self, picture: bytes, timestamp_ns: int) -> None:
        (self.path / "composite").mkdir(exist_ok=True)
        name = f"composite/{self._count:06d}.{'jpg' if is_jpeg(picture) else 'png'}"
        (self.path / name).write_bytes(picture)
        self._append("composite.txt", timestamp_ns, name)

    def _add_depth(self, depth: DepthImage, timestamp_ns: int) -> None:
        if self._depth_camera is None:
            self._begin_depth(depth)
        if depth.camera != self._depth_camera:
            raise DeltalightError("the depth camera changed within the sequence; write a folder for each.")
        assert self._depth_scale is not None  # set by _begin_depth
        name = f"depth/{self._count:06d}.png"
        (self.path / name).write_bytes(encode_png(steps_from_depth(depth, self._depth_scale)))
        self._append("depth.txt", timestamp_ns, name)

    def _begin_depth(self, depth: DepthImage) -> None:
        (self.path / "depth").mkdir(exist_ok=True)
        self._depth_camera = depth.camera
        self._depth_scale = self._depth_scale or exact_depth_scale(depth, None) or DEFAULT_DEPTH_SCALE
        extra = {"depth_scale": self._depth_scale}
        if depth.noise_sigma_m is not None:
            extra["noise_sigma_m"] = depth.noise_sigma_m
        save_camera_yaml(self.path / "calibration" / "depth.yaml", depth.camera, "depth", extra)

    def _append(self, name: str, timestamp_ns: int, words: str) -> None:
        path = self.path / name
        is_new = not path.exists()
        with path.open("a", encoding="utf-8") as file:
            if is_new:
                file.write(HEADERS[name] + "\n")
            file.write(f"{format_timestamp(timestamp_ns)} {words}\n")


def _pose_words(world_from_camera: Float64[np.ndarray, "4 4"]) -> str:
    w, x, y, z = wxyz_from_rotation(world_from_camera[:3, :3])
    return " ".join(repr(float(value)) for value in (*world_from_camera[:3, 3], x, y, z, w))
