"""Image-based shading of the virtual objects: a map of all light around them, and what they hide of it ([D] 4.2)."""

import moderngl
import numpy as np
from jaxtyping import Float32

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.gpu.uniform_block import UniformBlock
from deltalight.render_server.lights.light_map import irradiance_coefficients
from deltalight.render_server.passes.lights import LightingBlock, environment_texture
from deltalight.render_server.view import Rectangle


class SurroundingLight:
    """A map of all light around the objects: averaged over cones, and its irradiance in nine harmonics."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._map: moderngl.TextureArray | None = None
        self._block = UniformBlock(gpu, LightingBlock())
        self._coefficients = np.zeros((9, 3), np.float32)

    def set_map(self, radiance: Float32[np.ndarray, "n n 3"]) -> None:
        """Takes an octahedral map, world axes."""
        release_all(self._map)
        self._map, half_angle = environment_texture(self._gpu, radiance)
        self._block.write(LightingBlock(0, self._map.layers, half_angle))
        self._coefficients = irradiance_coefficients(radiance).astype(np.float32)

    @property
    def bindings(self) -> dict[str, Binding]:
        """The bindings of environment.glsl, and the coefficients."""
        return {
            "environment_map": self._map,
            "Lighting": self._block,
            "irradiance_coefficients": self._coefficients,
        }

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._map, self._block)


class AmbientOcclusion:
    """What the objects leave of light from everywhere to their own surfaces, from what the picture shows of them.

    `open` (R16F) is the open fraction of the hemisphere, weighted by the cosine (Jimenez et al. 2016); blocks of
    4 x 4 pixels share its slices, so that their mean is wanted.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.open = texture_2d(gpu, size, 1, "f2")
        self._kernel = Kernel(gpu, "ambient_occlusion")

    def run(self, rectangle: Rectangle, scene: Bindings, radius_m: float) -> None:
        """Fills `open` in the rectangle. Objects count in full within `radius_m`, and less up to twice of it."""
        if min(rectangle[2:]) > 0:
            own: Bindings = {"rectangle": rectangle, "occlusion_radius": radius_m}
            self._kernel.run(rectangle[2:], own, scene, occlusion_out=self.open)

    @property
    def bindings(self) -> dict[str, Binding]:
        """The binding of image_based_radiance.comp.glsl."""
        return {"ambient_occlusion": self.open}

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.open, self._kernel)


class ImageBasedRadiance:
    """Radiance of the objects (RGBA16F) under a map of all light, on the picture's grid.

    `precomputed`: what the objects hide of it comes by their transfer, not by ambient occlusion.
    """

    def __init__(
        self, gpu: GpuContext, size: tuple[int, int], samples: int, *, precomputed: bool = False
    ) -> None:
        self._samples = samples
        self.texture = texture_2d(gpu, size, 4, "f2")
        self._kernel = Kernel(gpu, "image_based_radiance", **({"PRECOMPUTED": 1} if precomputed else {}))

    def run(self, light: SurroundingLight, hidden: Bindings, rectangle: Rectangle, scene: Bindings) -> None:
        """Shades the objects in the rectangle; `hidden` binds what they hide of the light."""
        if min(rectangle[2:]) > 0:
            own: Bindings = {"rectangle": rectangle, "sample_count": self._samples}
            self._kernel.run(rectangle[2:], own, light.bindings, hidden, scene, radiance_out=self.texture)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.texture, self._kernel)
