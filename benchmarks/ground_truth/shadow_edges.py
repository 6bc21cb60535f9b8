"""Shadow edges cast by straight edges of objects."""

import numpy as np
from jaxtyping import Float

from deltalight.benchmarks.ground_truth.benchmark_scene import TABLE_Z_M, ShadowEdge
from deltalight.benchmarks.ground_truth.lamps import SphereLamp
from deltalight.benchmarks.ground_truth.parts import Triple


def edge_of_shadow(
    lamp: SphereLamp, edge_m: tuple[Triple, Triple], inside_m: Triple, plane_z_m: float = TABLE_Z_M
) -> ShadowEdge:
    """Returns the path across the shadow that a straight edge of an object casts on a level plane.

    `inside_m` is a point of the object whose shadow lies beside the edge's, on the dark side. The path crosses the
    shadow of the edge's middle at a right angle and is twice as long as the penumbra is wide.
    """
    lamp_m, ends = np.array(lamp.position_m), np.array(edge_m)
    middle = ends.mean(axis=0)
    first, second, center, dark = (
        _shadow(lamp_m, point, plane_z_m) for point in (*ends, middle, np.array(inside_m))
    )
    along = (second - first) / np.linalg.norm(second - first)
    across = (dark - center) - along * np.dot(along, dark - center)
    across /= np.linalg.norm(across)
    half = across * _penumbra_m(lamp_m, lamp.radius_m, middle, center, across)
    start, end = center - half, center + half
    return ShadowEdge((start[0], start[1], start[2]), (end[0], end[1], end[2]))


def _shadow(
    lamp_m: Float[np.ndarray, "3"], point_m: Float[np.ndarray, "3"], plane_z_m: float
) -> Float[np.ndarray, "3"]:
    """Returns where the ray from a lamp through a point meets the plane."""
    reach = (lamp_m[2] - plane_z_m) / (lamp_m[2] - point_m[2])
    return np.asarray(lamp_m + reach * (point_m - lamp_m))


def _penumbra_m(
    lamp_m: Float[np.ndarray, "3"],
    radius_m: float,
    edge_m: Float[np.ndarray, "3"],
    shadow_m: Float[np.ndarray, "3"],
    across: Float[np.ndarray, "3"],
) -> float:
    """Returns the penumbra's width along `across`: the lamp's disc through the edge, projected onto the plane."""
    beam = (edge_m - lamp_m) / np.linalg.norm(edge_m - lamp_m)
    magnified = 2 * radius_m * np.linalg.norm(shadow_m - edge_m) / np.linalg.norm(edge_m - lamp_m)
    return float(magnified * np.hypot(1, np.dot(beam, across) / beam[2]))
