"""Lights for shaders, the views their depth maps need, and the environment's textures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from render_server.lights.lights import DirectionalLight, Light, RectangleLight, SpotLight
from render_server.lights.mirror_lights import MirrorLight

NEAR_MARGIN = 0.98  # near and far planes lie a little outside of what they enclose
FAR_MARGIN = 1.02
WIDEST_SINGLE_TANGENT = math.tan(math.radians(65))  # wider needs the six faces of a cube
NEAREST_M = 1e-3
EVERYWHERE = (0.0, 0.0, 0.0, 1.0)  # the plane before which everything lies
SHARE_TEXELS = 256  # an edge of the map of what a plane mirrors
NOT_MIRRORED = (0.0,) * 7 + (-1.0,) + (0.0,) * 8
NARROWEST_BLEND_RAD = 1e-4  # what a spot without blend falls off over


@dataclass(frozen=True, eq=False)
class LightView:
    """One tile of a light's depth map: the frame (light at the origin, looking along +z) and what it encloses.

    `half_extent` is in metres for a directional light, the tangent of the half angle for all others.
    `front` is the plane a, b, c, d (world) before which ax + by + cz + d >= 0 the light shines, if only there.
    """

    view_from_world: Float64[np.ndarray, "4 4"]
    half_extent: float
    near: float
    far: float
    orthographic: bool
    front: Float64[np.ndarray, "4"] | None = None

    @property
    def texel_span(self) -> float:
        """Extent of the tile; divided by its texels: m (directional) or tangent a texel."""
        return 2.0 * self.half_extent


def light_views(
    light: Light, receivers: Float64[np.ndarray, "n 3"], occluders: Float64[np.ndarray, "m 3"]
) -> list[LightView]:
    """Views that enclose the receivers (world points) as far as the light shines: one, or faces of a cube.

    The occluders set where a view begins: what stands between the light and the receivers is in it. A
    rectangle looks from its centre.
    """
    if isinstance(light, DirectionalLight):
        return [_orthographic_view(np.asarray(light.direction, float), receivers, occluders)]
    position = np.asarray(light.position, float)
    if isinstance(light, RectangleLight):
        return _rectangle_views(light, position, receivers, occluders)
    if isinstance(light, SpotLight):
        return _spot_views(light, position, receivers, occluders)
    return _views_around(position, receivers, occluders)


def mirror_views(
    mirror: MirrorLight,
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
    above_m: float = 0.0,
) -> list[LightView]:
    """Views of an image of a light, of what stands before its plane by more than `above_m`."""
    front = mirror.plane - np.array([0.0, 0.0, 0.0, above_m])
    receivers, occluders = (points[points @ front[:3] + front[3] > 0] for points in (receivers, occluders))
    if not len(receivers):
        return []
    return [replace(view, front=front) for view in light_views(mirror.light, receivers, occluders)]


def share_map(
    mirror: MirrorLight, points: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "4"], Float64[np.ndarray, "4"]]:
    """Coordinates (0..1) on the plane, as rows that multiply (x, y, z, 1): where it shows the light to the points."""
    normal, plane = mirror.plane[:3], mirror.plane
    heights = points @ normal + plane[3]
    points, heights = points[heights > 0], heights[heights > 0, None]
    if isinstance(mirror.light, DirectionalLight):
        way = np.broadcast_to(-mirror.light.direction.astype(float), points.shape)
    else:
        way = mirror.light.position.astype(float) - points
    met = points + way * (heights / -(way @ normal)[:, None])
    axes = _frame(normal)[:2]
    local = met @ axes.T
    if not len(local):
        local = np.zeros((1, 2))
    low, high = local.min(axis=0), local.max(axis=0)
    extent = max(float((high - low).max()), NEAREST_M) * 1.1
    offset = 0.5 - (low + high) / 2 / extent
    rows = [np.append(axis / extent, shift) for axis, shift in zip(axes, offset, strict=True)]
    return rows[0], rows[1]


def _views_around(
    position: Float64[np.ndarray, "3"],
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> list[LightView]:
    view = _perspective_view(position, receivers.mean(axis=0) - position, receivers, occluders)
    if view is not None:
        return [view]
    axes = np.vstack([np.eye(3), -np.eye(3)])
    return [
        _wide_view(position, axis, 1.0, receivers, occluders)
        for axis in axes
        if (_tangents((receivers - position) @ _frame(axis).T) <= 1.0).any()
    ]


def _spot_views(
    light: SpotLight,
    position: Float64[np.ndarray, "3"],
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> list[LightView]:
    """The cone, unless a view of the receivers alone is narrower."""
    half = math.tan(light.half_angle_rad) * 1.01
    around = _views_around(position, receivers, occluders)
    if half > WIDEST_SINGLE_TANGENT or (len(around) == 1 and around[0].half_extent <= half):
        return around
    axis = np.asarray(light.direction, float)
    if not ((receivers - position) @ axis > NEAREST_M).any():
        return []
    return [_wide_view(position, axis, half, receivers, occluders)]


def _rectangle_views(
    light: RectangleLight,
    position: Float64[np.ndarray, "3"],
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> list[LightView]:
    """Views of what lies before the rectangle; the lamp's own housing and the wall behind it are left out."""
    normal = light.normal
    front = np.append(normal, -normal @ position - NEAREST_M)
    receivers, occluders = (points[points @ front[:3] + front[3] > 0] for points in (receivers, occluders))
    if not len(receivers):
        return []
    return [replace(view, front=front) for view in _views_around(position, receivers, occluders)]


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
    near = max(float(depths.min(initial=local[:, 2].max())) * NEAR_MARGIN, NEAREST_M)
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


def _wide_view(
    position: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    half: float,
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> LightView:
    """View along `axis` up to the tangent `half`, whatever of the receivers lies in it."""
    rotation = _frame(axis)
    local = (receivers - position) @ rotation.T
    near, far = _depth_range(local, (occluders - position) @ rotation.T, half)
    # Triangles whose vertices lie beside this view reach nearer than any vertex in it.
    reach = float(np.linalg.norm(local, axis=1).max()) * FAR_MARGIN
    return LightView(_matrix(rotation, position), half, max(0.1 * near, NEAREST_M), max(far, reach), False)


def tile_columns(count: int) -> int:
    """Tiles a row of an atlas of `count` tiles."""
    return max(1, math.ceil(math.sqrt(count)))


def pack_view(view: LightView, tile: int, columns: int, tile_size: int) -> Float64[np.ndarray, "28"]:
    """std430 LightView: matrix by columns, tile, range, front."""
    x, y = (tile % columns) * tile_size, (tile // columns) * tile_size
    return np.concatenate(
        [
            view.view_from_world.T.ravel(),
            [x, y, tile_size, view.half_extent],
            [view.near, view.far, float(view.orthographic), 0.0],
            EVERYWHERE if view.front is None else view.front,
        ]
    )


def pack_mirror(
    mirror: MirrorLight, layer: int, rows: Sequence[Float64[np.ndarray, "4"]], ranges: Sequence[int]
) -> bytes:
    """std430 Light of an image of a light; `rows` are those of `share_map`."""
    own = mirror.tolerance_m, mirror.roughness, float(mirror.surface), float(mirror.source)
    tail = [*mirror.plane, *mirror.f0, float(layer), *rows[0], *rows[1]]
    return pack_light(mirror.light, ranges, own, tail)


def pack_light(
    light: Light,
    ranges: Sequence[int],
    own: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    tail: Sequence[float] = NOT_MIRRORED,
) -> bytes:
    """std430 Light: place, colour, shape, two axes and an image's own as floats, ranges of its views as integers."""
    axis_u = axis_v = np.zeros(3)
    shape = (0.0, 1.0, 0.0)
    if isinstance(light, DirectionalLight):
        kind, place, color = 0, light.direction, light.irradiance
        shape = (math.tan(light.angular_radius_rad), 1.0, 0.0)
    elif isinstance(light, RectangleLight):
        kind, place, color = 3, light.position, light.radiance
        axis_u, axis_v = light.axis_u / 2, light.axis_v / 2
    elif isinstance(light, SpotLight):
        kind, place, color, axis_u = 2, light.position, light.intensity, light.direction
        blend = max(light.half_angle_rad - light.full_angle_rad, NARROWEST_BLEND_RAD)
        shape = (light.radius_m, light.half_angle_rad / blend, 1.0 / blend)
    else:
        kind, place, color = 1, light.position, light.intensity
        shape = (light.radius_m, 1.0, 0.0)
    floats = [*place, kind, *color, own[0], *shape, own[1], *axis_u, own[2], *axis_v, own[3], *tail]
    integers: np.ndarray[Any, np.dtype[np.int32]] = np.array(ranges, np.int32)
    return np.array(floats, np.float32).tobytes() + integers.tobytes()
