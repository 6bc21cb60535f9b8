"""The virtual object of the demo, generated here: a glossy trefoil knot on a small round foot."""

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.visual.material import PBRMaterial

BASE_COLOR = (0.03, 0.42, 0.30)
"""Linear, saturated, so that the colour that the object reflects onto the table is clearly visible."""
ROUGHNESS = 0.35
METALLIC = 0.0
SPECULAR = 0.5

TUBE_RADIUS_M = 0.0165
SCALE_M = 0.0205
"""Metres per unit of the curve (its own extent is about 6 by 5.4 by 2 units)."""
FOOT_PROFILE_M = (
    (0.0, 0.0),
    (0.034, 0.0),
    (0.0365, 0.0012),
    (0.038, 0.004),
    (0.0375, 0.0075),
    (0.035, 0.0105),
    (0.030, 0.0125),
    (0.022, 0.0138),
    (0.0, 0.0145),
)
"""Radius and height along the foot's outline, from the middle of its underside to the middle of its top."""


def object_mesh() -> trimesh.Trimesh:
    """Returns knot and foot in the object's own frame: metres, z up, standing on z = 0 around the z axis."""
    knot = _knot(segments=200, sides=18)
    knot.apply_translation([0, 0, FOOT_PROFILE_M[-1][1] - 0.003 - knot.bounds[0, 2]])
    foot = trimesh.creation.revolve(np.array(FOOT_PROFILE_M), sections=64)
    mesh = trimesh.util.concatenate([knot, foot])
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def write_glb(path: Path) -> None:
    """Writes the object as GLB with its PBR material, y up as glTF requires."""
    mesh = object_mesh()
    normals = mesh.vertex_normals.copy()
    y_up = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    mesh.apply_transform(y_up)
    mesh.vertex_normals = normals @ y_up[:3, :3].T
    mesh.visual = trimesh.visual.TextureVisuals(
        material=PBRMaterial(
            name="glazed",
            baseColorFactor=[*BASE_COLOR, 1.0],
            metallicFactor=METALLIC,
            roughnessFactor=ROUGHNESS,
        )
    )
    path.write_bytes(mesh.export(file_type="glb", include_normals=True))


def _knot(segments: int, sides: int) -> trimesh.Trimesh:
    """Returns a tube around the trefoil (sin t + 2 sin 2t, -sin 3t, cos t - 2 cos 2t), framed by its curvature."""
    t = np.linspace(0, 2 * np.pi, segments, endpoint=False)[:, None]
    center = np.hstack([np.sin(t) + 2 * np.sin(2 * t), -np.sin(3 * t), np.cos(t) - 2 * np.cos(2 * t)])
    first = np.hstack([np.cos(t) + 4 * np.cos(2 * t), -3 * np.cos(3 * t), -np.sin(t) + 4 * np.sin(2 * t)])
    second = np.hstack([-np.sin(t) - 8 * np.sin(2 * t), 9 * np.sin(3 * t), -np.cos(t) + 8 * np.cos(2 * t)])
    binormal = _unit(np.cross(first, second))
    normal = np.cross(binormal, _unit(first))
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)[None, :, None]
    outward = np.cos(angle) * normal[:, None] + np.sin(angle) * binormal[:, None]
    vertices = SCALE_M * center[:, None] + TUBE_RADIUS_M * outward
    return trimesh.Trimesh(
        vertices.reshape(-1, 3),
        _tube_triangles(segments, sides),
        vertex_normals=outward.reshape(-1, 3),
        process=False,
    )


def _tube_triangles(segments: int, sides: int) -> np.ndarray:
    """Returns indices (2 segments sides, 3) of a tube closed in both directions, wound outwards."""
    ring, side = np.divmod(np.arange(segments * sides), sides)
    ahead, beside = (ring + 1) % segments, (side + 1) % sides
    a, b = ring * sides + side, ahead * sides + side
    c, d = ahead * sides + beside, ring * sides + beside
    return np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
