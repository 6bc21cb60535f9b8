"""Triangle meshes: checks and conversion of a file's geometry, vertex normals, joining, and the form for the GPU."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64

from deltalight.protocol import short_axis
from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.scene.asset_check import MAX_TRIANGLES
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.texture_maps import TextureMap

# Scanned meshes of 100k triangles are full of edges beyond 40 degrees that nobody means to be sharp.
CREASE_ANGLE_DEG = 60.0
# Twice the area relative to the longest edge squared, below which a triangle has no normal in float32.
DEGENERATE_RATIO = 1e-9
# Components of a unit vector are rounded by up to 6e-8 each, and once more by a length.
UNIT_ROUNDING = 2.5e-7
MAX_COORDINATE_M = 1e4


def face_normals(
    positions: Float32[np.ndarray, "n 3"], triangles: Int32[np.ndarray, "m 3"]
) -> tuple[Float64[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Returns unit normals by the right-hand rule, and which triangles are not degenerate."""
    corners = positions.astype(np.float64)[triangles]
    edges = np.roll(corners, -1, axis=1) - corners
    normals = np.cross(edges[:, 0], edges[:, 1])
    double_area = short_axis.lengths(normals)
    longest = short_axis.greatest(np.einsum("mij,mij->mi", edges, edges))
    proper = double_area > DEGENERATE_RATIO * longest
    normals[proper] /= double_area[proper, None]
    return normals, proper


@dataclass(frozen=True, eq=False)
class Smoothing:
    """Smoothing group of each vertex. Edges stay sharp or smooth while a mesh deforms."""

    group: Int32[np.ndarray, " n"]

    def normals(
        self, positions: Float32[np.ndarray, "n 3"], triangles: Int32[np.ndarray, "m 3"]
    ) -> Float32[np.ndarray, "n 3"]:
        """Returns angle-weighted mean normals (Thuermer & Wuethrich 1998) of each group."""
        normals, _ = face_normals(positions, triangles)
        weights = _corner_angles(positions.astype(np.float64)[triangles]).ravel()[:, None]
        weighted = weights * np.repeat(normals, 3, axis=0)
        groups = self.group[triangles.ravel()]
        sums = np.stack([np.bincount(groups, weighted[:, axis]) for axis in range(3)], axis=1)
        lengths = np.maximum(short_axis.lengths(sums)[:, None], 1e-30)
        return np.asarray((sums / lengths)[self.group], np.float32)


def split_at_creases(
    positions: Float32[np.ndarray, "n 3"],
    triangles: Int32[np.ndarray, "m 3"],
    crease_deg: float = CREASE_ANGLE_DEG,
) -> tuple[Int64[np.ndarray, " k"], Int32[np.ndarray, "m 3"], Smoothing]:
    """Splits vertices where normals must not be smoothed over a crease.

    Vertices at one position count as one. Around each, triangles that hang together over edges with less
    than `crease_deg` between their normals share a normal. Triangles must not be degenerate.

    Returns:
        (source, triangles, smoothing): vertex i of the result is vertex source[i] of the input.
    """
    normals, _ = face_normals(positions, triangles)
    welded = weld(positions)[triangles]
    groups = _smoothing_groups(welded, normals, np.cos(np.radians(crease_deg)))
    keys = groups.astype(np.int64) * len(positions) + triangles.ravel()
    _, first, index = np.unique(keys, return_index=True, return_inverse=True)
    source = triangles.ravel()[first].astype(np.int64)
    return source, index.reshape(-1, 3).astype(np.int32), Smoothing(groups[first])


def smooth_normals(
    positions: Float32[np.ndarray, "n 3"],
    triangles: Int32[np.ndarray, "m 3"],
    crease_deg: float = CREASE_ANGLE_DEG,
) -> tuple[Int64[np.ndarray, " k"], Int32[np.ndarray, "m 3"], Float32[np.ndarray, "k 3"]]:
    """Computes normals that do not smooth over creases.

    Returns:
        (source, triangles, normals): as of `split_at_creases`.
    """
    source, split, smoothing = split_at_creases(positions, triangles, crease_deg)
    return source, split, smoothing.normals(positions[source], split)


def unit_or(
    vectors: Float[np.ndarray, "n 3"], instead: Float[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Normalizes vectors; zero vectors become `instead`, unit vectors within float32 rounding keep their bits."""
    lengths = np.linalg.norm(vectors.astype(np.float64), axis=1, keepdims=True)
    lengths[np.abs(lengths - 1) < UNIT_ROUNDING] = 1
    return np.where(lengths > 0, vectors / np.maximum(lengths, 1e-300), instead).astype(np.float32)


def weld(positions: Float32[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Returns the index of each vertex's position; equal positions share an index."""
    order = np.lexsort(positions.T)
    ordered = positions[order]
    fresh = np.concatenate([[False], (ordered[1:] != ordered[:-1]).any(axis=1)])
    numbers = np.empty(len(positions), np.int64)
    numbers[order] = np.cumsum(fresh)
    return numbers


def _smoothing_groups(
    welded: Int64[np.ndarray, "m 3"], normals: Float64[np.ndarray, "m 3"], cos_crease: float
) -> Int32[np.ndarray, " c"]:
    """Returns the smoothing group of every corner (3 * triangle + k)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    start, end = welded.ravel(), np.roll(welded, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((low, high))
    same = (low[order[1:]] == low[order[:-1]]) & (high[order[1:]] == high[order[:-1]])
    one, other = order[:-1][same], order[1:][same]
    smooth = np.einsum("ei,ei->e", normals[one // 3], normals[other // 3]) >= cos_crease
    one, other = one[smooth], other[smooth]
    one_end, other_end = _next_corner(one), _next_corner(other)
    # Neighbours wound alike run through their common edge in opposite directions.
    alike = start[one] == start[other]
    rows = np.concatenate([one, one_end])
    columns = np.concatenate([np.where(alike, other, other_end), np.where(alike, other_end, other)])
    count = welded.size
    links = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], np.int32)


def _next_corner(corner: Int64[np.ndarray, " e"]) -> Int64[np.ndarray, " e"]:
    return np.asarray(corner - corner % 3 + (corner + 1) % 3)


def _corner_angles(corners: Float64[np.ndarray, "m 3 3"]) -> Float64[np.ndarray, "m 3"]:
    forward = np.roll(corners, -1, axis=1) - corners
    backward = np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(forward, backward), axis=2)
    return np.asarray(np.arctan2(sine, np.einsum("mij,mij->mi", forward, backward)))


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles of one material, counter-clockwise seen from outside.

    `normals` are unit vectors. `uv` (0, 0) is the top-left corner of the texture array. `colors` are linear
    R G B that multiply the material's base colour. `second_uv` is what maps of set 1 lie on. `opacity` (0..1)
    multiplies the alpha of a material that is blended or masked. `tangents` point along u of normal maps (unit
    vectors, or zero where the file gives none); w: +1 or -1, the sign of (normal x tangent) along the maps' y.
    """

    positions: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    triangles: Int32[np.ndarray, "m 3"]
    uv: Float32[np.ndarray, "n 2"] | None
    material: Material
    colors: Float32[np.ndarray, "n 3"] | None = None
    second_uv: Float32[np.ndarray, "n 2"] | None = None
    opacity: Float32[np.ndarray, "n 1"] | None = None
    tangents: Float32[np.ndarray, "n 4"] | None = None

    def uv_of(self, texture: TextureMap | None) -> Float32[np.ndarray, "n 2"] | None:
        """Returns the coordinates that a map of its material lies on; None without them, or without a map."""
        if texture is None:
            return None
        return self.second_uv if texture.uv_set == 1 else self.uv

    def bounds(self) -> Float32[np.ndarray, "2 3"]:
        """Returns the least and greatest coordinates of the vertices that triangles use."""
        return np.stack(self.bounds_at(self.positions))

    def bounds_at(
        self, positions: short_axis.Array[short_axis.Scalar]
    ) -> tuple[short_axis.Array[short_axis.Scalar], short_axis.Array[short_axis.Scalar]]:
        """Returns the least and the greatest of those vertices' coordinates if all were at other positions (n, 3)."""
        uses_all = len(self._used) == len(positions)
        return short_axis.bounds(positions if uses_all else positions.take(self._used, axis=0))

    @cached_property
    def _used(self) -> Int64[np.ndarray, " k"]:
        """Numbers of the vertices that triangles use."""
        is_used = np.zeros(len(self.positions), bool)
        is_used[self.triangles.ravel()] = True
        return np.flatnonzero(is_used)

    def changed(self, **attributes: Any) -> "TriangleMesh":  # noqa: ANN401 (of any attribute)
        """Returns the mesh with other attributes; its triangles use the same vertices."""
        mesh = replace(self, **attributes)
        if "_used" in vars(self):  # the same, and it takes longer to find than to move the mesh
            vars(mesh)["_used"] = self._used
        return mesh


def turned_tangents(
    tangents: Float32[np.ndarray, "n 4"], linear: Float64[np.ndarray, "*n 3 3"], mirrored: bool
) -> Float32[np.ndarray, "n 4"]:
    """Transforms tangents by one matrix, or one each, as directions of the surface; mirrors turn the sign of w."""
    along = (linear @ tangents[:, :3, None].astype(np.float64))[..., 0]
    unit = unit_or(along, np.zeros_like(along))
    return np.column_stack([unit, -tangents[:, 3] if mirrored else tangents[:, 3]])


@dataclass(frozen=True, eq=False)
class FileGeometry:
    """Geometry of one mesh as a file has it; None for attributes that it lacks."""

    positions: Float32[np.ndarray, "n 3"]
    triangles: Int64[np.ndarray, "m 3"]
    normals: Float32[np.ndarray, "n 3"] | None = None
    uv: Float32[np.ndarray, "n 2"] | None = None
    colors: Float32[np.ndarray, "n 3"] | None = None
    second_uv: Float32[np.ndarray, "n 2"] | None = None
    opacity: Float32[np.ndarray, "n 1"] | None = None
    tangents: Float32[np.ndarray, "n 4"] | None = None


@dataclass(frozen=True, eq=False)
class ConvertedMesh:
    """A converted mesh, the file's vertex behind each of its vertices, and its smoothing if normals were computed."""

    mesh: TriangleMesh
    source: Int64[np.ndarray, " n"]
    smoothing: Smoothing | None


def converted(
    given: FileGeometry, material: Material, path: Path, *, keeps_degenerate: bool = False
) -> ConvertedMesh | None:
    """Converts a file's mesh; None if no triangle is left after dropping degenerate ones.

    Computes missing normals (sharp at edges beyond 60 degrees); tangents then do not count (glTF 2.0, 3.7.2.1).

    Raises:
        DeltalightError: vertices that do not exist, coordinates or normals that are not finite, or beyond 10 km.
    """
    positions, triangles = given.positions, given.triangles
    if len(triangles) == 0:
        return None
    _check_geometry(positions, triangles, path)
    triangles = triangles.astype(np.int32)
    if not keeps_degenerate:
        triangles = triangles[face_normals(positions, triangles)[1]]
    if len(triangles) == 0:
        return None
    normals = _unit_normals(given.normals, len(positions), path)
    source, smoothing, tangents = np.arange(len(positions)), None, given.tangents
    if normals is None:
        source, triangles, smoothing = split_at_creases(positions, triangles)
        tangents = None
        normals = smoothing.normals(positions[source], triangles)
    mesh = TriangleMesh(
        np.ascontiguousarray(positions[source]),
        normals,
        triangles,
        None if given.uv is None else given.uv[source],
        material,
        None if given.colors is None else given.colors[source],
        None if given.second_uv is None else given.second_uv[source],
        None if given.opacity is None else given.opacity[source],
        None if tangents is None else _unit_tangents(tangents),
    )
    return ConvertedMesh(mesh, source, smoothing)


def _check_geometry(
    positions: Float32[np.ndarray, "n 3"], triangles: Int64[np.ndarray, "m 3"], path: Path
) -> None:
    if triangles.min() < 0 or triangles.max() >= len(positions):
        raise DeltalightError(f"{path} has triangles whose vertices do not exist; export the mesh again.")
    if len(triangles) > MAX_TRIANGLES:
        raise DeltalightError(f"{path} has more than {MAX_TRIANGLES} triangles; simplify the mesh.")
    if not np.isfinite(positions).all():
        raise DeltalightError(f"{path} has coordinates that are not finite; repair the mesh.")
    if np.abs(positions).max() > MAX_COORDINATE_M:
        raise DeltalightError(f"{path} has coordinates beyond 10 km; scale the mesh to metres.")


def _unit_normals(
    normals: Float32[np.ndarray, "n 3"] | None, count: int, path: Path
) -> Float32[np.ndarray, "n 3"] | None:
    """Returns the file's own normals at unit length; None where it has none or some of length zero."""
    if normals is None or normals.shape != (count, 3):
        return None
    if not np.isfinite(normals).all():
        raise DeltalightError(f"{path} has normals that are not finite; repair the mesh.")
    return unit_or(normals, normals) if (np.linalg.norm(normals, axis=1) > 1e-6).all() else None


def _unit_tangents(tangents: Float32[np.ndarray, "n 4"]) -> Float32[np.ndarray, "n 4"]:
    """Returns tangents of length 1 with w as its sign; those that are not finite or have no length become zero."""
    usable = np.isfinite(tangents).all(axis=1, keepdims=True)
    finite = np.where(usable, tangents, 0)
    unit = unit_or(finite[:, :3], np.zeros_like(finite[:, :3]))
    return np.column_stack([unit, np.where(finite[:, 3] < 0, -1, 1).astype(np.float32)])


def joined(parts: Sequence[TriangleMesh]) -> TriangleMesh:
    """Concatenates meshes of one material."""
    if len(parts) == 1:
        return parts[0]
    return TriangleMesh(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.normals for part in parts]),
        joined_triangles([part.triangles for part in parts], [len(part.positions) for part in parts]),
        joined_attribute([part.uv for part in parts], parts, 0.0),
        parts[0].material,
        joined_attribute([part.colors for part in parts], parts, 1.0),
        joined_attribute([part.second_uv for part in parts], parts, 0.0),
        joined_attribute([part.opacity for part in parts], parts, 1.0),
        joined_tangents(parts),
    )


def joined_triangles(
    parts: Sequence[Int32[np.ndarray, "_ 3"]], vertex_counts: Sequence[int]
) -> Int32[np.ndarray, "m 3"]:
    """Concatenates triangles whose vertices are concatenated too."""
    starts = np.cumsum([0, *vertex_counts[:-1]], dtype=np.int32)
    return np.concatenate(
        [
            np.asarray(triangles, np.int32) + start if start else np.asarray(triangles, np.int32)
            for triangles, start in zip(parts, starts, strict=True)
        ]
    )


def joined_tangents(parts: Sequence[TriangleMesh]) -> Float32[np.ndarray, "n 4"] | None:
    """Concatenates tangents; zero for parts without; None if no part has any."""
    return joined_attribute([part.tangents for part in parts], parts, 0.0)


def joined_attribute(
    values: Sequence[np.ndarray | None], parts: Sequence[TriangleMesh], default: float
) -> np.ndarray | None:
    """Concatenates an attribute; parts without it get the default; None if no part has it."""
    width = next((value.shape[1] for value in values if value is not None), None)
    if width is None:
        return None
    filled = [
        np.full((len(part.positions), width), default, np.float32) if value is None else value
        for value, part in zip(values, parts, strict=True)
    ]
    return np.concatenate(filled)


def bounds_of(meshes: Sequence[TriangleMesh]) -> Float32[np.ndarray, "2 3"]:
    """Returns the least and greatest coordinates of several meshes together."""
    each = np.stack([mesh.bounds() for mesh in meshes])
    return np.stack([each[:, 0].min(axis=0), each[:, 1].max(axis=0)])


def padded(positions: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 4"]:
    """Returns positions with a zero behind each: NumPy gathers rows of 16 bytes three times as fast as rows of 12."""
    rows = np.zeros((len(positions), 4), np.float32)
    rows[:, :3] = positions
    return rows
