"""Cone tracing at reduced resolution: the pixel that represents each texel, and the light that its cones gather."""

import math
from collections.abc import Mapping
from copy import copy

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import GROUP, LIST_HEADER_BYTES, ListGroups, list_threads
from deltalight.render_server.gpu.textures import release_all, release_target, texture_2d
from deltalight.render_server.passes.object_bvh import ObjectBvh
from deltalight.render_server.passes.voxels import VoxelMipmap


class LowResGrid:
    """For each block of the picture, the pixel of a real surface (x, y) and of a virtual one (x, y), as RGBA16I.

    -1 marks a block that shows none; -2 - pixel represents real surfaces that objects hide. `virtual_texels` lists
    the texels that show an object (count, then indices), `shown_pixels` the picture's pixels that do; `quads`, if
    `lists_quads`, one pixel that does of each 2 x 2. `reached_texels` lists those in which objects may change the
    direct light of a pixel: `shadow_defines` say how they cast shadows (`DirectLight.defines`). With `lists_cones`,
    `cone_texels` lists those in which they may change what cones gather at the real surface, and `cone_reach` is 1
    there.
    """

    def __init__(
        self,
        gpu: GpuContext,
        picture_size: tuple[int, int],
        scale: int,
        *,
        shadow_defines: Mapping[str, float | str],
        lists_quads: bool = False,
        lists_cones: bool = False,
    ) -> None:
        self._gpu = gpu
        self.picture_size, self.scale = picture_size, scale
        self.size = (-(-picture_size[0] // scale), -(-picture_size[1] // scale))
        self.pixels = texture_2d(gpu, self.size, 4, "i2")
        self.virtual_texels, self.reached_texels = (
            gpu.ctx.buffer(bytes(4 * (1 + self.texel_count))) for _ in range(2)
        )
        self.shown_pixels = gpu.ctx.buffer(bytes(4 * (1 + math.prod(picture_size))))
        self.quads = gpu.ctx.buffer(bytes(self.shown_pixels.size)) if lists_quads else None
        self.cone_reach, self.cone_texels = None, None
        if lists_cones:
            self.cone_reach = texture_2d(gpu, self.size, 1, "u1")
            self.cone_texels = gpu.ctx.buffer(bytes(4 * (1 + self.texel_count)))
        defines = {"QUADS": lists_quads, "CONES": lists_cones}
        wanted = {name: 1 for name, is_wanted in defines.items() if is_wanted}
        self._kernel = Kernel(gpu, "low_res_grid", **wanted, **shadow_defines)

    @property
    def texel_count(self) -> int:
        """Number of texels of the grid."""
        return self.size[0] * self.size[1]

    @property
    def bindings(self) -> dict[str, Binding]:
        """The bindings of low_res_grid.glsl and upsample.glsl."""
        return {
            "sample_pixels": self.pixels,
            "cone_reach": self.cone_reach,
            "low_resolution_size": self.size,
            "scale": self.scale,
        }

    def empty_list(self, texels: moderngl.Buffer) -> None:
        """Clears a list of texels (count, then indices), and makes room for all of the grid."""
        needed = 4 * (1 + self.texel_count)
        if texels.size < needed:
            texels.orphan(needed)
        self._gpu.clear_start(texels, LIST_HEADER_BYTES)

    def run(self, scene: Bindings) -> None:
        """Selects the pixels, and lists texels; `scene` brings lights and volumes too."""
        self.empty_list(self.virtual_texels)
        self.empty_list(self.reached_texels)
        self._gpu.clear_start(self.shown_pixels, LIST_HEADER_BYTES)
        lists: dict[str, Binding] = {}
        if self.quads is not None:
            self._gpu.clear_start(self.quads, LIST_HEADER_BYTES)
            lists["Quads"] = self.quads
        if self.cone_texels is not None:
            self.empty_list(self.cone_texels)
            lists |= {"ConeTexels": self.cone_texels, "cone_reach_out": self.cone_reach}
        self._kernel.run(
            self.size,
            scene,
            lists,
            sample_pixels_out=self.pixels,
            Texels=self.virtual_texels,
            ShownPixels=self.shown_pixels,
            Reached=self.reached_texels,
            picture_pixels=self.picture_size,
            scale=self.scale,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        lists = self.virtual_texels, self.reached_texels, self.shown_pixels, self.quads, self.cone_texels
        release_all(self.pixels, self.cone_reach, *lists, self._kernel)


class KeptIrradiance:
    """Irradiance of cones as far as the last frame knows it: without (mu) and with the objects, and at objects.

    That at objects is 0 where it is not known (a: 1 where it is). `stale_texels` lists the texels at whose real
    surface it is not known.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.mu, self.rho, self.virtual = (texture_2d(gpu, size, 4, "f2") for _ in range(3))
        self.stale_texels = gpu.ctx.buffer(reserve=4)

    @property
    def bindings(self) -> dict[str, Binding]:
        """What stale_texels.comp.glsl fills in."""
        return {
            "kept_mu": self.mu,
            "kept_rho": self.rho,
            "kept_irradiance": self.virtual,
            "StaleCones": self.stale_texels,
        }

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.mu, self.rho, self.virtual, self.stale_texels)


class ConeFields:
    """Light gathered by cones at 1/scale of the picture: irradiance (diffuse) and mean radiance (specular cone).

    With `remembers`, the irradiance of the last frame too. `kept` is what of it serves for this one; None: nothing is
    kept.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], *, remembers: bool = False) -> None:
        self.mu = texture_2d(gpu, size, 4, "f2")
        self.rho = texture_2d(gpu, size, 4, "f2")
        self.specular_mu = texture_2d(gpu, size, 4, "f2")
        self.specular_rho = texture_2d(gpu, size, 4, "f2")
        self.virtual = texture_2d(gpu, size, 4, "f2")
        self.virtual_specular = texture_2d(gpu, size, 4, "f2")
        self.kept: KeptIrradiance | None = None
        self.last: tuple[moderngl.Texture, ...] = ()
        if remembers:
            self.last = tuple(texture_2d(gpu, size, 4, "f2") for _ in range(3))

    def keep_irradiance(self, gpu: GpuContext) -> None:
        """Lets the irradiance that the last frame knows be kept."""
        self.kept = KeptIrradiance(gpu, self.mu.size)

    def remember(self) -> dict[str, Binding]:
        """Makes the irradiance the last frame's, and returns its bindings."""
        now = self.mu, self.rho, self.virtual
        (self.mu, self.rho, self.virtual), self.last = self.last, now
        return {
            "last_cone_mu": now[0],
            "last_cone_rho": now[1],
            "last_irradiance": now[2],
            "REUSES_IRRADIANCE": self.kept is not None,
            **({} if self.kept is None else self.kept.bindings),
        }

    def release(self) -> None:
        """Frees the textures."""
        of_frame = (
            self.mu,
            self.rho,
            self.specular_mu,
            self.specular_rho,
            self.virtual,
            self.virtual_specular,
        )
        release_all(*of_frame, *self.last, self.kept)


def reuse_define(reuses: bool) -> dict[str, int]:
    """Returns the define of kernels that leave out what the last frame's light serves for."""
    return {"REUSES": 1} if reuses else {}


class TraceRealCones:
    """Traces the cones of the exact operator at real surfaces, through mu and rho (docs/method.md 3 and 4.5).

    `size` is that of the reduced grid, which lists cones; `defines` are those of march.glsl. With `reuses`, only
    where the light that `fields` keep of the last frame does not serve. `refract` bends those that meet transparent
    objects.
    """

    def __init__(
        self, gpu: GpuContext, size: tuple[int, int], defines: Mapping[str, int], *, reuses: bool = False
    ) -> None:
        self._gpu, self._defines = gpu, defines
        self._own = None if reuses else tuple(texture_2d(gpu, size, 4, "f2") for _ in range(2))
        self._trace = Kernel(gpu, "trace_cones", REAL=1, **defines)
        self._filter = Kernel(gpu, "bilateral_cone_filter", REAL=1, **reuse_define(reuses))
        self._refract: RefractCones | None = None  # made when objects are transparent

    def run(
        self, fields: ConeFields, grid: LowResGrid, mu: VoxelMipmap, rho: VoxelMipmap, scene: Bindings
    ) -> None:
        """Traces and filters."""
        self.trace(fields, grid, mu, rho, scene)
        filtered = self.to_filter(fields, grid)
        self._filter.run(grid.size, filtered, grid.bindings, scene)

    def trace(
        self, fields: ConeFields, grid: LowResGrid, mu: VoxelMipmap, rho: VoxelMipmap, scene: Bindings
    ) -> None:
        """Traces E_mu, E_rho and the specular cones."""
        traced = self._traced(fields, grid)
        self._trace.run(
            (list_threads(self._gpu, grid.texel_count),),
            _specular(fields),
            grid.bindings,
            scene,
            irradiance_mu=traced["traced_mu"],
            irradiance_rho=traced["traced_rho"],
            Texels=traced["Texels"],
            mipmap_mu=mu.texture,
            mipmap_rho=rho.texture,
            Occupied=rho.occupied,
        )

    def to_filter(self, fields: ConeFields, grid: LowResGrid) -> dict[str, Binding]:
        """Returns what the filter reads and writes of them: where E_mu and E_rho are equal they stay equal."""
        filtered: dict[str, Binding] = {"irradiance_mu": fields.mu, "irradiance_rho": fields.rho}
        return {**self._traced(fields, grid), **_specular(fields), **filtered}

    def _traced(self, fields: ConeFields, grid: LowResGrid) -> dict[str, Binding]:
        """Returns what cones are traced into, and the list of texels from which."""
        if self._own is not None:
            mu, rho = self._own
            return {"traced_mu": mu, "traced_rho": rho, "Texels": grid.cone_texels}
        kept = fields.kept
        assert kept is not None
        return {"traced_mu": kept.mu, "traced_rho": kept.rho, "Texels": kept.stale_texels}

    def refract(
        self,
        fields: ConeFields,
        grid: LowResGrid,
        rho: VoxelMipmap,
        objects: ObjectBvh,
        scene: Bindings,
        *,
        cone_count: int,
    ) -> ConeFields:
        """Returns `fields` with the cones that `run` traced bent where they meet transparent objects.

        `scene` has the direct light; the picture needs its mip levels (`CameraImage.build_levels`).
        """
        if self._refract is None:
            self._refract = RefractCones(self._gpu, grid.size, self._defines, cone_count)
        lit = {**scene, **self._traced(fields, grid)}
        return self._refract.run(fields, grid, rho, objects, lit)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(*(self._own or ()), self._trace, self._filter, self._refract)


def _specular(fields: ConeFields) -> dict[str, Binding]:
    return {"specular_mu": fields.specular_mu, "specular_rho": fields.specular_rho}


class RefractCones:
    """Bends cones at real surfaces that meet transparent objects (docs/method.md 4.11), in a field of its own."""

    def __init__(
        self, gpu: GpuContext, size: tuple[int, int], defines: Mapping[str, int], cone_count: int
    ) -> None:
        self._groups = ListGroups(gpu, GROUP // cone_count)
        self._change, self._rho = (texture_2d(gpu, size, 4, "f2") for _ in range(2))
        self._target = gpu.ctx.framebuffer([self._change])
        self._refract = Kernel(gpu, "refract_cones", REAL=1, **defines)
        self._filter = Kernel(gpu, "bilateral_cone_filter", REAL=1, BENT=1)

    def run(
        self, fields: ConeFields, grid: LowResGrid, rho: VoxelMipmap, objects: ObjectBvh, lit: Bindings
    ) -> ConeFields:
        """Returns the fields with another E_rho; `lit` has the scene, what the cones traced, and the list of them."""
        texels = lit["Texels"]
        assert isinstance(texels, moderngl.Buffer)
        self._target.use()
        self._target.clear()
        self._refract.run_counted(
            self._groups.count(texels),
            grid.bindings,
            objects.bindings,
            lit,
            cone_change=self._change,
            cone_mu=fields.mu,
            cone_rho=fields.rho,
            mipmap_rho=rho.texture,
            Occupied=rho.occupied,
        )
        bent: dict[str, Binding] = {"irradiance_mu": fields.mu, "irradiance_rho": self._rho}
        self._filter.run(grid.size, bent, grid.bindings, lit, traced_change=self._change)
        found = copy(fields)
        found.rho = self._rho
        return found

    def release(self) -> None:
        """Frees the GL objects."""
        release_target(self._target)
        release_all(self._change, self._rho, self._refract, self._filter, self._groups)


class TraceVirtualCones:
    """Traces the cones of the exact operator at virtual surfaces, through rho; `size` and `defines` as at real ones.

    With `reuses`, only where the light that `fields` keep of the last frame does not serve.
    """

    def __init__(
        self, gpu: GpuContext, size: tuple[int, int], defines: Mapping[str, int], *, reuses: bool = False
    ) -> None:
        self._gpu = gpu
        self._irradiance = None if reuses else texture_2d(gpu, size, 4, "f2")
        self._target = None if self._irradiance is None else gpu.ctx.framebuffer([self._irradiance])
        self._trace = Kernel(gpu, "trace_cones", **reuse_define(reuses), **defines)
        self._filter = Kernel(gpu, "bilateral_cone_filter", **reuse_define(reuses))

    def run(
        self, fields: ConeFields, grid: LowResGrid, mu: VoxelMipmap, rho: VoxelMipmap, scene: Bindings
    ) -> None:
        """Traces and filters."""
        self.trace(fields, grid, mu, rho, scene)
        self._filter.run(grid.size, self.to_filter(fields), grid.bindings, scene)

    def trace(
        self, fields: ConeFields, grid: LowResGrid, mu: VoxelMipmap, rho: VoxelMipmap, scene: Bindings
    ) -> None:
        """Traces E_rho and the specular cone."""
        traced = self._begin(fields)
        self._trace.run(
            (list_threads(self._gpu, grid.texel_count),),
            grid.bindings,
            scene,
            Texels=grid.virtual_texels,
            irradiance_rho=traced,
            specular_rho=fields.virtual_specular,
            mipmap_mu=mu.texture,
            mipmap_rho=rho.texture,
            Occupied=rho.occupied,
        )

    def to_filter(self, fields: ConeFields) -> dict[str, Binding]:
        """Returns what the filter reads and writes of them."""
        return {"traced_objects": self._held(fields), "object_irradiance": fields.virtual}

    def _held(self, fields: ConeFields) -> moderngl.Texture:
        """Returns the texture that cones are traced into."""
        if self._irradiance is not None:
            return self._irradiance
        assert fields.kept is not None
        return fields.kept.virtual

    def _begin(self, fields: ConeFields) -> moderngl.Texture:
        """Returns the texture to trace into, which holds what is kept of the last frame and 0 elsewhere."""
        if self._target is not None:
            self._target.use()
            self._target.clear()
        return self._held(fields)

    def release(self) -> None:
        """Frees the GL objects."""
        if self._target is not None:
            release_target(self._target)
        release_all(self._irradiance, self._trace, self._filter)


class FilterBothCones:
    """Filters the cones of real surfaces and of objects in one dispatch."""

    def __init__(self, gpu: GpuContext, *, reuses: bool) -> None:
        self._kernel = Kernel(gpu, "bilateral_cone_filter", BOTH=1, **reuse_define(reuses))

    def run(
        self,
        fields: ConeFields,
        grid: LowResGrid,
        traced: tuple[TraceRealCones, TraceVirtualCones],
        scene: Bindings,
    ) -> None:
        """Filters what both have `traced` into the same fields."""
        real, virtual = traced
        both = {**real.to_filter(fields, grid), **virtual.to_filter(fields)}
        self._kernel.run((*grid.size, 2), both, grid.bindings, scene)

    def release(self) -> None:
        """Frees the program."""
        self._kernel.release()


class TraceConesPaper:
    """Traces the cones of the paper's operator ([P1] eq. 6 and 8): nine diffuse ones and a specular one.

    They march through V_delta at real surfaces, through V_rho at virtual ones.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._real = Kernel(gpu, "trace_cones_paper", DIRECTIONS=1, REAL=1)
        self._virtual = Kernel(gpu, "trace_cones_paper", DIRECTIONS=1)

    def trace_real(self, fields: ConeFields, grid: LowResGrid, delta: VoxelMipmap, scene: Bindings) -> None:
        """Computes ambient irradiance without occlusion (mu), the same with C_delta (rho), and specular cones."""
        self._real.run(
            grid.size,
            grid.bindings,
            scene,
            mipmap=delta.texture,
            irradiance_mu=fields.mu,
            irradiance_rho=fields.rho,
            specular_mu=fields.specular_mu,
            specular_rho=fields.specular_rho,
        )

    def trace_virtual(self, fields: ConeFields, grid: LowResGrid, rho: VoxelMipmap, scene: Bindings) -> None:
        """Computes irradiance and specular cone of virtual surfaces."""
        self._virtual.run(
            grid.size,
            grid.bindings,
            scene,
            mipmap=rho.texture,
            irradiance_rho=fields.virtual,
            specular_rho=fields.virtual_specular,
        )

    def release(self) -> None:
        """Frees the programs."""
        self._real.release()
        self._virtual.release()
