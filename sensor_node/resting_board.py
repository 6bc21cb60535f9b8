"""Tells whether a board lies in a picture where it lay in an earlier one, without a search.

The change of the pixels around the corners is explained, in least squares, by a motion of the plane (the eight
directions in which a homography can change; a step of Lucas and Kanade 1981) and by another gain and offset of the
light. The residuals also say how exact the fit is, so that noise needs no model: a board rests if its corners
certainly moved by less than `REST_PX`. Elsewhere on it, blocks of pixels must be the same up to noise, so that a hand
that covers a marker, or uncovers one, is noticed.
"""

from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

# Displacement of a corner below which the board rests: the noise of a single corner.
REST_PX = 0.05
# Of the fit's standard deviations, added to each displacement.
SIGMAS = 2.0
# Half the edge of the windows around corners.
WINDOW_HALF_PX = 6
# Surroundings of the board that are compared too, as a multiple of the blocks' edge.
MARGIN_BLOCKS = 1
BLOCK_PX = 8
# Change of a block's mean, in codes, that noise does not reach: the pixels' noise, and this for JPEG's blocks.
BLOCK_CODES = 2.0
# Such a change is a jump or a thing in front, and needs no fit.
COARSE_CODES = 24.0
# Corners in the picture that determine eight directions and leave residuals.
LEAST_CORNERS = 4
# Keeps fits of a plain picture solvable; far below what an edge contributes.
RIDGE = 1e-3


class _Fit(NamedTuple):
    """The linear model of a change: eight motions, gain, offset."""

    pixels: Int64[np.ndarray, " n"]
    """Flat positions in the region."""
    changes: Float64[np.ndarray, "10 n"]
    """Change of each pixel by each unknown."""
    inverse: Float64[np.ndarray, "10 10"]
    """Of the normal equations."""
    displacements: Float64[np.ndarray, "corners 2 10"]
    """Displacement of each corner by each unknown, pixels."""
    sigmas_px: Float64[np.ndarray, " corners"]
    """Standard deviation of a corner's displacement by noise of one code."""


class RestingBoard:
    """A board as one picture shows it, to be compared with later ones of the same size.

    Args:
        gray: the picture.
        corners: of the board's markers, pixels (x, y), in the picture or not.
    """

    def __init__(self, gray: UInt8[np.ndarray, "h w"], corners: Float64[np.ndarray, "n 2"]) -> None:
        height, width = (size // BLOCK_PX * BLOCK_PX for size in gray.shape)
        inside = ((corners >= 1) & (corners <= (width - 2, height - 2))).all(axis=1)
        self._region = _blocks_around(corners[inside], width, height)
        self._corners = corners[inside] - (self._region[1].start, self._region[0].start)
        self._seen = gray[self._region].astype(np.float32)

    def rests_in(self, gray: UInt8[np.ndarray, "h w"]) -> bool:
        """Whether a later picture certainly shows the board in the same place, and as much of it."""
        if len(self._corners) < LEAST_CORNERS:
            return False
        change = gray[self._region] - self._seen
        blocks = _block_means(change)
        if np.abs(blocks).max() > COARSE_CODES:
            return False
        fit = self._fit
        changes = change.ravel()[fit.pixels]
        found = fit.inverse @ (fit.changes @ changes)
        noise = float(np.sqrt(np.mean((changes - found @ fit.changes) ** 2)))
        moved_px = np.linalg.norm(fit.displacements @ found, axis=1) + SIGMAS * noise * fit.sigmas_px
        unlike = np.abs(blocks - found[-2] * _block_means(self._seen) - found[-1])
        return bool(moved_px.max() < REST_PX and unlike.max() < BLOCK_CODES + noise)

    @cached_property
    def _fit(self) -> _Fit:
        """Made for the first comparison: a board that moves fast needs none."""
        pixels = np.flatnonzero(self._windows())
        rows, columns = np.divmod(pixels, self._seen.shape[1])
        # A surface that moves by d changes a fixed pixel by -slope d.
        along_x, along_y = (
            -cv2.Sobel(self._seen, cv2.CV_64F, *axis, scale=1 / 8).ravel()[pixels]
            for axis in ((1, 0), (0, 1))
        )
        u, v = self._centred(columns, rows)
        twist = along_x * u + along_y * v
        motions = (along_x, along_x * u, along_x * v, along_y, along_y * u, along_y * v, twist * u, twist * v)
        changes = np.stack([*motions, self._seen.ravel()[pixels], np.ones(len(pixels))])
        inverse = np.linalg.inv(changes @ changes.T + RIDGE * np.eye(len(changes)))
        displacements = self._displacements()
        variance = np.einsum("cij,jk,cik->c", displacements, inverse, displacements)
        return _Fit(pixels, changes, inverse, displacements, np.sqrt(variance))

    def _windows(self) -> UInt8[np.ndarray, "h w"]:
        """Returns the mask of the pixels around corners."""
        windows = np.zeros(self._seen.shape, np.uint8)
        columns, rows = np.rint(self._corners).astype(np.int64).T
        windows[rows, columns] = 1
        edge = 2 * WINDOW_HALF_PX + 1
        return np.asarray(cv2.dilate(windows, np.ones((edge, edge), np.uint8)))

    def _displacements(self) -> Float64[np.ndarray, "corners 2 10"]:
        """Returns the displacement of each corner by each unknown; gain and offset displace nothing."""
        u, v = self._centred(*self._corners.T)
        one, none = np.ones_like(u), np.zeros_like(u)
        along_x = [one, u, v, none, none, none, u * u, u * v, none, none]
        along_y = [none, none, none, one, u, v, u * v, v * v, none, none]
        return np.stack([np.stack(along_x, axis=-1), np.stack(along_y, axis=-1)], axis=1)

    def _centred(self, x: np.ndarray, y: np.ndarray) -> list[Float64[np.ndarray, " n"]]:
        """Returns coordinates from the board's middle, -1..1 on it."""
        middle = self._corners.mean(axis=0)
        reach = np.abs(self._corners - middle).max()
        return [(values - centre) / reach for values, centre in zip((x, y), middle, strict=True)]


def _blocks_around(corners: Float64[np.ndarray, "n 2"], width: int, height: int) -> tuple[slice, slice]:
    """Returns rows and columns of the whole blocks of a picture that hold the corners, and some around them."""
    slices = []
    for axis, size in ((1, height), (0, width)):
        low, high = (corners[:, axis].min(), corners[:, axis].max()) if len(corners) else (0, 0)
        first = max(int(low) // BLOCK_PX - MARGIN_BLOCKS, 0)
        last = min(int(high) // BLOCK_PX + MARGIN_BLOCKS + 1, size // BLOCK_PX)
        slices.append(slice(first * BLOCK_PX, last * BLOCK_PX))
    return slices[0], slices[1]


def _block_means(region: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "rows columns"]:
    height, width = region.shape
    size = width // BLOCK_PX, height // BLOCK_PX
    return np.asarray(cv2.resize(region, size, interpolation=cv2.INTER_AREA))
