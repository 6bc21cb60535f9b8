"""Flat targets whose points can be found without knowing the lens: chessboards and marker boards."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from deltalight.protocol.board import BoardSpec, load_board_yaml
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut
from deltalight.sensor_node.marker_finder import MarkerFinder

CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 0.005)
# Half the edge of the window about a corner, as a fraction of the distance to the next one, which it must not reach.
WINDOW_FRACTION = 0.4
WINDOW_HALF_PX = (2, 11)
# A refined marker corner that moved farther was attracted by another edge.
CAUGHT_PX = 3.0
CHESSBOARD = re.compile(r"chessboard:(\d{1,3})x(\d{1,3}):(\d*\.?\d+)")


class Sighting(NamedTuple):
    """Points of a target that were found: their indices in `Target.points`, and the pixels."""

    numbers: Int64[np.ndarray, " n"]
    pixels: Float64[np.ndarray, "n 2"]


class Target(Protocol):
    """A flat target; `points` (m, 3) are all of its points in metres in its own frame."""

    @property
    def points(self) -> Float64[np.ndarray, "m 3"]:
        """All points in metres, in the target's frame."""

    def find(self, gray: UInt8[np.ndarray, "h w"]) -> Sighting | None:
        """Finds the target in a picture of an uncalibrated camera."""

    def refined(self, gray: UInt8[np.ndarray, "h w"], sighting: Sighting, camera: CameraModel) -> Sighting:
        """Returns the same points, refined with the nearly known lens."""


class Chessboard:
    """A chessboard of `columns` x `rows` inner corners; its frame is that of marker boards (y up, z out)."""

    def __init__(self, columns: int, rows: int, square_m: float) -> None:
        self._size = (columns, rows)
        grid = np.mgrid[:rows, :columns].reshape(2, -1)
        self._points = np.column_stack([grid[1], -grid[0], np.zeros(columns * rows)]) * square_m

    @property
    def points(self) -> Float64[np.ndarray, "m 3"]:
        """Inner corners in metres, row by row."""
        return self._points

    def find(self, gray: UInt8[np.ndarray, "h w"]) -> Sighting | None:
        """Finds all inner corners, or none."""
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(gray, self._size, flags=flags)
        if not found:
            return None
        start = np.asarray(corners, np.float32).reshape(-1, 2)
        return Sighting(np.arange(len(start)), self._saddles(gray, start))

    def refined(self, gray: UInt8[np.ndarray, "h w"], sighting: Sighting, camera: CameraModel) -> Sighting:
        """Returns the sighting unchanged: a saddle point does not depend on the lens."""
        del gray, camera
        return sighting

    def _saddles(
        self, gray: UInt8[np.ndarray, "h w"], start: Float32[np.ndarray, "n 2"]
    ) -> Float64[np.ndarray, "n 2"]:
        """Refines each corner in its own window, because squares get small towards the rim of a fish-eye."""
        grid = start.reshape(self._size[1], self._size[0], 2)
        steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1) for axis in (0, 1)]
        gaps = np.minimum(_least_beside(steps[0], 0), _least_beside(steps[1], 1)).ravel()
        halves = np.clip(np.rint(WINDOW_FRACTION * gaps), *WINDOW_HALF_PX).astype(int)
        refined = [
            cv2.cornerSubPix(gray, corner.reshape(1, 1, 2).copy(), (int(half),) * 2, (-1, -1), CRITERIA)
            for corner, half in zip(start, halves, strict=True)
        ]
        return np.asarray(refined, np.float64).reshape(-1, 2)


class MarkerBoard:
    """A marker board; its frame is the world's (docs/formats.md 3)."""

    def __init__(self, board: BoardSpec) -> None:
        self.board = board
        self._finder = MarkerFinder(board)
        corners = board.corner_points()
        self._first = {name: 4 * place for place, name in enumerate(corners)}
        chess = board.chessboard_corners()
        self._points = chess if len(chess) else np.concatenate(list(corners.values()))

    @property
    def points(self) -> Float64[np.ndarray, "m 3"]:
        """Corners of the markers by order of the ids, or the inner corners of a ChArUco board."""
        return self._points

    def find(self, gray: UInt8[np.ndarray, "h w"]) -> Sighting | None:
        """Finds the board's markers, or on a ChArUco board the inner corners beside them."""
        quads = self._finder.quads(gray, self._first)
        if not quads:
            return None
        if self.board.type == "charuco":
            numbers, pixels = self._finder.inner_corners(gray, gray, quads)
            return Sighting(numbers, pixels) if len(numbers) else None
        numbers = np.concatenate([self._first[name] + np.arange(4) for name in quads])
        start = Sighting(numbers, np.concatenate(list(quads.values())))
        # A marker is so small that its edges are nearly straight in any lens.
        height, width = gray.shape
        matrix = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
        return self.refined(gray, start, CameraModel(width, height, matrix))

    def refined(self, gray: UInt8[np.ndarray, "h w"], sighting: Sighting, camera: CameraModel) -> Sighting:
        """Fits the markers' edges, straightened by the lens model."""
        if self.board.type == "charuco":
            return sighting
        # Paper and ink are grey, so their grey code decodes to linear light.
        light = decode_lut(None)[:, 0][gray]
        better = self._finder.refined(light, camera, sighting.pixels.reshape(-1, 4, 2)).reshape(-1, 2)
        moved = np.linalg.norm(better - sighting.pixels, axis=1)
        kept = np.where((moved < CAUGHT_PX)[:, None], better, sighting.pixels)
        return Sighting(sighting.numbers, kept)


def parse_target(text: str | None, known: BoardSpec | None, folders: Sequence[Path | None]) -> Target:
    """Returns the target that `--target` names, or by default the known board.

    Args:
        text: `chessboard:COLUMNSxROWS:SQUARE_M` (inner corners, metres) or the path of a board.yaml.
        known: the board that a recording describes.
        folders: dataset folders; the first one with a calibration/board.yaml is used.

    Raises:
        DeltalightError: no target is given, or the given one is wrong.
    """
    if text is None:
        boards = [folder / "calibration" / "board.yaml" for folder in folders if folder is not None]
        found = next((path for path in boards if path.is_file()), None)
        if known is None and found is None:
            raise DeltalightError(
                "the source has no calibration/board.yaml; name the target with --target board.yaml or "
                "--target chessboard:8x6:0.117 (inner corners, edge of a square in metres)."
            )
        return MarkerBoard(known or load_board_yaml(found or Path()))
    if not text.startswith("chessboard"):
        return MarkerBoard(load_board_yaml(Path(text)))
    match = CHESSBOARD.fullmatch(text)
    columns, rows, square = (float(group) for group in match.groups()) if match else (0.0, 0.0, 0.0)
    if min(columns, rows) < 3 or not 0 < square < 10:
        raise DeltalightError(
            f"'{text}' is not a chessboard; write chessboard:COLUMNSxROWS:SQUARE with its inner corners (3 or more "
            "each) and the edge of a square in metres, such as chessboard:8x6:0.117."
        )
    return Chessboard(int(columns), int(rows), square)


def _least_beside(steps: Float64[np.ndarray, "r c"], axis: int) -> Float64[np.ndarray, "r c"]:
    """Returns the distance to the nearer neighbour along an axis, for every corner of the grid."""
    ends = [(1, 0) if each == axis else (0, 0) for each in (0, 1)]
    starts = [(0, 1) if each == axis else (0, 0) for each in (0, 1)]
    pads = [np.pad(steps, width, constant_values=np.inf) for width in (ends, starts)]
    return np.asarray(np.minimum(*pads))
