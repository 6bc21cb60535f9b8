"""Triangle meshes as the GPU consumes them: merged into one vertex buffer, or split for voxelisation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from protocol.errors import DeltalightError
from render_server.scene.materials import Material, material_table
from render_server.scene.triangle_mesh import TriangleMesh, joined_triangles

MAX_PIECES = 4_000_000
VERTEX_LAYOUT = "3f 3f 2f 3f 1f"
VERTEX_ATTRIBUTES = ("in_position", "in_normal", "in_uv", "in_color", "in_material")


@dataclass(frozen=True, eq=False)
class GpuMesh:
    """Several meshes in one vertex buffer.

    A row of `vertices` is position 3, normal 3, uv 2, colour 3, material index 1 (`VERTEX_LAYOUT`).
    For `material_table` see `materials.material_table`; `textures` are the base-colour textures in the order of its
    texture indices.
    """

    vertices: Float32[np.ndarray, "n 12"]
    triangles: Int32[np.ndarray, "m 3"]
    materials: tuple[Material, ...]
    material_table: Float32[np.ndarray, "k 16"]
    textures: tuple[np.ndarray, ...]


def merge_for_gpu(meshes: Sequence[TriangleMesh]) -> GpuMesh:
    """Merges meshes (each with its own material, in this order) into one interleaved buffer.

    Raises:
        DeltalightError: there is no mesh.
    """
    if not meshes:
        raise DeltalightError("there is no mesh to draw; give the scene an object.")
    materials = tuple(mesh.material for mesh in meshes)
    textures = [material.base_color_texture for material in materials]
    return GpuMesh(
        np.concatenate([_interleaved(mesh, index) for index, mesh in enumerate(meshes)]),
        joined_triangles([mesh.triangles for mesh in meshes], [len(mesh.positions) for mesh in meshes]),
        materials,
        material_table(materials),
        tuple(texture for texture in textures if texture is not None),
    )


def _interleaved(mesh: TriangleMesh, material_id: int) -> Float32[np.ndarray, "n 12"]:
    rows = np.empty((len(mesh.positions), 12), np.float32)
    rows[:, 0:3], rows[:, 3:6] = mesh.positions, mesh.normals
    rows[:, 6:8] = 0.0 if mesh.uv is None else mesh.uv
    rows[:, 8:11] = 1.0 if mesh.colors is None else mesh.colors
    rows[:, 11] = material_id
    return rows


def split_triangles(corners: Float32[np.ndarray, "m 3 c"], max_edge: float) -> Float32[np.ndarray, "k 3 c"]:
    """Bisects longest edges until none is longer than `max_edge` (same unit as the positions).

    Columns 0..2 of a corner are its position; all other columns (normal, uv, material index...) are
    interpolated linearly with it. Triangles that are short enough come first, unchanged and in order.
    (llvmpipe ends loops of a shader invocation early, so voxelisation needs triangles of bounded size.)

    Raises:
        DeltalightError: more than 4 million triangles would result.
    """
    done: list[np.ndarray] = []
    pending = np.ascontiguousarray(corners, np.float32)
    _check_pieces(pending, max_edge)
    while len(pending):
        edges = np.roll(pending[..., :3], -1, axis=1) - pending[..., :3]
        lengths = np.linalg.norm(edges, axis=2)
        long = lengths.max(axis=1) > max_edge
        done.append(pending[~long])
        pending = _bisected(pending[long], lengths[long].argmax(axis=1))
    return np.concatenate(done) if done else np.zeros_like(pending)


def _check_pieces(corners: Float32[np.ndarray, "m 3 c"], max_edge: float) -> None:
    """Refuses by a lower bound on the number of pieces, before memory runs out.

    An equilateral triangle is the largest that the limit allows; bisection makes a few times as many.
    """
    edges = np.roll(corners[..., :3], -1, axis=1) - corners[..., :3]
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    by_area = areas / (np.sqrt(3) / 4 * max_edge**2)
    by_length = np.linalg.norm(edges, axis=2).max(axis=1, initial=0) / max_edge
    if np.maximum(by_area, by_length).sum() > MAX_PIECES:
        raise DeltalightError(
            f"a mesh splits into more than {MAX_PIECES} triangles; use fewer voxels or a smaller mesh."
        )


def _bisected(corners: Float32[np.ndarray, "m 3 c"], edge: np.ndarray) -> Float32[np.ndarray, "k 3 c"]:
    """Cuts every triangle at the midpoint of its edge number `edge` (from corner `edge` to the next)."""
    row = np.arange(len(corners))
    start, end, opposite = (corners[row, (edge + step) % 3] for step in range(3))
    middle = (start + end) * np.float32(0.5)
    halves = [np.stack([start, middle, opposite], axis=1), np.stack([middle, end, opposite], axis=1)]
    return np.concatenate(halves)
