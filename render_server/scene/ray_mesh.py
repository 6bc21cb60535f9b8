"""Where a ray meets a mesh first (Möller and Trumbore 1997), for a single ray: no tree is worth its building."""

import numpy as np
from jaxtyping import Float32, Float64

PARALLEL = 1e-12  # determinant (m^2), from which on a ray counts as going along the triangle's plane


def first_hit(
    corners: Float32[np.ndarray, "m 3 3"], origin: Float64[np.ndarray, "3"], toward: Float64[np.ndarray, "3"]
) -> tuple[float, Float64[np.ndarray, "3"]] | None:
    """Distance along `toward` (in its lengths) to the nearest triangle before the origin, and its unit normal.

    The normal faces the origin. None: the ray meets none.
    """
    first, second, third = np.moveaxis(corners.astype(np.float64), 1, 0)
    u_edge, v_edge = second - first, third - first
    across = np.cross(toward, v_edge)
    determinant = (u_edge * across).sum(axis=1)
    crossed = np.abs(determinant) > PARALLEL
    scale = np.divide(1.0, determinant, out=np.zeros_like(determinant), where=crossed)
    start = origin - first
    u = (start * across).sum(axis=1) * scale
    turned = np.cross(start, u_edge)
    v, distance = (turned @ toward) * scale, (turned * v_edge).sum(axis=1) * scale
    hit = crossed & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    if not hit.any():
        return None
    nearest = int(np.flatnonzero(hit)[distance[hit].argmin()])
    normal = np.cross(u_edge[nearest], v_edge[nearest])
    normal /= np.linalg.norm(normal)
    return float(distance[nearest]), -normal if normal @ toward > 0 else normal
