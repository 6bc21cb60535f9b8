"""The camera of one picture: matrices and lens, as the passes need them; frames at other sizes."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from jaxtyping import Float64

from deltalight.protocol import short_axis
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.messages import MAX_CAMERAS, MAX_PART_BYTES
from deltalight.protocol.scene_output import Output
from deltalight.render_server.gpu.uniform_block import Block, Mat4, Vec2, Vec3, Vec4

NEAR_M = 0.02
FAR_M = 100.0
# Of so many lenses is kept what is the same in each frame: a room's cameras, at their own size and at the picture's.
LENSES_KEPT = 2 * MAX_CAMERAS
RECTANGLE_MARGIN_PX = 8  # a lens bends the edges between the corners of a box

Rectangle = tuple[int, int, int, int]  # first column and row, width and height
NOWHERE: Rectangle = (0, 0, 0, 0)


def union(one: Rectangle, other: Rectangle) -> Rectangle:
    """Returns the least rectangle that holds both."""
    if min(one[2:]) <= 0 or min(other[2:]) <= 0:
        return other if min(one[2:]) <= 0 else one
    x, y = min(one[0], other[0]), min(one[1], other[1])
    right, bottom = (max(one[axis] + one[axis + 2], other[axis] + other[axis + 2]) for axis in range(2))
    return x, y, right - x, bottom - y


@dataclass(frozen=True, eq=False)
class CameraBlock(Block):
    """Uniform block `Camera` (passes/shaders/common/camera.glsl)."""

    camera_from_world: Mat4
    world_from_camera: Mat4
    camera_pinhole: Vec4
    raster_pinhole: Vec4
    camera_position: Vec3
    picture_size: Vec2


@dataclass(frozen=True, eq=False)
class CameraView:
    """Pose and lens of a picture.

    `world_from_camera` is (4, 4), optical frame (+x right, +y down, +z forward). `antialiased`: the objects'
    geometry buffer is resolved from several samples per pixel, on the picture's own grid. `matting_px`: pixels from
    real things within which hair and fingers before objects are found by colour.
    """

    camera: CameraModel
    world_from_camera: Float64[np.ndarray, "4 4"]
    antialiased: bool = False
    matting_px: int = 0

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if not isinstance(other, CameraView):
            return NotImplemented
        same_kind = self.antialiased == other.antialiased and self.matting_px == other.matting_px
        return (
            same_kind
            and self.camera == other.camera
            and np.array_equal(self.world_from_camera, other.world_from_camera)
        )

    def __hash__(self) -> int:
        return hash((self.camera, self.world_from_camera.tobytes(), self.antialiased, self.matting_px))

    @cached_property
    def with_antialiasing(self) -> "CameraView":
        """Returns the view for stages that read an antialiased geometry buffer of the objects."""
        return self._altered(antialiased=True)

    @cached_property
    def without_antialiasing(self) -> "CameraView":
        """Returns the view for passes that raster the objects, or sample such a raster through the lens."""
        return self._altered(antialiased=False)

    def with_matting(self, reach_px: int) -> "CameraView":
        """Returns the view for stages that find mattes within `reach_px` pixels of real things; 0 = none."""
        return self._altered(matting_px=reach_px)

    def _altered(self, *, antialiased: bool | None = None, matting_px: int | None = None) -> "CameraView":
        """Returns the view with other options: itself if they are its own, else one that shares what it found."""
        wanted = (
            self.antialiased if antialiased is None else antialiased,
            self.matting_px if matting_px is None else matting_px,
        )
        if wanted == (self.antialiased, self.matting_px):
            return self
        altered = CameraView(self.camera, self.world_from_camera, *wanted)
        vars(altered)["camera_from_world"] = self.camera_from_world
        return altered

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.camera.width, self.camera.height

    @cached_property
    def camera_from_world(self) -> Float64[np.ndarray, "4 4"]:
        """Inverse of `world_from_camera`."""
        return np.linalg.inv(self.world_from_camera)

    @property
    def position(self) -> Float64[np.ndarray, "3"]:
        """Optical centre in the world, m."""
        return self.world_from_camera[:3, 3]

    @cached_property
    def raster(self) -> tuple[Float64[np.ndarray, "4"], tuple[int, int]]:
        """Pinhole (fx, fy, cx, cy) and size that cover every ray of the lens.

        The camera's own, grown by whole pixels: without distortion, each pixel centre is a texel centre.
        """
        return _raster_of(self.camera)

    @cached_property
    def clip_from_camera(self) -> Float64[np.ndarray, "4 4"]:
        """Projection of the raster pinhole; row 0 of the picture comes first in memory."""
        return _clip_from(self.camera)

    @cached_property
    def clip_from_world(self) -> Float64[np.ndarray, "4 4"]:
        """`clip_from_camera`, of points in the world."""
        return np.asarray(self.clip_from_camera @ self.camera_from_world)

    def rectangle_around(self, points: Float64[np.ndarray, "n 3"]) -> Rectangle:
        """Returns the pixels that can show the convex hull of world points.

        The whole picture if any of them lies behind the camera, (0, 0) in size if all lie beside the picture.
        """
        seen = self._in_camera(points)
        if seen is None:
            return _rectangle(None, self.size)
        # Far outside the picture a lens model may fold back into it.
        low, high = _ray_bounds(self.camera)
        rays = np.minimum(np.maximum(seen / seen[:, 2:], low), high)
        return _rectangle(self.camera.project(rays), self.size)

    def raster_rectangle_around(self, points: Float64[np.ndarray, "n 3"]) -> Rectangle:
        """Like `rectangle_around`, for the raster's texels."""
        seen = self._in_camera(points)
        (fx, fy, cx, cy), size = self.raster
        return _rectangle(seen[:, :2] / seen[:, 2:] * (fx, fy) + (cx, cy) if seen is not None else None, size)

    def _in_camera(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"] | None:
        """Returns world points in the optical frame; None if any of them lies behind the camera."""
        matrix = self.camera_from_world
        seen = points @ matrix[:3, :3].T + matrix[:3, 3]
        return None if (seen[:, 2] <= NEAR_M).any() else seen

    @property
    def raster_is_bent(self) -> bool:
        """Whether the objects' raster is sampled through the lens model."""
        return self.camera.has_distortion and not self.antialiased

    def block(self) -> CameraBlock:
        """Returns the camera's uniform block."""
        matrix = self.camera.matrix
        return CameraBlock(
            camera_from_world=self.camera_from_world,
            world_from_camera=self.world_from_camera,
            camera_pinhole=(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]),
            raster_pinhole=self.raster[0].tolist(),
            camera_position=self.position.tolist(),
            picture_size=self.size,
        )


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """A frame and the view that it was taken from."""

    frame: ViewFrame
    view: CameraView
    _sizes: dict[tuple[int, int], "PosedFrame"] = field(default_factory=dict, repr=False)

    def at(self, size: tuple[int, int]) -> "PosedFrame":
        """Returns the same at another size (width, height); the same object each time."""
        if size == self.view.size:
            return self
        if size not in self._sizes:
            frame = resized_frame(self.frame, *size)
            self._sizes[size] = PosedFrame(frame, replace(self.view, camera=frame.camera))
        return self._sizes[size]


def scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Returns a picture size at that scale."""
    return max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)


def output_size(frame: ViewFrame, output: Output) -> tuple[int, int]:
    """Returns width and height of the composite; a missing one follows from the camera's aspect ratio.

    Raises:
        DeltalightError: no message holds a picture of that size.
    """
    camera = frame.camera
    if output.width is None and output.height is None:
        return camera.width, camera.height
    width = output.width or max(round(camera.width * (output.height or 0) / camera.height), 1)
    height = output.height or max(round(camera.height * width / camera.width), 1)
    if 3 * width * height > MAX_PART_BYTES:
        raise DeltalightError(
            f"A picture of {width} x {height} pixels is asked for, and {MAX_PART_BYTES // 3e6:.0f} million are the "
            "most: lower output.width and output.height."
        )
    return width, height


def resized_frame(frame: ViewFrame, width: int, height: int) -> ViewFrame:
    """Resizes a frame: colour averaged over areas, depth from the nearest pixel."""
    camera, depth = frame.camera.resized(width, height), frame.depth
    if depth is not None:
        depth = replace(depth.resized(width, height), camera=camera)
    color = cv2.resize(frame.color, (width, height), interpolation=cv2.INTER_AREA)
    return replace(frame, color=color, camera=camera, depth=depth)


@lru_cache(maxsize=LENSES_KEPT)
def _ray_extremes(camera: CameraModel) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
    """Returns the least and greatest (x/z, y/z) of the pixels' centres."""
    rays = camera.rays().reshape(-1, 2)
    return rays.min(axis=0), rays.max(axis=0)


@lru_cache(maxsize=LENSES_KEPT)
def _raster_of(camera: CameraModel) -> tuple[Float64[np.ndarray, "4"], tuple[int, int]]:
    """Returns the raster of a lens."""
    matrix = camera.matrix
    own = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    if not camera.has_distortion:
        return own, (camera.width, camera.height)
    least, greatest = _ray_extremes(camera)
    low = np.floor(least * own[:2] + own[2:]) - 1
    high = np.ceil(greatest * own[:2] + own[2:]) + 1
    width, height = (int(v) + 1 for v in high - low)
    return np.array([*own[:2], *(own[2:] - low)]), (width, height)


@lru_cache(maxsize=LENSES_KEPT)
def _clip_from(camera: CameraModel) -> Float64[np.ndarray, "4 4"]:
    """Returns the projection of a lens' raster."""
    (fx, fy, cx, cy), (width, height) = _raster_of(camera)
    depth = (FAR_M + NEAR_M) / (FAR_M - NEAR_M)
    return np.array(
        [
            [2 * fx / width, 0, (2 * cx + 1) / width - 1, 0],
            [0, 2 * fy / height, (2 * cy + 1) / height - 1, 0],
            [0, 0, depth, -2 * FAR_M * NEAR_M / (FAR_M - NEAR_M)],
            [0, 0, 1, 0],
        ]
    )


@lru_cache(maxsize=LENSES_KEPT)
def _ray_bounds(camera: CameraModel) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Returns the least and greatest (x/z, y/z, 1) that the picture shows, two pixels wider."""
    (low, high), margin = _ray_extremes(camera), 2 / camera.matrix[[0, 1], [0, 1]]
    return np.append(low - margin, 1.0), np.append(high + margin, 1.0)


def _rectangle(places: Float64[np.ndarray, "n 2"] | None, size: tuple[int, int]) -> Rectangle:
    """Returns the rectangle around positions, with a margin; the whole picture if none is finite."""
    if places is None:
        return 0, 0, *size
    lows, highs = (each.tolist() for each in short_axis.bounds(places))
    if not all(map(math.isfinite, (*lows, *highs))):
        return 0, 0, *size
    x, y = (_within(math.floor(low) - RECTANGLE_MARGIN_PX, end) for low, end in zip(lows, size, strict=True))
    right, bottom = (
        _within(math.ceil(high) + RECTANGLE_MARGIN_PX, end) for high, end in zip(highs, size, strict=True)
    )
    return x, y, right - x, bottom - y


def _within(place: int, end: int) -> int:
    return min(max(place, 0), end)
