"""One object's occlusion field on the GPU, and where the object stands (passes/common/object_field.glsl)."""

from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float16, Float32, Float64

from render_server.gpu.context import GpuContext
from render_server.scene.occlusion_field import OcclusionField
from render_server.scene.occlusion_transfer import LENGTH

MOST_SHELLS = 6


class FieldTextures:
    """The samples of one field: RGBA16F, four coefficients a slab; and the transfer of reflected light."""

    def __init__(self, gpu: GpuContext, field: OcclusionField) -> None:
        self.field = field
        self.occlusion = _slabs(gpu, field.occlusion)
        self.transfer: moderngl.Buffer | None = None
        self.glow_size = 0
        if field.transfer is not None:
            self.glow_size = field.transfer.shape[1]
            self.transfer = gpu.ctx.buffer(np.ascontiguousarray(field.transfer).tobytes())

    @property
    def glow_shape(self) -> tuple[int, int, int]:
        """Texels of the texture that holds what is reflected under one light: a slab a shell and coefficient."""
        size = self.glow_size
        return size, size, size * len(self.field.occlusion) * LENGTH

    def release(self) -> None:
        """Free the GL objects."""
        self.occlusion.release()
        if self.transfer is not None:
            self.transfer.release()


def _slabs(gpu: GpuContext, samples: Float16[np.ndarray, "shells n n n k"]) -> moderngl.Texture3D:
    shells, n, *_, count = samples.shape
    groups = -(-count // 4)
    padded = np.zeros((shells, n, n, n, 4 * groups), np.float16)
    padded[..., :count] = samples
    stacked = np.moveaxis(padded.reshape(shells, n, n, n, groups, 4), 4, 1)
    texture = field_texture(gpu, (n, n, n * shells * groups))
    texture.write(np.ascontiguousarray(stacked).tobytes(), alignment=1)
    return texture


def field_texture(gpu: GpuContext, shape: tuple[int, int, int]) -> moderngl.Texture3D:
    """RGBA16F volume that is read trilinearly."""
    texture = gpu.ctx.texture3d(shape, 4, dtype="f2")
    texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
    texture.repeat_x = texture.repeat_y = texture.repeat_z = False
    return texture


def standing_uniforms(
    world_from_asset: Float64[np.ndarray, "4 4"],
    field: OcclusionField | None,
    bounds: Float32[np.ndarray, "2 3"],
) -> dict[str, Any]:
    """Uniforms of an object's place and shells; without a field `bounds` (asset's frame) say where its middle is."""
    linear = world_from_asset[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    low, high = bounds.astype(np.float64)
    centre, half = (low + high) / 2, (high - low) / 2
    halves = np.ones((1, 3)) if field is None else field.grid.halves
    padded = np.concatenate([halves, np.repeat(halves[-1:], MOST_SHELLS - len(halves), axis=0)])
    return {
        "object_position": tuple(world_from_asset[:3, 3]),
        "world_from_object": linear / scale,
        "object_scale": scale,
        "field_centre": tuple(centre if field is None else field.grid.centre),
        "object_half": tuple(half),
        "object_radius": float(np.linalg.norm(half)) if field is None else field.radius,
        "shell_halves": [tuple(row) for row in padded],
        "shells": len(halves),
        "resolution": 2 if field is None else field.occlusion.shape[1],
    }
