"""Backs of surfaces that were seen from one side only."""

import numpy as np
from jaxtyping import Float32

OFFSET_VOXELS = 2.0
"""A ray that leaves a surface looks at the cells around its own, and must not meet the back of the surface there."""


def back_sheets(corners: Float32[np.ndarray, "m 3 10"], voxel_edge: float) -> Float32[np.ndarray, "m 3 10"]:
    """The back of each triangle (three corners, position first), turned round and some voxels behind it.

    A depth camera sees the front of things. Light does not pass through them from behind either: the underside of a
    shelf keeps off the light from above it and reflects that from below. How thick things are is unknown, so a back
    lies as near as voxels allow. `voxel_edge` in m.
    """
    positions = corners[..., :3]
    across = np.cross(positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0])
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    normals = across / np.maximum(length, np.finfo(np.float32).tiny)
    backs = corners[:, ::-1].copy()
    backs[..., :3] -= OFFSET_VOXELS * voxel_edge * normals[:, None]
    return backs
