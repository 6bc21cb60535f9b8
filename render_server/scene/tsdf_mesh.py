"""Triangles of a fused volume: surface nets (Gibson 1998), and fewer of them by clustering vertices."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from render_server.scene.depth_mesh import REAL_MATERIAL
from render_server.scene.mesh_loading import TriangleMesh
from render_server.scene.tsdf_volume import BLOCK, GRID, FusedVolume

CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
EDGES = tuple((a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1)
VOXELS = GRID * BLOCK  # voxels an edge of the whole grid
# Growth of the clusters where their triangles are still too many.
CLUSTER_GROWTH = 1.15


class _Cells(NamedTuple):
    """Cells through which the surface passes: voxel of their first corner, distances at their corners."""

    voxel: Int64[np.ndarray, "n 3"]
    corners: Float32[np.ndarray, "n 8"]


def fused_mesh(volume: FusedVolume) -> TriangleMesh:
    """The surface where the field is zero, in the world; only where it was seen on all sides of a cell.

    Triangles are counter-clockwise seen from free space; normals are the field's gradient. Behind the rim of a thing
    that was seen from one side only, the surface goes on as far as distances reach, as if the thing were so thick.
    """
    cells = _crossed_cells(volume)
    places, normals = _vertices(cells)
    positions = (cells.voxel + places) * volume.placement.voxel_m + volume.placement.origin
    triangles = _triangles(cells)
    if volume.placement.hole is not None:
        least, greatest = volume.placement.hole
        inside = ((positions >= least) & (positions <= greatest)).all(axis=1)
        triangles = triangles[~inside[triangles].all(axis=1)]
    return _only_used(positions, normals, triangles)


def decimated(mesh: TriangleMesh, triangle_budget: int) -> TriangleMesh:
    """The mesh, or one of at most `triangle_budget` triangles: vertices within a cube become one (Rossignac 1993)."""
    if len(mesh.triangles) <= triangle_budget:
        return mesh
    corners = mesh.positions[mesh.triangles]
    double_area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    # A plane along the axes gives two triangles a cube's face; others give more.
    cell_m = float(np.sqrt(double_area.sum(dtype=np.float64) / max(triangle_budget, 1)))
    result = mesh
    while len(result.triangles) > triangle_budget:
        result = _clustered(mesh, cell_m)
        cell_m *= CLUSTER_GROWTH
    return result


def _clustered(mesh: TriangleMesh, cell_m: float) -> TriangleMesh:
    cube = np.floor(mesh.positions / cell_m).astype(np.int64)
    cube -= cube.min(axis=0)
    _, cluster = np.unique(
        np.ravel_multi_index(tuple(cube.T), tuple(cube.max(axis=0) + 1)), return_inverse=True
    )
    count = np.bincount(cluster)[:, None]
    positions = _sums(cluster, mesh.positions) / count
    normals = _unit(_sums(cluster, mesh.normals))
    corners = cluster[mesh.triangles]
    proper = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    return _only_used(positions, normals, _without_copies(corners[proper]))


def _without_copies(triangles: Int64[np.ndarray, "m 3"]) -> Int64[np.ndarray, "k 3"]:
    """One of the triangles that have the same corners."""
    low, middle, high = np.sort(triangles, axis=1).T
    count = int(triangles.max(initial=0)) + 1
    _, first = np.unique((low * count + middle) * count + high, return_index=True)
    return triangles[np.sort(first)]


def _sums(groups: Int64[np.ndarray, " n"], values: Float32[np.ndarray, "n 3"]) -> Float64[np.ndarray, "k 3"]:
    return np.stack([np.bincount(groups, values[:, axis]) for axis in range(3)], axis=1)


def _unit(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))


def _crossed_cells(volume: FusedVolume) -> _Cells:
    """Cells with known distances of both signs at their corners."""
    # Distances at the corners of a cell that the surface passes through are below sqrt(3) voxels.
    near = np.abs(volume.distance) < 2 * volume.placement.voxel_m
    blocks = np.flatnonzero(near.any(axis=1))
    distance = _with_border(volume, blocks)
    corners = [
        distance[:, x : BLOCK + x, y : BLOCK + y, z : BLOCK + z].reshape(-1, BLOCK**3) for x, y, z in CORNERS
    ]
    least, greatest = corners[0], corners[0]
    for corner in corners[1:]:  # NaN, unknown, stays NaN
        least, greatest = np.minimum(least, corner), np.maximum(greatest, corner)
    block, cell = np.nonzero((least < 0) & (greatest >= 0))
    inside = np.stack(np.unravel_index(cell, (BLOCK,) * 3), axis=1)
    voxel = volume.places[blocks[block]].astype(np.int64) * BLOCK + inside
    return _Cells(voxel, np.stack([corner[block, cell] for corner in corners], axis=1))


def _with_border(volume: FusedVolume, blocks: Int64[np.ndarray, " k"]) -> Float32[np.ndarray, "k 9 9 9"]:
    """Distances of blocks and of the voxels after them, NaN where unknown."""
    known = volume.known_distance()
    result = np.full((len(blocks), *(BLOCK + 1,) * 3), np.nan, np.float32)
    for step in CORNERS:
        place = volume.places[blocks] + step
        last = volume.placement.blocks - 1
        slot = np.where((place <= last).all(axis=1), volume.slots[tuple(np.minimum(place, last).T)], -1)
        there = np.flatnonzero(slot >= 0)
        part = known[slot[there]].reshape(-1, *(BLOCK,) * 3)[
            :, *(slice(0, 1) if far else slice(None) for far in step)
        ]
        result[there, *(slice(BLOCK, None) if far else slice(0, BLOCK) for far in step)] = part
    return result


def _vertices(cells: _Cells) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Mean of the zeros on a cell's edges (voxels from its first corner), and the field's direction there."""
    total = np.zeros((len(cells.voxel), 3))
    count = np.zeros((len(cells.voxel), 1))
    for a, b in EDGES:
        one, other = cells.corners[:, a], cells.corners[:, b]
        crossed = (one < 0) != (other < 0)
        share = np.divide(one, one - other, out=np.zeros_like(one), where=crossed)[:, None]
        total += np.where(crossed[:, None], CORNERS[a] + share * (CORNERS[b] - CORNERS[a]), 0)
        count += crossed[:, None]
    gradient = cells.corners.astype(np.float64) @ (2 * CORNERS - 1)
    return total / np.maximum(count, 1), _unit(gradient)


def _triangles(cells: _Cells) -> Int64[np.ndarray, "m 3"]:
    """Two triangles for each edge of the voxels' lattice that the surface crosses between four cells."""
    keys = np.ravel_multi_index(tuple(cells.voxel.T), (VOXELS,) * 3)
    order = np.argsort(keys)
    inside = cells.corners < 0
    parts = []
    for axis, end in enumerate((4, 2, 1)):  # corner at the end of the edge from corner 0 along the axis
        across = [np.eye(3, dtype=np.int64)[(axis + turn) % 3] for turn in (1, 2)]
        crossed = np.flatnonzero(inside[:, 0] != inside[:, end])
        ring = [
            -across[0] - across[1],
            -across[1],
            0 * across[0],
            -across[0],
        ]  # counter-clockwise about the axis
        found = np.stack([_find(keys, order, cells.voxel[crossed] + step) for step in ring], axis=1)
        whole = (found >= 0).all(axis=1)
        quads = found[whole]
        # Free space lies along the axis where the edge begins inside.
        quads = np.where(inside[crossed[whole], :1], quads, quads[:, ::-1])
        parts += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    return np.concatenate(parts)


def _find(
    keys: Int64[np.ndarray, " n"], order: Int64[np.ndarray, " n"], voxel: Int64[np.ndarray, "m 3"]
) -> Int64[np.ndarray, " m"]:
    """Number of the cell at each voxel, -1 for none."""
    if not len(keys):
        return np.full(len(voxel), -1)
    wanted = np.ravel_multi_index(tuple(np.maximum(voxel, 0).T), (VOXELS,) * 3)
    place = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
    known: Bool[np.ndarray, " m"] = (keys[place] == wanted) & (voxel >= 0).all(axis=1)
    return np.where(known, place, -1)


def _only_used(
    positions: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    triangles: Int64[np.ndarray, "m 3"],
) -> TriangleMesh:
    used = np.zeros(len(positions), bool)
    used[triangles.ravel()] = True
    numbers: Int32[np.ndarray, " n"] = np.cumsum(used, dtype=np.int32) - 1
    return TriangleMesh(
        positions[used].astype(np.float32),
        normals[used].astype(np.float32),
        numbers[triangles].astype(np.int32),
        None,
        REAL_MATERIAL,
    )
