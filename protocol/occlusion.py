"""What a depth image hides from a place beside the camera."""

import numpy as np
from jaxtyping import Bool, Float, Float64

from deltalight.protocol import short_axis
from deltalight.protocol.frames import DepthImage

RAY_STEP_M = 0.01  # as fine as things on a table that can occlude a light
MAX_RAY_M = 10.0  # range of depth cameras
DEPTH_TOLERANCE = 0.02  # of depth: beyond the noise of any depth camera in its range
# Greatest depth of the first point behind a surface: more than a step, even where the camera looks along the surface,
# and less than things on a table are apart.
THICKNESS_M = 0.05


def is_occluded(
    depth: DepthImage,
    world_from_camera: Float64[np.ndarray, "4 4"],
    origin: Float64[np.ndarray, "3"],
    direction: Float64[np.ndarray, "3"],
) -> bool:
    """Whether the ray from `origin` (world, m) in a unit direction passes through a surface of the depth image.

    The ray is marched while the camera sees it; beyond, nothing is known to occlude it.
    """
    known = depth.valid & (depth.depth_m > 0)
    if not known.any():
        return False
    reach = min(MAX_RAY_M, 2 * float(depth.depth_m[known].max()))
    along = np.arange(RAY_STEP_M, reach, RAY_STEP_M)
    return bool(are_occluded(depth, world_from_camera, origin[None], direction[None], along)[0])


def are_occluded(
    depth: DepthImage,
    world_from_camera: Float64[np.ndarray, "4 4"],
    origins: Float[np.ndarray, "r 3"],
    directions: Float[np.ndarray, "r 3"],
    along: Float[np.ndarray, " s"],
) -> Bool[np.ndarray, " r"]:
    """Returns which rays pass through a surface of the depth image between two of the distances `along` them, m.

    Passing behind something near the camera is no hit: the ray must enter a surface from the front and lie close
    behind it.
    """
    rotation, eye = world_from_camera[:3, :3], world_from_camera[:3, 3]
    starts, ways = (origins - eye) @ rotation, directions @ rotation
    points = (starts + along[:, None, None] * ways).reshape(-1, 3)
    pixels = np.rint(np.nan_to_num(depth.camera.project(points), nan=-1.0))
    height, width = depth.depth_m.shape
    inside = short_axis.all_of((pixels >= 0) & (pixels < (width, height)))
    column, row = np.where(inside[:, None], pixels, 0).astype(int).T
    surface = depth.depth_m[row, column]
    behind = points[:, 2] - surface
    slack = DEPTH_TOLERANCE * np.abs(points[:, 2])
    shown = inside & depth.valid[row, column] & (surface > 0)
    before = shown & (behind <= slack)
    through = shown & (behind > slack) & (behind <= slack + THICKNESS_M)
    shape = len(along), len(origins)
    return np.asarray((before.reshape(shape)[:-1] & through.reshape(shape)[1:]).any(axis=0))
