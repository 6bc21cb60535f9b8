"""Light that a rigid object reflects onto what is around it (radiance transfer field, [D] 5.2.4).

Each piece of its surface has a transfer vector, including self-shadowing: its irradiance under light of unit SH
coefficients. A sample of the field sums the pieces that it sees.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float16, Float32, Int64

from deltalight.render_server.lights.octahedral import harmonics
from deltalight.render_server.scene.occlusion_field import (
    CHUNK,
    FieldSettings,
    ObjectRays,
    PartKeeper,
    ProgressCallback,
    RayHits,
    ShellGrid,
    compute_part,
    direction_set,
    fill_inside,
)
from deltalight.render_server.scene.texture_maps import TextureMap
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.scene.triangle_splitting import split_triangles

ORDER = 3  # SH bands of incident and reflected light: both are diffuse
LENGTH = ORDER**2
# Longest edge of a piece in enclosing radii: about the change of direction that 3 bands resolve.
PIECE_EDGE = 1 / 6
# Pieces with a transfer vector of their own; the others take that of the nearest one with a similar normal.
MAX_PIECES = 4096
FACING = 0.5  # half the distance that opposite normals count as, enclosing radii: a thin sheet has two sides
LIFT = 1e-4  # of the radius: offset of rays, so that a piece does not occlude itself


@dataclass(frozen=True, eq=False)
class SurfacePieces:
    """Triangles with uniform diffuse reflectance (linear RGB)."""

    corners: Float32[np.ndarray, "m 3 3"]
    reflectance: Float32[np.ndarray, "m 3"]

    @property
    def centres(self) -> Float32[np.ndarray, "m 3"]:
        """Centroids."""
        return np.asarray(self.corners.mean(axis=1))

    @property
    def normals(self) -> Float32[np.ndarray, "m 3"]:
        """Unit normals."""
        across = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        return np.asarray(across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30))


def object_surface(meshes: Sequence[TriangleMesh], *, plain: bool) -> Float32[np.ndarray, "m 3 6"]:
    """Returns the corners of all triangles: position, diffuse reflectance (linear RGB).

    `plain`: reflectance 1, because the scene document's material replaces the asset's.
    """
    return np.concatenate([_with_reflectance(mesh, plain=plain) for mesh in meshes])


def surface_pieces(surface: Float32[np.ndarray, "m 3 6"], radius: float) -> SurfacePieces:
    """Splits large triangles into pieces."""
    pieces = split_triangles(surface, PIECE_EDGE * radius)
    return SurfacePieces(np.ascontiguousarray(pieces[..., :3]), pieces[..., 3:].mean(axis=1))


def _with_reflectance(mesh: TriangleMesh, *, plain: bool) -> Float32[np.ndarray, "m 3 6"]:
    corners = mesh.positions[mesh.triangles]
    color = np.ones_like(corners)
    if not plain:
        material = mesh.material
        maps = (material.base_color_map, material.metallic_roughness_map, material.transmission_map)
        base, metal, clear = (_texels(mesh, each) for each in maps)
        metallic = material.metallic * (1.0 if metal is None else metal[..., 2:] / 255)
        passing = material.transmission * (1.0 if clear is None else clear[..., :1] / 255)
        color *= (1 - metallic) * (1 - passing) * material.base_color
        if mesh.colors is not None:
            color *= mesh.colors[mesh.triangles]
        if base is not None:
            color *= base[..., :3]
    return np.concatenate([corners, color.astype(np.float32)], axis=2)


def _texels(mesh: TriangleMesh, texture: TextureMap | None) -> Float32[np.ndarray, "m 3 c"] | None:
    """Returns the nearest texels at the triangles' corners; None without a texture, or a place on it."""
    uv = mesh.uv_of(texture)
    return None if texture is None or uv is None else texture.nearest(uv[mesh.triangles])


def compute_transfer(
    pieces: SurfacePieces,
    grid: ShellGrid,
    settings: FieldSettings,
    progress: ProgressCallback,
    keep: PartKeeper = compute_part,
) -> Float16[np.ndarray, "shells h h h 9 9 3"]:
    """Samples the radiance reflected by the object on all shells, at half the resolution of the occlusion.

    Each shell is a part of its own.
    """
    rays = ObjectRays(pieces.corners)
    reflected = _reflected_light(pieces, rays, settings.rays)
    found = []
    for shell in range(settings.shells):
        compute = partial(_shell_transfer, rays, grid, shell, reflected, settings)
        found.append(keep(f"transfer-{shell}", compute))
        progress((shell + 1) / settings.shells)
    return np.stack(found)


def _shell_transfer(
    rays: ObjectRays,
    grid: ShellGrid,
    shell: int,
    reflected: Float32[np.ndarray, "m 9 3"],
    settings: FieldSettings,
) -> Float16[np.ndarray, "h h h 9 9 3"]:
    n = settings.resolution // 2
    values, inside = _received_light(rays, grid.points(shell, n), reflected, settings.rays)
    cells = values.reshape(n, n, n, LENGTH, LENGTH, 3)
    spacing = 2 * grid.halves[shell][::-1] / (n - 1)
    return fill_inside(cells, inside.reshape(n, n, n), spacing).astype(np.float16)


def _reflected_light(pieces: SurfacePieces, rays: ObjectRays, count: int) -> Float32[np.ndarray, "2m 9 3"]:
    """Returns the radiance of each piece's front for unit light coefficients, then that of each piece's back."""
    chosen, representative = _representative_pieces(pieces, rays.radius)
    normals = pieces.normals[chosen]
    front, back = (_irradiance(pieces.centres[chosen], side * normals, rays, count) for side in (1, -1))
    colors = pieces.reflectance[:, None, :] / math.pi
    return np.concatenate([side[representative][:, :, None] * colors for side in (front, back)]).astype(
        np.float32
    )


def _representative_pieces(
    pieces: SurfacePieces, radius: float
) -> tuple[Int64[np.ndarray, " c"], Int64[np.ndarray, " m"]]:
    """Chooses pieces with a transfer vector of their own, evenly by area, and the one that represents each piece."""
    count = len(pieces.corners)
    if count <= MAX_PIECES:
        return np.arange(count), np.arange(count)
    from scipy.spatial import cKDTree

    edges = pieces.corners[:, 1:] - pieces.corners[:, :1]
    area = np.cumsum(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1))
    chosen = np.unique(np.searchsorted(area, np.linspace(0, area[-1], MAX_PIECES + 1)[:-1], side="right"))
    place = np.concatenate([pieces.centres / radius, FACING * pieces.normals], axis=1)
    return chosen, np.asarray(cKDTree(place[chosen]).query(place)[1], np.int64)


def _irradiance(
    points: Float32[np.ndarray, "c 3"], normals: Float32[np.ndarray, "c 3"], rays: ObjectRays, count: int
) -> Float32[np.ndarray, "c 9"]:
    """Returns transfer vectors: the integral of visibility, clamped cosine and each harmonic."""
    directions = direction_set(count)
    basis = (harmonics(directions.directions, ORDER) * directions.solid_angle).astype(np.float32)
    start = (points + LIFT * rays.radius * normals).astype(np.float32)
    found = np.empty((len(points), LENGTH), np.float32)
    for part in np.array_split(np.arange(len(points)), -(-len(points) * count // CHUNK)):
        cosine = np.maximum(normals[part] @ directions.directions.T, 0)
        hits = rays.trace_hemisphere(start[part], normals[part].astype(np.float32), directions)
        cosine[hits.point, hits.direction] = 0
        found[part] = cosine @ basis
    return found


def _received_light(
    rays: ObjectRays, points: Float32[np.ndarray, "n 3"], reflected: Float32[np.ndarray, "m 9 3"], count: int
) -> tuple[Float32[np.ndarray, "n 9 27"], Bool[np.ndarray, " n"]]:
    """Returns radiance coefficients at points, by light coefficient and colour, and which points lie inside."""
    values = np.zeros((len(points), LENGTH, LENGTH * 3), np.float32)
    inside = np.zeros(len(points), bool)
    flat = reflected.reshape(len(reflected), -1)
    for part, chosen, hits in rays.trace(points, count):
        basis = (harmonics(chosen.directions, ORDER) * chosen.solid_angle).astype(np.float32)
        _accumulate(values, part, hits, basis, flat)
        inside[part] = rays.inside(hits, len(part), chosen)
    return values, inside


def _accumulate(
    values: Float32[np.ndarray, "n 9 27"],
    points: Int64[np.ndarray, " p"],
    hits: RayHits,
    basis: Float32[np.ndarray, "d 9"],
    reflected: Float32[np.ndarray, "m 27"],
) -> None:
    """Sums over each point's rays; hits are ordered by point."""
    pieces = len(reflected) // 2
    light = reflected[hits.triangle + pieces * hits.behind]
    seen = basis[hits.direction]
    ends = np.searchsorted(hits.point, np.arange(len(points) + 1))
    for number, (start, end) in enumerate(pairwise(ends)):
        values[points[number]] = seen[start:end].T @ light[start:end]
