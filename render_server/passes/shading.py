"""Full-resolution shading: direct light on the real surfaces, and radiance of the virtual ones."""

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.kernel import Binding, Bindings, Kernel, list_threads
from render_server.gpu.textures import release_all, texture_2d
from render_server.passes.caustics import Caustics
from render_server.passes.cones import ConeFields, LowResGrid
from render_server.passes.lights import LightBuffers


class DirectLight:
    """E_mu and E_rho of the lights (RGBA16F), and their lobes on declared specular surfaces.

    With `shadow_cones`, that many cones through voxels give the objects' shadows ([P1] eq. 4); without, shadow maps
    do. Without `objects_shadow` other passes do, and E_rho is E_mu.
    """

    def __init__(
        self,
        gpu: GpuContext,
        size: tuple[int, int],
        *,
        shadow_cones: int | None = None,
        objects_shadow: bool = True,
    ) -> None:
        self._size = size
        self.mu = texture_2d(gpu, size, 4, "f2")
        self.rho = texture_2d(gpu, size, 4, "f2")
        self.lobe_mu = texture_2d(gpu, size, 4, "f2")
        self.lobe_rho = texture_2d(gpu, size, 4, "f2")
        defines = {} if shadow_cones is None else {"SHADOW_CONES": 1, "DIRECTIONS": shadow_cones}
        if not objects_shadow:
            defines = {"REAL_SHADOWS": 1}
        self._kernel = Kernel(gpu, "direct_light", **defines)

    @property
    def bindings(self) -> dict[str, Binding]:
        """Its textures by GLSL name."""
        return {
            "direct_mu": self.mu,
            "direct_rho": self.rho,
            "lobe_mu": self.lobe_mu,
            "lobe_rho": self.lobe_rho,
        }

    def run(
        self,
        grid: LowResGrid,
        scene: Bindings,
        *,
        joint: moderngl.Texture3D | None = None,
        caustics: Caustics | None = None,
    ) -> None:
        """Shades every pixel. `joint`: the voxels that shadow cones march through; `caustics`: added to E_rho."""
        voxels: dict[str, Binding] = {} if joint is None else {"joint_pyramid": joint}
        self._kernel.run(self._size, self.bindings, voxels, _caustics_on(grid, caustics), scene)

    def release(self) -> None:
        """Frees the GL objects."""
        for item in (self.mu, self.rho, self.lobe_mu, self.lobe_rho, self._kernel):
            item.release()


class DirectLightPair(DirectLight):
    """Direct light of two full solutions, each under its own shadow maps (docs/method.md 6).

    E_mu comes from the maps of one set of lights, E_rho from those of another; neither has maps of objects alone.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        super().__init__(gpu, size, objects_shadow=False)
        self._unused = [texture_2d(gpu, size, 4, "f2") for _ in range(2)]

    def run_both(self, mu: LightBuffers, rho: LightBuffers, grid: LowResGrid, scene: Bindings) -> None:
        """Shades every pixel in both solutions."""
        self.run(grid, {**scene, **mu.bindings})
        self._kernel.run(
            self._size,
            {**self.bindings, "direct_mu": self._unused[0], "lobe_mu": self._unused[1]},
            _caustics_on(grid, None),
            rho.bindings,
            scene,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(*self._unused)
        super().release()


class VirtualSurface:
    """Radiance of the virtual surfaces (RGBA16F) on the picture's grid, where objects cover it."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._threads = list_threads(gpu, size[0] * size[1])
        self.radiance = texture_2d(gpu, size, 4, "f2")
        self._kernel = Kernel(gpu, "virtual_surface")

    def run(
        self,
        cones: ConeFields,
        grid: LowResGrid,
        scene: Bindings,
        *,
        screen: moderngl.Texture | None = None,
        caustics: Caustics | None = None,
    ) -> None:
        """Shades the objects. `screen`: what they reflect of the picture (passes/reflections.py), if anything."""
        self._kernel.run(
            (self._threads,),
            _caustics_on(grid, caustics),
            scene,
            radiance_out=self.radiance,
            Texels=grid.virtual_texels,
            cone_irradiance=cones.virtual,
            cone_specular=cones.virtual_specular,
            screen_reflection=screen,
            has_screen_reflection=screen is not None,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        self.radiance.release()
        self._kernel.release()


def _caustics_on(grid: LowResGrid, caustics: Caustics | None) -> dict[str, Binding]:
    """Returns the bindings that shaders/common/caustics.glsl reads besides the scene."""
    sums: dict[str, Binding] = {"CausticSums": None} if caustics is None else caustics.bindings
    return {"sample_pixels": grid.pixels, "scale": grid.scale, **sums}
