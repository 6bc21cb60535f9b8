"""Virtual objects in smooth real surfaces, and the camera's picture in smooth virtual ones and through them."""

from collections.abc import Mapping

import moderngl

from deltalight.protocol.quality import QualityTier
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import GROUP, LIST_HEADER_BYTES, ListGroups, ListWalk
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.caustics import GREATEST_ALPHA
from deltalight.render_server.passes.cones import ConeFields, LowResGrid, reuse_define
from deltalight.render_server.passes.object_bvh import ObjectBvh
from deltalight.render_server.passes.shading import DirectLight

# Of equal energy each: up to RAY_ROUGHNESS they are closer together than voxels. There the cone of the lobe is 48
# degrees wide and the rays some 12 apart: a fifth of an object's length away from it, six of 64 voxels.
RAY_COUNT = 16
# Of surfaces; rougher ones use cones. These span many voxels there, and so few rays would show as grain.
RAY_ROUGHNESS = 0.3

# A lobe with 85 % of its energy within 45 degrees or more is as good as diffuse: the wider cones serve.
ROUGHEST = GREATEST_ALPHA**0.5
# A uniform disc with the median of the GGX lobe has this multiple of alpha as its half-angle (rad): half of the lobe
# lies within 2 alpha, half of a disc within 1 / sqrt(2) of its radius.
MEDIAN_DISC = 2.0 * 2.0**0.5


class MirrorRays:
    """Traces the virtual objects in smooth surfaces by rays, because cones through voxels would blur them.

    The surfaces are real ones, or with `of_objects` those of the objects. `reflection` (RGBA16F): radiance of the
    objects times the fraction of the lobe that they fill, and that fraction. `gather` completes the name of the
    kernel that lights reflected points (`mirror_gather...`); `defines` are that kernel's.
    """

    def __init__(
        self,
        gpu: GpuContext,
        grid: LowResGrid,
        objects: ObjectBvh,
        gather: str,
        defines: Mapping[str, float | str],
        *,
        of_objects: bool = False,
    ) -> None:
        self._gpu, self._grid, self._objects = gpu, grid, objects
        if of_objects:
            defines = {**defines, "OF_OBJECTS": 1}
        self.reflection = texture_2d(gpu, grid.picture_size, 4, "f2")
        self._traced = texture_2d(gpu, grid.picture_size, 4, "f2")
        self._hit_distance = texture_2d(gpu, grid.picture_size, 1, "f2")
        self._position = texture_2d(gpu, grid.size, 4, "f4")
        self._normal = texture_2d(gpu, grid.size, 4, "f2")
        self._irradiance = texture_2d(gpu, grid.size, 4, "f2")
        self._specular = texture_2d(gpu, grid.size, 4, "f2")
        self._pixels = gpu.ctx.buffer(reserve=4 + 4 * grid.picture_size[0] * grid.picture_size[1])
        self._texels = gpu.ctx.buffer(reserve=4 + 4 * grid.size[0] * grid.size[1])
        self._pixel_groups, self._texel_groups = (ListGroups(gpu, GROUP) for _ in range(2))
        self._ray_groups = ListGroups(gpu, GROUP // RAY_COUNT)
        self._select, self._hits, self._gather, self._trace, self._smooth = (
            Kernel(gpu, f"mirror_{name}", RAY_ROUGHNESS=RAY_ROUGHNESS, RAY_COUNT=RAY_COUNT, **defines)
            for name in ("select", "hits", gather, "objects", "smooth")
        )

    def run(self, light: Bindings, scene: Bindings) -> None:
        """Fills `reflection`; `light` holds what the gathering kernel reads besides the scene.

        The GPU counts the pixels that need rays, and traces nothing if there are none.
        """
        self._gather_light(light, scene)
        self._list_pixels(scene)
        self._trace_rays(scene)
        self._smooth.run_counted(
            self._pixel_groups.count(self._pixels),
            scene,
            Texels=self._pixels,
            reflection=self.reflection,
            traced=self._traced,
            hit_distance=self._hit_distance,
        )

    def _list_pixels(self, scene: Bindings) -> None:
        """Lists the pixels that need rays; the others reflect nothing."""
        self._gpu.clear_start(self._pixels, LIST_HEADER_BYTES)
        self._select.run(
            self._grid.picture_size,
            scene,
            Texels=self._pixels,
            reflection=self.reflection,
            traced=self._traced,
            hit_distance=self._hit_distance,
            bounds_centre=tuple(self._objects.centre),
            bounds_radius=self._objects.radius,
            hit_position=self._position,
            scale=self._grid.scale,
        )

    def _gather_light(self, light: Bindings, scene: Bindings) -> None:
        """Computes the light at reflected points, at the resolution of the cones."""
        grid = self._grid
        self._gpu.clear_start(self._texels, LIST_HEADER_BYTES)
        self._hits.run(
            grid.size,
            self._objects.bindings,
            scene,
            Texels=self._texels,
            position_out=self._position,
            normal_out=self._normal,
            sample_pixels=grid.pixels,
            scale=grid.scale,
        )
        self._gather.run_counted(
            self._texel_groups.count(self._texels),
            light,
            scene,
            Texels=self._texels,
            sample_pixels=grid.pixels,
            hit_position=self._position,
            hit_normal=self._normal,
            irradiance_out=self._irradiance,
            specular_out=self._specular,
        )

    def _trace_rays(self, scene: Bindings) -> None:
        self._trace.run_counted(
            self._ray_groups.count(self._pixels),
            self._objects.bindings,
            scene,
            Texels=self._pixels,
            traced=self._traced,
            hit_distance=self._hit_distance,
            sample_pixels=self._grid.pixels,
            scale=self._grid.scale,
            hit_position=self._position,
            hit_normal=self._normal,
            hit_irradiance=self._irradiance,
            hit_specular=self._specular,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        for item in vars(self).values():
            if hasattr(item, "release") and item not in (self._gpu, self._grid, self._objects):
                item.release()


class ScreenCones:
    """Traces what smooth virtual surfaces reflect of the visible real scene ([D] 4.4.2).

    `reflected` (RGBA16F): radiance times fraction of the specular lobe, and that fraction, on the picture's grid.
    `march` are defines of march.glsl to look up in voxels and environment what the picture does not show; the
    fraction is then 1. None: that fraction of the lobe is left to other passes. `tier` says by how many cones; they
    start at one pixel of each quad if the `grid` lists quads, and where what the last frame traced does not serve.
    """

    def __init__(
        self,
        gpu: GpuContext,
        grid: LowResGrid,
        march: Mapping[str, float | str] | None,
        tier: QualityTier,
    ) -> None:
        self._grid, step = grid, 1 if grid.quads is None else 2
        width, height = grid.picture_size
        self._walk = ListWalk(gpu, width * height)
        size = -(-width // step), -(-height // step)
        self._traced = texture_2d(gpu, size, 4, "f2")
        self._history = (
            ReflectionHistory(gpu, size, tier.reflection_turns) if tier.reflection_turns > 1 else None
        )
        voxels = {} if march is None else {"VOXELS": 1, **march}
        self._kernel = Kernel(
            gpu,
            "screen_cones",
            ROUGHEST=ROUGHEST,
            CONE_COUNT=tier.reflection_cones,
            RAY_ROUGHNESS=RAY_ROUGHNESS,
            MEDIAN_DISC=MEDIAN_DISC / tier.reflection_cones**0.5,  # the cones share the disc
            STEP=step,
            **voxels,
            **reuse_define(self._history is not None),
        )
        self._filled: moderngl.Texture | None = None
        self._fill: Kernel | None = None
        if grid.quads is not None:
            self._filled = texture_2d(gpu, grid.picture_size, 4, "f2")
            self._fill = Kernel(gpu, "fill_reflections")

    @property
    def reflected(self) -> moderngl.Texture:
        """What the newest run found."""
        return self._traced if self._filled is None else self._filled

    def run(
        self,
        direct: DirectLight,
        cones: ConeFields,
        objects: ObjectBvh,
        scene: Bindings,
        object_rays: moderngl.Texture | None,
    ) -> None:
        """Fills `reflected`; the picture needs its mip levels (`CameraImage.build_levels`).

        `object_rays`: what rays saw of the objects (`MirrorRays.reflection`), so that cones leave them out.
        """
        rays: Bindings = {"OBJECT_RAYS": object_rays is not None, "object_rays": object_rays}
        kept = {} if self._history is None else self._history.turn(scene)
        listed = self._grid.shown_pixels if self._grid.quads is None else self._grid.quads
        self._walk.run(
            self._kernel,
            listed,
            objects.bindings,
            rays,
            {**scene, **kept},
            ShownPixels=listed,
            scale=self._grid.scale,
            reflected=self._traced,
            sample_pixels=self._grid.pixels,
            direct_mu=direct.light.mu,
            direct_rho=direct.light.rho,
            cone_mu=cones.mu,
            cone_rho=cones.rho,
        )
        if self._fill is not None:
            shown = self._grid.shown_pixels
            filled: Bindings = {"traced": self._traced, "reflected": self._filled}
            self._walk.run(self._fill, shown, scene, filled, ShownPixels=shown)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._traced, self._history, self._filled, self._kernel, self._fill, self._walk)


class ReflectionHistory:
    """What the last frame traced of reflections, for frames in which only the camera moved.

    A reflection depends on the direction that it is seen from, so each texel has a record of the point and the
    mirrored direction that its cones were for, and of what they found (shaders/common/reflection_history.glsl). One
    tile in `turns` is traced in turn, because the picture that is reflected may change. `size` is that of the traced
    texels.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], turns: int) -> None:
        width, height = size
        self._records = texture_2d(gpu, (3 * width, 2 * height), 2, "u4")  # of the last frame and of this one
        self._turns, self._runs = turns, 0
        self._changes: Binding = None

    def turn(self, scene: Bindings) -> Bindings:
        """Makes the newest records the last frame's; returns the kernel's bindings for this one's."""
        then, self._changes = self._changes, scene["direct_light_changes"]
        self._runs += 1
        return {
            "has_history": then == self._changes,
            "records": self._records,
            "run_number": self._runs,
            "turns": self._turns,
            "turn": self._runs % self._turns,
        }

    def release(self) -> None:
        """Frees the texture."""
        self._records.release()


class TransmittedLight:
    """Adds what transparent objects show of what is behind them, by rays that their surfaces refract.

    `radiance` (RGBA16F): with it, of the objects on the picture's grid. `march` as of ScreenCones; without voxels,
    what the picture does not show is the environment.
    """

    def __init__(
        self,
        gpu: GpuContext,
        grid: LowResGrid,
        march: Mapping[str, float | str] | None,
        tier: QualityTier,
    ) -> None:
        self._grid, rays = grid, tier.reflection_cones
        self._ray_groups = ListGroups(gpu, GROUP // rays)
        self.radiance = texture_2d(gpu, grid.picture_size, 4, "f2")
        voxels = {} if march is None else {"VOXELS": 1, **march}
        self._kernel = Kernel(gpu, "transmitted_light", RAY_COUNT=rays, MEDIAN_DISC=MEDIAN_DISC, **voxels)

    def run(
        self,
        reflected: moderngl.Texture,
        direct: DirectLight,
        cones: ConeFields,
        objects: ObjectBvh,
        scene: Bindings,
    ) -> None:
        """Fills `radiance`; `reflected` is the objects' own. The picture needs its mip levels."""
        self._kernel.run_counted(
            self._ray_groups.count(self._grid.shown_pixels),
            objects.bindings,
            scene,
            ShownPixels=self._grid.shown_pixels,
            scale=self._grid.scale,
            reflected_radiance=reflected,
            radiance_out=self.radiance,
            sample_pixels=self._grid.pixels,
            direct_mu=direct.light.mu,
            direct_rho=direct.light.rho,
            cone_mu=cones.mu,
            cone_rho=cones.rho,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.radiance, self._kernel, self._ray_groups)
