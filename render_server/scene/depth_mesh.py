"""Triangle mesh of one depth image, and back faces for it."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt32

from deltalight.protocol import short_axis
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.render_server.scene.depth_surface import (
    DepthSurface,
    by_ray,
    depth_surface,
    jump_threshold,
    normals_along,
    ray_planes,
)
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.view import LENSES_KEPT

CELL_SAMPLES = 6
BOUND_POINTS = 4000  # for fitting light views
# Pixels of two neighbouring nodes are at most this many cells apart: two in each direction.
MAX_CELL_DISTANCE = 2 * float(np.sqrt(2))
REAL_MATERIAL = Material(roughness=1.0, specular=0.0, name="real")
# A ray that leaves a surface samples the cells around its own, which must not contain the surface's back face.
BACK_OFFSET_VOXELS = 2.0
# Corners of the triangles in a quad of nodes (0 1 above 2 3): two if it is cut from 0 to 3, two if from 1 to 2.
QUAD_TRIANGLES = ((0, 2, 3), (0, 3, 1), (0, 2, 1), (1, 2, 3))
QUAD_CORNERS = (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:])


@dataclass(frozen=True, eq=False)
class _Nodes:
    """The mesh's grid: pixel coordinates (u, v), rays, inverse depth (0 = hole), normals, optical frame."""

    pixels: Float32[np.ndarray, "gh gw 2"]
    rays: Float32[np.ndarray, "2 gh gw"]
    inverse_depth: Float32[np.ndarray, "gh gw"]
    normals: Float32[np.ndarray, "3 gh gw"]


def depth_mesh(
    depth: DepthImage,
    camera: CameraModel,
    world_from_camera: Float64[np.ndarray, "4 4"],
    triangle_budget: int = 40_000,
    surface: DepthSurface | None = None,
    *,
    grazing: Callable[[], Float32[np.ndarray, "h w"]] | None = None,
) -> TriangleMesh:
    """Meshes a clean depth image, registered to `camera`, in the world.

    A node represents each cell of stride x stride pixels, at the cell's centre, with the cell's median depth (moved
    to the centre along the fitted surface); the stride is the least within the budget. No triangle crosses a depth
    discontinuity; cells without depth or normal are holes. `uv` is the vertex's pixel coordinate (pixel centres at
    integers) in the camera's picture. `surface` is `depth_surface(depth, camera)` if already computed. `grazing`
    returns the inverse depth of surfaces too oblique to measure (`grazing_depth_fill`), which join their two sides.
    Without any valid depth the mesh is empty.

    Raises:
        DeltalightError: the budget is below 2, or depth and camera differ in size.
    """
    if depth.depth_m.shape != (camera.height, camera.width):
        raise DeltalightError("the depth image and its camera differ in size; correct the calibration.")
    if triangle_budget < 2:
        raise DeltalightError(f"a budget of {triangle_budget} triangles holds no mesh; use 1000 or more.")
    known = depth_surface(depth, camera) if surface is None else surface
    stride = stride_for_budget(camera.width, camera.height, triangle_budget)
    nodes = _nodes(known, camera, stride)
    limit = jump_threshold(depth, camera, nodes.inverse_depth, stride)
    slack = None
    oblique = None if grazing is None else grazing()
    if oblique is not None and oblique.any():
        nodes, slack = _with_grazing(nodes, oblique, camera, stride)
    return _world_mesh(nodes, _triangles_of_quads(nodes.inverse_depth, limit, slack), world_from_camera)


def bound_points(
    depth: DepthImage,
    camera: CameraModel,
    world_from_camera: Float64[np.ndarray, "4 4"],
    most: int = BOUND_POINTS,
) -> Float64[np.ndarray, "n 3"]:
    """Returns at most so many points of what a depth image shows (world, m), without its outliers; quickly.

    They lie on a grid of pixels that begins and ends at the picture's border.
    """
    rows, columns, rays = _bound_grid(camera, most)
    valid, depth_m = (each.take(rows, axis=0).take(columns, axis=1) for each in (depth.valid, depth.depth_m))
    metres = np.where(valid, depth_m, np.float32(0))
    known = _are_among_neighbours(np.divide(1, metres, out=np.zeros_like(metres), where=metres > 0))
    local = rays[known] * metres[known][:, None]
    return np.asarray(local @ world_from_camera[:3, :3].T + world_from_camera[:3, 3])


def _are_among_neighbours(inverse_depth: Float32[np.ndarray, "a b"]) -> Bool[np.ndarray, "a b"]:
    """Returns which points (0: unknown) lie in the range of medians around them, or beyond it by no more than it.

    An end of a slanted plane is a step of it beyond; an outlier in front of a surface is far beyond.
    """
    median = cv2.medianBlur(inverse_depth, 3)
    beside = np.ones((3, 3), np.uint8)
    most = cv2.dilate(median, beside)
    least = -cv2.dilate(np.where(median > 0, -median, -np.inf), beside)
    spread = np.where(most > 0, most - least, 0)
    return np.asarray(
        (inverse_depth > 0) & (inverse_depth >= least - spread) & (inverse_depth <= most + spread)
    )


@lru_cache(maxsize=LENSES_KEPT)
def _bound_grid(
    camera: CameraModel, most: int
) -> tuple[Int64[np.ndarray, " a"], Int64[np.ndarray, " b"], Float64[np.ndarray, "a b 3"]]:
    """Returns rows and columns of a grid of at most so many pixels, and points at a depth of 1 on their rays."""
    scale = min(1.0, math.sqrt(most / (camera.width * camera.height)))
    rows, columns = (
        np.linspace(0, length - 1, max(1, int(scale * length))).round().astype(np.int64)
        for length in (camera.height, camera.width)
    )
    rays = camera.rays()[np.ix_(rows, columns)]
    return rows, columns, np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)


def stride_for_budget(width: int, height: int, triangle_budget: int) -> int:
    """Returns the least cell edge in pixels whose grid has at most `triangle_budget` triangles."""
    stride = 1
    while 2 * (-(-width // stride) - 1) * (-(-height // stride) - 1) > triangle_budget:
        stride += 1
    return stride


def _nodes(surface: DepthSurface, camera: CameraModel, stride: int) -> _Nodes:
    pixels, rays = node_rays(camera, stride)
    depth, all_rays = surface.fitted_depth, ray_planes(camera)
    flat = _median_pixels(depth, stride)
    chosen = depth.ravel().take(flat)
    gradient = surface.gradient.reshape(2, -1).take(flat, axis=1)
    along = all_rays.reshape(2, -1).take(flat, axis=1)
    shift = gradient[0] * (rays[0] - along[0]) + gradient[1] * (rays[1] - along[1])
    # An outlier of the slope must not throw the node off the depths of its cell.
    at_centre = chosen + np.clip(shift, -0.1 * chosen, 0.1 * chosen)
    inverse = np.where(chosen > 0, at_centre, np.float32(0))
    return _Nodes(pixels, rays, inverse, np.stack(normals_along(chosen, gradient, along)))


def _with_grazing(
    nodes: _Nodes, grazing: Float32[np.ndarray, "h w"], camera: CameraModel, stride: int
) -> tuple[_Nodes, Float32[np.ndarray, "gh gw"]]:
    """Fills holes with nodes of grazing surfaces; the second value is the step (1/m) that their slopes explain."""
    flat = _median_pixels(grazing, stride)
    chosen, by_pixel = grazing.ravel().take(flat), _slopes(grazing, flat)
    along = ray_planes(camera).reshape(2, -1).take(flat, axis=1)
    normals = np.stack(normals_along(chosen, by_ray(by_pixel, camera, flat), along))
    added = (chosen > 0) & (nodes.inverse_depth == 0) & (normals != 0).any(axis=0)
    joined = _Nodes(
        nodes.pixels,
        nodes.rays,
        np.where(added, chosen, nodes.inverse_depth),
        np.where(added, normals, nodes.normals),
    )
    slope = np.hypot(*by_pixel)
    return joined, np.where(added, np.float32(MAX_CELL_DISTANCE * stride) * slope, np.float32(0))


def _slopes(
    inverse: Float32[np.ndarray, "h w"], flat: Int64[np.ndarray, "gh gw"]
) -> Float32[np.ndarray, "2 gh gw"]:
    """Returns differences per pixel, to the right and down, among non-zero pixels; NaN for isolated ones."""
    known = cv2.copyMakeBorder(inverse, 1, 1, 1, 1, cv2.BORDER_CONSTANT).astype(np.float64)
    known[known <= 0] = np.nan
    width = known.shape[1]
    at = (flat // inverse.shape[1] + 1) * width + flat % inverse.shape[1] + 1
    slopes = np.empty((2, *flat.shape), np.float32)
    for slope, step in ((slopes[0], 1), (slopes[1], width)):
        own = known.ravel().take(at)
        before, after = own - known.ravel().take(at - step), known.ravel().take(at + step) - own
        slope[:] = np.where(np.isnan(before), after, np.where(np.isnan(after), before, (before + after) / 2))
    return slopes


@lru_cache(maxsize=2 * LENSES_KEPT)  # meshes are made fine and coarse
def node_rays(
    camera: CameraModel, stride: int
) -> tuple[Float32[np.ndarray, "gh gw 2"], Float32[np.ndarray, "2 gh gw"]]:
    """Returns pixel coordinates and rays (x/z, y/z) of the centres of cells, also of those that the border cuts."""
    columns = _cell_centres(camera.width, stride)
    rows = _cell_centres(camera.height, stride)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    rays = camera.unproject(pixels.reshape(-1, 2)).reshape(pixels.shape)
    return pixels.astype(np.float32), np.ascontiguousarray(rays.transpose(2, 0, 1), np.float32)


def _cell_centres(length: int, stride: int) -> Float64[np.ndarray, " n"]:
    starts = np.arange(0, length, stride)
    return np.asarray((starts + np.minimum(starts + stride, length) - 1) / 2)


def _median_pixels(inverse: Float32[np.ndarray, "h w"], stride: int) -> Int64[np.ndarray, "gh gw"]:
    """Returns the flat index of the pixel with the median inverse depth among the valid ones of each cell.

    Cells without a valid pixel get an invalid one. Large cells are judged by 6 x 6 of their pixels. Positive floats
    sort like their bits; the lowest bits are replaced by the pixel's number in the cell.
    """
    height, width = inverse.shape
    rows, columns = -(-height // stride), -(-width // stride)
    bits = inverse.view(np.uint32)
    steps = np.unique(np.linspace(0, stride - 1, min(stride, CELL_SAMPLES)).round().astype(int))
    offsets = np.array([(down, right) for down in steps for right in steps])
    count = len(offsets)
    number_bits = np.uint32((1 << (count - 1).bit_length()) - 1)
    keys = np.empty((count + 1, rows, columns), np.uint32)  # one more than there are, for sorting
    invalid = np.zeros((rows, columns), np.uint8)
    for number, (down, right) in enumerate(offsets):
        sampled = bits[down::stride, right::stride]  # less than all cells where the border cuts some
        if sampled.shape != invalid.shape:
            keys[number] = 0
        keys[number, : len(sampled), : sampled.shape[1]] = sampled
        invalid += keys[number] == 0
        keys[number] &= ~number_bits
        keys[number] |= np.uint32(number)
    middle = np.minimum((invalid + np.uint8(count)) // 2, count - 1)
    place = _sorted_planes(keys).take(middle)
    chosen = (
        keys.ravel().take(place * invalid.size + np.arange(invalid.size).reshape(invalid.shape)) & number_bits
    )
    row = np.minimum(offsets[:, 0].take(chosen) + np.arange(rows)[:, None] * stride, height - 1)
    column = np.minimum(offsets[:, 1].take(chosen) + np.arange(columns) * stride, width - 1)
    return np.asarray(row * width + column)


def _sorted_planes(planes: UInt32[np.ndarray, "k+1 a b"]) -> Int64[np.ndarray, " k"]:
    """Sorts every element's values over all planes but the last, which is free; returns where each place's plane is.

    Batcher's odd-even merge network.
    """
    *places, free = range(len(planes))
    count, run = len(places), 1
    while run < count:
        gap = run
        while gap:
            for start in range(gap % run, count - gap, 2 * gap):
                for low in range(start, min(start + gap, count - gap)):
                    if low // (2 * run) == (low + gap) // (2 * run):
                        one, other = planes[places[low]], planes[places[low + gap]]
                        np.minimum(one, other, out=planes[free])
                        np.maximum(one, other, out=other)
                        places[low], free = free, places[low]
            gap //= 2
        run *= 2
    return np.array(places)


def _triangles_of_quads(
    inverse: Float32[np.ndarray, "gh gw"],
    threshold: Float32[np.ndarray, "gh gw"],
    slack: Float32[np.ndarray, "gh gw"] | None,
) -> list[Bool[np.ndarray, "a b"]]:
    """Joins neighbouring nodes on one surface: returns which quads hold each of QUAD_TRIANGLES.

    Quads are cut along the diagonal with the lesser step. Steps may exceed the threshold by the slack of either node.
    Seen from the camera, triangles are counter-clockwise.
    """
    corners = [inverse[quad] for quad in QUAD_CORNERS]
    usable = [corner > 0 for corner in corners]
    holes = [~each for each in usable]

    def joined(one: int, other: int) -> Bool[np.ndarray, "a b"]:
        limit = threshold[:-1, :-1]
        if slack is not None:
            limit = limit + slack[QUAD_CORNERS[one]] + slack[QUAD_CORNERS[other]]
        return np.asarray(np.abs(corners[one] - corners[other]) <= limit)

    top, bottom, left, right = joined(0, 1), joined(2, 3), joined(0, 2), joined(1, 3)
    falling = np.abs(corners[0] - corners[3]) <= np.abs(corners[1] - corners[2])
    # A quad with one hole still holds a triangle, if it is cut between the hole's neighbours.
    falling = (falling | holes[1] | holes[2]) & ~(holes[0] | holes[3])
    diagonal = np.where(falling, joined(0, 3), joined(1, 2))
    edges = (falling & left & bottom, falling & right & top, ~falling & left & top, ~falling & right & bottom)
    return [
        fits & diagonal & usable[one] & usable[two] & usable[three]
        for fits, (one, two, three) in zip(edges, QUAD_TRIANGLES, strict=True)
    ]


@lru_cache(maxsize=2 * LENSES_KEPT)
def _first_nodes(rows: int, columns: int) -> Int32[np.ndarray, " q"]:
    """Returns the upper left node (flat index) of each quad of a grid."""
    nodes = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    return nodes[:-1, :-1].ravel()


def _world_mesh(
    nodes: _Nodes, triangles: list[Bool[np.ndarray, "a b"]], world_from_camera: Float64[np.ndarray, "4 4"]
) -> TriangleMesh:
    """Keeps the nodes that triangles use and transforms them to the world."""
    shape = nodes.inverse_depth.shape
    is_used = np.zeros(shape, bool)
    for chosen, names in zip(triangles, QUAD_TRIANGLES, strict=True):
        for name in names:
            is_used[QUAD_CORNERS[name]] |= chosen
    used = np.flatnonzero(is_used)
    depth = 1 / nodes.inverse_depth.ravel().take(used).astype(np.float64)
    x, y = nodes.rays.reshape(2, -1).take(used, axis=1)
    rotation = world_from_camera[:3, :3]
    positions = _turned(np.stack([x * depth, y * depth, depth]), rotation) + world_from_camera[:3, 3:]
    normals = _turned(nodes.normals.reshape(3, -1).take(used, axis=1).astype(np.float64), rotation)
    uv = nodes.pixels.reshape(-1, 2).take(used, axis=0)
    numbers = np.cumsum(is_used, dtype=np.int32) - 1  # of vertices, node by node
    return TriangleMesh(
        np.ascontiguousarray(positions.T, np.float32),
        np.ascontiguousarray(normals.T, np.float32),
        _numbered(triangles, numbers, shape),
        uv,
        REAL_MATERIAL,
    )


def _turned(
    columns: Float64[np.ndarray, "3 n"], rotation: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "3 n"]:
    """Returns turned vectors. Given by columns: NumPy is slow along short rows."""
    # einsum, because the BLAS behind `@` spins on every core for such slim matrices.
    return np.asarray(np.einsum("ij,jn->in", rotation, columns))


def _numbered(
    triangles: list[Bool[np.ndarray, "a b"]], numbers: Int32[np.ndarray, " n"], shape: tuple[int, ...]
) -> Int32[np.ndarray, "m 3"]:
    """Returns the triangles, of which quads of a grid of that shape hold these, by the numbers of its nodes."""
    first, offsets = _first_nodes(*shape), (0, 1, shape[1], shape[1] + 1)
    ends = np.cumsum([np.count_nonzero(chosen) for chosen in triangles])
    found = np.empty((ends[-1], 3), np.int32)

    for chosen, end, names in zip(triangles, ends, QUAD_TRIANGLES, strict=True):
        node = first.take(np.flatnonzero(chosen))
        own = found[end - len(node) : end]
        for column, name in enumerate(names):
            own[:, column] = numbers.take(node + np.int32(offsets[name]))
    return found


def back_faces(corners: Float32[np.ndarray, "m 3 10"], voxel_edge: float) -> Float32[np.ndarray, "m 3 10"]:
    """Returns the back face of each triangle (three corners, position first), reversed and some voxels behind it.

    A depth camera sees only the front of things, but they block light from behind too: the underside of a shelf
    blocks the light from above it and reflects that from below. The thickness is unknown, so a back face lies as near
    as voxels allow. `voxel_edge` in m.
    """
    first, second, third = np.ascontiguousarray(corners[..., :3].transpose(1, 2, 0))
    along, beside = second - first, third - first
    across = np.stack(
        [
            along[after] * beside[before] - along[before] * beside[after]
            for after, before in ((1, 2), (2, 0), (0, 1))
        ]
    )
    normals = across / np.maximum(short_axis.lengths(across.T), np.finfo(np.float32).tiny)
    backs = corners[:, ::-1].copy()
    backs[..., :3] -= (BACK_OFFSET_VOXELS * voxel_edge * normals).T[:, None]
    return backs
