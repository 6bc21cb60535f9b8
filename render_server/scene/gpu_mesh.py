"""Meshes merged for the GPU: parts in one vertex buffer, of which those that rest are kept."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Int32

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.scene.material_tables import material_table
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.triangle_mesh import (
    TriangleMesh,
    joined_attribute,
    joined_tangents,
    joined_triangles,
    padded,
)

VERTEX_LAYOUT = "3f 3f 2f 3f 1f"
CLEAR_FRACTION = 0.5  # beside the material's whole number, that of a vertex of opacity 0
VERTEX_ATTRIBUTES = ("in_position", "in_normal", "in_uv", "in_color", "in_material")


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Meshes that move together, such as those of one object; another part once they have moved.

    A row of `vertices` is position 3, normal 3, uv 2, colour 3, material index 1 (`VERTEX_LAYOUT`). `triangles` count
    from the part's own first vertex; `first_vertex` and `first_triangle` tell where they lie in the whole.
    """

    vertices: Float32[np.ndarray, "n 12"]
    triangles: Int32[np.ndarray, "m 3"]
    first_vertex: int
    first_triangle: int

    @cached_property
    def corners(self) -> Float32[np.ndarray, "m 3 3"]:
        """Positions of each triangle's corners."""
        return np.asarray(padded(self.vertices[:, :3]).take(self.triangles, axis=0)[..., :3])


@dataclass(frozen=True, eq=False)
class GpuMesh:
    """Several meshes in one vertex buffer: its `parts` one after the other.

    `triangles` count vertices of the whole. For `material_table` see `materials.material_table`. A row of `placement`
    is what maps need beside a vertex: the second uv 2, tangent 4, zero where there is none; None if no vertex has
    either.
    """

    parts: tuple[MeshPart, ...]
    triangles: Int32[np.ndarray, "m 3"]
    materials: tuple[Material, ...]
    material_table: Float32[np.ndarray, "k 20"]
    placement: Float32[np.ndarray, "n 6"] | None

    @property
    def vertex_count(self) -> int:
        """Number of all vertices."""
        last = self.parts[-1]
        return last.first_vertex + len(last.vertices)

    @cached_property
    def vertices(self) -> Float32[np.ndarray, "n 12"]:
        """Rows of all parts; copies them if there are several."""
        return _joined([part.vertices for part in self.parts])

    @cached_property
    def corners(self) -> Float32[np.ndarray, "m 3 3"]:
        """Positions of each triangle's corners."""
        return _joined([part.corners for part in self.parts])

    def parts_beside(self, before: "GpuMesh | None") -> list[MeshPart]:
        """Returns the parts that another mesh does not have at their places."""
        known = set() if before is None else set(before.parts)
        return [part for part in self.parts if part not in known]

    def repeats_per_m(self) -> Float32[np.ndarray, " k"]:
        """Returns how often the base colour's map repeats over a metre of each material's triangles, on average."""
        corners = self.vertices[self.triangles].astype(np.float64)
        edges, turns = (corners[:, 1:, part] - corners[:, :1, part] for part in (slice(0, 3), slice(6, 8)))
        material = corners[:, 0, 11].astype(int)
        area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        sums = [
            np.bincount(material, each, len(self.materials)) for each in (np.abs(np.linalg.det(turns)), area)
        ]
        scale = np.array([_map_area(each) for each in self.materials])
        return np.sqrt(scale * sums[0] / np.maximum(sums[1], 1e-30)).astype(np.float32)

    def mean_path_m(self, material: int) -> float:
        """Returns the mean length of straight paths through a closed part of that material, 4 V / A (Cauchy 1841)."""
        of_part = self.vertices[self.triangles[:, 0], 11].astype(int) == material
        a, b, c = np.moveaxis(self.vertices[self.triangles[of_part], :3].astype(np.float64), 1, 0)
        across = np.cross(b - a, c - a)
        volume = abs(float(((a - a.mean(axis=0)) * across).sum())) / 6
        return 4 * volume / max(float(np.linalg.norm(across, axis=1).sum()) / 2, 1e-30)


def _map_area(material: Material) -> float:
    """Returns the area of the base colour's map that a unit of texture coordinates covers."""
    placed = material.base_color_map
    return 1.0 if placed is None else abs(float(np.linalg.det(placed.from_uv[:, :2])))


def merge_for_gpu(meshes: Sequence[TriangleMesh]) -> GpuMesh:
    """Merges meshes (each with its own material, in this order) into one part.

    Raises:
        DeltalightError: there is no mesh.
    """
    return merge_parts([meshes])


def merge_parts(groups: Sequence[Sequence[TriangleMesh]]) -> GpuMesh:
    """Merges groups of meshes (each mesh with its own material, in this order), each into a part.

    Raises:
        DeltalightError: there is no mesh.
    """
    meshes = [mesh for group in groups for mesh in group]
    if not meshes:
        raise DeltalightError("there is no mesh to draw; give the scene an object.")
    materials = tuple(mesh.material for mesh in meshes)
    parts: list[MeshPart] = []
    material = vertex = triangle = 0
    for group in groups:
        triangles = joined_triangles(
            [mesh.triangles for mesh in group], [len(mesh.positions) for mesh in group]
        )
        parts.append(MeshPart(_interleaved(group, material), triangles, vertex, triangle))
        material += len(group)
        vertex += len(parts[-1].vertices)
        triangle += len(triangles)
    return GpuMesh(
        tuple(parts),
        joined_triangles([part.triangles for part in parts], [len(part.vertices) for part in parts]),
        materials,
        material_table(materials),
        _placement(meshes),
    )


def merged_again(
    merged: GpuMesh | None,
    before: Sequence[Sequence[TriangleMesh]],
    groups: Sequence[Sequence[TriangleMesh]],
) -> GpuMesh:
    """Merges groups as `merge_parts` does, keeping the parts that rest since those `before` were `merged`.

    Raises:
        DeltalightError: there is no mesh.
    """
    if merged is None or len(before) != len(groups) or not all(map(_have_only_moved, groups, before)):
        return merge_parts(groups)
    return replace(merged, parts=tuple(map(_moved, merged.parts, before, groups)))


def _have_only_moved(meshes: Sequence[TriangleMesh], before: Sequence[TriangleMesh]) -> bool:
    """Whether nothing but positions and normals differs."""
    if meshes is before:
        return True
    kept = "triangles", "uv", "material", "colors", "second_uv", "opacity", "tangents"
    return len(meshes) == len(before) and all(
        getattr(mesh, name) is getattr(old, name)
        for mesh, old in zip(meshes, before, strict=True)
        for name in kept
    )


def _moved(part: MeshPart, before: Sequence[TriangleMesh], meshes: Sequence[TriangleMesh]) -> MeshPart:
    """Returns a part of meshes that have moved since `before`: the same if they rest."""
    if meshes is before:
        return part
    rows, first = part.vertices.copy(), 0
    for mesh, old in zip(meshes, before, strict=True):
        own = rows[first : first + len(mesh.positions)]
        if mesh.positions is not old.positions:
            _write_columns(own, 0, mesh.positions)
        if mesh.normals is not old.normals:
            _write_columns(own, 3, mesh.normals)
        first += len(own)
    return replace(part, vertices=rows)


def _joined(arrays: Sequence[Float32[np.ndarray, "..."]]) -> Float32[np.ndarray, "..."]:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _placement(meshes: Sequence[TriangleMesh]) -> Float32[np.ndarray, "n 6"] | None:
    second_uv = joined_attribute([mesh.second_uv for mesh in meshes], meshes, 0.0)
    tangents = joined_tangents(meshes)
    if second_uv is None and tangents is None:
        return None
    rows = np.zeros((sum(len(mesh.positions) for mesh in meshes), 6), np.float32)
    for columns, values in ((slice(0, 2), second_uv), (slice(2, 6), tangents)):
        if values is not None:
            rows[:, columns] = values
    return rows


def _interleaved(meshes: Sequence[TriangleMesh], first_material: int) -> Float32[np.ndarray, "n 12"]:
    """Returns the vertices of meshes as rows."""
    ends = np.cumsum([len(mesh.positions) for mesh in meshes])
    rows = np.empty((ends[-1], 12), np.float32)
    for material, (mesh, end) in enumerate(zip(meshes, ends, strict=True), first_material):
        own = rows[end - len(mesh.positions) : end]
        for first, values in ((0, mesh.positions), (3, mesh.normals), (6, mesh.uv), (8, mesh.colors)):
            if values is not None:
                _write_columns(own, first, values)
        if mesh.uv is None:
            own[:, 6:8] = 0
        if mesh.colors is None:
            own[:, 8:11] = 1
        own[:, 11] = material
        if mesh.opacity is not None:
            own[:, 11] += CLEAR_FRACTION * (1 - np.clip(mesh.opacity[:, 0], 0, 1))
    return rows


def _write_columns(rows: Float32[np.ndarray, "n 12"], first: int, values: Float32[np.ndarray, "n k"]) -> None:
    """Writes k columns from `first` on; one by one, because NumPy is slow along short rows."""
    for column, part in enumerate(values.T, first):
        rows[:, column] = part
