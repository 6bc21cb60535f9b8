"""The albedo memory on the GPU: what real_radiance.glsl reads where the camera does not look."""

from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float32

from render_server.gpu.context import GpuContext
from render_server.scene.albedo_volume import MEAN_ALBEDO, AlbedoVolume


class UnseenAlbedo:
    """A 3-D texture of albedo over a cube in world axes; the mean of rooms until something was observed."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._texture: moderngl.Texture3D | None = None
        self.clear(MEAN_ALBEDO)

    def clear(self, albedo: float) -> None:
        """Take the same albedo everywhere."""
        self._replace(np.full((1, 1, 1, 3), albedo, np.float32))
        self._cube = (0.0, 0.0, 0.0, 1.0)

    def upload(self, memory: AlbedoVolume) -> None:
        """Take over everything that was observed."""
        self._replace(memory.filled())
        x, y, z = (float(v) for v in memory.origin)
        self._cube = (x, y, z, 1 / memory.edge)

    def _replace(self, albedo: Float32[np.ndarray, "z y x 3"]) -> None:
        self.release()
        texels = np.concatenate([albedo, np.ones_like(albedo[..., :1])], axis=-1).astype(np.float16)
        depth, height, width = albedo.shape[:3]
        texture = self._gpu.ctx.texture3d(
            (width, height, depth), 4, texels.tobytes(), dtype="f2", alignment=1
        )
        texture.repeat_x = texture.repeat_y = texture.repeat_z = False
        self._texture = texture

    def bind(self) -> None:
        """Bind to the place that real_radiance.glsl names."""
        assert self._texture is not None
        self._texture.use(location=21)

    def uniforms(self) -> dict[str, Any]:
        """Every uniform that shaders read of it."""
        return {"albedo_cube": self._cube}

    def release(self) -> None:
        """Free the texture."""
        if self._texture is not None:
            self._texture.release()
