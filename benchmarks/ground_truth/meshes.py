"""Shapes of benchmark scenes, generated here: in their own frames, metres, z up, on z = 0 around the z axis."""

import numpy as np
import trimesh
from jaxtyping import Float
from skimage.measure import marching_cubes

from deltalight.benchmarks.ground_truth.parts import Triple

# Centre, half axes and pitch (degrees, nose up) of the rabbit's parts in units of its height; it looks along -y. The
# left ear and feet mirror the right ones.
_BODY = (
    ((0.00, 0.10, 0.26), (0.225, 0.30, 0.245), 12.0),  # rump
    ((0.00, -0.08, 0.27), (0.170, 0.20, 0.22), 25.0),  # chest
    ((0.00, -0.21, 0.53), (0.125, 0.155, 0.130), -8.0),  # head
    ((0.00, -0.33, 0.49), (0.065, 0.060, 0.060), 0.0),  # nose
    ((0.00, 0.41, 0.20), (0.075, 0.075, 0.075), 0.0),  # tail
)
_PAIRS = (
    ((0.070, -0.125, 0.785), (0.050, 0.032, 0.205), -14.0),  # ear
    ((0.105, -0.20, 0.04), (0.055, 0.110, 0.060), 0.0),  # fore foot
    ((0.190, 0.02, 0.05), (0.065, 0.165, 0.070), 0.0),  # hind foot
    ((0.165, 0.12, 0.20), (0.105, 0.175, 0.170), 20.0),  # thigh
)
_BLEND = 0.028
"""Radius, in heights, over which the parts blend into each other."""
_CELLS = 60
"""Grid cells along the rabbit's height: 2.5 mm for one of 15 cm, whose outline then bends by less than a pixel."""

_PAWN = (
    *(
        (0.0, 0.0),
        (0.270, 0.0),
        (0.285, 0.006),
        (0.292, 0.020),
        (0.292, 0.060),
        (0.285, 0.085),
        (0.262, 0.105),
    ),
    *((0.235, 0.118), (0.225, 0.135), (0.222, 0.160), (0.205, 0.180), (0.165, 0.215), (0.135, 0.270)),
    *((0.115, 0.350), (0.105, 0.440), (0.102, 0.520), (0.108, 0.560), (0.135, 0.580), (0.172, 0.592)),
    *((0.182, 0.606), (0.172, 0.622), (0.135, 0.640)),
)
"""Radius and height along the outline up to the collar, in units of the height."""
_VASE = (
    *(
        (0.0, 0.0),
        (0.150, 0.0),
        (0.165, 0.006),
        (0.172, 0.022),
        (0.200, 0.090),
        (0.245, 0.190),
        (0.275, 0.300),
    ),
    *((0.278, 0.400), (0.255, 0.500), (0.205, 0.600), (0.150, 0.690), (0.118, 0.770), (0.112, 0.840)),
    *((0.130, 0.910), (0.168, 0.970), (0.180, 0.990), (0.176, 1.0), (0.166, 0.996), (0.152, 0.970)),
    *((0.112, 0.905), (0.092, 0.840), (0.098, 0.770), (0.130, 0.690), (0.184, 0.600), (0.234, 0.500)),
    *((0.256, 0.400), (0.253, 0.300), (0.222, 0.190), (0.175, 0.090), (0.140, 0.040), (0.0, 0.030)),
)
"""Outside up to the lip, then inside down, in units of the height."""


def rabbit(height_m: float = 0.15) -> trimesh.Trimesh:
    """Returns one closed surface around blended ellipsoids; it looks along -y."""
    low, high = np.array([-0.32, -0.46, -0.04]), np.array([0.32, 0.54, 1.04])
    axes = [np.arange(a, b, 1 / _CELLS) for a, b in zip(low, high, strict=True)]
    field = _rabbit_field(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(1 / _CELLS,) * 3)
    mesh = trimesh.Trimesh(vertices + low, faces, process=False)
    mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
    mesh.apply_scale(height_m / mesh.extents[2])
    return mesh


def _rabbit_field(points: Float[np.ndarray, "x y z 3"]) -> Float[np.ndarray, "x y z"]:
    """Returns the approximate distance to the rabbit, negative inside; cut flat by the ground."""
    mirrored = [((-x, y, z), axes, pitch) for (x, y, z), axes, pitch in _PAIRS]
    parts = [_ellipsoid(points, *part) for part in (*_BODY, *_PAIRS, *mirrored)]
    blended = -_BLEND * np.log(sum(np.exp(-part / _BLEND) for part in parts))
    return np.asarray(np.maximum(blended, -points[..., 2]))


def _ellipsoid(
    points: Float[np.ndarray, "*n 3"], center: Triple, half_axes: Triple, pitch_deg: float
) -> Float[np.ndarray, "*n"]:
    """Returns the distance to an ellipsoid, to first order near its surface."""
    turn = trimesh.transformations.rotation_matrix(np.radians(-pitch_deg), [1, 0, 0])[:3, :3]
    local = (points - np.array(center)) @ turn
    level = np.linalg.norm(local / half_axes, axis=-1)
    steepness = np.linalg.norm(local / np.square(half_axes), axis=-1)
    return np.asarray(level * (level - 1) / np.maximum(steepness, 1e-6))


def pawn(height_m: float = 0.13) -> trimesh.Trimesh:
    """Returns a chess pawn: foot, stem, collar and ball."""
    angle = np.linspace(-0.72, np.pi / 2, 24)
    ball = np.stack([0.180 * np.cos(angle), 0.82 + 0.180 * np.sin(angle)], axis=1)
    ball[-1, 0] = 0.0
    return _revolved(np.concatenate([np.array(_PAWN), ball]), height_m)


def vase(height_m: float = 0.16) -> trimesh.Trimesh:
    """Returns a hollow vase with a narrow neck."""
    return _revolved(np.array(_VASE), height_m)


def ball(radius_m: float = 0.04) -> trimesh.Trimesh:
    """Returns a sphere lying on the ground."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius_m)
    mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
    return mesh


def ring(radius_m: float = 0.055, tube_m: float = 0.015) -> trimesh.Trimesh:
    """Returns a ring standing upright, its axis along y."""
    mesh = trimesh.creation.torus(radius_m, tube_m, major_sections=96, minor_sections=32)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
    return mesh


def block(size_m: Triple) -> trimesh.Trimesh:
    """Returns a box with sharp edges, every face with its own normals."""
    mesh = trimesh.creation.box(extents=size_m)
    mesh.apply_translation([0, 0, size_m[2] / 2])
    mesh.unmerge_vertices()
    return mesh


def mug() -> trimesh.Trimesh:
    """Returns a mug with wall, rounded lip and handle (towards +x)."""
    lip = np.linspace(0, np.pi, 7)
    outside = [(0.0, 0.0), (0.032, 0.0), (0.036, 0.002), (0.038, 0.006), (0.038, 0.088)]
    rim = [(0.0365 + 0.0015 * float(np.cos(a)), 0.088 + 0.0015 * float(np.sin(a))) for a in lip[1:-1]]
    inside = [(0.035, 0.088), (0.035, 0.010), (0.032, 0.006), (0.0, 0.005)]
    body = trimesh.creation.revolve(np.array(outside + rim + inside), sections=64)
    handle = trimesh.creation.torus(0.024, 0.005, major_sections=48, minor_sections=16)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    handle.apply_translation([0.039, 0, 0.046])
    handle.update_faces((handle.vertices[handle.faces][..., 0] > 0.0355).all(axis=1))  # none inside the mug
    mesh = trimesh.util.concatenate([body, handle])
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def _revolved(profile: Float[np.ndarray, "n 2"], height_m: float) -> trimesh.Trimesh:
    """Revolves an outline (radius, height in units of the height) around z."""
    return trimesh.creation.revolve(profile * height_m, sections=96)
