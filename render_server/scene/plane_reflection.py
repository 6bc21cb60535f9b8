"""Predicts what a smooth plane should reflect, by mirroring what the same picture shows elsewhere."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from deltalight.protocol.frames import linear_color
from deltalight.render_server.scene.depth_surface import noise_sigma
from deltalight.render_server.view import PosedFrame

CELL_PX = 2  # of the grid that mirrored points fall on, which are farther apart than pixels
NOISES = 3.0  # standard deviations of depth beside the plane's tolerance
FRONT = 1.05  # up to which multiple of the least depth in a cell points count as the nearest surface


@dataclass(frozen=True, eq=False)
class MirrorPlane:
    """A declared plane: a point (m) and its unit normal, reflectance at normal incidence R G B, and roughness.

    `tolerance_m`: what lies nearer to the plane is part of it.
    """

    point: Float64[np.ndarray, "3"]
    normal: Float64[np.ndarray, "3"]
    f0: Float64[np.ndarray, "3"]
    roughness: float
    tolerance_m: float


@dataclass(frozen=True, eq=False)
class PlaneReflection:
    """Of each pixel: whether it shows the plane, the picture, and the part of it that should be a reflection.

    `picture` and `expected` are linear, camera units; `expected` is known where `known`, on the plane or not.
    """

    on_plane: Bool[np.ndarray, "h w"]
    picture: Float32[np.ndarray, "h w 3"]
    expected: Float32[np.ndarray, "h w 3"]
    known: Bool[np.ndarray, "h w"]


def plane_reflection(seen: PosedFrame, plane: MirrorPlane) -> PlaneReflection | None:
    """Predicts a plane's reflection from a frame with depth; None if nothing that the picture shows is mirrored.

    Each measured point in front of the plane is mirrored and projected; of those in a cell, the nearest count. Its
    radiance towards the plane is taken to be that towards the camera.
    """
    depth, pose = seen.frame.depth, seen.view.world_from_camera
    assert depth is not None
    valid = depth.valid & (depth.depth_m > 0)
    rays = np.dstack([depth.camera.rays(), np.ones_like(depth.depth_m)]) @ pose[:3, :3].T
    points = rays * depth.depth_m[..., None] + pose[:3, 3]
    side = np.sign((pose[:3, 3] - plane.point) @ plane.normal)
    height = ((points - plane.point) @ plane.normal) * side
    picture = linear_color(seen.frame, seen.frame.color)
    cosine = np.abs(rays @ plane.normal) / np.linalg.norm(rays, axis=2)
    tolerance = plane.tolerance_m + NOISES * noise_sigma(depth) * depth.depth_m**2 * cosine
    above = valid & (height > tolerance)
    images = points[above] - (2 * side * height[above])[:, None] * plane.normal
    mirrored = _mirrored(seen, images, picture[above], plane.roughness)
    if mirrored is None:
        return None
    radiance, known = mirrored
    fresnel = plane.f0 + (1 - plane.f0) * (1 - cosine[..., None]) ** 5
    expected = (fresnel * radiance).astype(np.float32)
    return PlaneReflection(valid & (np.abs(height) <= tolerance), picture, expected, known)


def _mirrored(
    seen: PosedFrame,
    images: Float64[np.ndarray, "n 3"],
    radiance: Float32[np.ndarray, "n 3"],
    roughness: float,
) -> tuple[Float32[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]] | None:
    """Returns the radiance of mirrored points (world, m) where the picture would show them, and where it does."""
    camera, pose = seen.view.camera, seen.view.world_from_camera
    local = (images - pose[:3, 3]) @ pose[:3, :3]
    in_front = local[:, 2] > 0
    local, radiance = local[in_front], radiance[in_front]
    cells = np.floor((camera.project(local) + 0.5) / CELL_PX).astype(int)
    columns, rows = -(-camera.width // CELL_PX), -(-camera.height // CELL_PX)
    inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=1)
    if not inside.any():
        return None
    cell, depth = (cells[inside, 1] * columns + cells[inside, 0]), local[inside, 2]
    nearest = np.full(rows * columns, np.inf)
    np.minimum.at(nearest, cell, depth)
    front = depth <= FRONT * nearest[cell]
    count = np.bincount(cell[front], minlength=rows * columns)
    sums = [np.bincount(cell[front], each, rows * columns) for each in radiance[inside][front].T]
    grid = np.dstack([*sums, count]).reshape(rows, columns, 4).astype(np.float32)
    # A lobe of alpha spreads directions by 2 alpha; seen from the camera, by at most that.
    soft = cv2.GaussianBlur(grid, (0, 0), max(roughness**2 * camera.matrix[0, 0] / CELL_PX, 0.5))
    mean = np.where(count.reshape(rows, columns, 1) > 0, soft[..., :3] / np.maximum(soft[..., 3:], 1e-6), 0)
    size, whole = (camera.width, camera.height), (columns * CELL_PX, rows * CELL_PX)
    full = cv2.resize(
        np.dstack([mean, count.reshape(rows, columns) > 0]), whole, interpolation=cv2.INTER_NEAREST
    )
    full = full[: size[1], : size[0]]
    return full[..., :3].astype(np.float32), full[..., 3] > 0
