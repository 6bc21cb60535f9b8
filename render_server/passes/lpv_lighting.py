"""Light into and out of light propagation volumes: injection, bounces, surface irradiance (docs/method.md 5)."""

from collections.abc import Iterable, Sequence

import moderngl

from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.gpu.clearing import note_cleared
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import list_threads, map_threads
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.caustics import GREATEST_ALPHA
from deltalight.render_server.passes.cones import ConeFields, LowResGrid
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.lpv import LightVolume, PropagatedLight, cells_of
from deltalight.render_server.passes.lpv_small import HalfSteps
from deltalight.render_server.passes.volumes import PlacedVolume, VolumePlacement
from deltalight.render_server.passes.voxels import VoxelStore


def light_volume_bindings(mu: PropagatedLight, rho: PropagatedLight) -> dict[str, Binding]:
    """Returns the light without and with objects, as shaders/common/lpv_light.glsl reads it."""
    return {"light_mu": mu.total, "light_rho": rho.total}


class LpvInjectMaps:
    """Adds the light of reflective shadow maps to fixed-point sums ([P2] 4.3)."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._real = Kernel(gpu, "lpv_inject_maps", REAL=1, GREATEST_ALPHA=GREATEST_ALPHA)
        self._change = Kernel(gpu, "lpv_inject_maps", GREATEST_ALPHA=GREATEST_ALPHA)
        self._direct = Kernel(gpu, "lpv_inject_maps", DIRECT=1, GREATEST_ALPHA=GREATEST_ALPHA)

    def add_real(
        self, sums: moderngl.Buffer, lights: LightBuffers, real_albedo: moderngl.Texture, scene: Bindings
    ) -> None:
        """Adds the light that the real scene reflects as if there were no objects."""
        views = [
            view for view in range(len(lights.real_views)) if view not in lights.real_views_of_object_lamps
        ]
        self._inject_views(self._real, views, lights, scene, Injected=sums, real_albedo=real_albedo)

    def add_change(
        self, sums: moderngl.Buffer, lights: LightBuffers, real_albedo: moderngl.Texture, scene: Bindings
    ) -> None:
        """Adds the light that the objects reflect, minus what the real scene behind them reflected.

        Of lights that come with objects, adds what all of the real scene reflects.
        """
        own: dict[str, Binding] = {"Injected": sums, "real_albedo": real_albedo}
        self._inject_views(self._real, lights.real_views_of_object_lamps, lights, scene, **own)
        self._inject_views(self._change, _object_views(lights), lights, scene, **own)

    def add_direct(self, sums: moderngl.Buffer, lights: LightBuffers, scene: Bindings) -> None:
        """Adds the direct light that meets the objects, and subtracts what it lit before ([P2] 4.3.2)."""
        self._inject_views(self._direct, _object_views(lights), lights, scene, Injected=sums)

    def _inject_views(
        self, kernel: Kernel, views: Iterable[int], lights: LightBuffers, scene: Bindings, **own: Binding
    ) -> None:
        threads = (map_threads(self._gpu, lights.tile_size),)
        for view in views:
            kernel.run(threads, scene, view_index=view, **own)

    def release(self) -> None:
        """Frees the GL objects."""
        for kernel in (self._real, self._change, self._direct):
            kernel.release()


def _object_views(lights: LightBuffers) -> range:
    first = lights.first_object_view
    return range(first, first + len(lights.object_views))


class LpvInjectSurfaces:
    """Adds the surfaces' reflection of environment light, and their emission, to fixed-point sums."""

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._real = Kernel(gpu, "lpv_inject_surfaces", REAL=1)
        self._virtual = Kernel(gpu, "lpv_inject_surfaces")

    def add_real(self, sums: moderngl.Buffer, store: VoxelStore, scene: Bindings) -> None:
        """Adds the real scene's surfels."""
        self._real.run((self._threads,), store.bindings, scene, Injected=sums)

    def add_virtual(self, sums: moderngl.Buffer, store: VoxelStore, scene: Bindings) -> None:
        """Adds the objects' surfels."""
        self._virtual.run((self._threads,), store.bindings, scene, Injected=sums)

    def release(self) -> None:
        """Frees the GL objects."""
        self._real.release()
        self._virtual.release()


class LpvBounce:
    """Adds the surfaces' reflection of propagated light to fixed-point sums.

    On a GPU in one dispatch; software would run the code for both sets for each surfel.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._both = None if gpu.is_software else Kernel(gpu, "lpv_bounce", REAL=1, BOTH=1)
        self._each = (Kernel(gpu, "lpv_bounce", REAL=1), Kernel(gpu, "lpv_bounce")) if gpu.is_software else ()

    def run(
        self,
        sums: moderngl.Buffer,
        stores: tuple[VoxelStore, VoxelStore],
        light: tuple[LightVolume, LightVolume],
        scene: Bindings,
    ) -> None:
        """Adds real and virtual surfels under the light without and with objects."""
        threads, shared = (self._threads,), {**scene, **light_volume_bindings(*light), "Injected": sums}
        if self._both is not None:
            real, virtual = stores
            self._both.run(threads, real.bindings, shared, VirtualSurfels=virtual.surfels)
        for kernel, store in zip(self._each, stores, strict=False):
            kernel.run(threads, store.bindings, shared)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._both, *self._each)


class LpvAddBounce:
    """Adds bounces to light that is under way, and those beyond the last one (docs/method.md 5.6).

    A small volume goes on in the same dispatch: `then` says by how many half steps.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._clears = {} if gpu.is_software else {"CLEARS": 1}
        self._kernels: dict[str, Kernel] = {}
        self._measure = Kernel(gpu, "lpv_bounce_share")
        width = self._measure.local_size[0]
        self._threads = width**2  # as many workgroups as there are parts (shaders/common/added_bounce.glsl)
        self.parts = gpu.ctx.buffer(reserve=8 * width)

    def measure(self, first: moderngl.Buffer, both: moderngl.Buffer) -> None:
        """Finds which share of a bounce returns, from the sums of the `first` one and those of `both` first ones."""
        threads, cells = (self._threads,), cells_of(both)
        self._measure.run(threads, Before=first, Injected=both, Parts=self.parts, cells=cells)

    def run_first(
        self,
        volume: LightVolume,
        bounced: moderngl.Buffer,
        spare: moderngl.Buffer,
        *,
        then: HalfSteps | None = None,
    ) -> None:
        """Adds the first bounce to `volume`; on a GPU also clears the `spare` sums, which the next one fills."""
        cleared: Bindings = {} if self._gpu.is_software else {"Before": spare}
        self._run("FIRST", volume, bounced, cleared, then)
        note_cleared(self._gpu, (spare, spare.size))

    def run(
        self,
        volume: LightVolume,
        bounced: moderngl.Buffer,
        before: moderngl.Buffer,
        *,
        is_last: bool,
        then: HalfSteps | None = None,
    ) -> None:
        """Adds what the sums `bounced` have more than those `before`, which it clears on a GPU.

        The last bounce brings all that are not propagated, to the sums `bounced` too.
        """
        own: Bindings = {"Before": before, **({"Parts": self.parts} if is_last else {})}
        self._run("TAIL" if is_last else "", volume, bounced, own, then)
        note_cleared(self._gpu, (before, before.size))

    def _run(
        self, kind: str, volume: LightVolume, bounced: moderngl.Buffer, own: Bindings, then: HalfSteps | None
    ) -> None:
        cells, sums = volume.cells, {**own, "Injected": bounced}
        defines = {**({kind: 1} if kind else {}), **self._clears}
        if then is not None:
            then.run(volume, sums, BOUNCE=1, **defines)
            return
        if kind not in self._kernels:
            self._kernels[kind] = Kernel(self._gpu, "lpv_add_bounce", **defines)
        self._kernels[kind].run((cells**3,), sums, state=volume.state, total=volume.total, cells=cells)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(*self._kernels.values(), self._measure, self.parts)


SOURCE_TEXELS = 9  # of a volume: those of two sources, and which fractions arrive where (light_sources.glsl)


class LpvSources:
    """What several volumes change of the light beyond them, as point sources (docs/method.md 5.9)."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._kernel = Kernel(gpu, "lpv_sources")
        self.rows: moderngl.Texture | None = None

    def make_room(self, count: int) -> None:
        """Makes a row for each of `count` volumes."""
        if self.rows is None or self.rows.height != count:
            release_all(self.rows)
            self.rows = texture_2d(self._gpu, (SOURCE_TEXELS, count), 4, "f4")

    def sum_up(
        self,
        volume: int,
        cells: VolumePlacement,
        change: moderngl.Buffer,
        *,
        bounced: moderngl.Buffer | None,
        covered: moderngl.Buffer | None,
        arriving: Sequence[float],
    ) -> None:
        """Sums the light injected into a `volume` of these cells, in which its objects have `covered` faces.

        `arriving`: fractions of it that arrive in each volume.
        """
        self._kernel.run(
            (self._kernel.local_size[0],),
            Change=change,
            Bounced=bounced,
            VirtualCovered=covered,
            sources=self.rows,
            cells=cells.size,
            cell_edge=cells.voxel_edge,
            low_corner=cells.origin,
            has_bounced=bounced is not None,
            has_geometry=covered is not None,
            row=volume,
            arriving=tuple(arriving),
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._kernel, self.rows)


class LpvQuery:
    """Reads irradiance from light volumes on the reduced grid, into the fields that other methods trace by cones.

    Of both geometries in one dispatch on a GPU; in software every workgroup would pay for entering the longer kernel.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._both = None if gpu.is_software else Kernel(gpu, "lpv_query", BOTH=1)
        self._real = Kernel(gpu, "lpv_query", REAL=1)
        self._change = Kernel(gpu, "lpv_query", REAL=1, CHANGE=1)
        self._virtual = Kernel(gpu, "lpv_query")

    def read(
        self, fields: ConeFields, grid: LowResGrid, mu: PropagatedLight, rho: PropagatedLight, scene: Bindings
    ) -> None:
        """Writes E_mu and E_rho of real surfaces, and what `read_virtual` does."""
        volumes = light_volume_bindings(mu, rho)
        if self._both is None:
            self._run_real(self._real, fields, grid, volumes, scene)
            self.read_virtual(fields, grid, rho, scene)
        else:
            images = {**_real_images(fields), **_object_images(fields)}
            self._both.run((*grid.size, 2), images, grid.bindings, volumes, scene)

    def read_change(
        self,
        fields: ConeFields,
        grid: LowResGrid,
        delta: PropagatedLight,
        direct: PropagatedLight | None,
        scene: Bindings,
    ) -> None:
        """Writes E_mu of real surfaces without the volumes, and E_rho with `delta` and `direct` added."""
        volumes = light_volume_bindings(direct or delta, delta)
        own: dict[str, Binding] = {"direct_size": 0 if direct is None else direct.cells}
        self._run_real(self._change, fields, grid, {**volumes, **own}, scene)

    def _run_real(
        self, kernel: Kernel, fields: ConeFields, grid: LowResGrid, volumes: Bindings, scene: Bindings
    ) -> None:
        kernel.run(grid.size, _real_images(fields), grid.bindings, volumes, scene)

    def read_virtual(
        self, fields: ConeFields, grid: LowResGrid, rho: PropagatedLight, scene: Bindings
    ) -> None:
        """Writes the irradiance of virtual surfaces, and the radiance that a mirror there would show."""
        volumes = light_volume_bindings(rho, rho)
        self._virtual.run(grid.size, _object_images(fields), grid.bindings, volumes, scene)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._both, self._real, self._change, self._virtual)


def _real_images(fields: ConeFields) -> dict[str, Binding]:
    return {
        "irradiance_mu": fields.mu,
        "irradiance_rho": fields.rho,
        "specular_mu": fields.specular_mu,
        "specular_rho": fields.specular_rho,
    }


def _object_images(fields: ConeFields) -> dict[str, Binding]:
    return {"object_irradiance": fields.virtual, "object_specular": fields.virtual_specular}


def query_bindings(settings: DlpvMethod) -> dict[str, Binding]:
    """Returns the bindings for reading light from volumes (shaders/common/lpv_light.glsl)."""
    damping = settings.resolved_damping
    return {
        "has_geometry": settings.resolved_geometry_volume,
        "damping": damping,
        "is_damped": damping > 0.0,
    }


class LpvFields:
    """Reads from the volumes what other methods trace by cones."""

    def __init__(self, gpu: GpuContext, settings: DlpvMethod, fields: ConeFields) -> None:
        self._fields, self._bindings = fields, query_bindings(settings)
        self._query = LpvQuery(gpu)

    def marching(
        self, rho: PropagatedLight, volume: PlacedVolume, sources: moderngl.Texture | None
    ) -> dict[str, Binding]:
        """Returns the bindings for lighting reflected points from V_rho, whose cells fill the `volume`."""
        own = {**self._bindings, "light_sources": sources}
        return {**light_volume_bindings(rho, rho), **volume.bindings, **own}

    def read_difference(
        self,
        scene: Bindings,
        grid: LowResGrid,
        sources: moderngl.Texture | None,
        mu: PropagatedLight,
        rho: PropagatedLight,
    ) -> ConeFields:
        """Reads the irradiance at real surfaces and at the objects."""
        own = {**scene, **self._bindings, "light_sources": sources}
        self._query.read(self._fields, grid, mu, rho, own)
        return self._fields

    def read_printed(  # noqa: PLR0917 (a stage, which the graph gives its inputs in order)
        self,
        scene: Bindings,
        grid: LowResGrid,
        sources: moderngl.Texture | None,
        delta: PropagatedLight,
        direct: PropagatedLight | None,
        rho: PropagatedLight,
        rho_volume: PlacedVolume,
    ) -> ConeFields:
        """Reads the change of irradiance at real surfaces, and the irradiance at the objects."""
        own = {**scene, **self._bindings, "light_sources": sources}
        self._query.read_change(self._fields, grid, delta, direct, own)
        self._query.read_virtual(self._fields, grid, rho, {**own, **rho_volume.bindings})
        return self._fields

    def release(self) -> None:
        """Frees the programs."""
        self._query.release()
