"""Triangles of one material, and what every file's geometry must be before it becomes such."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from protocol.errors import DeltalightError
from render_server.scene.asset_check import MAX_TRIANGLES
from render_server.scene.materials import Material
from render_server.scene.normals import Smoothing, face_normals, split_at_creases, unit_or

MAX_COORDINATE_M = 1e4


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles of one material, counter-clockwise seen from outside.

    `normals` are unit vectors. `uv` (0, 0) is the top-left corner of the texture array. `colors` are linear
    R G B that multiply the material's base colour.
    """

    positions: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    triangles: Int32[np.ndarray, "m 3"]
    uv: Float32[np.ndarray, "n 2"] | None
    material: Material
    colors: Float32[np.ndarray, "n 3"] | None = None

    def bounds(self) -> Float32[np.ndarray, "2 3"]:
        """Return the least and greatest coordinates of the vertices that triangles use."""
        used = self.positions[self.triangles.ravel()]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    def transformed(self, matrix: Float64[np.ndarray, "4 4"]) -> "TriangleMesh":
        """Return the mesh in another frame; a mirroring matrix turns the winding round."""
        linear = matrix[:3, :3]
        positions = self.positions @ linear.T + matrix[:3, 3]
        normals = self.normals @ np.linalg.inv(linear)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        mirrored = np.linalg.det(linear) < 0
        return replace(
            self,
            positions=positions.astype(np.float32),
            normals=normals.astype(np.float32),
            triangles=np.ascontiguousarray(self.triangles[:, ::-1]) if mirrored else self.triangles,
        )


@dataclass(frozen=True, eq=False)
class FileGeometry:
    """What a file says of one mesh; None where it says nothing."""

    positions: Float32[np.ndarray, "n 3"]
    triangles: Int64[np.ndarray, "m 3"]
    normals: Float32[np.ndarray, "n 3"] | None = None
    uv: Float32[np.ndarray, "n 2"] | None = None
    colors: Float32[np.ndarray, "n 3"] | None = None


@dataclass(frozen=True, eq=False)
class ConvertedMesh:
    """A mesh, which of the file's vertices each of its vertices is, and how its normals were computed, if so."""

    mesh: TriangleMesh
    source: Int64[np.ndarray, " n"]
    smoothing: Smoothing | None


def converted(
    given: FileGeometry, material: Material, path: Path, *, keeps_degenerate: bool = False
) -> ConvertedMesh | None:
    """Take over a file's mesh; None if no triangle is left after degenerate ones are dropped.

    Missing normals are computed (sharp at edges beyond 60 degrees).

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
    source, smoothing = np.arange(len(positions)), None
    if normals is None:
        source, triangles, smoothing = split_at_creases(positions, triangles)
        normals = smoothing.normals(positions[source], triangles)
    mesh = TriangleMesh(
        np.ascontiguousarray(positions[source]),
        normals,
        triangles,
        None if given.uv is None else given.uv[source],
        material,
        None if given.colors is None else given.colors[source],
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
    """The file's own normals, normalised; None where it has none or some of length zero."""
    if normals is None or normals.shape != (count, 3):
        return None
    if not np.isfinite(normals).all():
        raise DeltalightError(f"{path} has normals that are not finite; repair the mesh.")
    return unit_or(normals, normals) if (np.linalg.norm(normals, axis=1) > 1e-6).all() else None


def joined(parts: Sequence[TriangleMesh]) -> TriangleMesh:
    """Concatenate meshes of one material."""
    if len(parts) == 1:
        return parts[0]
    return TriangleMesh(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.normals for part in parts]),
        joined_triangles([part.triangles for part in parts], [len(part.positions) for part in parts]),
        _joined_attribute([part.uv for part in parts], parts, 0.0),
        parts[0].material,
        _joined_attribute([part.colors for part in parts], parts, 1.0),
    )


def joined_triangles(
    parts: Sequence[Int32[np.ndarray, "_ 3"]], vertex_counts: Sequence[int]
) -> Int32[np.ndarray, "m 3"]:
    """Concatenate triangles whose vertices are concatenated too."""
    starts = np.cumsum([0, *vertex_counts[:-1]])
    moved = [triangles + start for triangles, start in zip(parts, starts, strict=True)]
    return np.concatenate(moved).astype(np.int32)


def _joined_attribute(
    values: Sequence[np.ndarray | None], parts: Sequence[TriangleMesh], default: float
) -> np.ndarray | None:
    """Concatenate an attribute; parts without it get the default; None if no part has it."""
    width = next((value.shape[1] for value in values if value is not None), None)
    if width is None:
        return None
    filled = [
        np.full((len(part.positions), width), default, np.float32) if value is None else value
        for value, part in zip(values, parts, strict=True)
    ]
    return np.concatenate(filled)
