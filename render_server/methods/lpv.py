"""Delta light propagation volumes ([P2], docs/method.md 5)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import moderngl
import numpy as np

from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.frame import FrameResources
from deltalight.render_server.geometry_state import ObjectExtent
from deltalight.render_server.gpu.clearing import clear_buffer
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.methods.light_maps import (
    LitScene,
    lagging_behind_objects,
    light_stages,
    object_extent,
)
from deltalight.render_server.methods.lpv_cells import cell_stages, release_held
from deltalight.render_server.methods.lpv_memory import PrintedSizes, affordable_count, state_memory
from deltalight.render_server.methods.lpv_propagated import Propagated
from deltalight.render_server.methods.method import RelightingMethod, ResolvedSettings, Setup
from deltalight.render_server.methods.per_volume import ForEachVolume, PerVolume, volume_pool
from deltalight.render_server.methods.surface_shading import (
    Layers,
    MethodStages,
    ShadingOptions,
    SurfaceShading,
    shading_stages,
)
from deltalight.render_server.methods.volume_placement import SizeOf, outside_fractions, volume_placements
from deltalight.render_server.passes.cones import ConeFields, LowResGrid
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.lpv import (
    LightVolume,
    LpvBoxFilter,
    LpvJoin,
    LpvShow,
    PropagatedLight,
    cells_of,
    injected_sums,
)
from deltalight.render_server.passes.lpv_lighting import (
    LpvAddBounce,
    LpvBounce,
    LpvFields,
    LpvInjectMaps,
    LpvSources,
    query_bindings,
)
from deltalight.render_server.passes.lpv_small import HalfSteps
from deltalight.render_server.passes.shading import DirectLight
from deltalight.render_server.passes.volumes import MOST_VOLUMES, PlacedVolume, VolumePlacement
from deltalight.render_server.passes.voxels import VoxelMipmap, VoxelsOnDemand, VoxelStore


class DifferenceVolumes:
    """V_rho and V_mu.

    V_mu starts from the real scene's light without objects, V_rho from V_mu and the change due to them. Each bounce
    adds to V_rho what surfaces reflect of its light; the last one, if there are two, what all later ones would add.
    """

    def __init__(self, gpu: GpuContext, settings: DlpvMethod, size: int) -> None:
        self._gpu, self._settings = gpu, settings
        steps = settings.steps or size
        self._mu, self._rho = (Propagated(gpu, settings, size, steps) for _ in range(2))
        self._bounced, self._before = (injected_sums(gpu, size) for _ in range(2))
        self._bounce = LpvBounce(gpu)
        self._add = LpvAddBounce(gpu)

    def propagate_mu(self, injected: moderngl.Buffer, through: moderngl.Texture3D | None) -> LightVolume:
        """Propagates V_mu."""
        return self._mu.run(through, injected)

    def propagate_rho(
        self,
        mu: LightVolume,
        change: moderngl.Buffer,
        through_real: moderngl.Texture3D | None,
        through: moderngl.Texture3D | None,
    ) -> LightVolume:
        """Propagates V_rho."""
        return self._rho.run_change(mu, change, through_real, through)

    def bounce(
        self,
        rho: LightVolume,
        mu: LightVolume,
        surfels: tuple[VoxelStore, VoxelStore],
        scene: Bindings,
        through: moderngl.Texture3D | None,
    ) -> tuple[LightVolume, moderngl.Buffer | None]:
        """Propagates V_rho on, with the light that surfaces reflect of it.

        Returns it and the sums of what they reflect; None if there is no bounce. It adds to V_rho, so `propagate_rho`
        runs before each run: whatever changes an input of this stage changes one of that stage, too, and where this
        one fails, the graph runs both again.
        """
        own = {**scene, **query_bindings(self._settings)}
        last = self._settings.resolved_bounces
        for number in range(1, last + 1):
            self._bounced, self._before = self._before, self._bounced
            clear_buffer(self._gpu, self._bounced)
            self._bounce.run(self._bounced, surfels, (mu, rho), own)
            then = self._rho.half_steps_of_a_bounce(through)
            self._add_to(rho, number, is_last=number == last, then=then)
            if then is None:
                self._rho.go_on(through)
        return rho, self._bounced if last > 0 else None

    def _add_to(self, rho: LightVolume, number: int, *, is_last: bool, then: HalfSteps | None) -> None:
        """Adds the sums of that bounce, counted from 1."""
        if number == 1:
            self._add.run_first(rho, self._bounced, self._before, then=then)
            return
        if number == 2:
            self._add.measure(self._before, self._bounced)
        self._add.run(rho, self._bounced, self._before, is_last=is_last, then=then)

    def release(self) -> None:
        """Frees the GL objects."""
        release_held(self)


class PrintedVolumes:
    """The volumes of [P2] 4.3: V_rho for the objects, V_delta of the indirect change, and one of the direct change.

    The direct change is injected apart from the indirect one, so that it can have steps of its own (none in 4.3.2,
    "n" in section 7, five in fig. 7).
    """

    def __init__(self, gpu: GpuContext, settings: DlpvMethod, sizes: PrintedSizes) -> None:
        self._gpu, self._settings = gpu, settings
        steps, own_steps = settings.steps, settings.objects_steps or settings.steps
        self._rho = Propagated(gpu, settings, sizes.objects, own_steps or sizes.objects)
        self._delta = Propagated(gpu, settings, sizes.indirect, steps or sizes.indirect)
        self._direct: Propagated | None = None
        if settings.resolved_shadow == "lobe":
            self._direct = Propagated(gpu, settings, sizes.direct, settings.resolved_direct_steps)
        self._maps = LpvInjectMaps(gpu)
        self._direct_light = injected_sums(gpu, sizes.direct)
        self._filter = LpvBoxFilter(gpu)

    def propagate_rho(
        self, real: moderngl.Buffer, change: moderngl.Buffer, through: moderngl.Texture3D | None
    ) -> LightVolume:
        """Propagates V_rho."""
        return self._rho.run(through, real, change)

    def propagate_delta(self, change: moderngl.Buffer, through: moderngl.Texture3D | None) -> LightVolume:
        """Propagates the indirect change ([P2] 4.3.1)."""
        return self._delta.run(through, change)

    def inject_direct(self, scene: Bindings, lights: LightBuffers) -> moderngl.Buffer:
        """Injects the direct change ([P2] 4.3.2); nothing where shadow maps bring it."""
        if self._direct is not None:
            clear_buffer(self._gpu, self._direct_light)
            self._maps.add_direct(self._direct_light, lights, scene)
        return self._direct_light

    def propagate_direct(
        self, injected: moderngl.Buffer, through: moderngl.Texture3D | None
    ) -> LightVolume | None:
        """Propagates and filters the direct change; None where shadow maps bring it."""
        if self._direct is None:
            return None
        light = self._direct.run(through, injected)
        self._filter.run(light, self._settings.direct_filter or 0)
        return light

    def release(self) -> None:
        """Frees the GL objects."""
        release_held(self)


class ShownCells:
    """What is injected of the change, for debug view `volume`."""

    def __init__(self, gpu: GpuContext, size: int) -> None:
        self._size, self._count = size, 1
        self._cells = VoxelMipmap(gpu, size, 1)
        self._show = LpvShow(gpu)

    def show(
        self, change: PerVolume[moderngl.Buffer], direct: PerVolume[moderngl.Buffer] | None = None
    ) -> VoxelsOnDemand:
        """Shows the injected change in the cells of all volumes, once somebody looks at them."""
        return VoxelsOnDemand(self._cells, partial(self._draw, change, direct))

    def _draw(self, change: PerVolume[moderngl.Buffer], direct: PerVolume[moderngl.Buffer] | None) -> None:
        if len(change) != self._count:
            self._cells.resize(self._size, len(change))
            self._count = len(change)
        for volume, own in enumerate(change):
            self._show.run(self._cells, own, None if direct is None else direct[volume], volume=volume)

    def release(self) -> None:
        """Frees the GL objects."""
        release_held(self)


class CellGrid:
    """Where the cells of one size lie, of all volumes."""

    def __init__(self, gpu: GpuContext, size: int) -> None:
        self._size = size
        self._volume = PlacedVolume(gpu, VolumePlacement((0.0, 0.0, 0.0), 1.0, size))

    def place(self, cubes: PerVolume[VolumePlacement]) -> PlacedVolume:
        """Fills the cubes with cells."""
        return self._volume.place(*(cube.divided(self._size) for cube in cubes))

    def release(self) -> None:
        """Frees the GL objects."""
        release_held(self)


class LightExchange:
    """Light that leaves the volumes and arrives in others (docs/method.md 5.9)."""

    def __init__(self, gpu: GpuContext) -> None:
        self._sources = LpvSources(gpu)

    def sum_up(
        self,
        cubes: PerVolume[VolumePlacement],
        extent: ObjectExtent,
        change: PerVolume[moderngl.Buffer],
        covered: PerVolume[moderngl.Buffer | None],
        bounced: PerVolume[moderngl.Buffer | None] | None = None,
    ) -> moderngl.Texture | None:
        """Sums up what leaves each volume; a single one has nobody to send it to."""
        if len(cubes) < 2:
            return None
        self._sources.make_room(len(cubes))
        outside = np.zeros((len(cubes), MOST_VOLUMES))
        outside[:, : len(cubes)] = outside_fractions(extent.parts, cubes)
        for volume, (cube, own) in enumerate(zip(cubes, change, strict=True)):
            self._sources.sum_up(
                volume,
                cube.divided(cells_of(own)),
                own,
                bounced=None if bounced is None else bounced[volume],
                covered=covered[volume],
                arriving=outside[volume].tolist(),
            )
        return self._sources.rows

    def release(self) -> None:
        """Frees the GL objects."""
        self._sources.release()


@dataclass(frozen=True, eq=False)
class LitCells:
    """What a form of the method hands to shading: a reader of fields, V_rho and its volume, that of the change.

    `sources`: what volumes send to each other.
    """

    read: Callable[[LpvFields, Resource[Bindings], Resource[LowResGrid]], Resource[ConeFields]]
    sources: Resource[moderngl.Texture | None]
    rho: Resource[PropagatedLight]
    rho_volume: Resource[PlacedVolume]
    volume: Resource[PlacedVolume]
    shown: Resource[VoxelsOnDemand]


def joined(g: Graph, name: str, light: Resource[PerVolume[LightVolume]]) -> Resource[PropagatedLight]:
    """Declares the light of all volumes as surfaces read it."""
    return g.stage(name, g.shared(name, partial(LpvJoin, g.gpu)).run, light)


def exchanged(
    g: Graph, s: FrameResources, cubes: Resource[PerVolume[VolumePlacement]], *light: Resource[Any]
) -> Resource[moderngl.Texture | None]:
    """Declares what volumes send to each other: of the `light` injected, what the objects cover, and all bounces."""
    exchange = g.shared("exchange", partial(LightExchange, g.gpu))
    return g.stage("exchange between volumes", exchange.sum_up, cubes, object_extent(g, s), *light)


def placed_cells(
    g: Graph, name: str, size: int, cubes: Resource[PerVolume[VolumePlacement]]
) -> Resource[PlacedVolume]:
    """Declares where the cells of all volumes are."""
    return g.value(name, g.shared(name, partial(CellGrid, g.gpu, size)).place, cubes)


def difference_stages(
    g: Graph,
    s: FrameResources,
    lit: LitScene,
    settings: DlpvMethod,
    cubes: Resource[PerVolume[VolumePlacement]],
) -> LitCells:
    """V_mu is subtracted from V_rho."""
    size = settings.volume_size
    pool = volume_pool(g, "volumes", partial(DifferenceVolumes, g.gpu, settings, size))
    propagate_mu = ForEachVolume(pool, DifferenceVolumes.propagate_mu)
    propagate_rho = ForEachVolume(pool, DifferenceVolumes.propagate_rho)
    mu = g.stage("propagate mu", propagate_mu, "inject real", "geometry volume real")
    c = cell_stages(g, s, lit, settings, cubes, size)
    first = g.stage("propagate rho", propagate_rho, mu, c.change, c.through_real, c.through)
    surfels = g.value("surfels", both_surfels, c.real, c.objects)
    names = "bounces", "reflected light"
    bounce = ForEachVolume(pool, DifferenceVolumes.bounce, outputs=len(names))
    bounced = first, mu, surfels, c.joint, c.through
    rho, reflected = g.stages("bounces", bounce, *bounced, outputs=names)
    sources = exchanged(g, s, cubes, c.change, c.covered, reflected)
    all_mu, all_rho = joined(g, "light mu", mu), joined(g, "light rho", rho)
    shown = g.value("shown cells", g.shared("shown cells", partial(ShownCells, g.gpu, size)).show, c.change)
    volume = placed_cells(g, "volume", size, cubes)

    def read(
        fields: LpvFields, scene: Resource[Bindings], grid: Resource[LowResGrid]
    ) -> Resource[ConeFields]:
        return g.stage("cones", fields.read_difference, scene, grid, sources, all_mu, all_rho)

    return LitCells(read, sources, all_rho, volume, volume, shown)


def both_surfels(
    real: PerVolume[VoxelStore], objects: PerVolume[VoxelStore]
) -> PerVolume[tuple[VoxelStore, VoxelStore]]:
    """Surfels of both geometries in each volume."""
    return PerVolume(zip(real, objects, strict=True))


def printed_stages(
    g: Graph,
    s: FrameResources,
    lit: LitScene,
    settings: DlpvMethod,
    cubes: Resource[PerVolume[VolumePlacement]],
) -> LitCells:
    """The change alone is propagated, direct light after and apart from the indirect one ([P2] 4.3)."""
    sizes = PrintedSizes.of(settings)
    pool = volume_pool(g, "volumes", partial(PrintedVolumes, g.gpu, settings, sizes))
    stages = {n: cell_stages(g, s, lit, settings, cubes, n) for n in sizes.counts}
    own, indirect, direct = stages[sizes.objects], stages[sizes.indirect], stages[sizes.direct]
    rho = g.stage(
        "propagate rho",
        ForEachVolume(pool, PrintedVolumes.propagate_rho),
        own.real_light,
        own.change,
        own.through,
    )
    delta = g.stage(
        "propagate delta",
        ForEachVolume(pool, PrintedVolumes.propagate_delta),
        indirect.change,
        indirect.through,
    )
    injected = g.stage(
        "inject direct", ForEachVolume(pool, PrintedVolumes.inject_direct), direct.joint, lit.object_maps
    )
    after = g.stage(
        "propagate direct", ForEachVolume(pool, PrintedVolumes.propagate_direct), injected, direct.through
    )
    sources = exchanged(g, s, cubes, indirect.change, indirect.covered)
    all_rho, all_delta = joined(g, "light rho", rho), joined(g, "light delta", delta)
    change: tuple[Resource[Any], ...] = (all_delta, joined(g, "light direct", after))
    show = g.shared("shown cells", partial(ShownCells, g.gpu, sizes.indirect)).show
    shown = g.value("shown cells", show, indirect.change, injected)
    volume = placed_cells(g, "volume", sizes.indirect, cubes)
    rho_volume = placed_cells(g, "volume of rho", sizes.objects, cubes)

    def read(
        fields: LpvFields, scene: Resource[Bindings], grid: Resource[LowResGrid]
    ) -> Resource[ConeFields]:
        return g.stage("cones", fields.read_printed, scene, grid, sources, *change, all_rho, rho_volume)

    return LitCells(read, sources, all_rho, rho_volume, volume, shown)


def _volume_sizes(settings: DlpvMethod) -> SizeOf:
    """As many volumes as the budget has room for."""
    return lambda count: settings.volume_size if count <= affordable_count(settings) else 0


def dlpv(g: Graph, s: FrameResources, setup: Setup[DlpvMethod]) -> Layers:
    """Subtracts V_mu from V_rho, or uses the paper's volume of the change."""
    settings, resolved, size = setup.settings, setup.resolved, setup.picture_size
    lit = light_stages(g, s, resolved, settings.shadow_samples, settings.tier)
    g.section("propagation volumes")
    declare = printed_stages if settings.operator == "paper" else difference_stages
    with lagging_behind_objects(g, s, lit, settings.tier):
        placed = volume_placements(g, s, _volume_sizes(settings), settings.volume_edge_m, settings.tier)
        cells = declare(g, s, lit, settings, g.value("volume cubes", PerVolume, placed))
    options = ShadingOptions(
        tier=settings.tier,
        caustics=settings.resolved_caustics,
        screen_space=settings.resolved_screen_space,
        mirror_gather="gather_lpv" if settings.resolved_reflections == "rays" else None,
    )
    reuses = settings.tier.refresh_tiles > 0
    direct = DirectLight(g.gpu, size, objects_shadow=settings.resolved_shadow == "map", reuses=reuses)
    shading = SurfaceShading(g.gpu, size, resolved, lit.buffers, direct, options)
    fields = LpvFields(g.gpu, settings, shading.cones)
    marching = g.value("marching", fields.marching, cells.rho, cells.rho_volume, cells.sources)

    def read(scene: Resource[Bindings], grid: Resource[LowResGrid]) -> Resource[ConeFields]:
        return cells.read(fields, scene, grid)

    return shading_stages(g, s, shading, lit, MethodStages(cells.volume, read, cells.shown, marching))


def resolve(settings: DlpvMethod, defaults: ResolvedSettings) -> ResolvedSettings:
    """Takes the document's values, or the machine's defaults where it says null."""
    return ResolvedSettings(
        settings.volume_size,
        settings.query_scale or defaults.cone_scale,
        settings.rsm_size or defaults.rsm_size,
        settings.triangle_budget or defaults.triangle_budget,
    )


DLPV = RelightingMethod(DlpvMethod, dlpv, resolve, state_memory)
