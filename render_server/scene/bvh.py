"""Bounding volume hierarchy of triangles for stackless traversal (passes/shaders/common/ray_mesh.glsl).

Many rays are cast on the processor by Embree (`RayCaster`), a single one by `first_hit`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from deltalight.protocol import short_axis
from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.render_server.scene.triangle_mesh import padded

LEAF_SIZE = 4  # triangles at most: boxes around fewer cost as many tests as they save
BINS = 16  # places an axis where a node may be split (Wald 2007)
# Of the greatest coordinate: boxes grow by it, so that float32 rays do not miss what touches them.
ROUNDING = 1e-6
COUNT_BITS = 3  # of a leaf: its number of triangles stands below the place of the first
PARALLEL = 1e-12  # determinant (m^2), from which on a ray counts as going along the triangle's plane


@dataclass(frozen=True, eq=False)
class Bvh:
    """Nodes in depth-first order: a node's first child follows it; `skip` is the node after its last descendant.

    `leaf` is -1 for inner nodes, else the index of the first triangle in `order` << 3 | number of triangles.
    """

    low: Float32[np.ndarray, "k 3"]
    high: Float32[np.ndarray, "k 3"]
    leaf: Int32[np.ndarray, " k"]
    skip: Int32[np.ndarray, " k"]
    order: Int32[np.ndarray, " m"]

    def packed(self, first_node: int = 0, first_triangle: int = 0) -> Float32[np.ndarray, "k 8"]:
        """Packs nodes as the shader's struct: low corner, leaf, high corner, skip (integers by their bits).

        `first_node`, `first_triangle`: how many of others stand before these.
        """
        rows = _box_rows(self.low, self.high)
        bits = rows.view(np.int32)
        bits[:, 3] = np.where(self.leaf < 0, self.leaf, self.leaf + (first_triangle << COUNT_BITS))
        bits[:, 7] = self.skip + first_node
        return rows

    def packed_triangles(
        self,
        positions: Float32[np.ndarray, "n 3"],
        triangles: Int32[np.ndarray, "m 3"],
        first_vertex: int = 0,
        out: Float32[np.ndarray, "m 3 4"] | None = None,
    ) -> Float32[np.ndarray, "m 3 4"]:
        """Packs triangles in `order`: first corner, edge to the second, edge to the third, with each one's vertex.

        `first_vertex`: how many vertices of others stand before these. `out`: where the triangles are to be packed.
        """
        vertices = padded(positions)
        vertices.view(np.int32)[:, 3] = np.arange(first_vertex, first_vertex + len(vertices))
        # In its default mode, "raise", NumPy would gather into a copy first.
        rows = vertices.take(triangles.take(self.order, axis=0), axis=0, out=out, mode="clip")
        for axis in range(3):  # one by one, as in `_box_rows`
            first, second, third = rows[:, :, axis].T
            second -= first
            third -= first
        return rows

    @property
    def cost(self) -> float:
        """Expected number of boxes that a ray opens: the sum of their surface areas relative to the root's."""
        x, y, z = (self.high.astype(np.float64) - self.low).T
        areas = x * z + y * x + z * y
        return float(areas.sum() / areas[0])

    def refitted(self, corners: Float32[np.ndarray, "m 3 3"]) -> "Bvh":
        """Refits the tree to moved triangles: always correct, and efficient while neighbours stay neighbours.

        Boxes are (low, 0, -high, 0) meanwhile, so that one minimum joins both corners.
        """
        least, greatest = short_axis.boxes(corners)
        triangles = _box_rows(least, -greatest)
        boxes = np.empty((len(self.leaf), 8), np.float32)
        leaves, held = self._leaves
        boxes[leaves] = reduce(np.minimum, [triangles.take(each, axis=0) for each in held])
        for nodes, children in self._inner:
            boxes[nodes] = np.minimum(*boxes.take(children, axis=0))
        margin = np.float32(ROUNDING * float(np.abs(boxes[0]).max()))
        return replace(self, low=boxes[:, :3] - margin, high=margin - boxes[:, 4:7])

    @cached_property
    def _leaves(self) -> tuple[Int64[np.ndarray, " l"], Int64[np.ndarray, "t l"]]:
        """The leaves, and the triangles of each; the last one stands in where a leaf holds fewer."""
        (leaves,) = np.nonzero(self.leaf >= 0)
        first, count = self.leaf[leaves] >> COUNT_BITS, self.leaf[leaves] & ((1 << COUNT_BITS) - 1)
        place = np.minimum(np.arange(count.max())[:, None], count - 1)
        return leaves, self.order[first + place].astype(np.int64)

    @cached_property
    def _inner(self) -> Sequence[tuple[Int64[np.ndarray, " i"], Int64[np.ndarray, "2 i"]]]:
        """Inner nodes of each depth, the deepest first, and their children; the first child follows its node."""
        depths = []
        nodes = np.zeros(1, np.int64)
        while len(nodes := nodes[self.leaf[nodes] < 0]):
            children = np.stack([nodes + 1, self.skip[nodes + 1].astype(np.int64)])
            depths.append((nodes, children))
            nodes = children.ravel()
        return depths[::-1]


def _box_rows(
    low: Float32[np.ndarray, "k 3"], high: Float32[np.ndarray, "k 3"]
) -> Float32[np.ndarray, "k 8"]:
    """Returns rows of (low, 0, high, 0): NumPy gathers rows of 32 bytes seven times as fast as rows of 24."""
    rows = np.zeros((len(low), 8), np.float32)
    for axis in range(3):  # one by one, because NumPy is slow along short rows
        rows[:, axis], rows[:, 4 + axis] = low[:, axis], high[:, axis]
    return rows


@dataclass(frozen=True, eq=False)
class _Level:
    """Nodes of one depth. The children of `inner` nodes are consecutive pairs in the next level."""

    low: Float32[np.ndarray, "s 3"]
    high: Float32[np.ndarray, "s 3"]
    inner: Bool[np.ndarray, " s"]


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Bounds of every triangle."""

    low: Float32[np.ndarray, "m 3"]
    high: Float32[np.ndarray, "m 3"]
    centre: Float32[np.ndarray, "m 3"]


def build_bvh(corners: Float32[np.ndarray, "m 3 3"]) -> Bvh:
    """Builds a tree by the binned surface area heuristic, all nodes of a depth at once; m >= 1.

    Deterministic: the same triangles give the same tree.
    """
    low, high = short_axis.boxes(corners)
    boxes = _Boxes(low, high, (low + high) * np.float32(0.5))
    levels: list[_Level] = []
    leaf_of = np.zeros((len(corners), 2), np.int64)  # level and number of the leaf that holds a triangle
    triangles, node = np.arange(len(corners)), np.zeros(len(corners), np.int64)
    while len(triangles):
        level, triangles, node = _split(boxes, triangles, node, leaf_of, len(levels))
        levels.append(level)
    return _flattened(levels, leaf_of, ROUNDING * float(np.abs(corners).max()))


def _split(
    boxes: _Boxes,
    triangles: Int64[np.ndarray, " a"],
    node: Int64[np.ndarray, " a"],
    leaf_of: Int64[np.ndarray, "m 2"],
    depth: int,
) -> tuple[_Level, Int64[np.ndarray, " b"], Int64[np.ndarray, " b"]]:
    """Returns the level of `triangles`, sorted by their `node` in it, and triangles and nodes of the next level."""
    counts = np.bincount(node)
    starts = np.cumsum(counts) - counts
    low = np.minimum.reduceat(boxes.low[triangles], starts)
    high = np.maximum.reduceat(boxes.high[triangles], starts)
    inner = counts > LEAF_SIZE
    ends = ~inner[node]
    leaf_of[triangles[ends]] = np.stack([np.full(ends.sum(), depth), node[ends]], axis=1)
    triangles, node = triangles[~ends], (np.cumsum(inner) - 1)[node[~ends]]
    if len(triangles):
        triangles, node = _children(boxes, triangles, node)
    return _Level(low, high, inner), triangles, node


def _children(
    boxes: _Boxes, triangles: Int64[np.ndarray, " a"], node: Int64[np.ndarray, " a"]
) -> tuple[Int64[np.ndarray, " a"], Int64[np.ndarray, " a"]]:
    """Sorts each node's triangles along its longest axis and divides them between its two children."""
    counts = np.bincount(node)
    starts = np.cumsum(counts) - counts
    centre = boxes.centre[triangles]
    least = np.minimum.reduceat(centre, starts)
    extent = np.maximum.reduceat(centre, starts) - least
    axis = extent.argmax(axis=1)
    rows = np.arange(len(counts))
    width = np.maximum(extent[rows, axis], np.finfo(np.float32).tiny)
    along = np.take_along_axis(centre, axis[node, None], axis=1)[:, 0] - least[rows, axis][node]
    cell = node * BINS + np.minimum((along / width[node] * BINS).astype(np.int64), BINS - 1)
    sort = np.argsort(cell, kind="stable")
    triangles, node, cell = triangles[sort], node[sort], cell[sort]
    first_count = _best_split(boxes, triangles, cell, counts)
    place = np.arange(len(triangles)) - starts[node]
    return triangles, 2 * node + (place >= first_count[node])


def _best_split(
    boxes: _Boxes,
    triangles: Int64[np.ndarray, " a"],
    cell: Int64[np.ndarray, " a"],
    counts: Int64[np.ndarray, " s"],
) -> Int64[np.ndarray, " s"]:
    """Returns how many triangles of each node, sorted by cell, the first child gets: half if all lie in one bin."""
    held = np.bincount(cell, minlength=len(counts) * BINS)
    used = np.flatnonzero(held)
    starts = np.cumsum(held[used]) - held[used]
    low = np.full((len(held), 3), np.inf, np.float32)
    high = np.full((len(held), 3), -np.inf, np.float32)
    low[used] = np.minimum.reduceat(boxes.low[triangles], starts)
    high[used] = np.maximum.reduceat(boxes.high[triangles], starts)
    bins_low, bins_high = low.reshape(-1, BINS, 3), high.reshape(-1, BINS, 3)
    before = np.cumsum(held.reshape(-1, BINS), axis=1)[:, :-1]
    behind = counts[:, None] - before
    cost = _areas(bins_low, bins_high)[:, :-1] * before
    cost += _areas(bins_low[:, ::-1], bins_high[:, ::-1])[:, ::-1][:, 1:] * behind
    cost = np.where((before == 0) | (behind == 0), np.inf, cost)
    best = cost.argmin(axis=1)
    rows = np.arange(len(counts))
    return np.where(np.isfinite(cost[rows, best]), before[rows, best], counts // 2)


def _areas(
    low: Float32[np.ndarray, "s b 3"], high: Float32[np.ndarray, "s b 3"]
) -> Float32[np.ndarray, "s b"]:
    """Returns half the surface area of the box around the first bins; 0 where they are empty."""
    extent = np.maximum.accumulate(high, axis=1) - np.minimum.accumulate(low, axis=1)
    extent = np.where(np.isfinite(extent), extent, 0)
    return np.asarray((extent * np.roll(extent, 1, axis=-1)).sum(axis=-1))


def _flattened(levels: list[_Level], leaf_of: Int64[np.ndarray, "m 2"], margin: float) -> Bvh:
    """Orders nodes depth first: subtree sizes bottom-up, then positions top-down."""
    sizes = [np.ones(len(level.inner), np.int64) for level in levels]
    for depth in reversed(range(len(levels) - 1)):
        sizes[depth][levels[depth].inner] += sizes[depth + 1].reshape(-1, 2).sum(axis=1)
    places = [np.zeros(1, np.int64)]
    for depth in range(len(levels) - 1):
        first = places[depth][levels[depth].inner] + 1
        places.append(np.stack([first, first + sizes[depth + 1][::2]], axis=1).ravel())
    return _assembled(levels, sizes, places, leaf_of, margin)


def _assembled(
    levels: list[_Level],
    sizes: list[Int64[np.ndarray, " s"]],
    places: list[Int64[np.ndarray, " s"]],
    leaf_of: Int64[np.ndarray, "m 2"],
    margin: float,
) -> Bvh:
    """Puts the nodes of all levels in their positions, and the triangles in the order of their leaves."""
    place, size = np.concatenate(places), np.concatenate(sizes)
    back = np.argsort(place)
    starts = np.cumsum([0] + [len(level.inner) for level in levels])
    home = place[starts[leaf_of[:, 0]] + leaf_of[:, 1]]
    order = np.argsort(home, kind="stable")
    held = np.bincount(home, minlength=len(place))
    first = np.cumsum(held) - held
    return Bvh(
        np.concatenate([level.low for level in levels])[back] - np.float32(margin),
        np.concatenate([level.high for level in levels])[back] + np.float32(margin),
        np.where(held > 0, first << COUNT_BITS | held, -1).astype(np.int32),
        (place + size)[back].astype(np.int32),
        order.astype(np.int32),
    )


def first_hit(
    corners: Float32[np.ndarray, "m 3 3"],
    origin: Float64[np.ndarray, "3"],
    direction: Float64[np.ndarray, "3"],
) -> tuple[float, Float64[np.ndarray, "3"]] | None:
    """Intersects a single ray with all triangles (Möller and Trumbore 1997); building a tree would not pay off.

    Returns:
        The distance to the nearest hit in lengths of `direction`, and its unit normal towards the origin; else None.
    """
    first, second, third = np.moveaxis(corners.astype(np.float64), 1, 0)
    u_edge, v_edge = second - first, third - first
    across = np.cross(direction, v_edge)
    determinant = (u_edge * across).sum(axis=1)
    crossed = np.abs(determinant) > PARALLEL
    scale = np.divide(1.0, determinant, out=np.zeros_like(determinant), where=crossed)
    start = origin - first
    u = (start * across).sum(axis=1) * scale
    turned = np.cross(start, u_edge)
    v, distance = (turned @ direction) * scale, (turned * v_edge).sum(axis=1) * scale
    hit = crossed & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    if not hit.any():
        return None
    nearest = int(np.flatnonzero(hit)[distance[hit].argmin()])
    normal = np.cross(u_edge[nearest], v_edge[nearest])
    normal /= np.linalg.norm(normal)
    return float(distance[nearest]), -normal if normal @ direction > 0 else normal


@dataclass(frozen=True, eq=False)
class FirstHits:
    """What each ray meets first: a triangle, -1 for none, and the weights of its second and third corner there."""

    triangle: Int32[np.ndarray, " r"]
    u: Float32[np.ndarray, " r"]
    v: Float32[np.ndarray, " r"]


class RayCaster:
    """Casts rays at triangles with Embree: by embreex, or by libigl where embreex has no wheel (Linux on arm64).

    libigl takes rays one by one and needs seven times as long.

    Raises:
        DeltalightError: neither package is installed.
    """

    def __init__(self, positions: Float32[np.ndarray, "n 3"], triangles: Int32[np.ndarray, "m 3"]) -> None:
        for backend in (_embreex, _libigl):
            try:
                self._cast = backend(positions, triangles)
            except ImportError:
                continue
            return
        raise DeltalightError(f"Rays are cast by the package embreex: {install_command('embreex')}.")

    def cast(self, origins: Float32[np.ndarray, "r 3"], directions: Float32[np.ndarray, "r 3"]) -> FirstHits:
        """Returns what rays without an end meet first."""
        return self._cast(np.ascontiguousarray(origins), np.ascontiguousarray(directions))


_Cast = Callable[[Float32[np.ndarray, "r 3"], Float32[np.ndarray, "r 3"]], FirstHits]


def _embreex(positions: Float32[np.ndarray, "n 3"], triangles: Int32[np.ndarray, "m 3"]) -> _Cast:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(positions), np.ascontiguousarray(triangles))

    def cast(origins: Float32[np.ndarray, "r 3"], directions: Float32[np.ndarray, "r 3"]) -> FirstHits:
        found = scene.run(origins, directions, output=1)
        return FirstHits(found["primID"], found["u"], found["v"])

    return cast


def _libigl(positions: Float32[np.ndarray, "n 3"], triangles: Int32[np.ndarray, "m 3"]) -> _Cast:
    from igl.embree import EmbreeIntersector

    scene = EmbreeIntersector()
    scene.init(np.asfortranarray(positions), np.asfortranarray(triangles))

    def cast(origins: Float32[np.ndarray, "r 3"], directions: Float32[np.ndarray, "r 3"]) -> FirstHits:
        rays = zip(origins, directions, strict=True)
        found = np.array([scene.intersectRay_first(*ray) for ray in rays]).reshape(-1, 4)
        with np.errstate(over="ignore"):  # rays that meet nothing have any u and v
            return FirstHits(found[:, 0].astype(np.int32), *found[:, 2:].astype(np.float32).T)

    return cast
