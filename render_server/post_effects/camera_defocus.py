"""Defocus by distance: how a camera's blur grows off the depth in focus, measured at the board's edges.

A thin lens of aperture A (m) and focal length f (px) shows a point at depth z as a disc of the diameter
A f |1/z - 1/z_focus| px, the circle of confusion, whose variance along either axis is a sixteenth of its square. So
with w = 1/z the variance of all blur is s0^2 + k^2 (w - w_focus)^2, k = A f / 4: a parabola in w. Edges at several
depths, in a frame that sees the board obliquely or in those of a camera that moves, tell it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import ViewFrame
from deltalight.render_server.post_effects.camera_blur import (
    PIXEL_VARIANCE,
    SIGNIFICANT,
    Color,
    Coverage,
    LensBlur,
    blur_kernels,
    blurred_in_parts,
)
from deltalight.render_server.post_effects.camera_edges import SIGMAS_PX, EdgeStep

MOST_FRAMES = 24
LEAST_STEP = 0.03
"""Of the half diagonal, or of the depth: how far the board must have moved for another frame to count."""
LEAST_EDGES = 16
ROUNDS = 5
OUTLIER_DEVIATIONS = 3.0
GRID_ERROR = 2 * np.log(SIGMAS_PX[1] / SIGMAS_PX[0]) / np.sqrt(12)
"""Of a variance, as a fraction: blurs are measured in steps."""
NO_BLUR = np.ones((3, 1, 1))
LEVEL_PX, MOST_LEVELS = 0.5, 6
"""Steps between the blurs that pixels of several depths are mixed of."""


@dataclass(frozen=True)
class Defocus:
    """The blur's variance in focus (px^2), 1 over the depth in focus (1/m), and the growth k (px m; module)."""

    sharpest: float
    focus: float
    growth: float

    def variance(self, inverse_m: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
        """Returns the variance of the whole blur at depths of 1 / `inverse_m`, px^2; a pixel's at least."""
        return np.maximum(self.sharpest + (self.growth * (inverse_m - self.focus)) ** 2, PIXEL_VARIANCE)

    def without(self, variance: float) -> "Defocus":
        """Returns what is left of the blur without a part of its variance, px^2."""
        return replace(self, sharpest=self.sharpest - variance)


def fit_defocus(edges: Sequence[EdgeStep]) -> Defocus | None:
    """Returns the defocus that edges at several depths show; None if it is within its error.

    A lens that is softer towards the picture's corners is no reason for it: the variance may also grow with the
    square of the distance from the principal point.
    """
    if len(edges) < LEAST_EDGES:
        return None
    sigma, w, radius = np.array([(each.sigma_px, each.inverse_m, each.radius_px) for each in edges]).T
    middle, width, corner = w.mean(), np.ptp(w), radius.max()
    if width < LEAST_STEP * middle:
        return None
    off, outwards = (w - middle) / width, (radius / corner) ** 2
    outwards -= outwards.mean()
    curve = _significant_curve(np.stack([np.ones_like(w), off, off**2, outwards], axis=1), sigma**2)
    if curve is None:
        return None
    level, slope, bend = curve
    focus = -slope / (2 * bend)
    return Defocus(level - bend * focus**2, float(middle + width * focus), float(np.sqrt(bend) / width))


def _significant_curve(
    columns: Float64[np.ndarray, "n 4"], variance: Float64[np.ndarray, " n"]
) -> tuple[float, float, float] | None:
    """Fits the variance by the columns, without outliers; returns the first three factors if the third is sure.

    A variance is known to a fraction of itself. In every round that is of what the last one fitted.
    """
    fitted = np.full_like(variance, np.median(variance))
    kept = np.ones(len(variance), bool)
    for _ in range(ROUNDS):
        x, y = columns[kept] / fitted[kept, None], variance[kept] / fitted[kept]
        normal = x.T @ x
        if len(y) < LEAST_EDGES or np.linalg.cond(normal) > 1e9:
            return None
        found = np.linalg.solve(normal, x.T @ y)
        deviation = max(float(np.sqrt(np.sum((y - x @ found) ** 2) / (len(y) - 4))), GRID_ERROR)
        error = deviation * np.sqrt(np.linalg.inv(normal)[2, 2])
        fitted = np.maximum(columns @ found, SIGMAS_PX[0] ** 2)
        misfit = variance / fitted - 1
        robust = max(1.4826 * float(np.median(np.abs(misfit))), GRID_ERROR)
        kept = np.abs(misfit) <= OUTLIER_DEVIATIONS * robust
    return tuple(found[:3].tolist()) if found[2] > SIGNIFICANT * error else None


class BoardDefocus:
    """Learns a camera's defocus from edges of the board, in frames in which that is elsewhere than in the others."""

    def __init__(self) -> None:
        self._places: list[Float64[np.ndarray, " 3"]] = []
        self._edges: list[EdgeStep] = []
        self.model: Defocus | None = None

    def wants(self, frame: ViewFrame) -> bool:
        """Tells whether a frame shows the board at a new place: edges of the same place all err alike."""
        place = _board_place(frame)
        if place is None or len(self._places) >= MOST_FRAMES:
            return False
        return all(np.linalg.norm(place - each) >= LEAST_STEP for each in self._places)

    def observe(self, frame: ViewFrame, edges: Sequence[EdgeStep]) -> None:
        """Takes the edges of a frame that is wanted; one that shows none well is not looked at again."""
        place = _board_place(frame)
        if place is not None:
            self._places.append(place)
            self._edges += edges
            self.model = fit_defocus(self._edges)


def _board_place(frame: ViewFrame) -> Float64[np.ndarray, " 3"] | None:
    """Returns where the board's middle is in the picture, in half diagonals, and its depth's logarithm."""
    if frame.board is None or frame.pose is None:
        return None
    middle = np.mean(list(frame.board.corner_points().values()), axis=(0, 1))
    from_world = np.linalg.inv(frame.pose.world_from_camera)
    seen = from_world[:3, :3] @ middle + from_world[:3, 3]
    if seen[2] <= 0:
        return None
    pixel = frame.camera.project(seen[None])[0] / _half_diagonal(frame.camera)
    return np.array([*pixel, np.log(seen[2])]) if np.isfinite(pixel).all() else None


def _half_diagonal(camera: CameraModel) -> float:
    return float(np.hypot(camera.width, camera.height) / 2)


@dataclass(frozen=True, eq=False)
class DistanceBlur:
    """What the objects of one frame get where defocus is known; motion and place as for `blur_kernels`."""

    defocus: Defocus
    lens: LensBlur
    motion_px: Float64[np.ndarray, " 2"]
    from_centre_px: Float64[np.ndarray, " 2"]

    def applied(
        self,
        color: Color,
        coverage: Coverage,
        depth_m: Float32[np.ndarray, "h w"],
        response: Float32[np.ndarray, "256 3"] | None,
    ) -> tuple[Color, Coverage]:
        """Returns `blurred` of a picture, each pixel of an object by its own depth (along the optical axis; 0: none).

        A pixel's blur is mixed of the two levels around it, by which its variance is met exactly.
        """
        known = (coverage > 0) & (depth_m > 0)
        if not known.any():
            return color, coverage
        variance = self.defocus.variance(1 / _continued(depth_m, known))
        sigma = np.sqrt(variance)
        low, high = sigma[coverage > 0].min(), sigma[coverage > 0].max()
        count = int(np.clip(np.ceil((high - low) / LEVEL_PX) + 1, 1, MOST_LEVELS))
        levels = np.linspace(low, high, count)
        kernels = [self._kernels(each) for each in levels]
        if all(each is None for each in kernels):
            return color, coverage
        hats = [np.interp(variance, levels**2, hat).astype(np.float32) for hat in np.eye(count)]
        parts = [(NO_BLUR if each is None else each, hat) for each, hat in zip(kernels, hats, strict=True)]
        return blurred_in_parts(color, coverage, parts, response)

    def _kernels(self, sigma_px: float) -> Float64[np.ndarray, "3 k k"] | None:
        return blur_kernels(replace(self.lens, sigma_px=sigma_px), self.motion_px, self.from_centre_px)


def _continued(
    depth_m: Float32[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> Float64[np.ndarray, "h w"]:
    """Returns the depth where `known`, and elsewhere that of the nearest such pixel; edges may have none."""
    unknown = (~known).astype(np.uint8)
    _, labels = cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    of_label = np.zeros(labels.max() + 1)
    of_label[labels[known]] = depth_m[known]
    return np.asarray(of_label[labels])
