"""The frames of a source whose pose is known, and the points that their depth shows."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.pictures import encode_png
from deltalight.protocol.source import Source
from deltalight.sensor_node.view_frames import ViewFrameBuilder
from deltalight.services.recording_copies import Track

POINT_EDGE_M = 0.01  # of the cubes that keep one point each
MOST_POINTS_A_FRAME = 20_000
PIXEL_CORNER = 0.5  # COLMAP, Nerfstudio and glTF count pixels from their corner, Deltalight from their centre


@dataclass(frozen=True)
class PosedView:
    """A frame with a pose; `picture` are its JPEG's bytes if it has any, else those of a PNG."""

    frame: ViewFrame
    picture: bytes
    suffix: str

    @property
    def world_from_camera(self) -> Float64[np.ndarray, "4 4"]:
        """Its pose."""
        assert self.frame.pose is not None  # see posed_views
        return self.frame.pose.world_from_camera

    def write(self, folder: Path) -> str:
        """Writes the picture into a folder and returns its name."""
        name = f"{self.frame.frame_id:06d}.{self.suffix}"
        (folder / name).write_bytes(self.picture)
        return name


@dataclass
class PointCloud:
    """Points of surfaces (world, metres) with their colours (codes), one for each cube of `POINT_EDGE_M`."""

    _cells: dict[tuple[int, int, int], tuple[float, ...]] = field(default_factory=dict)

    def add(self, view: PosedView) -> None:
        """Adds what the depth of a frame shows."""
        depth, color = view.frame.depth, view.frame.color
        if depth is None or not depth.valid.any():
            return
        rows, columns = np.nonzero(depth.valid)
        step = max(1, len(rows) // MOST_POINTS_A_FRAME)
        rows, columns = rows[::step], columns[::step]
        z = depth.depth_m[rows, columns].astype(float)[:, None]
        seen = np.hstack([depth.camera.rays()[rows, columns] * z, z])
        pose = view.world_from_camera
        points = seen @ pose[:3, :3].T + pose[:3, 3]
        cells = np.floor(points / POINT_EDGE_M).astype(int)
        for cell, point, code in zip(
            cells.tolist(), points.tolist(), color[rows, columns].tolist(), strict=True
        ):
            self._cells.setdefault(tuple(cell), (*point, *code))

    def arrays(self) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
        """Returns positions and colours."""
        rows = np.array(list(self._cells.values())).reshape(-1, 6)
        return rows[:, :3], rows[:, 3:].astype(np.uint8)


def posed_views(source: Source, track: Track) -> Iterator[PosedView]:
    """Yields the frames whose pose is given, or found by the marker board, with clean depth.

    Raises:
        DeltalightError: no frame has a pose, or one is damaged.
    """
    build, count = ViewFrameBuilder(source, needs_light=False), 0
    for index in track(range(len(source))):
        raw = source[index]
        frame = build(raw)
        if frame.pose is None:
            continue
        count += 1
        picture = raw.color_jpeg
        yield PosedView(frame, picture or encode_png(raw.color), "jpg" if picture else "png")
    if count == 0:
        raise DeltalightError(
            "No frame has a pose, and no marker board is seen in any; record with the board in view, or give poses."
        )


def lens_terms(camera: CameraModel, most: int, program: str) -> list[float]:
    """Returns the first `most` coefficients of the lens in OpenCV's order, zeros where it has fewer.

    Raises:
        DeltalightError: it has others, which `program` cannot express.
    """
    given = [float(value) for value in camera.to_dict()["distortion"]]
    if any(given[most:]):
        raise DeltalightError(
            f"{program} has no lens model with the camera's {len(given)} coefficients; calibrate it with fewer."
        )
    return [*given, *([0.0] * most)][:most]
