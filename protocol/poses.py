"""Rigid transforms: quaternions, checks, interpolation."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float64

from deltalight.protocol.errors import DeltalightError


def rotation_from_wxyz(quaternion: Sequence[float]) -> Float64[np.ndarray, "3 3"]:
    """Returns the rotation matrix of a quaternion (w, x, y, z) of any length but zero."""
    length = math.sqrt(sum(part * part for part in quaternion))
    w, x, y, z = (float(part) / length for part in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def wxyz_from_rotation(rotation: Float64[np.ndarray, "3 3"]) -> tuple[float, float, float, float]:
    """Returns the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix.

    The quaternion is the eigenvector of the largest eigenvalue of a symmetric 4x4 matrix (Bar-Itzhack 2000),
    which is stable at every angle.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    w, x, y, z = np.linalg.eigh(matrix)[1][:, -1] * 1.0
    sign = -1.0 if w < 0 else 1.0
    return float(sign * w), float(sign * x), float(sign * y), float(sign * z)


def rigid_matrix(
    rotation: Float64[np.ndarray, "3 3"], translation: Sequence[float] | Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "4 4"]:
    """Returns the 4x4 matrix of a rotation followed by a translation."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def require_rigid(matrix: object, name: str) -> Float64[np.ndarray, "4 4"]:
    """Returns a 4x4 matrix after checking that it is a proper rigid transform (orthonormal, determinant +1).

    Raises:
        DeltalightError: it is not; `name` names the transform in the sentence.
    """
    try:
        values = np.array(matrix, np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        raise DeltalightError(f"{name} must be a 4x4 matrix of numbers; write 4 rows of 4.") from None
    rotation = values[:3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not (np.isfinite(values).all() and orthonormal and np.allclose(values[3], [0, 0, 0, 1], atol=1e-9)):
        raise DeltalightError(
            f"{name} is not a rigid transform; give an orthonormal rotation and a last row 0 0 0 1."
        )
    if np.linalg.det(rotation) < 0:
        raise DeltalightError(
            f"{name} mirrors space (determinant -1); give a proper rotation (determinant +1)."
        )
    return values


def interpolate_pose(
    start: Float64[np.ndarray, "4 4"], end: Float64[np.ndarray, "4 4"], fraction: float
) -> Float64[np.ndarray, "4 4"]:
    """Returns the pose at `fraction` (0..1) of the path, rotating at constant speed about one axis."""
    step, _ = cv2.Rodrigues(start[:3, :3].T @ end[:3, :3])
    turn, _ = cv2.Rodrigues(step * fraction)
    return rigid_matrix(start[:3, :3] @ turn, (1 - fraction) * start[:3, 3] + fraction * end[:3, 3])
