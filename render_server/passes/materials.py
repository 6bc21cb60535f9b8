"""The material table that shaders read (passes/common/materials.glsl)."""

import cv2
import moderngl
import numpy as np
from jaxtyping import Float16

from render_server.gpu.context import GpuContext
from render_server.scene.gpu_mesh import GpuMesh

TEXTURE_SIZE = 1024  # texels an edge of a base-colour texture
METALLIC, REFLECTANCE, ROUGHNESS = 3, slice(4, 7), 7  # columns of the table, as materials.glsl has them


class MaterialTable:
    """Materials in a storage buffer, their base-colour textures in one array.

    `smoothest`: least roughness of those that reflect at all, 1 if none does.
    """

    def __init__(self, gpu: GpuContext, mesh: GpuMesh) -> None:
        self.smoothest = _smoothest(mesh)
        self._buffer = gpu.ctx.buffer(np.ascontiguousarray(mesh.material_table, np.float32).tobytes())
        size = TEXTURE_SIZE if mesh.textures else 1
        self._textures = gpu.ctx.texture_array((size, size, max(len(mesh.textures), 1)), 4, dtype="f2")
        for index, texture in enumerate(mesh.textures):
            self._textures.write(_resampled(texture, size), viewport=(0, 0, index, size, size, 1))
        self._textures.filter = (moderngl.LINEAR, moderngl.LINEAR)

    def bind(self) -> None:
        """Bind to the places that materials.glsl names."""
        self._buffer.bind_to_storage_buffer(15)
        self._textures.use(location=14)

    def release(self) -> None:
        """Free the GL objects."""
        self._buffer.release()
        self._textures.release()


def _smoothest(mesh: GpuMesh) -> float:
    table = mesh.material_table
    reflects = (table[:, METALLIC] > 0) | (table[:, REFLECTANCE] > 0).any(axis=1)
    return float(min(table[reflects, ROUGHNESS], default=1.0))


def _resampled(texture: Float16[np.ndarray, "h w 3"], size: int) -> bytes:
    """RGBA float16 bytes of a linear texture, area-averaged to size x size."""
    resized = cv2.resize(texture.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    rgba = np.dstack([resized, np.ones((size, size), np.float32)])
    return rgba.astype(np.float16).tobytes()
