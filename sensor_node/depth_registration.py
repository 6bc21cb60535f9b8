"""Registration of depth to the colour camera by forward projection with a depth buffer."""

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage
from deltalight.sensor_node.depth import known_pixels

# Pixels are enlarged a little, because lenses and slopes stretch some.
FOOTPRINT_MARGIN = 1.2
# A pixel this much larger in the colour picture would mean a calibration in the wrong unit.
MAX_FOOTPRINT_PX = 8


def register_depth(
    depth: DepthImage, color_camera: CameraModel, color_from_depth: Float64[np.ndarray, "4 4"]
) -> DepthImage:
    """Returns the depth as the colour camera would see it; unknown where no depth pixel lands.

    Every known pixel is a square that keeps its size under projection (so that a colour camera of higher resolution
    gets no pinholes); if several land on one colour pixel the nearest counts.

    Args:
        depth: depth along the axis of its own camera.
        color_camera: camera that the result belongs to, with its full lens model.
        color_from_depth: point_color = color_from_depth @ point_depth, rigid.
    """
    valid = known_pixels(depth)
    depth_m = depth.depth_m[valid].astype(np.float64)
    rays = depth.camera.rays()[valid].astype(np.float64)
    points = np.column_stack([rays * depth_m[:, None], depth_m])
    points = points @ color_from_depth[:3, :3].T + color_from_depth[:3, 3]
    # Half the side of a depth pixel's square as the colour camera sees it.
    growth = FOOTPRINT_MARGIN * color_camera.matrix[0, 0] / depth.camera.matrix[0, 0]
    half = np.clip(growth * depth_m / np.maximum(points[:, 2], 1e-6), 1, MAX_FOOTPRINT_PX) / 2
    registered = _splat(color_camera, points, half)
    known = np.isfinite(registered)
    depth_in_color = np.where(known, registered, 0).astype(np.float32)
    return DepthImage(depth_in_color, known, color_camera, depth.noise_sigma_m)


def _splat(
    camera: CameraModel, points: Float64[np.ndarray, "n 3"], half: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "h w"]:
    """Writes every point's z into the pixels whose centres its square of `half` the side covers."""
    pixels = camera.project(points)
    seen = np.isfinite(pixels).all(axis=1)
    seen[seen] = (np.abs(pixels[seen]) < 2 * max(camera.width, camera.height)).all(axis=1)
    pixels, half, z = pixels[seen], half[seen, None], points[seen, 2]
    first = np.ceil(pixels - half).astype(np.int64)
    # Half-open squares: neighbours share no pixel.
    last = np.ceil(pixels + half).astype(np.int64) - 1
    buffer = np.full(camera.height * camera.width, np.inf)
    for row_step in range(int((last - first)[:, 1].max(initial=-1)) + 1):
        for column_step in range(int((last - first)[:, 0].max(initial=-1)) + 1):
            target = np.add(first, (column_step, row_step))
            hit = ((target <= last) & (target >= 0) & (target < (camera.width, camera.height))).all(axis=1)
            np.minimum.at(buffer, target[hit, 1] * camera.width + target[hit, 0], z[hit])
    return buffer.reshape(camera.height, camera.width)
