"""A small exact scene for tests and demonstrations: a textured table, a marker board on it, and a box.

Rays of the camera's full lens model, several per pixel for colour, end on the table plane z = 0 or on the box, in the
world frame of docs/formats.md 3. Light is one distant lamp and constant ambient light; nothing casts shadows.
"""

from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel

SAMPLES_PER_EDGE = 2
BLACK_ALBEDO, PAPER_ALBEDO = 0.04, 0.8
TABLE_ALBEDO = np.array([0.45, 0.33, 0.22], np.float32)
BOX_ALBEDO = np.array([0.2, 0.35, 0.6], np.float32)
TO_LAMP = np.array([0.3, -0.2, 0.93]) / np.linalg.norm([0.3, -0.2, 0.93])
LAMP_IRRADIANCE, AMBIENT_IRRADIANCE = 1.8, 0.9
# White paper around the printed area, as a fraction of a marker's edge.
SHEET_MARGIN = 0.35
# Texels of the printed sheet per cell of a marker, and samples per texel edge when it is drawn.
TEXELS_PER_CELL, SAMPLES_PER_TEXEL = 16, 4
WOOD_PERIOD_M, WOOD_EDGE_M, WOOD_TEXEL_M = 0.037, 4.0, 0.003

Field = Float32[np.ndarray, "h w"]


class Hits(NamedTuple):
    """Where rays end: depth along the optical axis (0: nowhere), table coordinates, light on the box.

    `box_irradiance` is 0 for rays that do not end on the box.
    """

    depth_m: Field
    x: Field
    y: Field
    box_irradiance: Field


def irradiance(normal: Float64[np.ndarray, "3"]) -> float:
    """Returns the irradiance of a surface with this normal, in camera units."""
    return float(AMBIENT_IRRADIANCE + LAMP_IRRADIANCE * max(normal @ TO_LAMP, 0))


class SyntheticScene:
    """The table with the board and, to the right of it, a box of `box_m` (width, depth, height)."""

    def __init__(self, board: BoardSpec, box_m: tuple[float, float, float] = (0.08, 0.08, 0.1)) -> None:
        self.board, self.box_m = board, box_m

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        """Middle of the board in the world."""
        return np.asarray(self.board.sheet_outline().mean(axis=0))

    @property
    def aim(self) -> Float64[np.ndarray, "3"]:
        """Middle of board and box, on the table."""
        left, right = self.board.sheet_outline()[0, 0], self.box_bounds[1, 0]
        return np.array([(left + right) / 2, self.center[1], 0.0])

    @property
    def extent_m(self) -> float:
        """Diagonal of the printed area."""
        outline = self.board.sheet_outline()
        return float(np.linalg.norm(outline[2] - outline[0]))

    @property
    def box_bounds(self) -> Float64[np.ndarray, "2 3"]:
        """Lower and upper corner of the box in the world."""
        right, middle = self.board.sheet_outline()[1, 0], self.center[1]
        low = np.array([right + self._margin + 0.02, middle - self.box_m[1] / 2, 0.0])
        return np.array([low, low + self.box_m])

    @property
    def _margin(self) -> float:
        return SHEET_MARGIN * self.board.marker_length_m

    def trace(self, camera: CameraModel, world_from_camera: Float64[np.ndarray, "4 4"]) -> Hits:
        """Intersects the ray through every pixel centre with the table and the box."""
        turn, eye = world_from_camera[:3, :3].astype(np.float32), world_from_camera[:3, 3]
        rays = camera.rays()
        direction = [rays[..., 0] * row[0] + rays[..., 1] * row[1] + row[2] for row in turn]
        with np.errstate(divide="ignore", invalid="ignore"):
            table = np.float32(-eye[2]) / direction[2]
            box, light = self._box_hit(eye, direction)
        table[~(table > 0)] = np.inf
        on_box = box < table
        depth = np.where(on_box, box, table)
        depth[~np.isfinite(depth)] = 0
        x, y = (np.float32(eye[axis]) + depth * direction[axis] for axis in (0, 1))
        return Hits(depth, x, y, np.where(on_box, light, np.float32(0)))

    def picture(
        self, fine: CameraModel, world_from_camera: Float64[np.ndarray, "4 4"]
    ) -> Float32[np.ndarray, "h w 3"]:
        """Returns linear radiance, averaged over SAMPLES_PER_EDGE x SAMPLES_PER_EDGE pixels of `fine`."""
        hits = self.trace(fine, world_from_camera)
        on_table = ((hits.depth_m > 0) & (hits.box_irradiance == 0)).astype(np.float32)
        paper = _look_up(self._sheet, hits.x, hits.y) * on_table
        # The sheet's texture is negative outside the paper.
        wood = np.where(paper < 0, _look_up(self._wood, hits.x, hits.y), np.float32(0)) * on_table
        size = fine.width // SAMPLES_PER_EDGE, fine.height // SAMPLES_PER_EDGE
        layers = [np.maximum(paper, 0), wood, hits.box_irradiance, on_table + (hits.box_irradiance > 0)]
        paper, wood, box, hit = (cv2.resize(layer, size, interpolation=cv2.INTER_AREA) for layer in layers)
        upward = irradiance(np.array([0, 0, 1.0]))
        reflected = (paper * upward)[..., None] + (wood * upward)[..., None] * TABLE_ALBEDO
        reflected += box[..., None] * BOX_ALBEDO + ((1 - hit) * AMBIENT_IRRADIANCE)[..., None]
        return np.asarray(reflected / np.pi, np.float32)

    def _box_hit(self, eye: Float64[np.ndarray, "3"], direction: list[Field]) -> tuple[Field, Field]:
        """Returns the distance at which each ray enters the box (infinity: never), and that face's irradiance."""
        enter, leave = np.full_like(direction[0], -np.inf), np.full_like(direction[0], np.inf)
        light = np.zeros_like(enter)
        for axis, (low, high) in enumerate(self.box_bounds.T - eye[:, None]):
            inverse = 1 / direction[axis]
            first, second = np.float32(low) * inverse, np.float32(high) * inverse
            near = np.minimum(first, second)
            normal = np.eye(3)[axis] * np.sign(eye[axis] - self.box_bounds[:, axis].mean())
            light = np.where(near > enter, np.float32(irradiance(normal)), light)
            enter, leave = np.maximum(enter, near), np.minimum(leave, np.maximum(first, second))
        return np.where((enter < leave) & (enter > 0), enter, np.float32(np.inf)), light

    @cached_property
    def _wood(self) -> "_Texture":
        half = WOOD_EDGE_M / 2
        low = self.center[:2] - half
        x, y = np.meshgrid(*(start + np.arange(0, WOOD_EDGE_M, WOOD_TEXEL_M) for start in low))
        phase = 2 * np.pi / WOOD_PERIOD_M
        grain = 1 + 0.15 * np.sin(phase * x + 2 * np.sin(0.37 * phase * y)) * np.cos(0.6 * phase * y)
        return _Texture(grain.astype(np.float32), low, WOOD_TEXEL_M, border=1.0)

    @cached_property
    def _sheet(self) -> "_Texture":
        """Returns the albedo of the printed sheet, exact on average over each texel."""
        board, outline = self.board, self.board.sheet_outline()
        cells = board.opencv_dictionary().markerSize + 2 * board.border_bits
        texel = board.marker_length_m / cells / TEXELS_PER_CELL
        step = texel / SAMPLES_PER_TEXEL
        low, high = outline[3, :2] - self._margin, outline[1, :2] + self._margin
        counts = np.ceil((high - low) / texel).astype(int) * SAMPLES_PER_TEXEL
        x, y = (low[axis] + (np.arange(counts[axis]) + 0.5) * step for axis in (0, 1))
        albedo = np.full((counts[1], counts[0]), PAPER_ALBEDO, np.float32)
        for name, corners in board.corner_points().items():
            _print(
                albedo,
                _marker_cells(board, name),
                x - corners[0, 0],
                corners[0, 1] - y,
                board.marker_length_m,
            )
        if board.type == "charuco":
            self._print_squares(albedo, x - outline[0, 0], outline[0, 1] - y)
        size = tuple(int(count) for count in counts // SAMPLES_PER_TEXEL)
        texels = cv2.resize(albedo, size, interpolation=cv2.INTER_AREA)
        return _Texture(texels, low + texel / 2, texel, border=-1.0)

    def _print_squares(
        self, albedo: Field, right: Float64[np.ndarray, " w"], down: Float64[np.ndarray, " h"]
    ) -> None:
        """Prints the black squares of a ChArUco board; (row + column) even."""
        square = self.board.marker_length_m + self.board.separation_m
        column, row = np.floor(right / square), np.floor(down / square)
        black = (column[None] + row[:, None]) % 2 == 0
        black &= ((column >= 0) & (column < self.board.columns))[None]
        black &= ((row >= 0) & (row < self.board.rows))[:, None]
        albedo[black] = BLACK_ALBEDO


class _Texture(NamedTuple):
    """Values over the table: texel (row, column) is at (x, y) = low + (column, row) * texel_m."""

    values: Field
    low: Float64[np.ndarray, "2"]
    texel_m: float
    border: float


def _look_up(texture: _Texture, x: Field, y: Field) -> Field:
    column = (x - np.float32(texture.low[0])) * np.float32(1 / texture.texel_m)
    row = (y - np.float32(texture.low[1])) * np.float32(1 / texture.texel_m)
    return np.asarray(
        cv2.remap(
            texture.values,
            column,
            row,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=texture.border,
        )
    )


def _print(
    albedo: Field,
    cells: Bool[np.ndarray, "n n"],
    right: Float64[np.ndarray, " w"],
    down: Float64[np.ndarray, " h"],
    length_m: float,
) -> None:
    """Prints a marker; `right` and `down` are the positions of the columns and rows from its top-left corner."""
    columns, rows = (np.flatnonzero((place >= 0) & (place < length_m)) for place in (right, down))
    column, row = (
        (right[columns] / length_m * len(cells)).astype(int),
        (down[rows] / length_m * len(cells)).astype(int),
    )
    white = cells[row[:, None], column[None]]
    albedo[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = np.where(white, PAPER_ALBEDO, BLACK_ALBEDO)


def _marker_cells(board: BoardSpec, name: int) -> Bool[np.ndarray, "n n"]:
    """Returns the cells of a marker with its black border, True = white."""
    dictionary = board.opencv_dictionary()
    cells = dictionary.markerSize + 2 * board.border_bits
    return np.asarray(dictionary.generateImageMarker(name, cells, borderBits=board.border_bits) > 127)
