"""Detects when the real scene has changed since the renderer last built geometry and light from it."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from protocol.frames import DepthImage, ViewFrame, decode_lut
from render_server.scene.depth_surface import noise_sigma

GRID_STEP_PX = 4


@dataclass(frozen=True)
class MotionThresholds:
    """Thresholds beyond which the scene has changed.

    `image_motion_px`: motion of the picture by the change of pose alone, pixels (> 0).
    `depth_sigmas`: a depth sample has moved beyond this many standard deviations of a difference;
    `depth_fraction`: fraction of the samples that may (0..1). `color_noise`: standard deviation of linear colour at
    1.0, falling with its square root (shot noise; camera units); `color_sigmas`, `color_fraction` as for depth.
    """

    image_motion_px: float = 0.5
    depth_sigmas: float = 3.0
    depth_fraction: float = 0.02
    color_noise: float = 0.02
    color_sigmas: float = 4.0
    color_fraction: float = 0.005


@dataclass(frozen=True, eq=False)
class _Reference:
    """The frame that the scene was last built from, subsampled."""

    frame: ViewFrame
    color: Float32[np.ndarray, "gh gw 3"]
    inverse_depth: Float32[np.ndarray, "gh gw"] | None


class MotionDetector:
    """Compares each frame with the one that the real scene was last built from.

    Changes are measured against that frame, not the previous one, so that slow drift is found as well.
    Deterministic: the same frames in the same order give the same answers.
    """

    def __init__(self, thresholds: MotionThresholds | None = None) -> None:
        self._thresholds = thresholds or MotionThresholds()
        self._reference: _Reference | None = None

    def update(self, frame: ViewFrame) -> bool:
        """Returns whether the real scene must be rebuilt; if so, `frame` becomes the reference."""
        current = _Reference(frame, _downsampled_color(frame), _subsampled_inverse_depth(frame.depth))
        if self._reference is not None and not self._changed(self._reference, current):
            return False
        self._reference = current
        return True

    def _changed(self, old: _Reference, new: _Reference) -> bool:
        before, after = old.frame, new.frame
        return (
            before.camera != after.camera
            or (before.depth is None) != (after.depth is None)
            or _image_motion(before, after, old.inverse_depth) > self._thresholds.image_motion_px
            or self._moved_fraction(old, new) > self._thresholds.depth_fraction
            or self._recolored_fraction(old, new) > self._thresholds.color_fraction
        )

    def _moved_fraction(self, old: _Reference, new: _Reference) -> float:
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

    def _recolored_fraction(self, old: _Reference, new: _Reference) -> float:
        """Returns the fraction of block means whose linear colour differs in any channel by more than noise explains.

        A block's mean has the noise of a pixel divided by the block's edge; codecs leave some more.
        """
        sigma = self._thresholds.color_noise * np.sqrt(np.maximum(old.color, 0.01)) / 2
        limit = self._thresholds.color_sigmas * np.sqrt(2) * sigma
        return float((np.abs(new.color - old.color) > limit).any(axis=-1).mean())


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
