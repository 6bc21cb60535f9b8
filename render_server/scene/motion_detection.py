"""Detects when the real scene or the camera has moved, and when a kept real scene no longer explains a frame."""

import math
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64

from deltalight.protocol import short_axis
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage, ViewFrame, decode_lut
from deltalight.render_server.scene.depth_surface import MAX_SLOPE, noise_sigma
from deltalight.render_server.scene.threads import submit
from deltalight.render_server.view import LENSES_KEPT

GRID_STEP_PX = 4
SAMPLED = np.s_[GRID_STEP_PX // 2 :: GRID_STEP_PX, GRID_STEP_PX // 2 :: GRID_STEP_PX]  # the blocks' middles


@dataclass(frozen=True)
class MotionThresholds:
    """Thresholds beyond which the scene has changed.

    `image_motion_px`: motion of the picture by the change of pose alone, pixels (> 0).
    `depth_sigmas`: a depth sample has moved beyond this many standard deviations of a difference;
    `depth_fraction`: fraction of the samples that may (0..1). `color_noise`: standard deviation of linear colour at
    1.0, falling with its square root (shot noise; camera units); `color_sigmas`, `color_fraction` as for depth.
    `unseen_fraction`: fraction of a moving camera's samples that a kept scene need not hold (0..1).
    """

    image_motion_px: float = 0.5
    depth_sigmas: float = 3.0
    depth_fraction: float = 0.02
    color_noise: float = 0.02
    color_sigmas: float = 4.0
    color_fraction: float = 0.005
    unseen_fraction: float = 0.1


@dataclass(frozen=True, eq=False)
class FrameSamples:
    """A frame on a grid of GRID_STEP_PX pixels, sampled when asked: of a moving camera, poses alone tell enough."""

    frame: ViewFrame

    @cached_property
    def color(self) -> Float32[np.ndarray, "gh gw 3"]:
        """Mean linear colour."""
        return _downsampled_color(self.frame)

    @cached_property
    def inverse_depth(self) -> Float32[np.ndarray, "gh gw"] | None:
        """Inverse depth (1/m, 0 = unknown); None if the frame has no depth."""
        return _subsampled_inverse_depth(self.frame.depth)

    @cached_property
    def _known(self) -> Float32[np.ndarray, " n"]:
        """Inverse depths that are known."""
        return (
            np.zeros(0, np.float32)
            if self.inverse_depth is None
            else self.inverse_depth[self.inverse_depth > 0]
        )

    @cached_property
    def mean_distance(self) -> float:
        """The mean distance; without depth that of the world's origin."""
        inverse = self.inverse_depth
        known = 0 if inverse is None else int(np.count_nonzero(inverse))
        if inverse is not None and known:
            return known / float(inverse.sum(dtype=np.float64))
        assert self.frame.pose is not None
        return max(float(np.linalg.norm(self.frame.pose.world_from_camera[:3, 3])), 0.1)

    @cached_property
    def near_distance(self) -> float | None:
        """The nearest distance (5 % are nearer); None without depth."""
        return float(1 / np.percentile(self._known, 95)) if self._known.size else None

    @cached_property
    def depth_range(self) -> tuple[Float32[np.ndarray, "gh gw"], Float32[np.ndarray, "gh gw"]]:
        """Least and greatest known inverse depth of each sample and its eight neighbours; 0 where none is known."""
        assert self.inverse_depth is not None
        kernel, known = np.ones((3, 3), np.uint8), self.inverse_depth > 0
        far = cv2.erode(np.where(known, self.inverse_depth, np.float32(np.inf)), kernel)
        return np.where(np.isfinite(far), far, np.float32(0)), np.asarray(
            cv2.dilate(self.inverse_depth, kernel)
        )

    @cached_property
    def color_range(self) -> tuple[Float32[np.ndarray, "gh gw 3"], Float32[np.ndarray, "gh gw 3"]]:
        """Least and greatest colour of the blocks anywhere within each sample's block and its eight neighbours.

        Blocks at every pixel: what is narrower than two blocks may fill one that another view's grid cuts out, and
        none of this one's.
        """
        means = cv2.blur(_linear_color(self.frame), (GRID_STEP_PX, GRID_STEP_PX))
        places = np.ones((2 * GRID_STEP_PX + 1, 2 * GRID_STEP_PX + 1), np.uint8)
        low, high = (each[SAMPLED] for each in (cv2.erode(means, places), cv2.dilate(means, places)))
        return np.ascontiguousarray(low), np.ascontiguousarray(high)


class MotionDetector:
    """Compares each frame with the one that the real scene was last built from.

    Changes are measured against that frame, not the previous one, so that slow drift is found as well.
    Deterministic: the same frames in the same order give the same answers.
    """

    def __init__(self, thresholds: MotionThresholds | None = None) -> None:
        self._thresholds = thresholds or MotionThresholds()
        self._reference: FrameSamples | None = None
        self._expected: tuple[FrameSamples, Future[bool]] | None = None  # and whether it has changed

    def expect(self, coming: FrameSamples) -> None:
        """Begins to compare the frame that is taken next, on another thread."""
        if self._reference is not None:
            compare = partial(_has_changed, self._reference, coming, self._thresholds)
            self._expected = coming, submit(compare)

    def update(self, current: FrameSamples) -> bool:
        """Returns whether anything moved; if so, the frame becomes the reference."""
        expected, self._expected = self._expected, None
        if expected is not None and expected[0] is current:
            changed = expected[1].result()
        else:
            changed = self._reference is None or _has_changed(self._reference, current, self._thresholds)
        if changed:
            self._reference = current
        return changed


def _has_changed(old: FrameSamples, new: FrameSamples, thresholds: MotionThresholds) -> bool:
    """Returns whether two frames differ by more than noise."""
    before, after = old.frame, new.frame
    return (
        before.camera != after.camera
        or (before.depth is None) != (after.depth is None)
        or _moves_more(old, new, thresholds.image_motion_px)
        or _moved_fraction(old, new, thresholds) > thresholds.depth_fraction
        or _recolored_fraction(old, new, thresholds) > thresholds.color_fraction
    )


def _moved_fraction(old: FrameSamples, new: FrameSamples, thresholds: MotionThresholds) -> float:
    """Returns the fraction of common samples whose inverse depth differs by more than noise explains."""
    before, after, depth = old.inverse_depth, new.inverse_depth, new.frame.depth
    if before is None or after is None or depth is None:
        return 0.0
    if before.shape != after.shape:
        return 1.0
    both = (before > 0) & (after > 0)
    moved = both & (np.abs(after - before) > _depth_limit(depth, thresholds))
    return float(np.count_nonzero(moved)) / max(int(np.count_nonzero(both)), 1)


def _depth_limit(depth: DepthImage, thresholds: MotionThresholds) -> float:
    """Returns the difference of inverse depths that noise explains."""
    return thresholds.depth_sigmas * float(np.sqrt(2)) * noise_sigma(depth)


def _recolored_fraction(old: FrameSamples, new: FrameSamples, thresholds: MotionThresholds) -> float:
    """Returns the fraction of block means whose linear colour differs in any channel by more than noise explains.

    A block's mean has the noise of a pixel divided by the block's edge; codecs leave some more.
    """
    limit = _color_limit(old.color, thresholds)
    return float(short_axis.any_of(np.abs(new.color - old.color) > limit).mean())


class KeptWorld:
    """Tells whether the real scene, as built from an earlier frame, still explains what the camera sees.

    Seen from the same place, a frame may differ by no more than noise (MotionThresholds). Seen from elsewhere, its
    samples are looked up in the frame that the scene was built from.
    """

    def __init__(self, thresholds: MotionThresholds | None = None) -> None:
        self._thresholds = thresholds or MotionThresholds()
        self.built_from: FrameSamples | None = None
        self._newest: _Comparison | None = None

    def explains(self, new: FrameSamples) -> bool:
        """Returns whether the scene need not be rebuilt; without depth, while the picture has moved little."""
        return self._compare(new).explains.result()

    def explained_before(self, new: FrameSamples) -> bool:
        """Returns whether the scene explained the frame before; compares this one meanwhile, on another thread.

        For renderers that finish a frame in a fraction of the camera's frame time.
        """
        before = self._newest
        self._compare(new)
        return before is None or before.old is not self.built_from or before.explains.result()

    def _compare(self, new: FrameSamples) -> "_Comparison":
        old, newest = self.built_from, self._newest
        if newest is None or newest.old is not old or newest.new is not new:
            newest = _Comparison(old, new, submit(partial(_explains, old, new, self._thresholds)))
            self._newest = newest
        return newest


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Whether the scene built from one frame explains another; None if no scene was built."""

    old: FrameSamples | None
    new: FrameSamples
    explains: Future[bool]


def _explains(old: FrameSamples | None, new: FrameSamples, thresholds: MotionThresholds) -> bool:
    if old is None or old.frame.camera != new.frame.camera:
        return False
    motion_px = max(_image_motions(old, new))
    if motion_px <= thresholds.image_motion_px:
        return not _has_changed(old, new, thresholds)
    if old.inverse_depth is None or new.inverse_depth is None:
        return motion_px <= thresholds.unseen_fraction * new.frame.camera.width
    appeared, unseen = _compared(old, new, thresholds)
    return appeared <= thresholds.depth_fraction and unseen <= thresholds.unseen_fraction


def _compared(old: FrameSamples, new: FrameSamples, thresholds: MotionThresholds) -> tuple[float, float]:
    """Returns fractions of the samples with depth, seen from another place than the old frame's.

    The first: what has appeared before the old surface, or has another colour than anything around it had. The
    second: what the old frame did not show, or showed something else before it.
    """
    assert old.inverse_depth is not None
    assert new.inverse_depth is not None
    assert new.frame.depth is not None
    samples, cells, inverse = _reprojected(old, new)
    tilt = MAX_SLOPE * GRID_STEP_PX / new.frame.camera.matrix[0, 0]
    limit = _depth_limit(new.frame.depth, thresholds) + tilt * inverse
    farthest, nearest = (edge.ravel()[cells] for edge in old.depth_range)
    low, high = (edge.reshape(-1, 3).take(cells, axis=0) for edge in old.color_range)
    seen, excess = old.inverse_depth.ravel()[cells] > 0, inverse - limit
    same_place = seen & (inverse >= farthest - limit) & (excess <= nearest)
    spare = _color_limit(old.color.reshape(-1, 3).take(cells, axis=0), thresholds)
    color = new.color.reshape(-1, 3).take(samples, axis=0)
    recolored = short_axis.any_of((color < low - spare) | (color > high + spare))
    appeared = (seen & (excess > nearest)) | (same_place & recolored)
    total = max(int(np.count_nonzero(new.inverse_depth)), 1)
    unseen = total - int(np.count_nonzero(same_place | appeared))
    return float(np.count_nonzero(appeared)) / total, unseen / total


def _color_limit(
    color: Float32[np.ndarray, "*n 3"], thresholds: MotionThresholds
) -> Float32[np.ndarray, "*n 3"]:
    """Returns the difference of block means that noise explains: of half the deviation of a pixel's."""
    sigmas = thresholds.color_sigmas * math.sqrt(2) * thresholds.color_noise / 2
    return np.asarray(sigmas * np.sqrt(np.maximum(color, np.float32(0.01))))


def _reprojected(
    old: FrameSamples, new: FrameSamples
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Places the samples of `new` with depth in the picture of `old`.

    Returns those that it shows, the cells that show them (both counted row by row), and their inverse depths there.
    """
    assert new.inverse_depth is not None
    assert old.frame.pose is not None
    assert new.frame.pose is not None
    camera, (rows, columns) = new.frame.camera, new.inverse_depth.shape
    inverse = new.inverse_depth.ravel().astype(np.float64)
    old_from_new = np.linalg.inv(old.frame.pose.world_from_camera) @ new.frame.pose.world_from_camera
    # Scaled by inverse depth, so that nothing is divided by where there is none.
    x, y, z = old_from_new[:3, :3] @ _sample_rays(camera, (rows, columns)) + old_from_new[:3, 3:] * inverse
    fx, fy, cx, cy = camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    scale = 1 / np.maximum(z, 1e-6)
    column, row = (
        np.floor((across * scale * focal + centre) / GRID_STEP_PX)
        for across, focal, centre in ((x, fx, cx), (y, fy, cy))
    )
    shown = (inverse > 0) & (z > 0) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    samples = np.flatnonzero(shown)
    cells = (row[samples] * columns + column[samples]).astype(np.int64)
    return samples, cells, inverse[samples] * scale[samples]


@lru_cache(maxsize=LENSES_KEPT)
def _sample_rays(camera: CameraModel, shape: tuple[int, int]) -> Float64[np.ndarray, "3 n"]:
    """Returns (x/z, y/z, 1) of the grid's pixels, row by row, of which every fourth has its depth."""
    first = GRID_STEP_PX // 2
    columns, rows = (first + GRID_STEP_PX * np.arange(count) for count in shape[::-1])
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(float)
    rays = camera.unproject(pixels)
    return np.ascontiguousarray(np.column_stack([rays, np.ones(len(rays))]).T)


def _grid_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    """Returns rows and columns of a picture's whole blocks of GRID_STEP_PX pixels; what is left over is ignored."""
    return max(shape[0] // GRID_STEP_PX, 1), max(shape[1] // GRID_STEP_PX, 1)


def _linear_color(frame: ViewFrame) -> Float32[np.ndarray, "h w 3"]:
    """Returns linear colour of the whole blocks."""
    rows, columns = _grid_shape(frame.color.shape)
    table = decode_lut(frame.response)[None] / np.float32(frame.exposure_scale)
    return np.asarray(cv2.LUT(frame.color[: GRID_STEP_PX * rows, : GRID_STEP_PX * columns], table))


def _downsampled_color(frame: ViewFrame) -> Float32[np.ndarray, "gh gw 3"]:
    """Returns linear colour averaged over blocks of GRID_STEP_PX pixels."""
    rows, columns = _grid_shape(frame.color.shape)
    return np.asarray(cv2.resize(_linear_color(frame), (columns, rows), interpolation=cv2.INTER_AREA))


def _subsampled_inverse_depth(depth: DepthImage | None) -> Float32[np.ndarray, "gh gw"] | None:
    """Returns 1/z in the middle of each block, 0 where unknown."""
    if depth is None:
        return None
    rows, columns = _grid_shape(depth.depth_m.shape)
    metres = depth.depth_m[SAMPLED][:rows, :columns]
    known = depth.valid[SAMPLED][:rows, :columns] & (metres > 0)
    inverse = np.zeros_like(metres, np.float32)
    np.divide(1, metres, out=inverse, where=known)
    return inverse


def _moves_more(old: FrameSamples, new: FrameSamples, limit_px: float) -> bool:
    """Returns whether the change of pose moves the picture by more than `limit_px` pixels."""
    return any(motion_px > limit_px for motion_px in _image_motions(old, new))


def _image_motions(old: FrameSamples, new: FrameSamples) -> Iterator[float]:
    """Yields the greatest motion in pixels of points at each of the scene's distances between two poses.

    Points on a coarse grid of pixels are placed at the mean and at the nearest distance of the old frame.
    """
    before, after = old.frame, new.frame
    if before.pose is None or after.pose is None:
        yield 0.0 if before.pose is after.pose else np.inf
        return
    from_old, from_new = before.pose.world_from_camera, after.pose.world_from_camera
    if np.array_equal(from_old, from_new):
        yield 0.0
        return
    pixels, rays = _coarse_rays(before.camera)
    new_from_old = np.linalg.inv(from_new) @ from_old
    for distance in _distances(old):
        points = distance * rays @ new_from_old[:3, :3].T + new_from_old[:3, 3]
        motion_px = float(short_axis.lengths(before.camera.project(points) - pixels).max())
        yield math.inf if math.isnan(motion_px) else motion_px


@lru_cache(maxsize=LENSES_KEPT)
def _coarse_rays(camera: CameraModel) -> tuple[Float64[np.ndarray, "25 2"], Float64[np.ndarray, "25 3"]]:
    """Returns pixels all over the picture and (x/z, y/z, 1) of their rays."""
    columns, rows = np.linspace(0, camera.width - 1, 5), np.linspace(0, camera.height - 1, 5)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    return pixels, np.column_stack([camera.unproject(pixels), np.ones(len(pixels))])


def _distances(samples: FrameSamples) -> Iterator[float]:
    """Yields the mean distance and the nearest, if one is known."""
    yield samples.mean_distance
    if samples.near_distance is not None:
        yield samples.near_distance
