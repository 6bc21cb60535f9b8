"""A small exact scene for tests and demonstrations: a textured table, a marker board on it, and a box.

Everything is computed by intersecting the rays of the camera's full lens model, several a pixel, with the
table plane z = 0 and the box, in the world frame of FORMATS 3. Light is one distant lamp and a constant
ambient; nothing casts shadows.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8

from protocol.board import BoardSpec
from protocol.camera_model import CameraModel

SAMPLES_PER_EDGE = 3
BLACK_ALBEDO, PAPER_ALBEDO = 0.04, 0.8
TABLE_ALBEDO = np.array([0.45, 0.33, 0.22], np.float32)
BOX_ALBEDO = np.array([0.2, 0.35, 0.6], np.float32)
TO_LAMP = np.array([0.3, -0.2, 0.93], np.float32) / np.float32(np.linalg.norm([0.3, -0.2, 0.93]))
LAMP_IRRADIANCE, AMBIENT_IRRADIANCE = 1.8, 0.9
# White paper around the printed area, as a share of a marker's edge.
SHEET_MARGIN = 0.35
WOOD_PERIOD_M = 0.037
FACES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FLOOR, SHEET, BOX = 0, 1, 2


class Surface(NamedTuple):
    """What the rays of a picture hit."""

    depth_m: Float32[np.ndarray, "h w"]
    radiance: Float32[np.ndarray, "h w 3"]
    hit: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class SyntheticScene:
    """The table with the board and, to the right of it, a box of `box_m` (width, depth, height)."""

    board: BoardSpec
    box_m: tuple[float, float, float] = (0.1, 0.1, 0.12)

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        """Middle of the board in the world."""
        return np.asarray(self.board.sheet_outline().mean(axis=0))

    @property
    def extent_m(self) -> float:
        """Diagonal of the printed area."""
        outline = self.board.sheet_outline()
        return float(np.linalg.norm(outline[2] - outline[0]))

    @property
    def box_bounds(self) -> Float64[np.ndarray, "2 3"]:
        """Lower and upper corner of the box in the world."""
        right, middle = self.board.sheet_outline()[1, 0], self.center[1]
        margin = SHEET_MARGIN * self.board.marker_length_m
        low = np.array([right + margin + 0.02, middle - self.box_m[1] / 2, 0.0])
        return np.array([low, low + self.box_m])

    def trace(self, camera: CameraModel, world_from_camera: Float64[np.ndarray, "4 4"]) -> Surface:
        """Return depth along the optical axis and linear radiance where each ray of the camera ends."""
        rays = np.dstack([camera.rays(), np.ones((camera.height, camera.width), np.float32)])
        directions = rays @ world_from_camera[:3, :3].T.astype(np.float32)
        eye = world_from_camera[:3, 3].astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            table = -eye[2] / directions[..., 2]
            box, axis = self._box_hit(eye, directions)
        table[~(table > 0)] = np.inf
        nearest = np.minimum(table, box)
        hit = np.isfinite(nearest)
        depth = np.where(hit, nearest, 0).astype(np.float32)
        places = eye + directions * depth[..., None]
        albedo = self._table_albedo(places[..., 0], places[..., 1])
        on_box = box < table
        albedo[on_box] = BOX_ALBEDO
        normals = np.broadcast_to(FACES[2], directions.shape).copy()
        normals[on_box] = FACES[axis[on_box]]
        normals *= -np.sign((normals * directions).sum(axis=-1, keepdims=True))
        irradiance = AMBIENT_IRRADIANCE + LAMP_IRRADIANCE * np.clip(normals @ TO_LAMP, 0, None)
        radiance = albedo / np.pi * irradiance[..., None]
        radiance[~hit] = AMBIENT_IRRADIANCE / np.pi
        return Surface(depth, radiance.astype(np.float32), hit)

    def picture(
        self, camera: CameraModel, world_from_camera: Float64[np.ndarray, "4 4"]
    ) -> Float32[np.ndarray, "h w 3"]:
        """Return linear radiance, averaged over each pixel."""
        fine = camera.resized(camera.width * SAMPLES_PER_EDGE, camera.height * SAMPLES_PER_EDGE)
        radiance = self.trace(fine, world_from_camera).radiance
        mean = cv2.resize(radiance, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        return np.asarray(mean)

    def _box_hit(
        self, eye: Float32[np.ndarray, "3"], directions: Float32[np.ndarray, "h w 3"]
    ) -> tuple[Float32[np.ndarray, "h w"], Int8[np.ndarray, "h w"]]:
        """Distance at which each ray enters the box (infinity: never), and the axis of the face."""
        bounds = self.box_bounds.astype(np.float32)
        slabs = np.stack([(bound - eye) / directions for bound in bounds])
        entries = slabs.min(axis=0)
        entry, leave = entries.max(axis=-1), slabs.max(axis=0).min(axis=-1)
        distance = np.where((entry < leave) & (entry > 0), entry, np.inf)
        return distance.astype(np.float32), entries.argmax(axis=-1).astype(np.int8)

    def _table_albedo(
        self, x: Float32[np.ndarray, "h w"], y: Float32[np.ndarray, "h w"]
    ) -> Float32[np.ndarray, "h w 3"]:
        phase = 2 * np.pi / WOOD_PERIOD_M
        grain = 1 + 0.15 * np.sin(phase * x + 2 * np.sin(0.37 * phase * y)) * np.cos(0.6 * phase * y)
        albedo = TABLE_ALBEDO * grain[..., None]
        outline = self.board.sheet_outline()
        margin = SHEET_MARGIN * self.board.marker_length_m
        low, high = outline[3, :2] - margin, outline[1, :2] + margin
        albedo[(x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])] = PAPER_ALBEDO
        self._print_markers(albedo, x, y)
        return np.asarray(albedo, np.float32)

    def _print_markers(
        self,
        albedo: Float32[np.ndarray, "h w 3"],
        x: Float32[np.ndarray, "h w"],
        y: Float32[np.ndarray, "h w"],
    ) -> None:
        board, length = self.board, self.board.marker_length_m
        cells = board.opencv_dictionary().markerSize + 2 * board.border_bits
        for name, corners in board.corner_points().items():
            column = (x - corners[0, 0]) * (cells / length)
            row = (corners[0, 1] - y) * (cells / length)
            inside = (column >= 0) & (column < cells) & (row >= 0) & (row < cells)
            code = marker_cells(board, name)
            white = code[row[inside].astype(int), column[inside].astype(int)]
            albedo[inside] = np.where(white, PAPER_ALBEDO, BLACK_ALBEDO)[:, None]


def marker_cells(board: BoardSpec, name: int) -> Bool[np.ndarray, "n n"]:
    """Return the cells of a marker with its black border, True = white."""
    dictionary = board.opencv_dictionary()
    cells = dictionary.markerSize + 2 * board.border_bits
    return np.asarray(dictionary.generateImageMarker(name, cells, borderBits=board.border_bits) > 127)
