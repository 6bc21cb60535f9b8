"""Views of a target: selection of pictures for calibration."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.sensor_node.calibration.targets import Sighting, Target

# Fewer points do not determine a pose well.
LEAST_POINTS = 8
# A corner that moves by a thousandth of the width between two frames is blurred by at most as much.
STILL_FRACTION = 1e-3
# A view that differs less than this from an earlier one, as a fraction of the width, adds little.
NEW_FRACTION = 0.05


class Picture(NamedTuple):
    """A picture of a series (RGB) with its name; those of one `moment` are exposures of the same scene."""

    name: str
    color: UInt8[np.ndarray, "h w 3"]
    moment: int


@dataclass(frozen=True, eq=False)
class View:
    """One picture in which the target was found; `points` in metres in the target's frame."""

    name: str
    numbers: Int64[np.ndarray, " n"]
    points: Float64[np.ndarray, "n 3"]
    pixels: Float64[np.ndarray, "n 2"]
    gray: UInt8[np.ndarray, "h w"]
    moment: int

    def refined(self, target: Target, camera: CameraModel) -> "View":
        """Returns the view with its points refined by the nearly known lens."""
        sighting = target.refined(self.gray, Sighting(self.numbers, self.pixels), camera)
        return replace(self, pixels=sighting.pixels)

    def only(self, kept: Bool[np.ndarray, " n"]) -> "View":
        """Returns the view with some of its points."""
        return replace(self, numbers=self.numbers[kept], points=self.points[kept], pixels=self.pixels[kept])


class ViewCollector:
    """Selects the views from a series of pictures.

    Of a `moving` series (a recording, a live camera), only those in which the target stands still, at a new position;
    of a folder of pictures, all. `brightest` is the brightest value of every pixel.
    """

    def __init__(self, target: Target, *, moving: bool) -> None:
        self._target, self._moving = target, moving
        self._last: View | None = None
        self.views: list[View] = []
        self.seen = 0
        self.brightest: UInt8[np.ndarray, "h w"] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pictures, (0, 0) before the first."""
        return (0, 0) if self.brightest is None else (self.brightest.shape[1], self.brightest.shape[0])

    def add(self, picture: Picture) -> bool:
        """Examines the next picture; returns whether it was taken as a view.

        Raises:
            DeltalightError: its size differs from the earlier ones.
        """
        gray = cv2.cvtColor(np.ascontiguousarray(picture.color), cv2.COLOR_RGB2GRAY)
        self._examine(picture.name, gray)
        if self.views and self.views[-1].moment == picture.moment:
            return False
        sighting = self._target.find(gray)
        if sighting is None or len(sighting.numbers) < LEAST_POINTS:
            self._last = None
            return False
        points = self._target.points[sighting.numbers]
        view = View(picture.name, sighting.numbers, points, sighting.pixels, gray, picture.moment)
        last, self._last = self._last, view
        if self._moving and not (self._is_still(view, last) and self._is_new(view)):
            return False
        self.views.append(view)
        return True

    def _examine(self, name: str, gray: UInt8[np.ndarray, "h w"]) -> None:
        self.seen += 1
        if self.brightest is None:
            self.brightest = gray.copy()
        if gray.shape != self.brightest.shape:
            raise DeltalightError(
                f"{name} has {gray.shape[1]}x{gray.shape[0]} pixels and those before "
                f"{self.size[0]}x{self.size[1]}; calibrate with pictures of one camera and one size."
            )
        np.maximum(self.brightest, gray, out=self.brightest)

    def _is_still(self, view: View, last: View | None) -> bool:
        return last is not None and _apart_px(view, last) < STILL_FRACTION * self.size[0]

    def _is_new(self, view: View) -> bool:
        return all(_apart_px(view, taken) > NEW_FRACTION * self.size[0] for taken in self.views)


def _apart_px(first: View, second: View) -> float:
    """Returns the mean distance between the points that both views show; infinite if there are none."""
    _, ours, theirs = np.intersect1d(first.numbers, second.numbers, return_indices=True)
    if not len(ours):
        return float("inf")
    return float(np.linalg.norm(first.pixels[ours] - second.pixels[theirs], axis=1).mean())
