"""Poses of a flat target from directions (any lens, also beyond 90 degrees), and means of poses."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float64

from deltalight.protocol.poses import rigid_matrix, rotation_from_wxyz, wxyz_from_rotation


def target_pose(
    points: Float64[np.ndarray, "n 3"], directions: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "4 4"] | None:
    """Returns camera_from_target, or None if the points are collinear or seen from behind.

    The directions are rotated so that their mean is the axis: a flat target fills less than a half space, so there
    they are the rays of a pinhole camera whatever the lens. Of the two solutions of the planar ambiguity the one with
    the smaller error is returned.

    Args:
        points: points of the target, z = 0, metres.
        directions: unit directions to them in the camera's optical frame.
    """
    turn = _turn_to_axis(directions.mean(axis=0))
    turned = directions @ turn.T
    if turned[:, 2].min() <= 1e-3:
        return None
    rays = np.ascontiguousarray(turned[:, :2] / turned[:, 2:])
    centre = points.mean(axis=0)
    local = np.ascontiguousarray(points - centre)
    try:
        _, rotations, translations, errors = cv2.solvePnPGeneric(
            local, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return None
    solutions = []
    for rotation, translation, error in zip(rotations, translations, np.ravel(errors), strict=True):
        refined = cv2.solvePnPRefineLM(local, rays, np.eye(3), None, rotation, translation)
        matrix = rigid_matrix(cv2.Rodrigues(refined[0])[0], refined[1].ravel())
        if np.linalg.inv(matrix)[2, 3] > 0:
            solutions.append((float(error), matrix))
    if not solutions:
        return None
    best = min(solutions, key=lambda solution: solution[0])[1]
    return np.asarray(rigid_matrix(turn.T, (0, 0, 0)) @ best @ rigid_matrix(np.eye(3), -centre))


def _turn_to_axis(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Returns the rotation that takes a direction to +z."""
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def mean_pose(poses: Sequence[Float64[np.ndarray, "4 4"]]) -> Float64[np.ndarray, "4 4"]:
    """Returns the mean pose: median of the translations, mean of the rotations.

    The mean rotation's quaternion is the eigenvector of the sum of the outer products (Markley et al. 2007).
    """
    quaternions = np.array([wxyz_from_rotation(pose[:3, :3]) for pose in poses])
    w, x, y, z = np.linalg.eigh(quaternions.T @ quaternions)[1][:, -1].tolist()
    shift = np.median([pose[:3, 3] for pose in poses], axis=0)
    return rigid_matrix(rotation_from_wxyz((w, x, y, z)), shift)


def pose_offsets(
    poses: Sequence[Float64[np.ndarray, "4 4"]], mean: Float64[np.ndarray, "4 4"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Returns the distance of each pose from the mean: metres and degrees."""
    metres = np.array([np.linalg.norm(pose[:3, 3] - mean[:3, 3]) for pose in poses])
    turns = [np.linalg.norm(cv2.Rodrigues(mean[:3, :3].T @ pose[:3, :3])[0]) for pose in poses]
    return metres, np.degrees(turns)
