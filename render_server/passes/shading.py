"""Full-resolution shading: direct light on the real surfaces, and radiance of the virtual ones."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import moderngl
import numpy as np
from jaxtyping import Float64

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import GROUP, ListGroups, ListWalk, list_threads
from deltalight.render_server.gpu.textures import release_all, release_target, texture_2d
from deltalight.render_server.passes.caustics import Caustics
from deltalight.render_server.passes.cones import ConeFields, LowResGrid
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.object_bvh import ObjectBvh
from deltalight.render_server.view import CameraView

NOTHING_KEPT: Bindings = {"keeps_unblocked": False}


class LightPair:
    """Light without (mu) and with the objects (rho), RGBA16F."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.mu, self.rho = (texture_2d(gpu, size, 4, "f2") for _ in range(2))
        self._target = gpu.ctx.framebuffer([self.mu, self.rho])

    def clear(self) -> None:
        """Sets both to zero."""
        self._target.use()
        self._target.clear()

    def release(self) -> None:
        """Frees the GL objects."""
        release_target(self._target)
        release_all(self.mu, self.rho)


class DirectLight:
    """E_mu and E_rho of the lights (RGBA16F), and their lobes on declared specular surfaces.

    With `shadow_cones`, that many cones through voxels give the objects' shadows ([P1] eq. 4); without, shadow maps
    do. With `ray_shadows`, rays find penumbrae where some objects are transparent. Without `objects_shadow` other
    passes find shadows, and E_rho is E_mu. Pixels that objects do not reach are 0. The blocks of pixels that the grid
    lists are shaded; with `reuses`, those of `texels`, which LightHistory fills beforehand, in software apart from
    `spared` ones, whose light without the objects is known, and of which they block none.
    """

    def __init__(
        self,
        gpu: GpuContext,
        size: tuple[int, int],
        *,
        shadow_cones: int | None = None,
        objects_shadow: bool = True,
        ray_shadows: bool = False,
        reuses: bool = False,
    ) -> None:
        self._gpu, self._size = gpu, size
        self.light, self.lobes = LightPair(gpu, size), LightPair(gpu, size)
        defines = {} if shadow_cones is None else {"SHADOW_CONES": 1, "DIRECTIONS": shadow_cones}
        if not objects_shadow:
            defines = {"REAL_SHADOWS": 1}
        self.defines: Mapping[str, float | str] = defines
        traced = {"RAY_SHADOWS": 1} if ray_shadows else {}
        self._kernel = Kernel(gpu, "direct_light", **defines, **traced)
        self._spared = Kernel(gpu, "direct_light", SPARED=1) if reuses and gpu.is_software else None
        self._reuses = reuses
        self.texels = gpu.ctx.buffer(reserve=4)
        self.spared = gpu.ctx.buffer(reserve=4) if self._spared is not None else None
        self._pixel_groups: ListGroups | None = None  # made when rays are traced in software

    @property
    def has_shadow_cones(self) -> bool:
        """Whether cones through voxels give the objects' shadows."""
        return "SHADOW_CONES" in self.defines

    @property
    def bindings(self) -> dict[str, Binding]:
        """Its textures by GLSL name."""
        return {
            "direct_mu": self.light.mu,
            "direct_rho": self.light.rho,
            "lobe_mu": self.lobes.mu,
            "lobe_rho": self.lobes.rho,
        }

    def run(
        self,
        grid: LowResGrid,
        scene: Bindings,
        *,
        shadow_voxels: moderngl.Texture3D | None = None,
        caustics: Caustics | None = None,
        objects: ObjectBvh | None = None,
    ) -> None:
        """Shades the pixels.

        `shadow_voxels`: what shadow cones march through; `caustics`: added to E_rho; `objects`: what the rays of
        `ray_shadows` meet (shaders/common/ray_shadows.glsl).
        """
        voxels: dict[str, Binding] = {} if shadow_voxels is None else {"joint_mipmap": shadow_voxels}
        if not self._reuses:
            self.clear(scene)
        traced = {} if objects is None else objects.bindings
        shared = voxels, _caustics_on(grid, caustics), traced, scene
        self._shade(grid, self.bindings, *shared, traces_rays=bool(traced))
        if self._spared is not None:
            listed: Bindings = {**self.bindings, **grid.bindings, "Texels": self.spared}
            if scene["keeps_unblocked"]:
                self._spared.run((list_threads(self._gpu, math.prod(self._size)),), listed, *shared)
            elif scene["keeps_unblocked_later"]:
                self._spared.compile_later(listed, *shared, keeps_unblocked=True)

    def clear(self, scene: Bindings) -> None:
        """Sets all light to zero."""
        self.light.clear()
        if scene["specular_surfaces"]:
            self.lobes.clear()

    def _shade(
        self, grid: LowResGrid, targets: Bindings, *scene: Bindings, traces_rays: bool = False
    ) -> None:
        """Shades the texels of the list; with `traces_rays`, in software by a thread per pixel (SOFTWARE_DIVISOR)."""
        texels = self.texels if self._reuses else grid.reached_texels
        listed: Bindings = {**targets, **grid.bindings, "Texels": texels}
        if traces_rays and self._gpu.is_software:
            groups = self._groups_of_pixels(grid.scale).count(texels)
            self._kernel.run_counted(groups, listed, *scene, NOTHING_KEPT)
        else:
            threads = list_threads(self._gpu, math.prod(self._size))
            self._kernel.run((threads,), listed, *scene, NOTHING_KEPT)

    def _groups_of_pixels(self, scale: int) -> ListGroups:
        if self._pixel_groups is None:
            self._pixel_groups = ListGroups(self._gpu, GROUP // scale**2, in_rows=False)
        return self._pixel_groups

    def release(self) -> None:
        """Frees the GL objects."""
        kernels = self._kernel, self._spared, self._pixel_groups
        release_all(self.light, self.lobes, *kernels, self.texels, self.spared)


@dataclass(frozen=True, eq=False)
class LightState:
    """What light at real surfaces depends on besides the camera; each is another object whenever any of it changes.

    `unblocked`: direct light without the objects; `direct`: that, and what objects block and focus of it; `bounced`:
    what cones and beams bring.
    """

    unblocked: object
    direct: object
    bounced: object


class LightHistory:
    """Reuses the light of the last frame as far as only the camera has moved.

    Irradiance does not depend on where it is seen from: what the last frame computed is looked up where the surface
    was in its picture (reverse reprojection caching, Nehab et al. 2007). Pixels whose surface it did not show are
    computed, and in turn one tile in `turns`. Where objects moved, pixels that show the same point as before keep
    their light without the objects.
    """

    def __init__(
        self, gpu: GpuContext, grid: LowResGrid, direct: DirectLight, cones: ConeFields, turns: int
    ) -> None:
        self._gpu, self._grid, self._direct, self._cones, self._turns = gpu, grid, direct, cones, turns
        size = grid.picture_size
        self._last_light = LightPair(gpu, size)
        self._positions: tuple[Binding, int] = None, 0  # of the last frame, and how often they were filled
        self._real_texels, self._object_texels = (
            [texture_2d(gpu, grid.size, 4, "f4") for _ in range(2)] for _ in range(2)
        )
        self._stale = texture_2d(gpu, grid.size, 1, "u1")
        self._reproject = Kernel(gpu, "reproject_light", **direct.defines)
        self._find_stale = Kernel(gpu, "stale_texels")
        self._seen: tuple[LightState | None, Float64[np.ndarray, "4 4"]] = None, np.eye(4)
        self._turn = self._direct_changes = 0

    def run(self, scene: Bindings, light: LightState | None, view: CameraView) -> dict[str, Binding]:
        """Fills in the light that the last frame knows, and marks where cones and caustics are to compute it.

        Without `light`, nothing is known, now and in the next frame. Returns the bindings of the passes that compute
        the rest.
        """
        (last, matrix), self._seen = self._seen, (light, view.camera_from_world)
        positions = self._last_positions(scene)
        if positions is None:
            last = None
        knows_direct, knows_bounced, knows_unblocked = False, False, False
        if last is not None and light is not None:
            knows_direct, knows_bounced = last.direct is light.direct, last.bounced is light.bounced
            knows_unblocked = last.unblocked is light.unblocked
        self._direct_changes += not knows_direct
        self._turn = (self._turn + 1) % self._turns
        self._real_texels.reverse()
        self._object_texels.reverse()
        direct = self._direct
        self._last_light, direct.light = direct.light, self._last_light
        found: dict[str, Binding] = {
            "has_history": knows_bounced,
            "keeps_unblocked": knows_unblocked and not knows_direct,
            "has_history_later": light is not None,  # so that their programs are compiled ahead (`Kernel`)
            "keeps_unblocked_later": light is not None,
            "last_camera_from_world": matrix,
            "last_position": positions,
            "last_real_texels": self._real_texels[1],
            "last_object_texels": self._object_texels[1],
            "stale_texels": self._stale,
            "turns": self._turns,
            "turn": self._turn,
            "direct_light_changes": self._direct_changes,
            **self._cones.remember(),
        }
        self._fill(scene, found, knows_direct=knows_direct)
        return found

    def _fill(self, scene: Bindings, found: Bindings, *, knows_direct: bool) -> None:
        grid, direct = self._grid, self._direct
        shared: Bindings = {**found, **grid.bindings}
        direct.clear(scene)
        grid.empty_list(direct.texels)
        apart: dict[str, Binding] = {}
        if direct.spared is not None:
            grid.empty_list(direct.spared)
            apart["Spared"] = direct.spared
        if self._cones.kept is not None:
            grid.empty_list(self._cones.kept.stale_texels)
        self._reproject.run(
            (list_threads(self._gpu, grid.texel_count),),
            shared,
            scene,
            apart,
            has_history=knows_direct,
            direct_mu_out=direct.light.mu,
            direct_rho_out=direct.light.rho,
            last_direct_mu=self._last_light.mu,
            last_direct_rho=self._last_light.rho,
            Texels=grid.reached_texels,
            Needed=direct.texels,
        )
        self._find_stale.run(
            self._grid.size,
            shared,
            scene,
            objects_moved=not knows_direct,
            stale_out=self._stale,
            real_texels_out=self._real_texels[0],
            object_texels_out=self._object_texels[0],
        )

    def _last_positions(self, scene: Bindings) -> Binding:
        """Returns the positions that the last frame saw; None if they were overwritten, which takes two fillings."""
        (positions, then), now = self._positions, scene["real_surface_fillings"]
        assert isinstance(now, int)
        self._positions = scene["real_surface_position"], now
        return positions if now - then <= 1 else None

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(
            self._last_light,
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


class ObjectRadiance:
    """Radiance of the objects (RGBA16F) on the picture's grid, where objects cover it."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._walk = ListWalk(gpu, size[0] * size[1])
        self.texture = texture_2d(gpu, size, 4, "f2")
        self._kernel = Kernel(gpu, "object_radiance")

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
        self._walk.run(
            self._kernel,
            grid.shown_pixels,
            _caustics_on(grid, caustics),
            scene,
            radiance_out=self.texture,
            ShownPixels=grid.shown_pixels,
            cone_irradiance=cones.virtual,
            cone_specular=cones.virtual_specular,
            screen_reflection=screen,
            has_screen_reflection=screen is not None,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.texture, self._kernel, self._walk)


def _caustics_on(grid: LowResGrid, caustics: Caustics | None) -> dict[str, Binding]:
    """Returns the bindings that shaders/common/caustics.glsl reads besides the scene."""
    sums: dict[str, Binding] = {"CausticSums": None} if caustics is None else caustics.bindings
    return {"sample_pixels": grid.pixels, "scale": grid.scale, **sums}
