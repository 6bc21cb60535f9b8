"""Whether the real scene, as one depth image shows it, stands between a place and what is far away."""

import numpy as np
from jaxtyping import Float64

from protocol.frames import DepthImage

STEP_M = 0.01  # as fine as the things on a table that can hide a light
LONGEST_M = 10.0  # beyond, depth cameras see nothing
TOLERANCE = 0.02  # of depth: beyond the noise of any depth camera in its range
# How deep below a surface the first point behind it may lie: more than a step goes in, also where the camera looks
# along the surface, and less than the things on a table are apart.
THICKNESS_M = 0.05


def is_hidden(
    depth: DepthImage,
    world_from_camera: Float64[np.ndarray, "4 4"],
    place: Float64[np.ndarray, "3"],
    toward: Float64[np.ndarray, "3"],
) -> bool:
    """Whether the ray from a place (world, m) in a unit direction goes through a surface of the depth image.

    The ray is followed as long as the camera sees it: nothing is known to hide it beyond. Passing behind
    something near the camera is no hit: the ray must come from before a surface and leave it close behind.
    """
    known = depth.valid & (depth.depth_m > 0)
    if not known.any():
        return False
    camera_from_world = np.linalg.inv(world_from_camera)
    reach = min(LONGEST_M, 2 * float(depth.depth_m[known].max()))
    along = np.arange(STEP_M, reach, STEP_M)[:, None]
    points = (place + along * toward) @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    pixels = np.rint(np.nan_to_num(depth.camera.project(points), nan=-1.0))
    height, width = depth.depth_m.shape
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    column, row = np.where(inside[:, None], pixels, 0).astype(int).T
    behind = points[:, 2] - depth.depth_m[row, column]
    slack = TOLERANCE * np.abs(points[:, 2])
    shown = inside & known[row, column]
    before = shown & (behind <= slack)
    through = shown & (behind > slack) & (behind <= slack + THICKNESS_M)
    return bool((before[:-1] & through[1:]).any())
