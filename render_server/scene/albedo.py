"""Albedo of the real scene: of the board's paper and grey cards, and by position, averaged over time.

Paper and cards serve as a light meter (docs/method.md 1), the average for surfaces out of view (docs/method.md 2).
"""

from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8

from deltalight.protocol import short_axis
from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import LUMINANCE, BoardPose

MIN_PIXELS = 30
SUFFICIENT_PIXELS = 10 * MIN_PIXELS
MAX_COORDINATE_PX = 1e5  # fixed-point outlines overflow beyond this
# Margin inside a patch's edges, where lens and sampling mix it with its neighbours; the second if few pixels are
# left.
INSETS_PX = (2, 1)
EDGE_POINTS = 8
# Of a patch's box: constant, and not what lies around the box in the whole picture.
OUTSIDE_IS_OTHER = cv2.BORDER_CONSTANT | cv2.BORDER_ISOLATED
# Limits of linear values and codes within which a pixel carries its true radiance.
CLIPPED_LINEAR = 0.98
CLIPPED_CODE = 255
DARK_LINEAR = 0.005
CELLS = 64  # per edge of the cube: 5 cm in a room of 3 m, finer than bounce light resolves
MARGIN = 1.1  # of the cube over the scene's bounds
MAX_WEIGHT = 200.0  # samples a cell keeps: as many new ones replace an outdated albedo
ALBEDO_RANGE = (0.02, 0.95)  # as in common/albedo_range.glsl
MEAN_ALBEDO = 0.5  # before any observation


def known_albedo(board: BoardSpec, camera: CameraModel, pose: BoardPose) -> Float32[np.ndarray, "h w"]:
    """Returns the albedo of every pixel that shows a surface of known albedo; 0 elsewhere.

    Grey cards have the albedo that board.yaml gives them. White paper counts where its albedo is given too, and with
    the assumed one where no card is in view. Things that cover the board are not detected here.
    """
    albedo = np.zeros((camera.height, camera.width), np.float32)
    cards = [(card_pixels(card.outline(), camera, pose), card.albedo) for card in board.grey_cards]
    if board.white_albedo is not None or not any(mask.any() for mask, _ in cards):
        albedo[paper_pixels(board, camera, pose)] = board.paper_albedo
    for mask, value in cards:
        albedo[mask] = value
    return albedo


def paper_pixels(board: BoardSpec, camera: CameraModel, pose: BoardPose) -> Bool[np.ndarray, "h w"]:
    """Returns which pixels show white paper between the board's markers, well inside its edges."""
    covered = [_mask(card.outline(), camera, pose) for card in board.grey_cards]
    paper = _inside(_masks(board.paper_patches(), camera, pose), camera)
    for mask in covered:
        if mask is not None:
            paper &= ~cv2.dilate(mask, _square(INSETS_PX[0])).astype(bool)
    return paper


def card_pixels(
    outline: Float64[np.ndarray, "4 3"], camera: CameraModel, pose: BoardPose
) -> Bool[np.ndarray, "h w"]:
    """Returns which pixels show a card, well inside its edges."""
    return _inside(_masks([outline], camera, pose), camera)


def unclipped(
    color: UInt8[np.ndarray, "h w 3"], linear: Float[np.ndarray, "h w 3"]
) -> Bool[np.ndarray, "h w"]:
    """Returns which pixels carry their true radiance: no channel clipped, and not nearly black.

    `linear` is the picture decoded by the response alone, before division by the exposure.
    """
    bright = (linear >= CLIPPED_LINEAR) | (color == CLIPPED_CODE)
    return np.asarray(~short_axis.any_of(bright) & (linear @ LUMINANCE >= DARK_LINEAR))


def _inside(masks: list[UInt8[np.ndarray, "h w"]], camera: CameraModel) -> Bool[np.ndarray, "h w"]:
    """Returns the patches without their edges: 2 pixels, or 1 where few pixels would be left."""
    found = np.zeros((camera.height, camera.width), np.uint8)
    for inset in INSETS_PX:
        for mask in masks:
            x, y, width, height = cv2.boundingRect(mask)
            if not width:
                continue
            box = slice(y, y + height), slice(x, x + width)
            found[box] |= cv2.erode(mask[box], _square(inset), borderType=OUTSIDE_IS_OTHER, borderValue=0)
        if np.count_nonzero(found) >= SUFFICIENT_PIXELS:
            break
    return np.asarray(found.astype(bool))


def _square(inset: int) -> UInt8[np.ndarray, "n n"]:
    return np.ones((2 * inset + 1,) * 2, np.uint8)


def _masks(
    patches: Iterable[Float64[np.ndarray, "4 3"]], camera: CameraModel, pose: BoardPose
) -> list[UInt8[np.ndarray, "h w"]]:
    masks = (_mask(patch, camera, pose) for patch in patches)
    return [mask for mask in masks if mask is not None]


def _mask(
    patch: Float64[np.ndarray, "4 3"], camera: CameraModel, pose: BoardPose
) -> UInt8[np.ndarray, "h w"] | None:
    """Returns the pixels of a quad in world coordinates; None where it is not wholly in front of the camera."""
    camera_from_world = np.linalg.inv(pose.world_from_camera)
    outline = _dense_outline(patch) @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    pixels = camera.project(outline)
    if not np.isfinite(pixels).all() or np.abs(pixels).max() > MAX_COORDINATE_PX:
        return None
    mask = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillPoly(mask, [np.round(pixels * 16).astype(np.int32)], 1, shift=4)
    return mask


def _dense_outline(patch: Float64[np.ndarray, "4 3"]) -> Float64[np.ndarray, "n 3"]:
    """Returns points along a quad's edges, because a lens bends straight lines."""
    fraction = np.linspace(0, 1, EDGE_POINTS, endpoint=False)[:, None]
    following = np.roll(patch, -1, axis=0)
    return np.concatenate(
        [start + fraction * (end - start) for start, end in zip(patch, following, strict=True)]
    )


class AlbedoVolume:
    """Sums of measured radiance and of irradiance in the cells of a cube: albedo = pi sum B / sum E.

    `version` rises with every change. `origin` is the cube's lowest corner and `edge` its edge, world metres.
    """

    def __init__(self) -> None:
        self.version = 0
        self.origin = np.zeros(3)
        self.edge = 0.0
        self._sums = np.zeros((0, 7))

    def observe(
        self,
        bounds: tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]],
        position: Float[np.ndarray, "k 3"],
        measured: Float[np.ndarray, "k 3"],
        irradiance: Float[np.ndarray, "k 3"],
    ) -> None:
        """Accumulates the unshadowed, unclipped pixels of diffuse surfaces in one picture.

        Args:
            bounds: least and greatest coordinates of the real scene, world metres; if they leave the cube, all
                samples are dropped and a new cube is placed.
            position: world metres.
            measured: linear radiance B, camera units.
            irradiance: total irradiance E there, camera units.
        """
        self._place_cube(*bounds)
        cell, inside = self._cells(position)
        known = inside & short_axis.all_of(irradiance > 0) & short_axis.all_of(np.isfinite(measured))
        values = np.column_stack([measured, irradiance, np.ones(len(measured))])[known]
        new = np.stack([np.bincount(cell[known], column, CELLS**3) for column in values.T], axis=1)
        kept = np.minimum(1, np.maximum(MAX_WEIGHT - new[:, 6], 0) / np.maximum(self._sums[:, 6], 1e-9))
        self._sums = self._sums * kept[:, None] + new
        self.version += 1

    def _place_cube(self, low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"]) -> None:
        if self.edge > 0 and (low >= self.origin).all() and (high <= self.origin + self.edge).all():
            return
        self.edge = MARGIN * float(np.max(high - low))
        self.origin = (low + high - self.edge) / 2
        self._sums = np.zeros((CELLS**3, 7))

    def _cells(
        self, position: Float[np.ndarray, "k 3"]
    ) -> tuple[Int64[np.ndarray, " k"], Bool[np.ndarray, " k"]]:
        place = np.floor((position - self.origin) / self.edge * CELLS)
        inside = short_axis.all_of((place >= 0) & (place < CELLS))
        x, y, z = np.where(inside[:, None], place, 0).astype(np.int64).T
        return (z * CELLS + y) * CELLS + x, inside

    def filled(self) -> Float32[np.ndarray, "z y x 3"]:
        """Returns the albedo of every cell; empty cells take it from the finest coarser level with samples."""
        levels = [self._sums.reshape((CELLS,) * 3 + (7,))]
        while len(levels[-1]) > 1:
            half = len(levels[-1]) // 2
            levels.append(levels[-1].reshape(half, 2, half, 2, half, 2, 7).sum(axis=(1, 3, 5)))
        albedo = np.full((1, 1, 1, 3), MEAN_ALBEDO)
        for sums in reversed(levels):
            factor = len(sums) // len(albedo)
            coarse = albedo.repeat(factor, 0).repeat(factor, 1).repeat(factor, 2)
            found = np.pi * sums[..., :3] / np.maximum(sums[..., 3:6], 1e-12)
            albedo = np.where(sums[..., 6:] > 0, np.clip(found, *ALBEDO_RANGE), coarse)
        return np.asarray(albedo, np.float32)
