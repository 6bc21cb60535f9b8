"""Loading of mesh files: GLB, glTF, OBJ, PLY, STL."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut
from deltalight.protocol.scene_objects import GLTF_SUFFIXES
from deltalight.render_server.lights.light_models import Light
from deltalight.render_server.scene.asset_check import check_mesh_file
from deltalight.render_server.scene.gltf_meshes import GltfAsset, load_gltf
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.moved_meshes import transformed
from deltalight.render_server.scene.triangle_mesh import (
    FileGeometry,
    TriangleMesh,
    bounds_of,
    converted,
    joined,
)

if TYPE_CHECKING:
    import trimesh


def no_lamps(_world_from_asset: Float64[np.ndarray, "4 4"]) -> tuple[Light, ...]:
    """Returns no lights, for files that have none."""
    return ()


@dataclass(frozen=True, eq=False)
class Asset:
    """The meshes of a file in their rest pose, and the glTF asset that animates them if the file has clips.

    `left_out` says what of the file is not shown. `lamps` returns the file's lights at rest, in the world.
    """

    meshes: list[TriangleMesh]
    animated: GltfAsset | None
    left_out: str | None = None
    lamps: Callable[[Float64[np.ndarray, "4 4"]], tuple[Light, ...]] = no_lamps

    @cached_property
    def bounds(self) -> Float32[np.ndarray, "2 3"]:
        """Least and greatest coordinates in the rest pose, in the asset's frame."""
        return bounds_of(self.meshes)


def load_mesh(path: Path) -> list[TriangleMesh]:
    """Reads a GLB, glTF, OBJ, PLY or STL file: one mesh per material, in the file's own axes and units.

    Applies the scene graph's transforms (and skins and morph targets of glTF, in the rest pose), drops degenerate
    triangles, and computes missing normals (sharp at edges beyond 60 degrees). Vertex colours are sRGB bytes, in
    glTF linear.

    Raises:
        DeltalightError: the file is missing, of an unknown type, damaged, empty, or has coordinates that
            are not finite or beyond 10 km.
    """
    return load_asset(path).meshes


def load_asset(path: Path) -> Asset:
    """Reads a mesh file as `load_mesh` does, and the clips of a glTF file.

    Raises:
        DeltalightError: as `load_mesh`, or a malformed clip.
    """
    if check_mesh_file(path) in GLTF_SUFFIXES:
        gltf = load_gltf(path)
        rest = gltf.pose(None, 0.0)
        animated = gltf if gltf.clips else None
        return Asset(gltf.meshes(rest), animated, gltf.left_out, partial(gltf.lamps, rest))
    together: dict[int, list[TriangleMesh]] = defaultdict(list)
    for key, part in _parts(_open_scene(path), path):
        together[key].append(part)
    if not together:
        raise DeltalightError(f"{path} has no triangle with an area; export a triangle mesh.")
    return Asset([joined(same) for same in together.values()], None)


def _open_scene(path: Path) -> "trimesh.Scene":
    import trimesh

    try:
        return trimesh.load_scene(path, process=False, maintain_order=True)
    except MemoryError:
        raise
    except Exception as error:  # a damaged file can make the loader fail in any way
        raise DeltalightError(
            f"{path} cannot be read as a mesh ({error!s:.300}); export it again."
        ) from error


def _parts(scene: "trimesh.Scene", path: Path) -> list[tuple[int, TriangleMesh]]:
    """Returns (material key, mesh in the file's frame) of every node that shows triangles."""
    from trimesh import Trimesh

    materials: dict[int, Material] = {}
    parts = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, Trimesh) or len(geometry.faces) == 0:
            continue
        key = id(getattr(geometry.visual, "material", None))
        if key not in materials:
            materials[key] = _material(geometry, path)
        made = converted(_file_geometry(geometry, path), materials[key], path)
        if made is not None:
            mesh = made.mesh
            parts.append((key, mesh if np.array_equal(matrix, np.eye(4)) else transformed(mesh, matrix)))
    return parts


def _material(geometry: "trimesh.Trimesh", path: Path) -> Material:
    try:
        return _described_material(geometry).checked(str(path))
    except (TypeError, ValueError, AttributeError) as error:
        raise DeltalightError(
            f"{path} has a malformed material ({error!s:.300}); export it again."
        ) from error


def _described_material(geometry: "trimesh.Trimesh") -> Material:
    from trimesh.visual.material import SimpleMaterial

    loaded = getattr(geometry.visual, "material", None)
    if loaded is not None and isinstance(loaded, SimpleMaterial):
        # An image that no file names is the loader's own placeholder.
        image = loaded.image if loaded.image is not None and "file_path" in loaded.image.info else None
        return Material.from_mtl(str(loaded.name or ""), loaded.kwargs or {}, image)
    has_colors = geometry.visual.kind == "vertex"
    return Material(base_color=np.ones(3, np.float32)) if has_colors else Material()


def _file_geometry(geometry: "trimesh.Trimesh", path: Path) -> FileGeometry:
    positions, triangles = np.asarray(geometry.vertices, np.float32), np.asarray(geometry.faces, np.int64)
    # The loader takes vertices of any number of coordinates.
    if positions.shape[1:] != (3,) or triangles.shape[1:] != (3,):
        raise DeltalightError(f"{path} has vertices that are not three numbers each; export it again.")
    normals = geometry._cache["vertex_normals"] if "vertex_normals" in geometry._cache else np.zeros(0)
    return FileGeometry(
        positions,
        triangles,
        np.asarray(normals, np.float32) if np.shape(normals) == positions.shape else None,
        _uv(geometry, len(positions)),
        _colors(geometry),
    )


def _uv(geometry: "trimesh.Trimesh", count: int) -> Float32[np.ndarray, "n 2"] | None:
    """Returns texture coordinates with the origin at the top; the loader has it at the bottom."""
    uv = getattr(geometry.visual, "uv", None)
    if uv is None or np.shape(uv) != (count, 2) or not np.isfinite(uv).all():
        return None
    return np.column_stack([uv[:, 0], 1 - uv[:, 1]]).astype(np.float32)


def _colors(geometry: "trimesh.Trimesh") -> Float32[np.ndarray, "n 3"] | None:
    """Returns linear vertex colours: sRGB bytes of PLY, STL and OBJ."""
    if geometry.visual.kind != "vertex":
        return None
    codes = np.asarray(geometry.visual.vertex_colors, np.uint8)[:, :3]
    return decode_lut(None)[:, 0][codes]
