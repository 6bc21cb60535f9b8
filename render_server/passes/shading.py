"""Full-resolution shading: direct light on the real surfaces, and radiance of the virtual ones."""

import math

import moderngl
import numpy as np
from jaxtyping import Float64

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel, list_threads
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.caustics import Caustics
from deltalight.render_server.passes.cones import ConeFields, LowResGrid, reuse_define
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.view import CameraView


class DirectLight:
    """E_mu and E_rho of the lights (RGBA16F), and their lobes on declared specular surfaces.

    With `shadow_cones`, that many cones through voxels give the objects' shadows ([P1] eq. 4); without, shadow maps
    do. Without `objects_shadow` other passes do, and E_rho is E_mu. Pixels that objects do not reach are 0. With
    `reuses`, only those are shaded whose light the last frame does not know (LightHistory).
    """

    def __init__(
        self,
        gpu: GpuContext,
        size: tuple[int, int],
        *,
        shadow_cones: int | None = None,
        objects_shadow: bool = True,
        reuses: bool = False,
    ) -> None:
        self._gpu, self._size = gpu, size
        self.mu = texture_2d(gpu, size, 4, "f2")
        self.rho = texture_2d(gpu, size, 4, "f2")
        self.lobe_mu = texture_2d(gpu, size, 4, "f2")
        self.lobe_rho = texture_2d(gpu, size, 4, "f2")
        defines = {} if shadow_cones is None else {"SHADOW_CONES": 1, "DIRECTIONS": shadow_cones}
        if not objects_shadow:
            defines = {"REAL_SHADOWS": 1}
        self._kernel = Kernel(gpu, "direct_light", **defines)
        self._select = Kernel(gpu, "select_direct_texels", **defines, **reuse_define(reuses))
        self._texels = gpu.ctx.buffer(reserve=4)

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
        """Shades the pixels. `joint`: the voxels that shadow cones march through; `caustics`: added to E_rho."""
        voxels: dict[str, Binding] = {} if joint is None else {"joint_mipmap": joint}
        self._shade(grid, self.bindings, voxels, _caustics_on(grid, caustics), scene)

    def _shade(self, grid: LowResGrid, targets: Bindings, *scene: Bindings) -> None:
        """Lists the texels that need light, empties the others, and shades those of the list."""
        grid.empty_list(self._texels)
        listed: Bindings = {**targets, **grid.bindings, "Texels": self._texels}
        self._select.run(grid.size, listed, *scene)
        self._kernel.run((list_threads(self._gpu, math.prod(self._size)),), listed, *scene)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.mu, self.rho, self.lobe_mu, self.lobe_rho, self._kernel, self._select, self._texels)


class LightHistory:
    """Reuses the light of the last frame while only the camera moves.

    Irradiance does not depend on where it is seen from: what the last frame computed is looked up where the surface
    was in its picture (reverse reprojection caching, Nehab et al. 2007). Pixels whose surface it did not show are
    computed, and in turn one tile in `turns`.
    """

    def __init__(
        self, gpu: GpuContext, grid: LowResGrid, direct: DirectLight, cones: ConeFields, turns: int
    ) -> None:
        self._grid, self._direct, self._cones, self._turns = grid, direct, cones, turns
        size = grid.picture_size
        self._last_direct = tuple(texture_2d(gpu, size, 4, "f2") for _ in range(2))
        self._positions = [texture_2d(gpu, size, 4, "f4") for _ in range(2)]
        self._real_texels, self._object_texels = (
            [texture_2d(gpu, grid.size, 4, "f4") for _ in range(2)] for _ in range(2)
        )
        self._stale = texture_2d(gpu, grid.size, 1, "u1")
        self._reproject = Kernel(gpu, "reproject_light")
        self._find_stale = Kernel(gpu, "stale_texels")
        self._seen: tuple[object, Float64[np.ndarray, "4 4"]] | None = None
        self._turn = 0

    def run(self, scene: Bindings, light: object, view: CameraView) -> dict[str, Binding]:
        """Fills in the light that the last frame knows, and marks where cones and caustics are to compute it.

        `light` is the same object as in the last frame if nothing but the camera has changed since. Returns the
        bindings of the passes that compute the rest.
        """
        last, self._seen = self._seen, (light, view.camera_from_world)
        has_history = last is not None and last[0] is light
        matrix = view.camera_from_world if last is None else last[1]
        self._turn = (self._turn + 1) % self._turns
        self._positions.reverse()
        self._real_texels.reverse()
        self._object_texels.reverse()
        direct = self._direct
        self._last_direct, (direct.mu, direct.rho) = (direct.mu, direct.rho), self._last_direct
        found: dict[str, Binding] = {
            "has_history": has_history,
            "last_camera_from_world": matrix,
            "last_position": self._positions[1],
            "last_real_texels": self._real_texels[1],
            "last_object_texels": self._object_texels[1],
            "stale_texels": self._stale,
            "turns": self._turns,
            "turn": self._turn,
            **self._cones.remember(),
        }
        self._fill(scene, found)
        return found

    def _fill(self, scene: Bindings, found: Bindings) -> None:
        shared: Bindings = {**found, "scale": self._grid.scale}
        self._reproject.run(
            self._grid.picture_size,
            shared,
            scene,
            position_out=self._positions[0],
            direct_mu_out=self._direct.mu,
            direct_rho_out=self._direct.rho,
            last_direct_mu=self._last_direct[0],
            last_direct_rho=self._last_direct[1],
        )
        self._find_stale.run(
            self._grid.size,
            shared,
            scene,
            sample_pixels=self._grid.pixels,
            stale_out=self._stale,
            real_texels_out=self._real_texels[0],
            object_texels_out=self._object_texels[0],
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(
            *self._last_direct,
            *self._positions,
            *self._real_texels,
            *self._object_texels,
            self._stale,
            self._reproject,
            self._find_stale,
        )


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
        targets = {**self.bindings, "direct_mu": self._unused[0], "lobe_mu": self._unused[1]}
        self._shade(grid, targets, _caustics_on(grid, None), rho.bindings, scene)

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
