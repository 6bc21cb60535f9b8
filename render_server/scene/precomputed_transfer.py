"""Precomputed radiance transfer of rigid objects ([D] 4.3.1; Sloan et al. 2002): what light of each harmonic brings
to the vertices of their surface, less what the object hides of it, plus what it throws at itself.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float16, Float32, Int32, Int64

from deltalight.render_server.lights.octahedral import harmonics
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.occlusion_field import (
    CHUNK,
    INSIDE,
    DirectionSet,
    ObjectRays,
    ProgressCallback,
    RayHits,
    direction_set,
)
from deltalight.render_server.scene.occlusion_transfer import FACING, object_surface
from deltalight.render_server.scene.triangle_mesh import (
    CREASE_ANGLE_DEG,
    TriangleMesh,
    face_normals,
    unit_or,
)
from deltalight.render_server.scene.triangle_splitting import split_triangles

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Longest edge between vertices that have a transfer vector, in enclosing radii; meshes of longer ones are subdivided.
LONGEST_EDGE = 1 / 16
LIFT = 1e-4  # of the radius: offset of rays along the normal, so that a surface does not hide itself
# Offset of rays along the surface towards its triangles: a vertex of a crease lies in the other side's plane.
INSET = 0.02
SMOOTH_COSINE = math.cos(math.radians(CREASE_ANGLE_DEG))


@dataclass(frozen=True)
class TransferSettings:
    """`order` SH bands of light, `bounces` from surface to surface of the object, `rays` over a vertex's sphere."""

    order: int
    bounces: int
    rays: int


@dataclass(frozen=True, eq=False)
class TransferSurface:
    """An object's triangles, subdivided, in the asset's frame; `reflectance`: diffuse, linear RGB."""

    positions: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    triangles: Int32[np.ndarray, "m 3"]
    reflectance: Float32[np.ndarray, "m 3"]


@dataclass(frozen=True, eq=False)
class ObjectTransfer:
    """What light of unit SH coefficients (asset's frame) does at each vertex.

    `transfer` [vertex, harmonic]: irradiance R G B, and occlusion (1 where a ray meets the object).
    """

    positions: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    triangles: Int32[np.ndarray, "m 3"]
    transfer: Float16[np.ndarray, "n k 4"]


def transfer_surface(meshes: Sequence[TriangleMesh], material: Material | None) -> TransferSurface:
    """Subdivides an object's triangles; `material` replaces the asset's own.

    Raises:
        DeltalightError: more than 4 million triangles would result.
    """
    surface = object_surface(meshes, plain=material is not None)
    if material is not None:
        surface[..., 3:] *= material.diffuse_reflectance
    normals = np.concatenate([mesh.normals[mesh.triangles] for mesh in meshes])
    low, high = surface[..., :3].min(axis=(0, 1)), surface[..., :3].max(axis=(0, 1))
    edge = LONGEST_EDGE * max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    pieces = split_triangles(np.concatenate([surface[..., :3], normals, surface[..., 3:]], axis=2), edge)
    # Adding zero makes -0 and 0 the same bits.
    corners = np.ascontiguousarray(pieces[..., :6].reshape(-1, 6) + np.float32(0))
    _, first, index = np.unique(corners.view("V24").ravel(), return_index=True, return_inverse=True)
    vertices = corners[first]
    return TransferSurface(
        np.ascontiguousarray(vertices[:, :3]),
        unit_or(vertices[:, 3:], vertices[:, 3:]),
        index.reshape(-1, 3).astype(np.int32),
        np.ascontiguousarray(pieces[..., 6:].mean(axis=1)),
    )


def compute_object_transfer(
    surface: TransferSurface, settings: TransferSettings, progress: ProgressCallback
) -> ObjectTransfer:
    """Traces the rays of all vertices once, and lets light go on `bounces` times where they met the object.

    Raises:
        DeltalightError: no package that traces rays is installed.
    """
    from scipy.sparse import vstack

    rays = ObjectRays(surface.positions[surface.triangles])
    directions = direction_set(settings.rays)
    basis = (harmonics(directions.directions, settings.order) * directions.solid_angle).astype(np.float32)
    found = np.empty((len(surface.positions), settings.order**2, 4), np.float32)
    inside = np.zeros(len(found), bool)
    met = []
    for part, cosine, hits in _traced(surface, rays, directions):
        met.append(_weights_of_hits(hits, cosine, directions.solid_angle, len(surface.triangles)))
        occluded = np.zeros_like(cosine)
        occluded[hits.point, hits.direction] = 1
        found[part, :, :3] = (cosine * (1 - occluded) @ basis)[..., None]
        found[part, :, 3] = occluded @ basis
        behind = np.bincount(hits.point[hits.behind], minlength=len(part))
        inside[part] = behind > INSIDE * len(directions.directions) / 2
        progress(float(part[-1] + 1) / len(found))
    found[..., :3] = _with_bounces(found[..., :3], surface, vstack(met), settings.bounces)
    found = found[_nearest_outside(surface, rays.radius, inside)]
    return ObjectTransfer(surface.positions, surface.normals, surface.triangles, found.astype(np.float16))


def _nearest_outside(
    surface: TransferSurface, radius: float, inside: Bool[np.ndarray, " n"]
) -> Int64[np.ndarray, " n"]:
    """Returns each vertex's own number; of one within another part of the object that of the nearest outside."""
    from scipy.spatial import cKDTree

    numbers = np.arange(len(inside))
    if inside.any() and not inside.all():
        place = np.concatenate([surface.positions / radius, FACING * surface.normals], axis=1)
        numbers[inside] = numbers[~inside][cKDTree(place[~inside]).query(place[inside])[1]]
    return numbers


def _traced(
    surface: TransferSurface, rays: ObjectRays, directions: DirectionSet
) -> Iterator[tuple[Int64[np.ndarray, " p"], Float32[np.ndarray, "p d"], RayHits]]:
    """Traces the rays above vertices' horizons, in chunks: yields vertices, cosines to all directions, and hits.

    Triangles in whose plane a vertex lies, and whose way it faces, hide nothing from it, though its interpolated
    normal leans over them.
    """
    starts = _ray_starts(surface, rays.radius)
    facing, _ = face_normals(surface.positions, surface.triangles)
    count = len(starts)
    for part in np.array_split(np.arange(count), -(-count * len(directions.directions) // CHUNK)):
        normals = surface.normals[part]
        cosine = np.maximum(normals @ directions.directions.T, 0)
        hits = rays.trace_hemisphere(starts[part], normals, directions)
        apart = surface.positions[part][hits.point] - surface.positions[surface.triangles[hits.triangle, 0]]
        off = np.abs((apart * facing[hits.triangle]).sum(axis=1))
        turned = (normals[hits.point] * facing[hits.triangle]).sum(axis=1) < SMOOTH_COSINE
        yield part, cosine, _chosen(hits, turned | (off > LIFT * rays.radius))


def _chosen(hits: RayHits, which: Bool[np.ndarray, " h"]) -> RayHits:
    return RayHits(hits.point[which], hits.direction[which], hits.triangle[which], hits.behind[which])


def _ray_starts(surface: TransferSurface, radius: float) -> Float32[np.ndarray, "n 3"]:
    count = len(surface.positions)
    centres = surface.positions[surface.triangles].mean(axis=1)
    around = surface.triangles.ravel()
    sums = np.stack([np.bincount(around, np.repeat(axis, 3), count) for axis in centres.T], axis=1)
    held = np.maximum(np.bincount(around, minlength=count), 1)
    towards = sums / held[:, None] - surface.positions
    along = towards - (towards * surface.normals).sum(axis=1, keepdims=True) * surface.normals
    return np.asarray(surface.positions + INSET * along + LIFT * radius * surface.normals, np.float32)


def _weights_of_hits(
    hits: RayHits, cosine: Float32[np.ndarray, "p d"], solid_angle: float, triangles: int
) -> "csr_array":
    """Returns the weight of each triangle's radiance in each vertex's irradiance; backs reflect nothing."""
    from scipy.sparse import csr_array

    front = ~hits.behind
    point, direction = hits.point[front], hits.direction[front]
    weight = cosine[point, direction] * np.float32(solid_angle)
    return csr_array((weight, (point, hits.triangle[front])), shape=(len(cosine), triangles))


def _with_bounces(
    direct: Float32[np.ndarray, "n k 3"], surface: TransferSurface, weights: "csr_array", bounces: int
) -> Float32[np.ndarray, "n k 3"]:
    """Adds the light that reaches each vertex over the object's other triangles."""
    albedo = (surface.reflectance / math.pi)[:, None, :]
    last = total = direct
    for _ in range(bounces):
        radiance = (last[surface.triangles].mean(axis=1) * albedo).reshape(len(albedo), -1)
        last = np.asarray(weights @ radiance, np.float32).reshape(direct.shape)
        total = total + last
    return total
