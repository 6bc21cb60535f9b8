"""Meshes in other frames: what a change of place alone, as of dragged objects, leaves as it is, is kept."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol import short_axis
from deltalight.render_server.scene.triangle_mesh import TriangleMesh, turned_tangents


@dataclass(frozen=True, eq=False)
class TurnedMesh:
    """A mesh in another frame except for its place there: `positions` (n, 3) are relative to that.

    The positions of `mesh` itself mean nothing.
    """

    mesh: TriangleMesh
    positions: Float64[np.ndarray, "n 3"]

    def at(self, place: Float64[np.ndarray, "3"]) -> TriangleMesh:
        """Returns the mesh at its place."""
        return self.mesh.changed(positions=(self.positions + place).astype(np.float32))

    def bounds_at(self, place: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "2 3"]:
        """Returns the bounds of the mesh at its place.

        To the bit: rounding keeps the order of positions, so the least is the rounded least.
        """
        return np.asarray(self._bounds + place, np.float32)

    @cached_property
    def _bounds(self) -> Float64[np.ndarray, "2 3"]:
        """The same relative to its place."""
        return np.stack(self.mesh.bounds_at(self.positions))


def turned(mesh: TriangleMesh, linear: Float64[np.ndarray, "3 3"]) -> TurnedMesh:
    """Returns a mesh turned and scaled, to be placed; a mirroring matrix reverses the winding."""
    normals = mesh.normals @ np.linalg.inv(linear)
    normals /= np.maximum(short_axis.lengths(normals)[:, None], 1e-30)
    mirrored = bool(np.linalg.det(linear) < 0)
    changed = mesh.changed(
        normals=normals.astype(np.float32),
        triangles=np.ascontiguousarray(mesh.triangles[:, ::-1]) if mirrored else mesh.triangles,
        tangents=None if mesh.tangents is None else turned_tangents(mesh.tangents, linear, mirrored),
    )
    return TurnedMesh(changed, mesh.positions @ linear.T)


def transformed(mesh: TriangleMesh, matrix: Float64[np.ndarray, "4 4"]) -> TriangleMesh:
    """Returns a mesh in another frame; a mirroring matrix reverses the winding."""
    return turned(mesh, matrix[:3, :3]).at(matrix[:3, 3])
