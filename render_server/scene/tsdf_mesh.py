"""Mesh of the real scene's TSDF: surface nets (Gibson 1998), decimated by clustering vertices."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from deltalight.protocol import short_axis
from deltalight.render_server.scene.depth_mesh import REAL_MATERIAL
from deltalight.render_server.scene.depth_surface import DepthSurface
from deltalight.render_server.scene.depth_views import DepthViews, PosedSurface
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.scene.tsdf_volume import (
    BLOCK,
    CORNERS,
    GRID,
    PixelPlanes,
    TsdfPlacement,
    TsdfVolume,
    aligned_view,
)
from deltalight.render_server.view import CameraView

EDGES = tuple((a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1)
VOXELS = GRID * BLOCK  # per edge of the whole grid
# Growth of the clusters while there are too many triangles.
CLUSTER_GROWTH = 1.15
# Points beyond this many median distances go to a second, coarser volume: a far wall would otherwise use up the
# voxels that near things need.
NEAR_MEDIANS = 2.0
# Triangles of the near and the far volume at full resolution, before decimation: integrating a frame and extracting
# the meshes take a core 30 ms each at 320x240.
FINE_TRIANGLES = (80_000, 20_000)
# A surface of area A crosses A (|nx| + |ny| + |nz|) / h^2 edges of the lattice, 1.5 A / h^2 in the mean over
# directions; each gives two triangles.
TRIANGLES_PER_CELL = 3.0
# Memory for four times the blocks that the first frame fills (measured: a block per 54 triangles), 36 MB for the near
# volume; blocks beyond are left out.
TRIANGLES_PER_BLOCK = 54 / 4
# Fraction of a box's edge that the first frame fills: later frames look elsewhere.
FIRST_FRACTION = 0.5
# Meshes are extracted again when this fraction of the voxels at surfaces moved by more than this fraction of a voxel:
# less hardly changes how much of the scene's voxels they cover.
MOVED_FRACTION, MOVED_VOXELS = 0.02, 0.25


class _Cells(NamedTuple):
    """Cells that the surface crosses: voxel of their first corner, and distances at all corners."""

    voxel: Int64[np.ndarray, "n 3"]
    corners: Float32[np.ndarray, "n 8"]


def extract_mesh(volume: TsdfVolume) -> TriangleMesh:
    """Extracts the zero level set, in the world, from cells whose corners are all known.

    Triangles are counter-clockwise seen from free space; normals are the field's gradient. Behind the rim of a thing
    that was seen from one side only, the surface continues up to the truncation distance.
    """
    cells = _crossed_cells(volume)
    places, normals = _vertices(cells)
    positions = (cells.voxel + places) * volume.placement.voxel_m + volume.placement.origin
    triangles = _triangles(cells)
    if volume.placement.hole is not None:
        least, greatest = volume.placement.hole
        inside = short_axis.all_of((positions >= least) & (positions <= greatest))
        triangles = triangles[~short_axis.all_of(inside[triangles])]
    return _only_used(positions, normals, triangles)


def decimated(mesh: TriangleMesh, triangle_budget: int) -> TriangleMesh:
    """Returns a mesh of at most `triangle_budget` triangles: vertices within a cube become one (Rossignac 1993)."""
    if len(mesh.triangles) <= triangle_budget:
        return mesh
    corners = mesh.positions[mesh.triangles]
    double_area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    # An axis-aligned plane gives two triangles per face of a cube; others give more.
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
    proper = short_axis.all_of(corners != np.roll(corners, 1, axis=1))
    return _only_used(positions, normals, _without_copies(corners[proper]))


def _without_copies(triangles: Int64[np.ndarray, "m 3"]) -> Int64[np.ndarray, "k 3"]:
    """Drops all but one of the triangles with the same corners."""
    low, middle, high = np.sort(triangles, axis=1).T
    count = int(triangles.max(initial=0)) + 1
    _, first = np.unique((low * count + middle) * count + high, return_index=True)
    return triangles[np.sort(first)]


def _sums(groups: Int64[np.ndarray, " n"], values: Float32[np.ndarray, "n 3"]) -> Float64[np.ndarray, "k 3"]:
    return np.stack([np.bincount(groups, values[:, axis]) for axis in range(3)], axis=1)


def _unit(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return np.asarray(vectors / np.maximum(short_axis.lengths(vectors)[:, None], 1e-12))


def _crossed_cells(volume: TsdfVolume) -> _Cells:
    """Returns the cells with known distances of both signs at their corners."""
    # Distances at the corners of a crossed cell are below sqrt(3) voxels.
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


def _with_border(volume: TsdfVolume, blocks: Int64[np.ndarray, " k"]) -> Float32[np.ndarray, "k 9 9 9"]:
    """Returns the distances of blocks with the next voxels of their neighbours, NaN where unknown."""
    known = volume.known_distance()
    result = np.full((len(blocks), *(BLOCK + 1,) * 3), np.nan, np.float32)
    for step in CORNERS:
        place = volume.places[blocks] + step
        last = volume.placement.blocks - 1
        slot = np.where(short_axis.all_of(place <= last), volume.slots[tuple(np.minimum(place, last).T)], -1)
        there = np.flatnonzero(slot >= 0)
        part = known[slot[there]].reshape(-1, *(BLOCK,) * 3)[
            :, *(slice(0, 1) if far else slice(None) for far in step)
        ]
        result[there, *(slice(BLOCK, None) if far else slice(0, BLOCK) for far in step)] = part
    return result


def _vertices(cells: _Cells) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Returns the mean of the zero crossings on a cell's edges (voxels from its first corner), and normals."""
    total = np.zeros((len(cells.voxel), 3))
    count = np.zeros((len(cells.voxel), 1))
    for a, b in EDGES:
        one, other = cells.corners[:, a], cells.corners[:, b]
        crossed = (one < 0) != (other < 0)
        fraction = np.divide(one, one - other, out=np.zeros_like(one), where=crossed)[:, None]
        total += np.where(crossed[:, None], CORNERS[a] + fraction * (CORNERS[b] - CORNERS[a]), 0)
        count += crossed[:, None]
    gradient = cells.corners.astype(np.float64) @ (2 * CORNERS - 1)
    return total / np.maximum(count, 1), _unit(gradient)


def _triangles(cells: _Cells) -> Int64[np.ndarray, "m 3"]:
    """Connects the four cells around each lattice edge that the surface crosses by two triangles."""
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
    """Returns the index of the cell at each voxel, -1 for none."""
    if not len(keys):
        return np.full(len(voxel), -1)
    wanted = np.ravel_multi_index(tuple(np.maximum(voxel, 0).T), (VOXELS,) * 3)
    place = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
    known: Bool[np.ndarray, " m"] = (keys[place] == wanted) & short_axis.all_of(voxel >= 0)
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


class TsdfScene:
    """Near and far TSDF volume of the real scene, laid out for the first frames, and their meshes.

    `view` is the view from which the newest depth of the first camera fits the field.
    """

    def __init__(self) -> None:
        self.volumes: list[TsdfVolume] = []
        self._meshed: list[Float32[np.ndarray, "b 512"]] = []
        self._meshes: list[TriangleMesh] = []
        self.view: CameraView | None = None

    @property
    def voxel_m(self) -> float:
        """Voxel edge of the near volume, m; 0 before the first frame."""
        return self.volumes[0].placement.voxel_m if self.volumes else 0.0

    def add(self, *frames: PosedSurface, settle: bool = False) -> bool:
        """Integrates a frame of each camera; returns whether the meshes changed.

        Args:
            frames: the depth of a moment; those without any known pixel change nothing. Poses by a marker board are
                refined against the field.
            settle: extract the meshes however little changed.
        """
        self.view = frames[0].view
        known = [frame for frame in frames if (frame.surface.inverse_depth > 0).any()]
        if not known:
            return False
        if not self.volumes:
            self.volumes = [TsdfVolume(place) for place in place_tsdf_volumes(known)]
            self._meshed = [volume.known_distance() for volume in self.volumes]
        for frame in known:
            self._integrate(frame, is_first=frame is frames[0])
        if not settle and self._moved_fraction() <= MOVED_FRACTION:
            return False
        self._meshed = [volume.known_distance() for volume in self.volumes]
        self._meshes = [extract_mesh(volume) for volume in self.volumes]
        return True

    def _integrate(self, frame: PosedSurface, *, is_first: bool) -> None:
        view = frame.view
        if frame.aligns:
            view = aligned_view(self.volumes, frame.surface, view, frame.noise_sigma)
        if is_first:
            self.view = view
        planes = PixelPlanes.of(frame.surface, view.camera, frame.noise_sigma)
        for volume in self.volumes:
            volume.integrate(planes, view)

    def meshes(self, *triangle_budgets: int) -> list[list[TriangleMesh]]:
        """Returns near and far mesh within each triangle budget (in falling order); none before the first frame."""
        meshes, result = self._meshes, []
        for budget in triangle_budgets:
            fraction = min(1.0, budget / max(sum(len(mesh.triangles) for mesh in meshes), 1))
            meshes = [decimated(mesh, int(fraction * len(mesh.triangles))) for mesh in meshes]
            result.append(meshes)
        return result

    def _moved_fraction(self) -> float:
        """Returns the fraction of voxels at surfaces that moved since the meshes were extracted."""
        pairs = zip(self.volumes, self._meshed, strict=True)
        counts = np.array([_count_moved(volume, meshed) for volume, meshed in pairs]).sum(axis=0)
        return float(counts[0] / max(counts[1], 1))


def _count_moved(volume: TsdfVolume, meshed: Float32[np.ndarray, "b 512"]) -> tuple[int, int]:
    """Counts the voxels at surfaces that moved, and all voxels at surfaces."""
    now, voxel_m = volume.known_distance(), volume.placement.voxel_m
    before = np.full_like(now, np.nan)
    before[: len(meshed)] = meshed
    at_surface: Bool[np.ndarray, "b 512"] = (np.abs(now) < voxel_m) | (np.abs(before) < voxel_m)
    moved = at_surface & ~(np.abs(now - before) <= MOVED_VOXELS * voxel_m)
    return int(np.count_nonzero(moved)), int(np.count_nonzero(at_surface))


class _SeenPoints(NamedTuple):
    """Points of a frame's known pixels: position (world, m), depth (m), area (m^2)."""

    points: Float64[np.ndarray, "n 3"]
    z: Float64[np.ndarray, " n"]
    area: Float64[np.ndarray, " n"]

    def only(self, chosen: Bool[np.ndarray, " n"]) -> "_SeenPoints":
        return _SeenPoints(*(values[chosen] for values in self))


def place_tsdf_volumes(frames: Sequence[PosedSurface]) -> tuple[TsdfPlacement, TsdfPlacement]:
    """Places a cube around the near points of the cameras' frames, and a coarser one around all of them."""
    shown = _all_seen_points(frames)
    near = shown.z <= NEAR_MEDIANS * np.median(shown.z)
    pixel = max(1 / float(frame.view.camera.matrix[0, 0]) for frame in frames)
    details_1m = max(frame.noise_sigma for frame in frames), pixel
    inside = _placement(shown.only(near), shown.only(near), details_1m, FINE_TRIANGLES[0])
    beyond = shown if near.all() else shown.only(~near)
    around = _placement(shown, beyond, details_1m, FINE_TRIANGLES[1])
    return inside, replace(around, hole=inside.box)


def _all_seen_points(frames: Sequence[PosedSurface]) -> _SeenPoints:
    """Returns the points of all frames; the area of a surface that several show is divided among them."""
    parts = [_seen_points(frame.surface, frame.view) for frame in frames]
    if len(parts) == 1:
        return parts[0]
    together = _SeenPoints(*map(np.concatenate, zip(*parts, strict=True)))
    showing = DepthViews(tuple(frames)).count_showing(together.points)
    return together._replace(area=together.area / np.maximum(showing, 1))


def _placement(
    held: _SeenPoints, counted: _SeenPoints, details_1m: tuple[float, float], triangles: int
) -> TsdfPlacement:
    """Places a cube around the points `held`, with voxels so small that the points `counted` give so many triangles.

    Voxels are no smaller than a frame's noise and a pixel's footprint (`details_1m`: at 1 m) at the median distance,
    and so large that the cube leaves room around what it holds.
    """
    low, high = np.percentile(held.points, [1, 99], axis=0)
    edge_m = float((high - low).max()) / FIRST_FRACTION
    noise, pixel = details_1m
    distance = float(np.median(counted.z))
    by_budget = float(np.sqrt(TRIANGLES_PER_CELL * counted.area.sum() / triangles))
    voxel_m = max(by_budget, noise * distance**2, pixel * distance, edge_m / (GRID * BLOCK))
    blocks = min(int(np.ceil(edge_m / (BLOCK * voxel_m))), GRID)
    x, y, z = (float(v) for v in (low + high) / 2 - voxel_m * blocks * BLOCK / 2)
    return TsdfPlacement((x, y, z), voxel_m, blocks, int(triangles / TRIANGLES_PER_BLOCK))


def _seen_points(surface: DepthSurface, view: CameraView) -> _SeenPoints:
    """Returns the points of known pixels; a pixel's area is z^2 / f^2 / cos(slant), with a slant up to 80 degrees."""
    known = surface.inverse_depth > 0
    z = 1 / surface.inverse_depth[known].astype(np.float64)
    rays = np.dstack([view.camera.rays(), np.ones(known.shape, np.float32)])[known].astype(np.float64)
    cosine = np.abs(np.einsum("ni,ni->n", rays, surface.normals[known])) / short_axis.lengths(rays)
    cosine = np.where(cosine > 0, cosine, 1)  # unknown normals count as facing the camera
    matrix, focal = view.world_from_camera, view.camera.matrix
    area = z * z / (focal[0, 0] * focal[1, 1]) / np.maximum(cosine, np.cos(np.radians(80)))
    return _SeenPoints(rays * z[:, None] @ matrix[:3, :3].T + matrix[:3, 3], z, area)
