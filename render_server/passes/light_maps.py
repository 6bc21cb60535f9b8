"""Lights for shaders, the views their depth maps need, and the environment's textures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from render_server.scene.lights import DirectionalLight, SphereLight

NEAR_MARGIN = 0.98  # near and far planes lie a little outside of what they enclose
FAR_MARGIN = 1.02
WIDEST_SINGLE_TANGENT = math.tan(math.radians(65))  # wider needs the six faces of a cube
NEAREST_M = 1e-3


@dataclass(frozen=True, eq=False)
class LightView:
    """One tile of a light's depth map: the frame (light at the origin, looking along +z) and what it encloses.

    `half_extent` is in metres for a directional light, the tangent of the half angle for a sphere light.
    """

    view_from_world: Float64[np.ndarray, "4 4"]
    half_extent: float
    near: float
    far: float
    orthographic: bool

    @property
    def texel_span(self) -> float:
        """Extent of the tile; divided by its texels: m (directional) or tangent (sphere) a texel."""
        return 2.0 * self.half_extent


def light_views(
    light: DirectionalLight | SphereLight, points: Float64[np.ndarray, "n 3"]
) -> list[LightView]:
    """Views that enclose the world points: one, or the cube faces needed for a sphere light among them."""
    if isinstance(light, DirectionalLight):
        return [_orthographic_view(np.asarray(light.direction, float), points)]
    position = np.asarray(light.position, float)
    axis = points.mean(axis=0) - position
    view = _perspective_view(position, axis, points)
    if view is not None:
        return [view]
    faces = [_perspective_view(position, a, points, cube_face=True) for a in np.vstack([np.eye(3), -np.eye(3)])]
    return [face for face in faces if face is not None]


def _frame(axis: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Rotation whose rows are right, down, and the unit axis."""
    z = axis / np.linalg.norm(axis)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _matrix(rotation: Float64[np.ndarray, "3 3"], origin: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "4 4"]:
    """view_from_world of a frame with its origin in the world."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ origin
    return matrix


def _orthographic_view(direction: Float64[np.ndarray, "3"], points: Float64[np.ndarray, "n 3"]) -> LightView:
    rotation = _frame(direction)
    local = points @ rotation.T
    low, high = local.min(axis=0), local.max(axis=0)
    centre = (low + high) / 2
    margin = 0.01 * float((high - low).max()) + NEAREST_M
    half = float((high - low)[:2].max()) / 2 + margin
    origin = rotation.T @ np.array([centre[0], centre[1], low[2] - 2 * margin])
    return LightView(_matrix(rotation, origin), half, margin, float(high[2] - low[2]) + 3 * margin, True)


def _perspective_view(
    position: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    points: Float64[np.ndarray, "n 3"],
    cube_face: bool = False,
) -> LightView | None:
    """View along `axis`; None if the points do not fit one view, or no point lies in this cube face."""
    if np.linalg.norm(axis) < NEAREST_M:
        return None
    rotation = _frame(axis)
    local = (points - position) @ rotation.T
    in_front = local[:, 2] > NEAREST_M
    tangents = np.abs(local[:, :2]).max(axis=1) / np.maximum(local[:, 2], NEAREST_M)
    if cube_face:
        in_front &= tangents <= 1.0
        if not in_front.any():
            return None
        half = 1.0
    else:
        half = float(tangents.max()) * 1.01 + 1e-4
        if not in_front.all() or half > WIDEST_SINGLE_TANGENT:
            return None
    depth = local[in_front, 2]
    near = max(float(depth.min()) * NEAR_MARGIN, NEAREST_M)
    # A face of the cube may clip triangles whose vertices lie in its neighbours: keep what is nearer than its points.
    near = min(near, 0.1 * near + NEAREST_M) if cube_face else near
    far = float(np.linalg.norm(local, axis=1).max()) * FAR_MARGIN if cube_face else float(depth.max()) * FAR_MARGIN
    return LightView(_matrix(rotation, position), half, near, max(far, near + NEAREST_M), False)


def tile_columns(count: int) -> int:
    """Tiles a row of an atlas of `count` tiles."""
    return max(1, math.ceil(math.sqrt(count)))


def pack_view(view: LightView, tile: int, columns: int, tile_size: int) -> Float64[np.ndarray, "24"]:
    """std430 LightView: matrix by columns, tile, range."""
    x, y = (tile % columns) * tile_size, (tile // columns) * tile_size
    return np.concatenate(
        [
            view.view_from_world.T.ravel(),
            [x, y, tile_size, view.half_extent],
            [view.near, view.far, float(view.orthographic), 0.0],
        ]
    )


def pack_light(light: DirectionalLight | SphereLight, ranges: Sequence[int]) -> bytes:
    """std430 Light: place, colour, shape as floats, then the ranges of its views as integers."""
    if isinstance(light, DirectionalLight):
        place = [*map(float, light.direction), 0.0]
        color, size = light.irradiance, math.tan(light.angular_radius_rad)
    else:
        place = [*map(float, light.position), 1.0]
        color, size = light.intensity, light.radius_m
    floats = np.array([*place, *map(float, color), 0.0, size, 0.0, 0.0, 0.0], np.float32)
    integers: np.ndarray[Any, np.dtype[np.int32]] = np.array(ranges, np.int32)
    return floats.tobytes() + integers.tobytes()
