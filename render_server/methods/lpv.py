"""Delta light propagation volumes ([P2], docs/method.md 5)."""

import moderngl
import numpy as np
from jaxtyping import Float32

from protocol.scene_method import DlpvMethod
from render_server.frame import FrameResources, Observation
from render_server.gpu.context import GpuContext
from render_server.gpu.kernel import Binding, Bindings, clear_buffer
from render_server.gpu.textures import release_all
from render_server.gpu_scene import GeometryState
from render_server.graph import Graph, Resource
from render_server.lights.lights import LightSet
from render_server.methods.light_maps import LitScene, light_stages
from render_server.methods.lighting import (
    SURFEL_SHADOW_SAMPLES,
    Layers,
    Shading,
    ShadingOptions,
    casts_caustics,
    shading_stages,
    surfel_scene,
    volume_placement,
)
from render_server.methods.method import RelightingMethod, ResolvedSettings, Setup
from render_server.passes.cones import ConeFields, LowResGrid
from render_server.passes.lights import LightBuffers
from render_server.passes.lpv import (
    LightVolume,
    LpvCoverFaces,
    LpvPropagate,
    LpvShow,
    LpvStart,
    LpvTransmit,
    covered_sums,
    injected_sums,
    lobe_weights,
    moment_weights,
    transmitted_fractions,
)
from render_server.passes.lpv_lighting import (
    LpvBounce,
    LpvInjectMaps,
    LpvInjectSurfaces,
    LpvQuery,
    light_volume_bindings,
)
from render_server.passes.shading import DirectLight
from render_server.passes.split_injection import RealAlbedo
from render_server.passes.voxel_light import AlbedoTexture
from render_server.passes.voxels import PlacedVolume, VolumePlacement, Voxelize, VoxelMipmap, VoxelStore


class LpvVolumes:
    """V_rho with V_mu (`mu`), or the paper's V_delta (`change`).

    Two sums are injected: the real scene's light without objects, and the change due to the objects. V_mu starts from
    the first, V_rho from both, the paper's V_delta from the second and the negative lobes of direct light. Each
    bounce propagates V_rho again with the light that surfaces reflect of it. `shown` is the injected change, for
    debug view `volume`.
    """

    def __init__(self, gpu: GpuContext, settings: DlpvMethod, cells: int) -> None:
        self._gpu, self._settings, self._steps = gpu, settings, settings.steps or cells
        is_paper = settings.operator == "paper"
        has_moments = settings.resolved_propagation == "moments"
        self._weights = moment_weights(cells) if has_moments else lobe_weights()
        nowhere = VolumePlacement((0.0, 0.0, 0.0), 1.0, cells)
        self.volume, self._half_cells = PlacedVolume(gpu, nowhere), PlacedVolume(gpu, nowhere)
        self.rho = LightVolume(gpu, cells)
        self.mu = None if is_paper else LightVolume(gpu, cells)
        self.change = LightVolume(gpu, cells) if is_paper else None
        self.shown = VoxelMipmap(gpu, cells, 1)
        self._real_light, self._change_light, self._bounced_light, self._shadow_light = (
            injected_sums(gpu, cells) for _ in range(4)
        )
        self._real_covered, self._virtual_covered = (covered_sums(gpu, cells) for _ in range(2))
        self._through_real, self._through_joint = (transmitted_fractions(gpu, cells) for _ in range(2))
        self.real, self.objects = (VoxelStore(gpu, 2 * cells) for _ in range(2))
        self._voxelize = Voxelize(gpu)
        self._albedo = RealAlbedo(gpu)
        self._maps = LpvInjectMaps(gpu)
        self._surfaces = LpvInjectSurfaces(gpu)
        self._cover = LpvCoverFaces(gpu)
        self._transmit = LpvTransmit(gpu)
        self._start = LpvStart(gpu)
        self._propagate = LpvPropagate(gpu)
        self._bounce = LpvBounce(gpu)
        self._show = LpvShow(gpu)

    @property
    def _has_geometry(self) -> bool:
        """Whether surfaces block light between cells."""
        return self._settings.resolved_geometry_volume

    @property
    def _blocks_environment(self) -> bool:
        return self._settings.resolved_ambient == "blocked"

    @property
    def query_bindings(self) -> dict[str, Binding]:
        """Returns the bindings for reading light from the volumes (shaders/common/lpv_light.glsl)."""
        return {"has_geometry": self._has_geometry, "damping": self._settings.resolved_damping}

    def place(self, placement: VolumePlacement) -> PlacedVolume:
        """Places the cells, and the half-size cells for surfels."""
        self.volume.place(placement)
        self._half_cells.place(
            VolumePlacement(placement.origin, placement.voxel_edge / 2, 2 * placement.size)
        )
        return self.volume

    def voxelize_real(self, real: GeometryState, volume: PlacedVolume) -> VoxelStore:
        """Voxelises the real scene into surfels, if anything reads them."""
        if self._has_geometry or self._blocks_environment or self._settings.resolved_bounces > 0:
            self._surfels(self.real, real.solid_corners(volume.placement.voxel_edge))
        return self.real

    def voxelize_objects(self, objects: GeometryState, _volume: PlacedVolume) -> VoxelStore:
        """Voxelises the objects into surfels."""
        self._surfels(self.objects, objects.corners)
        return self.objects

    def _surfels(self, store: VoxelStore, corners: Float32[np.ndarray, "m 3 10"]) -> None:
        """Voxelises at half a cell; only the store's surfels are used."""
        clear_buffer(self._gpu, store.grid)
        self._voxelize.run(store, corners, self._half_cells)

    def real_scene(
        self,
        seen: Observation,
        albedo: AlbedoTexture,
        volume: PlacedVolume,
        _lights: LightSet,
        _environment: moderngl.TextureArray,
        lights: LightBuffers,
    ) -> dict[str, Binding]:
        """Returns the bindings for injecting the real scene's light."""
        seen.image.build_levels()
        own = {"blocks_environment": self._blocks_environment}
        return {**surfel_scene(seen, lights, albedo), **volume.bindings, **own}

    def inject_real(self, real: VoxelStore, scene: Bindings, lights: LightBuffers) -> moderngl.Buffer:
        """Injects the real scene's light without objects."""
        self._albedo.run(lights, scene)
        clear_buffer(self._gpu, self._real_light)
        self._maps.add_real(self._real_light, lights, self._albedo.atlas, scene)
        if self._blocks_environment:
            self._surfaces.add_real(self._real_light, real, scene)
        return self._real_light

    def cover_real(self, real: VoxelStore, volume: PlacedVolume) -> moderngl.Buffer | None:
        """Computes the transmittance between cells of the real scene; None: nothing is blocked."""
        if not self._has_geometry:
            return None
        self._cover.run(self._real_covered, real, volume.placement)
        self._transmit.run(self._through_real, volume.placement.size, self._real_covered)
        return self._through_real

    def propagate_mu(self, injected: moderngl.Buffer, through: moderngl.Buffer | None) -> LightVolume | None:
        """Propagates V_mu; None with the paper's operator."""
        if self.mu is not None:
            self._start.run(self.mu, injected)
            self._propagate.run(self.mu, self._weights, self._steps, through)
        return self.mu

    def joint_scene(
        self, scene: Bindings, objects: GeometryState, lights: LightBuffers
    ) -> dict[str, Binding]:
        """Returns the bindings for injecting the objects' change."""
        return {
            **scene,
            **lights.bindings,
            "shadow_samples": SURFEL_SHADOW_SAMPLES,
            **objects.materials.bindings,
            "has_caustics": self._settings.resolved_caustics and casts_caustics(objects),
        }

    def inject_change(
        self, objects: VoxelStore, scene: Bindings, lights: LightBuffers, _real: moderngl.Buffer
    ) -> moderngl.Buffer:
        """Injects the change due to the objects."""
        clear_buffer(self._gpu, self._change_light)
        self._maps.add_change(self._change_light, lights, self._albedo.atlas, scene)
        self._surfaces.add_virtual(self._change_light, objects, scene)
        return self._change_light

    def cover_joint(
        self, objects: VoxelStore, volume: PlacedVolume, _real: moderngl.Buffer | None
    ) -> moderngl.Buffer | None:
        """Computes the transmittance between cells with the objects; None: nothing is blocked."""
        if not self._has_geometry:
            return None
        self._cover.run(self._virtual_covered, objects, volume.placement)
        self._transmit.run(
            self._through_joint, volume.placement.size, self._real_covered, self._virtual_covered
        )
        return self._through_joint

    def propagate_rho(
        self, real: moderngl.Buffer, change: moderngl.Buffer, through: moderngl.Buffer | None
    ) -> LightVolume:
        """Propagates V_rho."""
        self._start.run(self.rho, real, change)
        self._propagate.run(self.rho, self._weights, self._steps, through)
        return self.rho

    def bounce(
        self,
        rho: LightVolume,
        mu: LightVolume | None,
        scene: Bindings,
        through: moderngl.Buffer | None,
    ) -> LightVolume:
        """Propagates V_rho again, with the light that surfaces reflect of the previous pass."""
        for _ in range(0 if mu is None else self._settings.resolved_bounces):
            assert mu is not None
            clear_buffer(self._gpu, self._bounced_light)
            own = {**scene, **self.query_bindings}
            self._bounce.run(self._bounced_light, (self.real, self.objects), (mu, rho), own)
            self._start.run(rho, self._real_light, self._change_light, self._bounced_light)
            self._propagate.run(rho, self._weights, self._steps, through)
        return rho

    def inject_shadow(self, scene: Bindings, lights: LightBuffers, _real: moderngl.Buffer) -> moderngl.Buffer:
        """Negative lobes of the direct light that objects keep off the real scene; nothing where maps shadow it."""
        if self._settings.resolved_shadow == "lobe":
            clear_buffer(self._gpu, self._shadow_light)
            self._maps.add_shadow(self._shadow_light, lights, self._albedo.atlas, scene)
        return self._shadow_light

    def propagate_change(
        self, change: moderngl.Buffer, shadow: moderngl.Buffer, through: moderngl.Buffer | None
    ) -> LightVolume | None:
        """Propagates the paper's V_delta: a single volume of the difference ([P2] 4.3).

        None with the other operator.
        """
        if self.change is not None:
            self._start.run(self.change, change, shadow)
            self._propagate.run(self.change, self._weights, self._steps, through)
        return self.change

    def show(self, change: moderngl.Buffer, shadow: moderngl.Buffer, volume: PlacedVolume) -> VoxelMipmap:
        """Draws the injected change into cells."""
        self._show.run(self.shown, volume.placement.size, change, shadow)
        return self.shown

    def release(self) -> None:
        """Frees the GL objects."""
        own = (item for item in vars(self).values() if item is not self._gpu)
        release_all(*(item for item in own if hasattr(item, "release")))


class LpvFields:
    """Reads from the volumes what other methods trace by cones."""

    def __init__(self, gpu: GpuContext, volumes: LpvVolumes, fields: ConeFields) -> None:
        self._volumes, self._fields = volumes, fields
        self._query = LpvQuery(gpu)

    def marching(self, rho: LightVolume) -> dict[str, Binding]:
        """Returns the bindings for lighting reflected points."""
        return {**light_volume_bindings(rho, rho), **self._volumes.query_bindings}

    def read(
        self,
        scene: Bindings,
        grid: LowResGrid,
        mu: LightVolume | None,
        rho: LightVolume,
        change: LightVolume | None,
    ) -> ConeFields:
        """Reads the irradiance at real surfaces and at the objects."""
        own = {**scene, **self._volumes.query_bindings}
        self._query.read_real(self._fields, grid, mu, rho if change is None else change, own)
        self._query.read_virtual(self._fields, grid, rho, own)
        return self._fields

    def release(self) -> None:
        """Frees the programs."""
        self._query.release()


def lpv_stages(
    g: Graph, s: FrameResources, lit: LitScene, volumes: LpvVolumes, volume: Resource[PlacedVolume]
) -> tuple[Resource[LightVolume | None], Resource[LightVolume], Resource[LightVolume | None]]:
    """Declares injection, blocking and propagation: V_mu, V_rho, and the paper's V_delta."""
    real = g.stage("voxelize real", volumes.voxelize_real, s.real, volume)
    scene = g.value(
        "inject scene",
        volumes.real_scene,
        s.measured,
        s.albedo,
        volume,
        s.lights,
        lit.environment,
        lit.real_maps,
    )
    real_light = g.stage("inject real", volumes.inject_real, real, scene, lit.real_maps)
    through_real = g.stage("geometry volume real", volumes.cover_real, real, volume)
    mu = g.stage("propagate mu", volumes.propagate_mu, real_light, through_real)
    objects = g.stage("voxelize objects", volumes.voxelize_objects, s.objects, volume)
    joint = g.value("inject scene joint", volumes.joint_scene, scene, s.objects, lit.object_maps)
    change = g.stage("inject change", volumes.inject_change, objects, joint, lit.object_maps, real_light)
    through = g.stage("geometry volume", volumes.cover_joint, objects, volume, through_real)
    first = g.stage("propagate rho", volumes.propagate_rho, real_light, change, through)
    rho = g.stage("bounces", volumes.bounce, first, mu, joint, through)
    shadow = g.stage("inject shadow", volumes.inject_shadow, joint, lit.object_maps, real_light)
    delta = g.stage("propagate delta", volumes.propagate_change, change, shadow, through)
    return mu, rho, delta


def dlpv(g: Graph, s: FrameResources, setup: Setup[DlpvMethod]) -> Layers:
    """Subtracts V_mu from V_rho, or uses the paper's single volume of the change."""
    settings, resolved, size = setup.settings, setup.resolved, setup.picture_size
    lit = light_stages(g, s, resolved, settings.shadow_samples, settings.tier)
    g.section("propagation volumes")
    placement = volume_placement(g, s, resolved.volume_size, settings.volume_edge_m, settings.tier)
    volumes = LpvVolumes(g.gpu, settings, resolved.volume_size)
    volume = g.value("volume", volumes.place, placement)
    mu, rho, delta = lpv_stages(g, s, lit, volumes, volume)
    shown = g.stage("shown cells", volumes.show, "inject change", "inject shadow", volume)
    options = ShadingOptions(
        tier=settings.tier,
        caustics=settings.resolved_caustics,
        screen_space=settings.resolved_screen_space,
        mirror_gather="gather_lpv" if settings.resolved_reflections == "rays" else None,
    )
    reuses = settings.tier.refresh_tiles > 0
    direct = DirectLight(g.gpu, size, objects_shadow=settings.resolved_shadow == "map", reuses=reuses)
    shading = Shading(g.gpu, size, resolved, lit.buffers, direct, options)
    fields = LpvFields(g.gpu, volumes, shading.cones)
    marching = g.value("marching", fields.marching, rho)

    def read(scene: Resource[Bindings], grid: Resource[LowResGrid]) -> Resource[ConeFields]:
        return g.stage("cones", fields.read, scene, grid, mu, rho, delta)

    return shading_stages(g, s, shading, lit, volume, read, voxels=shown, marching=marching)


def resolve(settings: DlpvMethod, defaults: ResolvedSettings) -> ResolvedSettings:
    """Takes the document's values, or the machine's defaults where it says null."""
    return ResolvedSettings(
        settings.volume_size,
        settings.query_scale or defaults.cone_scale,
        settings.rsm_size or defaults.rsm_size,
        settings.triangle_budget or defaults.triangle_budget,
    )


DLPV = RelightingMethod(DlpvMethod, dlpv, resolve)
