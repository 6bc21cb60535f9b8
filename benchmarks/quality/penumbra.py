"""Width of a shadow's edge, measured across it in truth and in a result."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy.ndimage import map_coordinates
from scipy.optimize import isotonic_regression

from deltalight.benchmarks.ground_truth.benchmark_scene import ShadowEdge
from deltalight.benchmarks.ground_truth.parts import Matrix
from deltalight.benchmarks.quality.regions import REAL_COVER, Linear
from deltalight.protocol.camera_model import CameraModel

ACROSS_PX = 3
"""Parallel lines to either side, a pixel apart: seven of them reduce noise by 2.6."""
LEAST_REACH_PX = 4
"""From the middle to either end: a sharp edge is two pixels wide in the picture, with two more beside it."""
SAMPLES_PER_PX = 2
PLATEAU_FRACTION = 1 / 6
"""Part of the profile at either end that counts as fully lit or fully dark."""
LEAST_STEP = 0.02
"""Least darkening of a profile with a shadow: three times the rounding of a mid-grey 8-bit code."""

Profile = Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Penumbra:
    """Metres between 90 % and 10 % of the step along a shadow edge; nan where there is no edge."""

    truth_m: float
    result_m: float

    @property
    def relative_error(self) -> float:
        """Signed: positive is too soft."""
        return self.result_m / self.truth_m - 1


@dataclass(frozen=True, eq=False)
class EdgeOnPicture:
    """A shadow edge as one camera sees it: pixels (x, y) along parallel lines from light into shadow."""

    lines: Float64[np.ndarray, "m n 2"]
    length_m: float

    @classmethod
    def seen(cls, edge: ShadowEdge, camera: CameraModel, world_from_camera: Matrix) -> "EdgeOnPicture":
        """Lays lines across an edge on a level surface, a pixel apart there, and projects them."""
        start, end = np.array(edge.start_m), np.array(edge.end_m)
        middle, half = (start + end) / 2, (end - start) / 2
        camera_from_world = np.linalg.inv(world_from_camera)
        depth_m = float(camera_from_world[2] @ [*middle, 1])
        pixel_m = depth_m / camera.matrix[0, 0]
        half *= max(1, LEAST_REACH_PX * pixel_m / np.linalg.norm(half))
        reach_m = float(np.linalg.norm(half))
        aside = np.cross([0, 0, 1], half) / reach_m * pixel_m
        positions = np.linspace(-1, 1, 2 * int(np.ceil(SAMPLES_PER_PX * reach_m / pixel_m)) + 1)
        offsets = np.arange(-ACROSS_PX, ACROSS_PX + 1)[:, None, None]
        points = middle + positions[:, None] * half + offsets * aside
        seen = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        return cls(camera.project(seen.reshape(-1, 3)).reshape(*points.shape[:2], 2), 2 * reach_m)

    def uncovered(self, cover: Float32[np.ndarray, "h w"]) -> "EdgeOnPicture":
        """Drops lines that objects or the picture's border hide."""
        height, width = cover.shape
        seen = np.all((self.lines >= 0) & (self.lines <= [width - 1, height - 1]), axis=(1, 2))
        free = np.all(_sampled(cover[..., None], self.lines) < REAL_COVER, axis=1)
        return EdgeOnPicture(self.lines[seen & free], self.length_m)

    def measure(self, camera: Linear, result: Linear, without: Linear, truth: Linear) -> Penumbra:
        """Measures the widths of one edge.

        `truth` against noise-free `without`, `result` against the `camera` picture.
        """
        widths = [step_width(self.profile(*pair)) for pair in ((truth, without), (result, camera))]
        return Penumbra(widths[0] * self.length_m, widths[1] * self.length_m)

    def profile(self, shadowed: Linear, lit: Linear) -> Profile:
        """Returns the ratio shadowed / lit along the edge, both averaged over the lines.

        1 where nothing is lit or seen.
        """
        sums = [_sampled(picture, self.lines).sum(axis=0) for picture in (shadowed, lit)]
        return np.asarray(np.divide(sums[0], sums[1], out=np.ones_like(sums[0]), where=sums[1] > 0))


def _sampled(
    picture: Float32[np.ndarray, "h w c"], places: Float64[np.ndarray, "m n 2"]
) -> Float64[np.ndarray, "m n"]:
    """Returns the sum of the channels at positions (x, y), bilinear; the border is repeated outside."""
    rows_columns = np.moveaxis(places, -1, 0)[::-1]
    total = picture.sum(axis=2, dtype=np.float64)
    return np.asarray(map_coordinates(total, rows_columns, order=1, mode="nearest"))


def step_width(profile: Profile) -> float:
    """Returns the fraction of a profile's length between 90 % and 10 % of its fall; nan if it does not fall.

    Noise may cross a level more than once, so the levels are read on the falling curve nearest to the profile (least
    squares).
    """
    plateau = max(1, round(PLATEAU_FRACTION * len(profile)))
    high, low = profile[:plateau].mean(), profile[-plateau:].mean()
    if high - low < LEAST_STEP:
        return np.nan
    fall = np.asarray(isotonic_regression(profile, increasing=False).x)
    positions = np.linspace(0, 1, len(profile))
    levels = low + np.array([0.9, 0.1]) * (high - low)
    begin, end = np.interp(levels, fall[::-1], positions[::-1])
    return float(end - begin)
