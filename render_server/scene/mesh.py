"""Triangle meshes: loading from files, merging for the GPU, splitting for voxelisation."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float32, Float64, Int32

from protocol.errors import DeltalightError
from protocol.frames import decode_lut
from render_server.scene.asset_check import MAX_TRIANGLES, CheckedGltf, check_mesh_file, read_gltf
from render_server.scene.materials import Material, material_table
from render_server.scene.normals import face_normals, smooth_normals

MAX_COORDINATE_M = 1e4
MAX_PIECES = 4_000_000
VERTEX_LAYOUT = "3f 3f 2f 3f 1f"
VERTEX_ATTRIBUTES = ("in_position", "in_normal", "in_uv", "in_color", "in_material")


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
class GpuMesh:
    """Several meshes in one vertex buffer.

    A row of `vertices` is position 3, normal 3, uv 2, colour 3, material index 1 (`VERTEX_LAYOUT`).
    `material_table` is described where it is made; `textures` are the base-colour textures in the order of its
    texture indices.
    """

    vertices: Float32[np.ndarray, "n 12"]
    triangles: Int32[np.ndarray, "m 3"]
    materials: tuple[Material, ...]
    material_table: Float32[np.ndarray, "k 16"]
    textures: tuple[np.ndarray, ...]


def load_mesh(path: Path) -> list[TriangleMesh]:
    """Read a GLB, glTF, OBJ, PLY or STL file: one mesh a material, in the file's own axes and units.

    The scene graph's transforms are applied, degenerate triangles dropped, missing normals computed (sharp
    at edges beyond 60 degrees). Vertex colours are sRGB bytes, in glTF linear.

    Raises:
        DeltalightError: the file is missing, of an unknown type, damaged, empty, or has coordinates that
            are not finite or beyond 10 km.
    """
    suffix = check_mesh_file(path)
    checked = read_gltf(path) if suffix in (".glb", ".gltf") else None
    parts: dict[int, list[TriangleMesh]] = defaultdict(list)
    for key, part in _parts(_open_scene(path, checked), checked, path):
        parts[key].append(part)
    meshes = [_joined(same) for same in parts.values()]
    if not meshes:
        raise DeltalightError(f"{path} has no triangle with an area; export a triangle mesh.")
    return meshes


def _open_scene(path: Path, checked: CheckedGltf | None) -> trimesh.Scene:
    try:
        if checked is None:
            return trimesh.load_scene(path, process=False, maintain_order=True)
        resolver = trimesh.resolvers.FilePathResolver(path)
        return trimesh.load_scene(
            checked.stream, file_type=checked.file_type, resolver=resolver, process=False
        )
    except MemoryError:
        raise
    except Exception as error:  # a damaged file can make the loader fail in any way
        raise DeltalightError(f"{path} cannot be read as a mesh ({error}); export it again.") from error


def _parts(scene: trimesh.Scene, checked: CheckedGltf | None, path: Path) -> list[tuple[int, TriangleMesh]]:
    """Return (material key, mesh in the file's frame) of every node that shows triangles."""
    materials: dict[int, Material] = {}
    parts = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or len(geometry.faces) == 0:
            continue
        key = id(getattr(geometry.visual, "material", None))
        if key not in materials:
            materials[key] = _material(geometry, checked, path)
        mesh = _converted(geometry, materials[key], path)
        if mesh is not None:
            parts.append((key, mesh if np.array_equal(matrix, np.eye(4)) else mesh.transformed(matrix)))
    return parts


def _material(geometry: trimesh.Trimesh, checked: CheckedGltf | None, path: Path) -> Material:
    try:
        return _described_material(geometry, checked).checked(str(path))
    except (TypeError, ValueError, AttributeError) as error:
        raise DeltalightError(f"{path} has a malformed material ({error}); export it again.") from error


def _described_material(geometry: trimesh.Trimesh, checked: CheckedGltf | None) -> Material:
    loaded = getattr(geometry.visual, "material", None)
    if checked is not None:
        if loaded is None or not str(loaded.name).isdigit():
            return Material(base_color=np.ones(3, np.float32), name="default")
        description = checked.document["materials"][int(loaded.name)]
        return Material.from_gltf(description, loaded.baseColorTexture)
    if loaded is not None and isinstance(loaded, trimesh.visual.material.SimpleMaterial):
        # An image that no file names is the loader's own placeholder.
        image = loaded.image if loaded.image is not None and "file_path" in loaded.image.info else None
        return Material.from_mtl(str(loaded.name or ""), loaded.kwargs or {}, image)
    has_colors = geometry.visual.kind == "vertex"
    return Material(base_color=np.ones(3, np.float32)) if has_colors else Material()


def _converted(geometry: trimesh.Trimesh, material: Material, path: Path) -> TriangleMesh | None:
    """Take over a loaded mesh; None if all its triangles are degenerate."""
    positions = np.asarray(geometry.vertices, np.float32)
    triangles = np.asarray(geometry.faces, np.int64)
    _check_geometry(positions, triangles, path)
    triangles = triangles[face_normals(positions, triangles.astype(np.int32))[1]].astype(np.int32)
    if len(triangles) == 0:
        return None
    normals = _given_normals(geometry, len(positions), path)
    source = np.arange(len(positions))
    if normals is None:
        source, triangles, normals = smooth_normals(positions, triangles)
    uv, colors = _uv(geometry, len(positions)), _colors(geometry, len(positions))
    return TriangleMesh(
        np.ascontiguousarray(positions[source]),
        normals,
        triangles,
        None if uv is None else uv[source],
        material,
        None if colors is None else colors[source],
    )


def _check_geometry(positions: Float32[np.ndarray, "n 3"], triangles: np.ndarray, path: Path) -> None:
    if triangles.min() < 0 or triangles.max() >= len(positions):
        raise DeltalightError(f"{path} has triangles whose vertices do not exist; export the mesh again.")
    if len(triangles) > MAX_TRIANGLES:
        raise DeltalightError(f"{path} has more than {MAX_TRIANGLES} triangles; simplify the mesh.")
    if not np.isfinite(positions).all():
        raise DeltalightError(f"{path} has coordinates that are not finite; repair the mesh.")
    if np.abs(positions).max() > MAX_COORDINATE_M:
        raise DeltalightError(f"{path} has coordinates beyond 10 km; scale the mesh to metres.")


def _given_normals(geometry: trimesh.Trimesh, count: int, path: Path) -> Float32[np.ndarray, "n 3"] | None:
    """Return the file's own normals, normalised; None where it has none or some of length zero."""
    if "vertex_normals" not in geometry._cache:
        return None
    normals = np.asarray(geometry._cache["vertex_normals"], np.float32)
    if normals.shape != (count, 3):
        return None
    if not np.isfinite(normals).all():
        raise DeltalightError(f"{path} has normals that are not finite; repair the mesh.")
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / lengths if (lengths > 1e-6).all() else None


def _uv(geometry: trimesh.Trimesh, count: int) -> Float32[np.ndarray, "n 2"] | None:
    """Return texture coordinates; the loader's have their origin at the bottom."""
    uv = getattr(geometry.visual, "uv", None)
    if uv is None or np.shape(uv) != (count, 2) or not np.isfinite(uv).all():
        return None
    return np.column_stack([uv[:, 0], 1 - uv[:, 1]]).astype(np.float32)


def _colors(geometry: trimesh.Trimesh, count: int) -> Float32[np.ndarray, "n 3"] | None:
    """Return linear vertex colours: sRGB bytes of PLY, STL and OBJ, linear attributes of glTF."""
    attributes: dict[str, Any] = getattr(geometry.visual, "vertex_attributes", {})
    values = np.asarray(attributes.get("color", np.zeros(0)))
    if values.shape[:1] == (count,):
        scale = np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1.0
        return (values[:, :3] / np.float32(scale)).astype(np.float32)
    if geometry.visual.kind != "vertex":
        return None
    codes = np.asarray(geometry.visual.vertex_colors, np.uint8)[:, :3]
    return decode_lut(None)[:, 0][codes]


def _joined(parts: Sequence[TriangleMesh]) -> TriangleMesh:
    """Concatenate meshes of one material."""
    if len(parts) == 1:
        return parts[0]
    starts = np.cumsum([0] + [len(part.positions) for part in parts[:-1]])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=True)]
    return TriangleMesh(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate(triangles).astype(np.int32),
        _joined_attribute([part.uv for part in parts], parts, 0.0),
        parts[0].material,
        _joined_attribute([part.colors for part in parts], parts, 1.0),
    )


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


def merge_for_gpu(meshes: Sequence[TriangleMesh]) -> GpuMesh:
    """Put meshes (each with its own material, in this order) into one interleaved buffer.

    Raises:
        DeltalightError: there is no mesh.
    """
    if not meshes:
        raise DeltalightError("there is no mesh to draw; give the scene an object.")
    materials = tuple(mesh.material for mesh in meshes)
    starts = np.cumsum([0] + [len(mesh.positions) for mesh in meshes[:-1]])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)]
    textures = [material.base_color_texture for material in materials]
    return GpuMesh(
        np.concatenate([_interleaved(mesh, index) for index, mesh in enumerate(meshes)]),
        np.concatenate(triangles).astype(np.int32),
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
    """Bisect longest edges until none is longer than `max_edge` (same unit as the positions).

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
    """Refuse before the memory is gone, by a bound from below on the number of pieces.

    An equilateral triangle is the largest that the limit allows; bisection ends a few times above that.
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
    """Cut every triangle at the midpoint of its edge number `edge` (from corner `edge` to the next)."""
    row = np.arange(len(corners))
    start, end, opposite = (corners[row, (edge + step) % 3] for step in range(3))
    middle = (start + end) * np.float32(0.5)
    halves = [np.stack([start, middle, opposite], axis=1), np.stack([middle, end, opposite], axis=1)]
    return np.concatenate(halves)
