"""Detects when the real scene or the camera has moved, and when a kept real scene no longer explains a frame."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from protocol.camera_model import CameraModel
from protocol.frames import DepthImage, ViewFrame, decode_lut
from render_server.scene.depth_surface import MAX_SLOPE_DEG, noise_sigma

GRID_STEP_PX = 4


@dataclass(frozen=True)
class MotionThresholds:
    """Thresholds beyond which the scene has changed.

    `image_motion_px`: motion of the picture by the change of pose alone, pixels (> 0).
    `depth_sigmas`: a depth sample has moved beyond this many standard deviations of a difference;
    `depth_fraction`: fraction of the samples that may (0..1). `color_noise`: standard deviation of linear colour at
    1.0, falling with its square root (shot noise; camera units); `color_sigmas`, `color_fraction` as for depth.
    `unexplained_fraction`: fraction of a moving camera's samples that a kept scene need not explain (0..1).
    """

    image_motion_px: float = 0.5
    depth_sigmas: float = 3.0
    depth_fraction: float = 0.02
    color_noise: float = 0.02
    color_sigmas: float = 4.0
    color_fraction: float = 0.005
    unexplained_fraction: float = 0.1


@dataclass(frozen=True, eq=False)
class FrameSamples:
    """A frame on a grid of GRID_STEP_PX pixels: mean linear colour, and inverse depth (0 = unknown)."""

    frame: ViewFrame
    color: Float32[np.ndarray, "gh gw 3"]
    inverse_depth: Float32[np.ndarray, "gh gw"] | None

    @staticmethod
    def of(frame: ViewFrame) -> "FrameSamples":
        """Samples a frame."""
        return FrameSamples(frame, _downsampled_color(frame), _subsampled_inverse_depth(frame.depth))

    @cached_property
    def color_range(self) -> tuple[Float32[np.ndarray, "gh gw 3"], Float32[np.ndarray, "gh gw 3"]]:
        """Least and greatest colour of each sample and its eight neighbours."""
        kernel = np.ones((3, 3), np.uint8)
        return np.asarray(cv2.erode(self.color, kernel)), np.asarray(cv2.dilate(self.color, kernel))


class MotionDetector:
    """Compares each frame with the one that the real scene was last built from.

    Changes are measured against that frame, not the previous one, so that slow drift is found as well.
    Deterministic: the same frames in the same order give the same answers.
    """

    def __init__(self, thresholds: MotionThresholds | None = None) -> None:
        self._thresholds = thresholds or MotionThresholds()
        self._reference: FrameSamples | None = None

    def update(self, current: FrameSamples) -> bool:
        """Returns whether anything moved; if so, the frame becomes the reference."""
        if self._reference is not None and not self._changed(self._reference, current):
            return False
        self._reference = current
        return True

    def _changed(self, old: FrameSamples, new: FrameSamples) -> bool:
        before, after = old.frame, new.frame
        return (
            before.camera != after.camera
            or (before.depth is None) != (after.depth is None)
            or _image_motion(before, after, old.inverse_depth) > self._thresholds.image_motion_px
            or self._moved_fraction(old, new) > self._thresholds.depth_fraction
            or self._recolored_fraction(old, new) > self._thresholds.color_fraction
        )

    def _moved_fraction(self, old: FrameSamples, new: FrameSamples) -> float:
        """Returns the fraction of common samples whose inverse depth differs by more than noise explains."""
        before, after, depth = old.inverse_depth, new.inverse_depth, new.frame.depth
        if before is None or after is None or depth is None:
            return 0.0
        if before.shape != after.shape:
            return 1.0
        both = (before > 0) & (after > 0)
        limit = self._thresholds.depth_sigmas * np.sqrt(2) * noise_sigma(depth)
        moved = both & (np.abs(after - before) > limit)
        return float(np.count_nonzero(moved)) / max(int(np.count_nonzero(both)), 1)

    def _recolored_fraction(self, old: FrameSamples, new: FrameSamples) -> float:
        """Returns the fraction of block means whose linear colour differs in any channel by more than noise explains.

        A block's mean has the noise of a pixel divided by the block's edge; codecs leave some more.
        """
        limit = _color_limit(old.color, self._thresholds)
        return float((np.abs(new.color - old.color) > limit).any(axis=-1).mean())


class KeptWorld:
    """Tells whether the real scene, as built from an earlier frame, still explains what the camera sees.

    The samples of a new frame are looked up in the frame that the scene was built from. One is explained if that
    frame shows it, at its depth, in a colour that its surroundings have there.
    """

    def __init__(self, thresholds: MotionThresholds | None = None) -> None:
        self._thresholds = thresholds or MotionThresholds()
        self.built_from: FrameSamples | None = None

    def explains(self, new: FrameSamples) -> bool:
        """Returns whether at most `unexplained_fraction` of the samples with depth are unexplained.

        Without depth, whether the picture has moved by at most that fraction of its width.
        """
        old = self.built_from
        if old is None or old.frame.camera != new.frame.camera:
            return False
        return self._unexplained_fraction(old, new) <= self._thresholds.unexplained_fraction

    def _unexplained_fraction(self, old: FrameSamples, new: FrameSamples) -> float:
        motion_px = _image_motion(old.frame, new.frame, old.inverse_depth)
        if old.inverse_depth is None or new.inverse_depth is None or new.frame.depth is None:
            return motion_px / new.frame.camera.width if motion_px > self._thresholds.image_motion_px else 1.0
        cells, inverse, known = _reprojected(old, new)
        before = old.inverse_depth[cells]
        tilt = np.tan(np.radians(MAX_SLOPE_DEG)) * GRID_STEP_PX / new.frame.camera.matrix[0, 0]
        limit = self._thresholds.depth_sigmas * np.sqrt(2) * noise_sigma(new.frame.depth) + tilt * inverse
        same_place = (before > 0) & (np.abs(before - inverse) <= limit)
        low, high = (edge[cells] for edge in old.color_range)
        color, spare = new.color[known], _color_limit(old.color[cells], self._thresholds)
        same_color = ((color >= low - spare) & (color <= high + spare)).all(axis=-1)
        total = int(np.count_nonzero(new.inverse_depth))
        return 1 - float(np.count_nonzero(same_place & same_color)) / max(total, 1)


def _color_limit(
    color: Float32[np.ndarray, "*n 3"], thresholds: MotionThresholds
) -> Float32[np.ndarray, "*n 3"]:
    """Returns the difference of block means that noise explains: of half the deviation of a pixel's."""
    sigma = thresholds.color_noise * np.sqrt(np.maximum(color, 0.01)) / 2
    return np.asarray(thresholds.color_sigmas * np.sqrt(2) * sigma)


def _reprojected(
    old: FrameSamples, new: FrameSamples
) -> tuple[tuple[np.ndarray, np.ndarray], Float64[np.ndarray, " n"], Bool[np.ndarray, "gh gw"]]:
    """Places the samples of `new` with depth in the picture of `old`.

    Returns the cells (row, column) and inverse depths of those that it shows, and which samples they are.
    """
    assert new.inverse_depth is not None
    assert old.frame.pose is not None
    assert new.frame.pose is not None
    camera, inverse = new.frame.camera, new.inverse_depth
    known = inverse > 0
    points = _sample_rays(camera, inverse.shape)[known] / inverse[known][:, None]
    old_from_new = np.linalg.inv(old.frame.pose.world_from_camera) @ new.frame.pose.world_from_camera
    moved = np.einsum("ni,ji->nj", points, old_from_new[:3, :3]) + old_from_new[:3, 3]
    ahead = np.maximum(moved[:, 2], 1e-6)
    fx, fy, cx, cy = camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    column = np.floor((moved[:, 0] / ahead * fx + cx) / GRID_STEP_PX).astype(int)
    row = np.floor((moved[:, 1] / ahead * fy + cy) / GRID_STEP_PX).astype(int)
    shown = (
        (moved[:, 2] > 0) & (row >= 0) & (row < len(inverse)) & (column >= 0) & (column < inverse.shape[1])
    )
    chosen = np.zeros_like(known)
    chosen[known] = shown
    return (row[shown], column[shown]), 1 / ahead[shown], chosen


@lru_cache(maxsize=2)
def _sample_rays(camera: CameraModel, shape: tuple[int, int]) -> Float64[np.ndarray, "gh gw 3"]:
    """Returns (x/z, y/z, 1) of the grid's pixels, of which every fourth has its depth."""
    first = GRID_STEP_PX // 2
    columns, rows = (first + GRID_STEP_PX * np.arange(count) for count in shape[::-1])
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(float)
    rays = camera.unproject(pixels)
    return np.column_stack([rays, np.ones(len(rays))]).reshape(*shape, 3)


def _downsampled_color(frame: ViewFrame) -> Float32[np.ndarray, "gh gw 3"]:
    """Returns linear colour averaged over blocks of 4 x 4 pixels."""
    height, width = frame.color.shape[:2]
    size = (max(width // GRID_STEP_PX, 1), max(height // GRID_STEP_PX, 1))
    table = decode_lut(frame.response)[None] / np.float32(frame.exposure_scale)
    linear = cv2.LUT(frame.color, table)
    return np.asarray(cv2.resize(linear, size, interpolation=cv2.INTER_AREA))


def _subsampled_inverse_depth(depth: DepthImage | None) -> Float32[np.ndarray, "gh gw"] | None:
    """Returns 1/z of every fourth pixel, 0 where unknown."""
    if depth is None:
        return None
    grid = np.s_[GRID_STEP_PX // 2 :: GRID_STEP_PX, GRID_STEP_PX // 2 :: GRID_STEP_PX]
    metres = depth.depth_m[grid]
    known = depth.valid[grid] & (metres > 0)
    inverse = np.zeros_like(metres, np.float32)
    np.divide(1, metres, out=inverse, where=known)
    return inverse


def _image_motion(
    before: ViewFrame, after: ViewFrame, inverse_depth: Float32[np.ndarray, "gh gw"] | None
) -> float:
    """Returns the greatest motion in pixels of points at the scene's distance between two poses.

    Points on a coarse grid of pixels are placed at the nearest and at the mean distance of the old frame.
    """
    if before.pose is None or after.pose is None:
        return 0.0 if before.pose is after.pose else np.inf
    old, new = before.pose.world_from_camera, after.pose.world_from_camera
    if np.array_equal(old, new):
        return 0.0
    camera = before.camera
    columns, rows = np.linspace(0, camera.width - 1, 5), np.linspace(0, camera.height - 1, 5)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = np.column_stack([camera.unproject(pixels), np.ones(len(pixels))])
    new_from_old = np.linalg.inv(new) @ old
    motion = 0.0
    for distance in _distances(inverse_depth, old):
        points = distance * rays @ new_from_old[:3, :3].T + new_from_old[:3, 3]
        shift = np.linalg.norm(camera.project(points) - pixels, axis=1)
        motion = max(motion, float(np.nan_to_num(shift, nan=np.inf).max()))
    return motion


def _distances(
    inverse_depth: Float32[np.ndarray, "gh gw"] | None, world_from_camera: Float64[np.ndarray, "4 4"]
) -> tuple[float, ...]:
    """Returns the nearest (5 % are nearer) and the mean distance; without depth that of the world's origin."""
    known = np.zeros(0) if inverse_depth is None else inverse_depth[inverse_depth > 0]
    if known.size == 0:
        return (max(float(np.linalg.norm(world_from_camera[:3, 3])), 0.1),)
    return float(1 / np.percentile(known, 95)), float(1 / known.mean(dtype=np.float64))
