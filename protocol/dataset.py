"""Reading a dataset folder (docs/formats.md 1): the TUM RGB-D convention, extended."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from deltalight.protocol.board import BoardSpec, load_board_yaml
from deltalight.protocol.calibration import Extrinsics, load_extrinsics_yaml
from deltalight.protocol.camera_model import CameraModel, camera_from_info, load_camera_yaml
from deltalight.protocol.dataset_fisheye import FisheyeFolder, load_fisheye_calibration
from deltalight.protocol.dataset_lists import (
    FisheyeEntry,
    ListEntry,
    PoseEntry,
    default_tolerance_ns,
    nearest_index,
    pose_at,
    read_fisheye_list,
    read_list,
    read_poses,
    require_increasing,
)
from deltalight.protocol.documents import read_mapping
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.protocol.pictures import (
    TUM_DEPTH_SCALE,
    decode_depth_png,
    decode_rgb,
    depth_from_steps,
    is_jpeg,
    read_bytes,
)
from deltalight.protocol.response_table import load_response_table
from deltalight.protocol.ros_bag_names import BAG_DATABASE, BAG_METADATA
from deltalight.protocol.scene import SceneDocument


@dataclass(frozen=True)
class DepthCalibration:
    """The depth sensor: its camera, metres per step, noise at 1 m (None = unknown)."""

    camera: CameraModel
    scale: float
    noise_sigma_m: float | None


def open_dataset(path: Path, board: BoardSpec | None = None) -> "DatasetReader":
    """Opens a dataset folder; `board` replaces calibration/board.yaml.

    Raises:
        DeltalightError: something in the folder is missing or wrong.
    """
    return DatasetReader(path, board)


class DatasetReader:
    """The frames of a dataset folder, decoded on demand; a `Source`.

    Colour and depth are paired by nearest time, at most `tolerance_ns` apart (half the median colour period, at most
    20 ms); `unpaired` counts the colour pictures left without depth. `notes` says once what is missing and what is
    used instead. A third column of rgb.txt is the exposure in seconds. `fisheye` lists the fish-eye pictures; frames
    carry the current ones, decoded on first use, if their lens is known.
    """

    def __init__(self, path: Path, board: BoardSpec | None = None) -> None:
        if not path.is_dir():
            raise DeltalightError(f"{path} is not a folder; give a dataset folder with rgb.txt.")
        self.path = path
        self.notes: list[str] = []
        self.scene: SceneDocument | None = None
        self._colors = self._read_colors()
        self.timestamps_ns = [entry.timestamp_ns for entry in self._colors]
        self.tolerance_ns = default_tolerance_ns(self.timestamps_ns)
        self.camera = self._read_camera()
        self.response = self._read_response()
        self.board = board or self._read_board()
        self.extrinsics = self._read_extrinsics()
        self._depth = self._read_depth_calibration()
        self._depths = self._read_depths()
        self._pairs, self.unpaired = self._pair()
        self._poses = self._read_poses()
        self._pose_times = [pose.timestamp_ns for pose in self._poses]
        self.fisheye = self._read_fisheye()
        self._fisheye_folder = self._open_fisheye()
        self._composites = self._read_composites()
        self._check_first_pictures()

    def __len__(self) -> int:
        return len(self._colors)

    def __iter__(self) -> Iterator[SensorFrame]:
        """Yields every frame in order."""
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> SensorFrame:
        """Decodes one frame; `index` is the zero-based line of rgb.txt.

        Raises:
            IndexError: there is no such frame.
            DeltalightError: a picture is unreadable, or its size is not that of its calibration.
        """
        index = range(len(self))[index]
        entry = self._colors[index]
        data = read_bytes(entry.path)
        pair = self._pairs[index]
        depth = None if pair is None else self._depths[pair]
        return SensorFrame(
            frame_id=index,
            timestamp_ns=entry.timestamp_ns,
            color=self._decode_color(entry, data),
            camera=self.camera,
            response=self.response,
            exposure_s=entry.exposure_s,
            depth=None if depth is None else self._decode_depth(depth),
            depth_timestamp_ns=None if depth is None else depth.timestamp_ns,
            world_from_camera=pose_at(self._poses, self._pose_times, entry.timestamp_ns, self.tolerance_ns),
            color_jpeg=data if is_jpeg(data) else None,
            fisheye=None if self._fisheye_folder is None else self._fisheye_folder.at(entry.timestamp_ns),
            composite=self._composite_at(entry.timestamp_ns),
        )

    @property
    def depth_scale(self) -> float | None:
        """Metres per step of the stored depth; None without depth."""
        return self._depth.scale if self._depths else None

    def _decode_color(self, entry: ListEntry, data: bytes) -> UInt8[np.ndarray, "h w 3"]:
        color = decode_rgb(data, str(entry.path))
        _require_size(color, self.camera, entry.path, "calibration/rgb.yaml")
        return color

    def _decode_depth(self, entry: ListEntry) -> DepthImage:
        steps = decode_depth_png(read_bytes(entry.path), str(entry.path))
        _require_size(
            steps, self._depth.camera, entry.path, "calibration/depth.yaml (or, without it, rgb.yaml)"
        )
        return depth_from_steps(steps, self._depth.scale, self._depth.camera, self._depth.noise_sigma_m)

    def _composite_at(self, timestamp_ns: int) -> bytes | None:
        path = self._composites.get(timestamp_ns)
        return None if path is None else read_bytes(path)

    def _check_first_pictures(self) -> None:
        """Detects a folder with wrong sizes before anybody has begun to write results."""
        first = self._colors[0]
        self._decode_color(first, read_bytes(first.path))
        if self._depths:
            self._decode_depth(self._depths[0])
        if self._fisheye_folder is not None:
            self._fisheye_folder.at(first.timestamp_ns)

    def _read_colors(self) -> list[ListEntry]:
        path = self.path / "rgb.txt"
        if not path.is_file():
            raise DeltalightError(_instead_of_list(self.path))
        entries = read_list(path)
        require_increasing(entries, path)
        return entries

    def _read_camera(self) -> CameraModel:
        path = self.path / "calibration" / "rgb.yaml"
        if not path.is_file():
            raise DeltalightError(
                f"{self.path} has no calibration/rgb.yaml and no picture says which camera took it; "
                "write that file as ROS camera_info (image_width, image_height, camera_matrix, "
                "distortion_coefficients)."
            )
        return load_camera_yaml(path)

    def _read_response(self) -> Float32[np.ndarray, "256 3"] | None:
        path = self.path / "response.txt"
        return load_response_table(path) if path.is_file() else None

    def _read_board(self) -> BoardSpec | None:
        path = self.path / "calibration" / "board.yaml"
        if not path.is_file():
            self.notes.append(f"{self.path} has no calibration/board.yaml; no marker board is looked for.")
            return None
        board = load_board_yaml(path)
        if board.white_albedo is None:
            self.notes.append(f"{path} gives no white_albedo; {board.paper_albedo} is assumed for the paper.")
        return board

    def _read_extrinsics(self) -> Extrinsics:
        path = self.path / "calibration" / "extrinsics.yaml"
        return load_extrinsics_yaml(path) if path.is_file() else Extrinsics()

    def _read_depth_calibration(self) -> DepthCalibration:
        path = self.path / "calibration" / "depth.yaml"
        if not path.is_file():
            return DepthCalibration(self.camera, TUM_DEPTH_SCALE, None)
        info = read_mapping(path)
        # A file that gives only the scale means that depth is registered to colour.
        camera = camera_from_info(info, path) if "camera_matrix" in info else self.camera
        scale = _positive(info.get("depth_scale", TUM_DEPTH_SCALE), f"{path}: `depth_scale`")
        noise = info.get("noise_sigma_m")
        return DepthCalibration(
            camera, scale, None if noise is None else _positive(noise, f"{path}: `noise_sigma_m`")
        )

    def _read_depths(self) -> list[ListEntry]:
        path = self.path / "depth.txt"
        if not path.is_file():
            self.notes.append(
                f"{self.path} has no depth.txt; the scene document must give a model of the room."
            )
            return []
        if not (self.path / "calibration" / "depth.yaml").is_file():
            self.notes.append(
                f"{self.path} has no calibration/depth.yaml; "
                "depth is taken as registered to colour, 1/5000 m a step."
            )
        if self._depth.camera != self.camera and self.extrinsics.depth_from_rgb is None:
            self.notes.append(
                f"{self.path} has no depth_from_rgb in calibration/extrinsics.yaml; the identity is used."
            )
        return read_list(path)

    def _pair(self) -> tuple[list[int | None], int]:
        times = [entry.timestamp_ns for entry in self._depths]
        pairs = [nearest_index(times, wanted, self.tolerance_ns) for wanted in self.timestamps_ns]
        unpaired = sum(pair is None for pair in pairs) if times else 0
        limit = f"{self.tolerance_ns / 1e6:.1f} ms"
        if times and unpaired == len(pairs):
            raise DeltalightError(
                f"{self.path}: no depth picture is within {limit} of a colour picture; "
                "give both lists the same clock."
            )
        if unpaired:
            self.notes.append(
                f"{self.path}: {unpaired} of {len(pairs)} colour pictures have no depth within {limit}; "
                "they are used without."
            )
        return pairs, unpaired

    def _read_poses(self) -> list[PoseEntry]:
        path = self.path / "groundtruth.txt"
        if path.is_file():
            return read_poses(path)
        instead = "frames have no pose" if self.board is None else "poses come from the marker board"
        self.notes.append(f"{self.path} has no groundtruth.txt; {instead}.")
        return []

    def _read_fisheye(self) -> list[FisheyeEntry]:
        path = self.path / "fisheye.txt"
        if path.is_file():
            return read_fisheye_list(path)
        self.notes.append(f"{self.path} has no fisheye.txt; light comes from the scene document.")
        return []

    def _read_composites(self) -> dict[int, Path]:
        path = self.path / "composite.txt"
        return {entry.timestamp_ns: entry.path for entry in read_list(path)} if path.is_file() else {}

    def _open_fisheye(self) -> FisheyeFolder | None:
        calibration = load_fisheye_calibration(self.path) if self.fisheye else None
        if self.fisheye and calibration is None:
            self.notes.append(
                f"{self.path} has fish-eye pictures but no calibration/fisheye.yaml; they are not used."
            )
        return None if calibration is None else FisheyeFolder(self.fisheye, calibration)


def _positive(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 1e3:
        raise DeltalightError(f"{name} is {value!r:.60}; write a positive number of metres.")
    return float(value)


def _require_size(picture: np.ndarray, camera: CameraModel, path: Path, calibration: str) -> None:
    height, width = picture.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise DeltalightError(
            f"{path} has {width}x{height} pixels but {calibration} says {camera.width}x{camera.height}; "
            "correct the calibration or the picture."
        )


def _instead_of_list(folder: Path) -> str:
    """Returns a sentence about a folder without rgb.txt, by what else it holds."""
    if (folder / BAG_METADATA).is_file():
        return f"{folder} is a ROS 2 bag; make a recording of it with `deltalight recordings import`."
    bags = sorted(path.name for path in folder.glob(f"*{BAG_DATABASE}"))
    if bags:
        return (
            f"{folder} is a ROS 2 bag ({bags[0]}) without its {BAG_METADATA}; let `ros2 bag reindex` write that file,"
            " then make a recording of the bag with `deltalight recordings import`."
        )
    recordings = sorted(path.name for path in folder.glob("*.mcap"))
    if recordings:
        return (
            f"{folder} has no rgb.txt, but {recordings[0]}; name that recording, or, if the folder is a ROS 2 bag,"
            f" let `ros2 bag reindex` write its {BAG_METADATA} and make a recording of it with"
            " `deltalight recordings import`."
        )
    return f"{folder} has no rgb.txt; write it, with a line `timestamp filename` for every picture."
