"""Which parts of the picture a calibration has covered, as a grid of cells, as text and as pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from deltalight.sensor_node.calibration.fits import LensFit
from deltalight.sensor_node.calibration.views import View

# Cells along the width. Distortion is smooth: one corner per eighth determines the polynomial there.
COLUMNS = 8
# Light below this fraction of the middle's is scattered by glass and housing outside the image circle.
CIRCLE_FRACTION = 0.1
# Residual vectors are scaled so that their rms is this fraction of the picture's width.
ARROW_FRACTION = 0.02
SEEN, UNSEEN, POINT, ARROW = (70, 160, 70), (170, 60, 60), (255, 220, 0), (255, 60, 60)


@dataclass(frozen=True, eq=False)
class Coverage:
    """Points found in each cell of the picture; cells outside the image circle do not count (`counted`)."""

    points: Int64[np.ndarray, "r c"]
    counted: Bool[np.ndarray, "r c"]

    @property
    def fraction(self) -> float:
        """Fraction of the counted cells that hold a point."""
        return float((self.points[self.counted] > 0).mean()) if self.counted.any() else 0.0

    def text(self) -> str:
        """Returns the grid with a character per cell: points in it, 9 = nine or more, `.` = none, space = dark."""
        rows = []
        for counts, inside in zip(self.points, self.counted, strict=True):
            rows.append(" ".join(_mark(int(n), bool(is_in)) for n, is_in in zip(counts, inside, strict=True)))
        return "\n".join(rows)


def _mark(points: int, counted: bool) -> str:
    if points:
        return str(min(points, 9))
    return "." if counted else " "


def measure_coverage(
    views: Sequence[View], size: tuple[int, int], circle: tuple[Float64[np.ndarray, "2"], float] | None = None
) -> Coverage:
    """Counts the points of views in the cells of a picture.

    Args:
        views: views of the target.
        size: width and height of the picture.
        circle: centre (pixels) and radius of a fish-eye's image circle; None = light is everywhere.
    """
    width, height = size
    rows = max(1, round(COLUMNS * height / width))
    pixels = np.concatenate([view.pixels for view in views]) + 0.5
    place = np.floor(pixels / size * (COLUMNS, rows)).astype(int)
    place = np.clip(place, 0, (COLUMNS - 1, rows - 1))
    points = np.zeros((rows, COLUMNS), np.int64)
    np.add.at(points, (place[:, 1], place[:, 0]), 1)
    middles = np.stack(np.meshgrid(np.arange(COLUMNS) + 0.5, np.arange(rows) + 0.5), axis=-1)
    counted = np.ones((rows, COLUMNS), bool)
    if circle is not None:
        away = middles / (COLUMNS, rows) * size - 0.5 - circle[0]
        counted = np.linalg.norm(away, axis=-1) <= circle[1]
    return Coverage(points, counted)


def image_circle(brightest: UInt8[np.ndarray, "h w"], centre: Float64[np.ndarray, "2"]) -> float | None:
    """Returns the radius in pixels about `centre` that light reaches, None if it fills the picture.

    Uses the median over each ring of each pixel's brightest value, so that a dark thing on one side does not count.
    """
    height, width = brightest.shape
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    rings = np.rint(np.hypot(columns - centre[0], rows - centre[1])).astype(int).ravel()
    order = np.argsort(rings, kind="stable")
    ends = np.searchsorted(rings[order], np.arange(1, rings.max() + 1))
    medians = np.array(
        [np.median(ring) if ring.size else 0 for ring in np.split(brightest.ravel()[order], ends)]
    )
    dark = medians < CIRCLE_FRACTION * medians.max()
    # the ring after which everything is dark
    last = len(dark) - int(np.argmin(dark[::-1]))
    return None if last >= len(dark) else float(last)


def draw_coverage(
    brightest: UInt8[np.ndarray, "h w"], fit: LensFit, coverage: Coverage
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the picture with seen cells in green, unseen ones in red, and all points."""
    picture = cv2.cvtColor(brightest // 2, cv2.COLOR_GRAY2RGB)
    height, width = brightest.shape
    rows, columns = coverage.points.shape
    tint = np.zeros((rows, columns, 3), np.uint8)
    tint[coverage.counted] = UNSEEN
    tint[coverage.points > 0] = SEEN
    cells = cv2.resize(tint, (width, height), interpolation=cv2.INTER_NEAREST)
    picture = cv2.addWeighted(picture, 0.7, cells, 0.3, 0)
    for x, y in np.rint(np.concatenate([view.pixels for view in fit.views])).astype(int).tolist():
        cv2.circle(picture, (x, y), max(1, width // 400), POINT, cv2.FILLED, cv2.LINE_AA)
    return np.asarray(picture)


def draw_misses(brightest: UInt8[np.ndarray, "h w"], fit: LensFit) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the picture with an arrow from each found point to its predicted position, enlarged."""
    picture = cv2.cvtColor(brightest // 2, cv2.COLOR_GRAY2RGB)
    enlarged = ARROW_FRACTION * picture.shape[1] / max(fit.rms_px, 1e-6)
    for view, misses in zip(fit.views, fit.misses, strict=True):
        for start, miss in zip(view.pixels, misses, strict=True):
            ends = np.rint(np.stack([start, start - enlarged * miss])).astype(int).tolist()
            cv2.arrowedLine(picture, tuple(ends[0]), tuple(ends[1]), ARROW, 1, cv2.LINE_AA, tipLength=0.2)
    text = f"rms {fit.rms_px:.2f} px, arrows {enlarged:.0f} times"
    scale = picture.shape[1] / 1200
    cv2.putText(picture, text, (10, picture.shape[0] - 12), cv2.FONT_HERSHEY_SIMPLEX, scale, (255,) * 3)
    return np.asarray(picture)
