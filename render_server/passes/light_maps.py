"""Lights for shaders, the views their depth maps need, and the environment's textures."""

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
    light: DirectionalLight | SphereLight,
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> list[LightView]:
    """Views that enclose the receivers (world points): one, or cube faces for a sphere light among them.

    The occluders set where a view begins: what stands between the light and the receivers is in it.
    """
    if isinstance(light, DirectionalLight):
        return [_orthographic_view(np.asarray(light.direction, float), receivers, occluders)]
    position = np.asarray(light.position, float)
    view = _perspective_view(position, receivers.mean(axis=0) - position, receivers, occluders)
    if view is not None:
        return [view]
    axes = np.vstack([np.eye(3), -np.eye(3)])
    faces = [_cube_face(position, axis, receivers, occluders) for axis in axes]
    return [face for face in faces if face is not None]


def _frame(axis: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Rotation whose rows are right, down, and the unit axis."""
    z = axis / np.linalg.norm(axis)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _matrix(
    rotation: Float64[np.ndarray, "3 3"], origin: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "4 4"]:
    """view_from_world of a frame with its origin in the world."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ origin
    return matrix


def _orthographic_view(
    direction: Float64[np.ndarray, "3"],
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> LightView:
    rotation = _frame(direction)
    local = receivers @ rotation.T
    low, high = local.min(axis=0), local.max(axis=0)
    first = min(float((occluders @ rotation[2]).min()), float(low[2]))
    centre = (low + high) / 2
    margin = 0.01 * float((high - low).max()) + NEAREST_M
    half = float((high - low)[:2].max()) / 2 + margin
    origin = rotation.T @ np.array([centre[0], centre[1], first - 2 * margin])
    return LightView(_matrix(rotation, origin), half, margin, float(high[2]) - first + 3 * margin, True)


def _tangents(local: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Greater tangent of each point's direction against +z, per axis; infinite behind the light."""
    tangents = np.abs(local[:, :2]).max(axis=1) / np.maximum(local[:, 2], NEAREST_M)
    return np.where(local[:, 2] > NEAREST_M, tangents, np.inf)


def _depth_range(
    local: Float64[np.ndarray, "n 3"], blocking: Float64[np.ndarray, "m 3"], half: float
) -> tuple[float, float]:
    """Near plane before all that can block within the view, far plane behind the receivers."""
    within = blocking[_tangents(blocking) <= half]
    depths = np.concatenate([within[:, 2], local[_tangents(local) <= half][:, 2]])
    near = max(float(depths.min()) * NEAR_MARGIN, NEAREST_M)
    return near, max(float(local[:, 2].max()) * FAR_MARGIN, near + NEAREST_M)


def _perspective_view(
    position: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> LightView | None:
    """View along `axis` around all receivers; None if that is too wide for one view."""
    if np.linalg.norm(axis) < NEAREST_M:
        return None
    rotation = _frame(axis)
    local = (receivers - position) @ rotation.T
    half = float(_tangents(local).max()) * 1.01 + 1e-4
    if half > WIDEST_SINGLE_TANGENT:
        return None
    near, far = _depth_range(local, (occluders - position) @ rotation.T, half)
    return LightView(_matrix(rotation, position), half, near, far, False)


def _cube_face(
    position: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> LightView | None:
    """90-degree view along `axis`; None if no receiver lies in it."""
    rotation = _frame(axis)
    local = (receivers - position) @ rotation.T
    if not (_tangents(local) <= 1.0).any():
        return None
    near, far = _depth_range(local, (occluders - position) @ rotation.T, 1.0)
    # Triangles whose vertices lie in the neighbouring faces reach nearer than any vertex of this one.
    reach = float(np.linalg.norm(local, axis=1).max()) * FAR_MARGIN
    return LightView(_matrix(rotation, position), 1.0, max(0.1 * near, NEAREST_M), max(far, reach), False)


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
