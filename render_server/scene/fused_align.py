"""Pose of a depth image against the fused surface (Bylow et al. 2013): the board's pose, corrected by the shape seen.

The board gives the colour camera's pose with an error of millimetres at the distance of other things, and depth may
be taken a little earlier or later than colour. Frames averaged as the board says would blur the surface.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from render_server.scene.depth_surface import DepthSurface
from render_server.scene.tsdf_volume import BLOCK, FusedVolume
from render_server.view import CameraView

SAMPLES = 4000
# Neighbouring pixels err alike (filters, calibration): so many count as one.
ALIKE_PIXELS = 100
# What is known of the pose beforehand, standard deviations: some millimetres at a metre. Shape corrects what it can
# tell; along a bare wall, say, the board's pose stays.
POSE_SIGMA_RAD, POSE_SIGMA_M = 0.005, 0.005
ITERATIONS = 8
# Corrections below this share of a voxel end the search.
SETTLED_VOXELS = 0.01
LEAST_SAMPLES = 50
CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])


def aligned_view(
    volumes: list[FusedVolume], surface: DepthSurface, view: CameraView, noise_sigma: float
) -> CameraView:
    """Return the view from which the depth image fits the volumes best; the view itself where too little fits.

    Args:
        volumes: what was fused so far.
        surface: of the frame's depth.
        view: camera and pose by the board.
        noise_sigma: depth noise at 1 m, m.
    """
    points, sigma_m = _samples(surface, view, noise_sigma)
    total = np.zeros(6)
    for _ in range(ITERATIONS):
        matrix = _moved(total, view.world_from_camera)
        step = _step(volumes, points @ matrix[:3, :3].T + matrix[:3, 3], sigma_m, total, matrix[:3, 3])
        if step is None:
            return view
        total += step
        if np.abs(step).max() < SETTLED_VOXELS * volumes[0].placement.voxel_m:
            break
    return replace(view, world_from_camera=_moved(total, view.world_from_camera))


def _moved(motion: Float64[np.ndarray, "6"], pose: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """The pose turned about the camera's centre (first three, rad) and shifted (m), both in world axes."""
    result = pose.copy()
    result[:3, :3] = cv2.Rodrigues(motion[:3])[0] @ pose[:3, :3]
    result[:3, 3] += motion[3:]
    return result


def _samples(
    surface: DepthSurface, view: CameraView, noise_sigma: float
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """Points spread over the picture (optical frame), and their standard deviations across the surface, m."""
    stride = max(1, int(np.sqrt(surface.inverse_depth.size / SAMPLES)))
    grid = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    inverse = surface.inverse_depth[grid]
    known = (inverse > 0) & (surface.normals[grid] != 0).any(axis=-1)
    z = 1 / inverse[known].astype(np.float64)
    towards = np.column_stack([view.camera.rays()[grid][known], np.ones(len(z))])
    return towards * z[:, None], noise_sigma * z * z


def _step(
    volumes: list[FusedVolume],
    world: Float64[np.ndarray, "n 3"],
    sigma_m: Float64[np.ndarray, " n"],
    total: Float64[np.ndarray, "6"],
    centre: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "6"] | None:
    """One Gauss-Newton step of the motion; None where too few samples meet a known surface."""
    rows, residuals, information = [], [], []
    for volume in volumes:
        found, distance, gradient = look_up(volume, world)
        # A voxel's interpolation is no better than a tenth of it.
        sigma = np.hypot(sigma_m[found], 0.1 * volume.placement.voxel_m)
        # Cauchy's weight: what moved must not pull the camera along.
        information.append(1 / (sigma**2 * (1 + (distance / (3 * sigma)) ** 2) * ALIKE_PIXELS))
        rows.append(np.hstack([np.cross(world[found] - centre, gradient), gradient]))
        residuals.append(distance)
    slopes, missed, weight = np.concatenate(rows), np.concatenate(residuals), np.concatenate(information)
    if len(missed) < LEAST_SAMPLES:
        return None
    prior = 1 / np.repeat([POSE_SIGMA_RAD, POSE_SIGMA_M], 3) ** 2
    normal = (slopes * weight[:, None]).T @ slopes + np.diag(prior)
    return np.asarray(np.linalg.solve(normal, -(slopes * weight[:, None]).T @ missed - prior * total))


def look_up(
    volume: FusedVolume, world: Float64[np.ndarray, "n 3"]
) -> tuple[Int64[np.ndarray, " m"], Float64[np.ndarray, " m"], Float64[np.ndarray, "m 3"]]:
    """Points whose voxel cell is known, their distances (m) and the unit gradient there, trilinear."""
    placement = volume.placement
    at = (world - placement.origin) / placement.voxel_m
    found = np.flatnonzero(((at >= 0) & (at < placement.blocks * BLOCK - 1)).all(axis=1))
    cell = np.floor(at[found]).astype(np.int64)
    share = at[found] - cell
    corners = np.stack([_at_voxels(volume, cell + step) for step in CORNERS], axis=1)
    known: Bool[np.ndarray, " m"] = np.isfinite(corners).all(axis=1)
    found, share, corners = found[known], share[known], corners[known]
    sides = np.where(CORNERS[None] == 1, share[:, None], 1 - share[:, None])
    distance = (corners * sides.prod(axis=2)).sum(axis=1)
    signs = 2.0 * CORNERS - 1
    slopes = [
        (corners * signs[:, axis] * np.delete(sides, axis, axis=2).prod(axis=2)).sum(axis=1)
        for axis in range(3)
    ]
    gradient = np.stack(slopes, axis=1)
    length = np.linalg.norm(gradient, axis=1)
    # Where distances are cut off they do not change.
    steep = length > 0.5 * placement.voxel_m
    return found[steep], distance[steep], gradient[steep] / length[steep, None]


def _at_voxels(volume: FusedVolume, voxel: Int64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
    """Distances at voxels inside the cube, NaN where unknown."""
    block, inside = np.divmod(voxel, BLOCK)
    slot = volume.slots[tuple(block.T)]
    index = np.ravel_multi_index(tuple(inside.T), (BLOCK,) * 3)
    if not len(volume.places):
        return np.full(len(voxel), np.nan)
    known = (slot >= 0) & (volume.weight[slot, index] > 0)
    return np.where(known, volume.distance[slot, index], np.nan).astype(np.float64)
