"""The printed marker board as a picture of its albedo, positioned in the world frame of docs/formats.md 3."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.errors import DeltalightError

PIXELS_PER_CELL = 20
MARGIN_M = 0.02
"""Texels along one black or white cell of a marker."""

INK_ALBEDO = 0.04


@dataclass(frozen=True)
class BoardTexture:
    """Albedo of the whole sheet; row 0 is its top edge (largest y), column 0 its left edge (smallest x)."""

    albedo: Float32[np.ndarray, "h w"]
    min_m: Float[np.ndarray, "2"]
    max_m: Float[np.ndarray, "2"]


def board_texture(board: BoardSpec) -> BoardTexture:
    """Prints `board` with a white margin of about MARGIN_M: marker edges fall on texel edges.

    Raises:
        DeltalightError: the board is not a grid of markers.
    """
    if board.type == "charuco":
        raise DeltalightError(
            "The printed sheet is made for marker grids only; use aruco_grid or apriltag_grid."
        )
    dictionary = board.opencv_dictionary()
    side = (dictionary.markerSize + 2 * board.border_bits) * PIXELS_PER_CELL
    texel_m = board.marker_length_m / side
    corners = board.corner_points()
    points = np.concatenate(list(corners.values()))[:, :2]
    margin = round(MARGIN_M / texel_m) * texel_m
    min_m, max_m = points.min(axis=0) - margin, points.max(axis=0) + margin
    width, height = (round(extent / texel_m) for extent in max_m - min_m)
    albedo = np.full((height, width), board.paper_albedo, np.float32)
    for marker_id, quad in corners.items():
        column, row = _texel_of(quad[0, :2], min_m, max_m, texel_m)
        print_area = albedo[row : row + side, column : column + side]
        marker = cv2.aruco.generateImageMarker(dictionary, marker_id, side, borderBits=board.border_bits)
        print_area[marker == 0] = INK_ALBEDO
    return BoardTexture(albedo, min_m, max_m)


def _texel_of(
    point_m: Float[np.ndarray, "2"],
    min_m: Float[np.ndarray, "2"],
    max_m: Float[np.ndarray, "2"],
    texel_m: float,
) -> Int[np.ndarray, "2"]:
    """Returns column and row of the texel whose upper left corner is `point_m`."""
    return np.rint(np.array([point_m[0] - min_m[0], max_m[1] - point_m[1]]) / texel_m).astype(int)
