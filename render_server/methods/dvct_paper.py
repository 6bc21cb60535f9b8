"""Delta voxel cone tracing with the operator of the paper ([P1] 3, docs/method.md 3.2)."""

from collections.abc import Callable
from dataclasses import replace

import moderngl

from deltalight.protocol.scene_method import DvctMethod
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.methods.light_maps import LitScene, lagging_behind_objects, light_stages
from deltalight.render_server.methods.method import Setup
from deltalight.render_server.methods.per_volume import PerVolume, VolumePool
from deltalight.render_server.methods.surface_shading import (
    Layers,
    MethodStages,
    ShadingOptions,
    SurfaceShading,
    shading_stages,
)
from deltalight.render_server.methods.volume_lights import VolumeLights, volume_light_stages
from deltalight.render_server.methods.volume_placement import Placements
from deltalight.render_server.methods.voxel_sets import VoxelSet, make_room, surfel_scene, voxel_placements
from deltalight.render_server.methods.voxel_volumes import joint_voxels, placed_volume
from deltalight.render_server.passes.cones import ConeFields, LowResGrid, TraceConesPaper
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.shading import DirectLight
from deltalight.render_server.passes.split_injection import (
    DeltaError,
    FilterIsotropic,
    RealAlbedo,
    ResolveInjection,
    SplitInjection,
)
from deltalight.render_server.passes.voxel_light import AlbedoTexture
from deltalight.render_server.passes.voxels import VoxelMipmap


class InjectedVoxels:
    """V_delta and V_rho with the joint opacity of V_eta, filled by split injection ([P1] 3.2).

    Two isotropic mipmaps: (V_delta, V_eta) with signed radiance, and (V_rho, V_eta). Those of several volumes lie
    side by side.
    """

    directions = 1

    def __init__(self, gpu: GpuContext, size: int) -> None:
        self.delta, self.rho = (VoxelMipmap(gpu, size, self.directions) for _ in range(2))
        self.real, self.objects = (VoxelSet(gpu, size, [self.delta, self.rho]) for _ in range(2))
        self._albedo = VolumePool(lambda: RealAlbedo(gpu))
        self._inject = SplitInjection(gpu)
        self._resolve = ResolveInjection(gpu)
        self._filter = FilterIsotropic(gpu)

    def voxelize_real(self, real: GeometryState, placements: Placements) -> VoxelSet:
        """Voxelises the real scene."""
        return self._fill(self.real, real, placements)

    def voxelize_objects(self, objects: GeometryState, placements: Placements) -> VoxelSet:
        """Voxelises the objects."""
        return self._fill(self.objects, objects, placements)

    def _make_room(self, placements: Placements) -> None:
        make_room(self.real, (self.delta, self.rho, self.objects), placements)

    def _fill(self, voxels: VoxelSet, geometry: GeometryState, placements: Placements) -> VoxelSet:
        self._make_room(placements)
        voxels.fill_all([geometry.parts] * len(placements), placements)
        return voxels

    def find_albedo(
        self,
        placed: VoxelSet,
        seen: Observation,
        albedo: AlbedoTexture,
        _lights: LightSet,
        lights: PerVolume[LightBuffers],
        _environment: moderngl.TextureArray,
    ) -> PerVolume[RealAlbedo]:
        """Computes the real scene's albedo as seen from the lights."""
        seen.image.build_levels()
        found = self._albedo.resized(len(lights))
        for volume, (each, own) in enumerate(zip(found, lights, strict=True)):
            each.run(own, {**surfel_scene(seen, own, albedo), **placed.volume.bindings}, volume)
        return PerVolume(found)

    def inject(
        self,
        real: VoxelSet,
        objects: VoxelSet,
        found: PerVolume[RealAlbedo],
        geometry: GeometryState,
        seen: Observation,
        albedo: AlbedoTexture,
        lights: PerVolume[LightBuffers],
    ) -> tuple[VoxelSet, VoxelSet]:
        """Injects the light of all maps."""
        shared = {**geometry.materials.bindings, **real.volume.bindings}
        self._inject.begin(real.store, objects.store)
        for volume, (seen_albedo, own) in enumerate(zip(found, lights, strict=True)):
            scene = {**surfel_scene(seen, own, albedo), **shared}
            self._inject.add(real.store, objects.store, own, seen_albedo.atlas, scene, volume=volume)
        return real, objects

    def filter(self, injected: tuple[VoxelSet, VoxelSet]) -> "InjectedVoxels":
        """Filters the sums into both mipmaps."""
        real, objects = injected
        self._resolve.run(self.delta, self.rho, real.store, objects.store, real.volume)
        self._filter.run(self.delta, self.rho, real.volume)
        return self

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(
            self.delta,
            self.rho,
            self.real,
            self.objects,
            self._albedo,
            self._inject,
            self._resolve,
            self._filter,
        )


def injection_stages(
    g: Graph,
    s: FrameResources,
    lit: LitScene,
    voxels: InjectedVoxels,
    placement: Resource[Placements],
    lights: VolumeLights,
) -> Resource[InjectedVoxels]:
    """Declares voxelisation of both geometries, real albedo, injection and filtering."""
    real_maps, object_maps = volume_light_stages(g, s, lit, placement, lights)
    real = g.stage("voxelize real", voxels.voxelize_real, s.real, placement)
    albedo = g.stage(
        "real albedo",
        voxels.find_albedo,
        real,
        s.measured,
        s.albedo,
        s.lights,
        real_maps,
        lit.environment,
    )
    objects = g.stage("voxelize objects", voxels.voxelize_objects, s.objects, placement)
    injected = g.stage(
        "split inject",
        voxels.inject,
        real,
        objects,
        albedo,
        s.objects,
        s.measured,
        s.albedo,
        object_maps,
    )
    return g.stage("filter", voxels.filter, injected)


class PaperCones:
    """Marches nine diffuse cones and a specular one: through V_delta at real surfaces, through V_rho at objects."""

    def __init__(self, gpu: GpuContext, fields: ConeFields, volume_size: int) -> None:
        self._gpu, self._fields, self._volume_size = gpu, fields, volume_size
        self._tracing = TraceConesPaper(gpu)
        self._error: DeltaError | None = None  # made when somebody asks

    def trace(self, scene: Bindings, grid: LowResGrid, voxels: InjectedVoxels) -> ConeFields:
        """Traces the cones at real surfaces and at the objects."""
        self._tracing.trace_real(self._fields, grid, voxels.delta, scene)
        self._tracing.trace_virtual(self._fields, grid, voxels.rho, scene)
        return self._fields

    def find_error(
        self, scene: Bindings, grid: LowResGrid, voxels: InjectedVoxels
    ) -> Callable[[], moderngl.Texture]:
        """Returns what traces [P1] eq. 9 (`DeltaError.run`)."""

        def find() -> moderngl.Texture:
            if self._error is None:
                self._error = DeltaError(self._gpu, grid.size, self._volume_size)
            real, volumes = voxels.real, (voxels.delta, voxels.rho)
            return self._error.run(*volumes, real.store, real.volume, grid=grid, scene=scene)

        return find

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._tracing, self._error)


def dvct_paper(g: Graph, s: FrameResources, setup: Setup[DvctMethod]) -> Layers:
    """The operator of [P1] 3 in radiometric units.

    Split injection fills V_delta and V_rho; the joint V_eta gives visibility.
    """
    settings, resolved, size = setup.settings, setup.resolved, setup.picture_size
    lit = light_stages(g, s, resolved, settings.shadow_samples, settings.tier)
    g.section("voxels")
    voxels = g.shared("voxels", lambda: InjectedVoxels(g.gpu, resolved.volume_size))
    with lagging_behind_objects(g, s, lit, settings.tier):
        placement = voxel_placements(g, s, setup, voxels.directions)
        lights = g.shared(
            "volume lights", lambda: VolumeLights(g.gpu, resolved, settings.shadow_samples, settings.tier)
        )
        injected = injection_stages(g, s, lit, voxels, placement, lights)
    shadow_cones = voxels.directions if settings.resolved_shadow == "cone" else None
    tier = settings.tier
    direct = DirectLight(g.gpu, size, shadow_cones=shadow_cones, reuses=tier.refresh_tiles > 0)
    shading = SurfaceShading(g.gpu, size, resolved, lit.buffers, direct, ShadingOptions(tier))
    cones = PaperCones(g.gpu, shading.cones, resolved.volume_size)

    def trace(scene: Resource[Bindings], grid: Resource[LowResGrid]) -> Resource[ConeFields]:
        g.value("delta error", cones.find_error, scene, grid, injected)
        return g.stage("cones", cones.trace, scene, grid, injected)

    volume = g.value("volume", placed_volume, "voxelize real")
    joint = g.value("joint voxels", joint_voxels, injected)
    layers = shading_stages(g, s, shading, lit, MethodStages(volume, trace, joint))
    return replace(layers, error=g.resource("delta error"))
