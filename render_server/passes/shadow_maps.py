"""Reflective shadow maps: the first surface that each light sees, and the views that its maps need."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import is_

import moderngl
import numpy as np
from jaxtyping import Float64

from deltalight.protocol import short_axis
from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.gpu.raster_kernel import RasterKernel
from deltalight.render_server.gpu.textures import release_all, release_target, texture_2d
from deltalight.render_server.lights.light_models import DirectionalLight, Lamp, Light
from deltalight.render_server.lights.mirror_lights import MirrorLight
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.passes.volumes import MOST_VOLUMES

NEAR_MARGIN = 0.98  # near and far planes lie a little outside of what they enclose
FAR_MARGIN = 1.02
WIDEST_SINGLE_TANGENT = math.tan(math.radians(65))  # wider needs the six faces of a cube
NEAREST_M = 1e-3
GREATEST_TILE = 4096  # texels an edge: `rsm_size` of the scene document
CASTER_CELL = 8
"""Texels an edge of the cells in which distances to casters are known; as in shaders/common/object_shadows.glsl."""
MOST_VIEWS = 6  # of a light: the faces of a cube
TEXEL_BYTES = 4 + 8 + 16  # of an atlas: depth, `normal` and `uv`
AXES = np.eye(3)
EVERYWHERE = (0.0, 0.0, 0.0, 1.0)  # the plane before which everything lies


@dataclass(frozen=True, eq=False)
class LightView:
    """One tile of a light's depth map: its frame (light at the origin, looking along +z) and extent.

    `half_extent` is in metres for a directional light, the tangent of the half angle for all others. `front` is a
    plane a, b, c, d (world): the light shines only where ax + by + cz + d >= 0.
    """

    view_from_world: Float64[np.ndarray, "4 4"]
    half_extent: float
    near: float
    far: float
    orthographic: bool
    front: Float64[np.ndarray, "4"] | None = None

    @property
    def texel_span(self) -> float:
        """Extent of the tile; divided by its texels: m (directional) or tangent per texel."""
        return 2.0 * self.half_extent


class ShadowMapAtlas:
    """One depth texture and its reflective layers, a tile for every light view of one geometry set.

    `normal` (RGBA16F) holds normal and material, `uv` (RGBA32F) texture coordinates and vertex colour.
    `caster_distance` (R32F, a texel for CASTER_CELL x CASTER_CELL) bounds how far away the nearest texel that shows
    anything is from below, squared, in cells; 0 unless `ShadowMaps` measured it.
    """

    def __init__(self, gpu: GpuContext, tiles: int, tile_size: int) -> None:
        columns = tile_columns(tiles)
        rows = max(1, -(-tiles // columns))
        size = (columns * tile_size, rows * tile_size)
        self.tiles, self.tile_size, self.columns, self.size = tiles, tile_size, columns, size
        self.normal = texture_2d(gpu, size, 4, "f2")
        self.uv = texture_2d(gpu, size, 4, "f4")
        self.depth = gpu.ctx.depth_texture(size)
        self.depth.compare_func = ""
        self.depth.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self.target = gpu.ctx.framebuffer([self.normal, self.uv], self.depth)
        self.tile_cells = -(-tile_size // CASTER_CELL)
        cells = (columns * self.tile_cells, rows * self.tile_cells)
        self.caster_distance = texture_2d(gpu, cells, 1, "f4")
        self.caster_distance.write(bytes(4 * cells[0] * cells[1]))
        self.clear()

    def clear(self) -> None:
        """Clears all tiles."""
        self.target.use()
        self.target.viewport = (0, 0, *self.size)
        self.target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)

    def box(self, tile: int) -> tuple[int, int, int, int]:
        """Returns the position of a tile: x, y, width, height in texels."""
        x, y = tile % self.columns, tile // self.columns
        return x * self.tile_size, y * self.tile_size, self.tile_size, self.tile_size

    def release(self) -> None:
        """Frees the GL objects."""
        release_target(self.target)
        for item in (self.depth, self.normal, self.uv, self.caster_distance):
            item.release()


def atlas_bytes(tiles: int, tile_size: int) -> int:
    """Returns the bytes of an atlas of so many tiles of `tile_size` texels an edge."""
    columns = tile_columns(tiles)
    places = columns * max(1, -(-tiles // columns))
    cells = -(-tile_size // CASTER_CELL)
    return places * (tile_size * tile_size * TEXEL_BYTES + cells * cells * 4)


def most_maps_bytes(lights: Sequence[Light], tile_size: int) -> int:
    """Returns the most bytes that maps of the real scene and of the objects take; `tile_size` in texels."""
    distant = sum(isinstance(light, DirectionalLight) for light in lights)
    lamps = MOST_VIEWS * (len(lights) - distant)
    of_groups = MOST_VOLUMES * distant  # passes/group_views.py
    return atlas_bytes(lamps + distant, tile_size) + atlas_bytes(lamps + of_groups, tile_size)


def require_atlas_fits(gpu: GpuContext, tiles: int, tile_size: int) -> None:
    """Refuses an atlas that is larger than a texture may be.

    Raises:
        DeltalightError: it is; the sentence says which `rsm_size` fits.
    """
    limit, columns = int(gpu.ctx.info["GL_MAX_TEXTURE_SIZE"]), tile_columns(tiles)
    if columns * tile_size > limit:
        raise DeltalightError(
            f"the lights need {tiles} shadow maps of {tile_size} texels an edge, and a texture of this GPU has no "
            f"more than {limit}; set `rsm_size` to {limit // columns} or less, or use fewer lights."
        )


class ShadowMaps:
    """Draws meshes into the tiles of an atlas."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._kernel = RasterKernel(gpu, "reflective_shadow_map")
        most_cells = -(-GREATEST_TILE // CASTER_CELL)
        self._find_casters = Kernel(gpu, "caster_distance", FIND=1, CELL=CASTER_CELL, MOST_CELLS=most_cells)
        self._spread = Kernel(gpu, "caster_distance", MOST_CELLS=most_cells)
        self._rows: moderngl.Texture | None = None

    def run(self, atlas: ShadowMapAtlas, meshes: Sequence[MeshBuffers], views: Sequence[LightView]) -> None:
        """Draws all `meshes` for each view, tile by tile."""
        atlas.clear()
        for tile, view in enumerate(views):
            for mesh in meshes:
                self._kernel.draw(
                    atlas.target,
                    mesh,
                    mesh.cutouts,
                    box=atlas.box(tile),
                    clips=view.front is not None,
                    view_from_world=view.view_from_world,
                    half_extent=view.half_extent,
                    depth_range=(view.near, view.far),
                    orthographic=view.orthographic,
                    front=EVERYWHERE if view.front is None else view.front,
                )

    def measure_distances(self, atlas: ShadowMapAtlas) -> None:
        """Fills `caster_distance` of the maps as they were drawn."""
        (columns, rows), cells = atlas.caster_distance.size, atlas.tile_cells
        if self._rows is None or self._rows.size != (columns, rows):
            release_all(self._rows)
            self._rows = texture_2d(self._gpu, (columns, rows), 1, "f4")
        group = self._spread.local_size[0]
        self._find_casters.run(
            (columns // cells * group, rows),
            depth_map=atlas.depth,
            distance_out=self._rows,
            tile_cells=cells,
            tile_size=atlas.tile_size,
        )
        self._spread.run(
            (columns * group, rows // cells),
            row_distance=self._rows,
            distance_out=atlas.caster_distance,
            tile_cells=cells,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._kernel, self._find_casters, self._spread, self._rows)


def light_views(
    light: Light, receivers: Float64[np.ndarray, "n 3"], occluders: Float64[np.ndarray, "m 3"]
) -> list[LightView]:
    """Views that enclose the receivers (world points) as far as the light shines: one, or faces of a cube.

    The occluders set where a view begins: what stands between the light and the receivers is in it. A lamp looks
    from its centre.
    """
    if isinstance(light, DirectionalLight):
        return [_orthographic_view(np.asarray(light.direction, float), receivers, occluders)]
    if light.front is None:
        return _lamp_views(light, receivers, occluders)
    # The lamp's own housing and the wall behind it are left out.
    front = light.front - np.array([0.0, 0.0, 0.0, NEAREST_M])
    return _before(front, receivers, occluders, partial(_lamp_views, light))


class FittedViews:
    """Each light's views (`light_views`), kept while lights and points are the very same objects."""

    def __init__(self) -> None:
        self._fitted: Sequence[object] = ()
        self._views: list[list[LightView]] = []

    def of(
        self,
        lights: Sequence[Light],
        receivers: Float64[np.ndarray, "n 3"],
        occluders: Float64[np.ndarray, "m 3"],
    ) -> list[list[LightView]]:
        """Returns the views of each light; none if there are no receivers."""
        wanted = receivers, occluders, *lights
        if len(self._fitted) != len(wanted) or not all(map(is_, self._fitted, wanted)):
            self._fitted = wanted
            self._views = [
                light_views(each, receivers, occluders) if len(receivers) else [] for each in lights
            ]
        return list(self._views)


def mirror_views(
    mirror: MirrorLight,
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
    above_m: float = 0.0,
) -> list[LightView]:
    """Returns the views of a mirror image, of what lies more than `above_m` in front of its plane."""
    front = mirror.plane - np.array([0.0, 0.0, 0.0, above_m])
    return _before(front, receivers, occluders, partial(light_views, mirror.light))


def _before(
    front: Float64[np.ndarray, "4"],
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
    views_of: Callable[[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "m 3"]], list[LightView]],
) -> list[LightView]:
    """Views of what lies before a plane."""
    receivers, occluders = (points[points @ front[:3] + front[3] > 0] for points in (receivers, occluders))
    if not len(receivers):
        return []
    return [replace(view, front=front) for view in views_of(receivers, occluders)]


def _lamp_views(
    lamp: Lamp, receivers: Float64[np.ndarray, "n 3"], occluders: Float64[np.ndarray, "m 3"]
) -> list[LightView]:
    """Views around the receivers, or the lamp's cone where that is narrower."""
    position = np.asarray(lamp.position, float)
    around = _views_around(position, receivers, occluders)
    if lamp.cone is None:
        return around
    axis, half_angle = lamp.cone
    half = math.tan(half_angle) * 1.01
    if half > WIDEST_SINGLE_TANGENT or (len(around) == 1 and around[0].half_extent <= half):
        return around
    if not ((receivers - position) @ axis > NEAREST_M).any():
        return []
    return [_wide_view(position, axis, half, receivers, occluders)]


def _views_around(
    position: Float64[np.ndarray, "3"],
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> list[LightView]:
    view = _perspective_view(position, short_axis.mean(receivers) - position, receivers, occluders)
    if view is not None:
        return [view]
    return [
        _wide_view(position, axis, 1.0, receivers, occluders)
        for axis in (*AXES, *-AXES)
        if (_tangents((receivers - position) @ frame_along(axis).T) <= 1.0).any()
    ]


def frame_along(axis: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Returns the rotation whose rows are right, down, and the unit axis."""
    z = axis / short_axis.length(axis)
    helper = AXES[np.abs(z).argmin()]
    x = _cross(helper, z)
    x /= short_axis.length(x)
    return np.array([x, _cross(z, x), z])


def _cross(a: Float64[np.ndarray, "3"], b: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """Returns a x b; `np.cross` takes ten times as long for single vectors."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a.tolist(), b.tolist()
    return np.array([a_y * b_z - a_z * b_y, a_z * b_x - a_x * b_z, a_x * b_y - a_y * b_x])


def _matrix(
    rotation: Float64[np.ndarray, "3 3"], origin: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "4 4"]:
    """Returns view_from_world of a frame with its origin in the world."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ origin
    return matrix


def _orthographic_view(
    direction: Float64[np.ndarray, "3"],
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> LightView:
    rotation = frame_along(direction)
    local = receivers @ rotation.T
    low, high = short_axis.bounds(local)
    first = min(float((occluders @ rotation[2]).min()), float(low[2]))
    centre = (low + high) / 2
    margin = 0.01 * float((high - low).max()) + NEAREST_M
    half = float((high - low)[:2].max()) / 2 + margin
    origin = rotation.T @ np.array([centre[0], centre[1], first - 2 * margin])
    return LightView(_matrix(rotation, origin), half, margin, float(high[2]) - first + 3 * margin, True)


def _tangents(local: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Returns the greater tangent of each point's direction to +z, per axis; infinite behind the light."""
    x, y, z = np.ascontiguousarray(local.T)
    tangents = np.maximum(np.abs(x), np.abs(y)) / np.maximum(z, NEAREST_M)
    return np.where(z > NEAREST_M, tangents, np.inf)


def _depth_range(
    local: Float64[np.ndarray, "n 3"], blocking: Float64[np.ndarray, "m 3"], half: float
) -> tuple[float, float]:
    """Returns a near plane in front of all that can block within the view, a far plane behind the receivers."""
    inside = _depths_within(local, half), _depths_within(blocking, half)
    return _range_around(inside, float(local[:, 2].max()))


def _depths_within(local: Float64[np.ndarray, "n 3"], half: float) -> Float64[np.ndarray, " k"]:
    """Returns the depths of the points inside a view."""
    return local[:, 2][_tangents(local) <= half]


def _range_around(depths: Sequence[Float64[np.ndarray, " n"]], farthest: float) -> tuple[float, float]:
    """Returns `_depth_range` of the depths of what lies inside the view; `farthest`: of all receivers."""
    nearest = min(float(each.min(initial=farthest)) for each in depths)
    near = max(nearest * NEAR_MARGIN, NEAREST_M)
    return near, max(farthest * FAR_MARGIN, near + NEAREST_M)


def _perspective_view(
    position: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> LightView | None:
    """Returns the view along `axis` around all receivers; None if that is too wide for one view."""
    if short_axis.length(axis) < NEAREST_M:
        return None
    rotation = frame_along(axis)
    local = (receivers - position) @ rotation.T
    half = float(_tangents(local).max()) * 1.01 + 1e-4
    if half > WIDEST_SINGLE_TANGENT:
        return None
    depths = [local[:, 2]]  # all of them are inside
    if occluders is not receivers:
        depths.append(_depths_within((occluders - position) @ rotation.T, half))
    near, far = _range_around(depths, float(local[:, 2].max()))
    return LightView(_matrix(rotation, position), half, near, far, False)


def _wide_view(
    position: Float64[np.ndarray, "3"],
    axis: Float64[np.ndarray, "3"],
    half: float,
    receivers: Float64[np.ndarray, "n 3"],
    occluders: Float64[np.ndarray, "m 3"],
) -> LightView:
    """Returns the view along `axis` up to the tangent `half`, whichever receivers lie in it."""
    rotation = frame_along(axis)
    local = (receivers - position) @ rotation.T
    near, far = _depth_range(local, (occluders - position) @ rotation.T, half)
    # Triangles whose vertices lie beside this view reach nearer than any vertex in it.
    reach = float(short_axis.lengths(local).max()) * FAR_MARGIN
    return LightView(_matrix(rotation, position), half, max(0.1 * near, NEAREST_M), max(far, reach), False)


def texel_size_m(view: LightView, tile_size: int, distance_m: float) -> float:
    """Returns the size of a texel at a distance from the light, m."""
    span = view.texel_span / tile_size
    return span if view.orthographic else span * float(np.abs(distance_m))


def tile_columns(count: int) -> int:
    """Returns the tiles per row of an atlas of `count` tiles."""
    return max(1, math.ceil(math.sqrt(count)))


def pack_view(view: LightView, tile: int, columns: int, tile_size: int) -> list[float]:
    """Packs the 28 numbers of a std430 LightView: matrix by columns, tile, range, front."""
    x, y = (tile % columns) * tile_size, (tile // columns) * tile_size
    return [
        *view.view_from_world.T.ravel().tolist(),
        *(x, y, tile_size, view.half_extent),
        *(view.near, view.far, float(view.orthographic), 0.0),
        *(EVERYWHERE if view.front is None else view.front.tolist()),
    ]
