"""Lit voxels for cone marching (docs/method.md 4).

mu holds the real scene, rho real and virtual surfaces.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import moderngl
import numpy as np

from deltalight.protocol.scene_method import DvctMethod, VoxelConeSettings
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.gpu.clearing import clear_ahead
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.gpu.uniform_block import UniformBlock
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.methods.caustic_beams import casts_caustics
from deltalight.render_server.methods.light_maps import LitScene
from deltalight.render_server.methods.method import march_defines
from deltalight.render_server.methods.volume_placement import Placements
from deltalight.render_server.methods.voxel_sets import (
    FAR_SIZE,
    SURFEL_SHADOW_SAMPLES,
    VoxelSet,
    make_room,
    surfel_scene,
)
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.volumes import (
    FarVolumeBlock,
    PlacedVolume,
    VolumePlacement,
    place_volume,
)
from deltalight.render_server.passes.voxel_light import (
    AlbedoTexture,
    BounceTail,
    GatherVoxels,
    GroupSurfels,
    LightVoxels,
)
from deltalight.render_server.passes.voxels import (
    DIRECTIONS,
    FillMipmap,
    VoxelMipmap,
)

FAR_EDGE_M = 20.0  # its greatest edge: what lies farther lights little through a cone's solid angle
FAR_MARGIN = 1.05


class FarScene:
    """The real scene beyond the volume: a coarse mu mipmap around everything in view.

    Cones that leave the volume meet the radiance that the camera measured there instead of the environment, if
    `is_used`.
    """

    def __init__(self, gpu: GpuContext, light: LightVoxels, *, is_used: bool) -> None:
        self._gpu, self._is_used = gpu, is_used
        self.mipmap = VoxelMipmap(gpu, FAR_SIZE, DIRECTIONS)
        self._set = VoxelSet(gpu, FAR_SIZE, [self.mipmap], own=self.mipmap)
        self._light = light
        self._fill = FillMipmap(gpu)
        self._block = UniformBlock[FarVolumeBlock](gpu, self._set.volume.placement.far_block(is_used=is_used))

    def voxelize(self, real: GeometryState) -> VoxelSet:
        """Voxelises the whole real scene coarsely."""
        if self._is_used:
            low, high = real.bounds
            edge = min(float(np.max(high - low)), FAR_EDGE_M) * FAR_MARGIN
            self._set.fill(real.coarse_parts, place_volume(low, high, FAR_SIZE, edge))
            self._block.write(self._set.volume.placement.far_block(is_used=True))
        return self._set

    def light(self, voxels: VoxelSet, scene: Bindings) -> VoxelSet:
        """Lights the voxels by the radiance that the camera measured, and filters them."""
        if self._is_used:
            voxels.forget_light()
            own = {**scene, **voxels.volume.bindings}
            self._light.light_real(voxels.store, own, occupied=self.mipmap.occupied)
            self._fill.fill_mu(self.mipmap, voxels.store, voxels.volume, is_first=True)
            clear_ahead(self._gpu, (voxels.store.sums, voxels.store.sums.size))
        return voxels

    @property
    def bindings(self) -> dict[str, Binding]:
        """Returns all bindings that march.glsl reads of it."""
        return {
            "mipmap_far": self.mipmap.texture,
            "OccupiedFar": self.mipmap.occupied,
            "FarVolume": self._block,
        }

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.mipmap, self._set, self._fill, self._block)


class DirectionalVoxels:
    """Voxel data of both marches: two anisotropic mipmaps, two voxel sets, and the scene beyond."""

    def __init__(self, gpu: GpuContext, settings: VoxelConeSettings, size: int) -> None:
        self._gpu, self._bounces = gpu, settings.bounces
        self._measured = settings.radiance == "measured"
        self.mu, self.rho = (VoxelMipmap(gpu, size, DIRECTIONS) for _ in range(2))
        self.real = VoxelSet(gpu, size, [self.mu, self.rho], own=self.mu)
        self.objects = VoxelSet(gpu, size, [self.rho])
        self._light = LightVoxels(gpu)
        self.far = FarScene(gpu, self._light, is_used=settings.far_volume)
        self._group = GroupSurfels(gpu)
        self._gather = GatherVoxels(gpu, march_defines(settings))
        self._tail = BounceTail(gpu, march_defines(settings))
        self._fill = FillMipmap(gpu)

    def _make_room(self, placements: Placements) -> None:
        make_room(self.real, (self.mu, self.rho, self.objects), placements)

    def voxelize_real(self, real: GeometryState, placements: Placements) -> VoxelSet:
        """Voxelises the real scene, with back faces if one camera saw it."""
        self._make_room(placements)
        self.real.fill_all([real.solid_parts(each.voxel_edge) for each in placements], placements)
        return self.real

    def voxelize_objects(self, objects: GeometryState, placements: Placements) -> VoxelSet:
        """Voxelises the objects."""
        self._make_room(placements)
        self.objects.fill_all([objects.parts] * len(placements), placements)
        self.objects.groups.reset(self.objects.store)
        if self._bounces > 0:
            self._group.run(self.objects.store, self.objects.groups, self.objects.volume.bindings)
        return self.objects

    def _fill_mu(self, *, is_first: bool) -> None:
        self._fill.fill_mu(self.mu, self.real.store, self.real.volume, is_first=is_first)

    def _fill_rho(self, *, is_last: bool = False) -> None:
        sets = self.real.store, self.objects.store
        if self._fill.fill_rho(self.rho, *sets, self.real.volume, is_last=is_last):
            self.objects.is_lit = False

    def _begin_rho(self) -> moderngl.Buffer:
        return self._fill.begin_rho(self.rho, self.mu)

    def _fill_first_rho(self) -> None:
        self._fill.fill_first_rho(self.rho, self.real.store, self.objects.store, self.real.volume)

    def _find_tail(self, scene: Bindings) -> None:
        """Finds what bounces change beyond those that were gathered."""
        if self._bounces > 0:
            real = self.real
            self._tail.find(real.store, real.groups, self.mu, self.rho, scene)

    def march_bindings(self, cone_count: int) -> dict[str, Binding]:
        """Returns all bindings that march.glsl reads."""
        return {
            **self._light.bindings,
            **self.far.bindings,
            "mipmap_mu": self.mu.texture,
            "mipmap_rho": self.rho.texture,
            "Occupied": self.rho.occupied,
            "cone_count": cone_count,
            "bounce_tail": self._tail.irradiance,
        }

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(
            self.mu,
            self.rho,
            self.real,
            self.objects,
            self.far,
            self._light,
            self._group,
            self._gather,
            self._tail,
            self._fill,
        )


@dataclass(frozen=True, eq=False)
class LitVoxels:
    """Voxels of both geometries with the light of rho, which of its cells are `occupied`, the bounds of what objects
    change, and the bounces' tail.
    """

    real: VoxelSet
    objects: VoxelSet
    occupied: moderngl.Buffer
    support: moderngl.Buffer
    tail: BounceTail


class DeltaVoxels(DirectionalVoxels):
    """Voxels of the exact operator; rho equals mu where objects change nothing.

    Light is gathered from voxel to voxel `settings.bounces` times, after direct and unoccluded ambient light.
    """

    def __init__(self, gpu: GpuContext, settings: DvctMethod, size: int) -> None:
        super().__init__(gpu, settings, size)
        self._caustics = settings.caustics

    def real_scene(
        self,
        seen: Observation,
        albedo: AlbedoTexture,
        _lights: LightSet,
        lights: LightBuffers,
        *_light: object,
    ) -> dict[str, Binding]:
        """Returns the bindings for lighting real voxels."""
        seen.image.build_levels()
        return surfel_scene(seen, lights, albedo, measured=self._measured)

    def light_real(self, voxels: VoxelSet, scene: Bindings) -> VoxelSet:
        """Lights real surfels: by the measured radiance where the camera sees them, by the lights elsewhere."""
        voxels.forget_light()
        voxels.groups.reset(voxels.store)
        own = {**scene, **voxels.volume.bindings}
        self._light.light_real(
            voxels.store,
            own,
            voxels.groups,
            finds_groups=self._bounces > 0,
            occupied=self.mu.occupied,
        )
        return voxels

    def filter_real(self, _lit: VoxelSet) -> VoxelMipmap:
        """Filters the lit voxels into mu."""
        self._fill_mu(is_first=True)
        return self.mu

    def bounce_real(
        self, voxels: VoxelSet, _mu: VoxelMipmap, _far: VoxelSet, scene: Bindings
    ) -> tuple[VoxelMipmap, VoxelSet]:
        """Replaces the ambient light of unseen real surfaces by what they gather from mu; gathers E_mu of all."""
        if self._bounces == 0:
            return self.mu, voxels
        own, store, groups = {**scene, **voxels.volume.bindings}, voxels.store, voxels.groups
        self._group.sum(store, groups, own, has_seen=True)
        for _ in range(self._bounces):
            self._gather.gather(store, groups, self.mu, {**own, **self.march_bindings(1)}, only_unseen=True)
            self._light.light_real(store, own, groups, gathered=True)
            self._fill_mu(is_first=False)
        self._gather.gather(store, groups, self.mu, {**own, **self.march_bindings(1)})
        return self.mu, voxels

    def joint_scene(
        self, scene: Bindings, objects: GeometryState, lights: LightBuffers, voxels: VoxelSet
    ) -> dict[str, Binding]:
        """Returns the bindings for lighting the objects' voxels and the change of real ones."""
        return {
            **scene,
            **lights.bindings,
            "shadow_samples": SURFEL_SHADOW_SAMPLES,
            **objects.materials.bindings,
            **voxels.volume.bindings,
            "has_caustics": self._caustics and casts_caustics(objects),
        }

    def light_joint(
        self, real: VoxelSet, voxels: VoxelSet, objects: GeometryState, scene: Bindings
    ) -> LitVoxels:
        """Lights the objects' surfels, and changes the light of real ones by the objects' shadows.

        With bounces, the light that both gather from mu is the first guess.
        """
        voxels.forget_light()
        self._light.reset_support(object_voxels(objects, voxels.volume.placements))
        if self._bounces > 0:
            self._light_by_mu(scene)
        else:
            self._light_rho(scene, gathered=False)
        return LitVoxels(real, voxels, self.rho.occupied, self._light.support, self._tail)

    def _light_by_mu(self, scene: Bindings) -> None:
        real, objects, light = self.real, self.objects, self._light
        self._gather.gather(objects.store, objects.groups, self.mu, {**scene, **self.march_bindings(1)})
        light.light_virtual(objects.store, scene, objects.groups, from_mu=True, occupied=self._begin_rho())
        light.light_real_delta(real.store, scene, real.groups, from_mu=True)

    def _light_rho(self, scene: Bindings, *, gathered: bool) -> None:
        objects, occupied = self.objects, None if gathered else self._begin_rho()
        self._light.light_virtual(objects.store, scene, objects.groups, gathered=gathered, occupied=occupied)
        self._light.light_real_delta(self.real.store, scene, self.real.groups, gathered=gathered)

    def filter_joint(self, lit: LitVoxels) -> tuple[VoxelMipmap, LitVoxels]:
        """Filters the lit voxels of both sets into rho, which uses up the sums of changed light."""
        self._fill_first_rho()
        return self.rho, lit

    def bounce_joint(
        self, lit: LitVoxels, _rho: VoxelMipmap, scene: Bindings
    ) -> tuple[VoxelMipmap, LitVoxels]:
        """Gathers light from rho, relights the objects and what real surfaces change with it; finds the tail."""
        marching = {**scene, **self.march_bindings(1)}
        for number in range(1, self._bounces + 1):
            self._gather.gather_change(self.real.store, self.real.groups, self.mu, self.rho, marching)
            self._gather.gather(self.objects.store, self.objects.groups, self.rho, marching)
            self._light_rho(scene, gathered=True)
            self._fill_rho(is_last=number == self._bounces)
        self._find_tail(marching)
        return self.rho, lit


def delta_voxel_stages(
    g: Graph, s: FrameResources, lit: LitScene, voxels: DeltaVoxels, placement: Resource[Placements]
) -> tuple[Resource[VoxelMipmap], Resource[VoxelMipmap]]:
    """Declares voxelisation, lighting, filtering and bounces: mu of the real scene, then rho with the objects."""
    real = g.stage("voxelize real", voxels.voxelize_real, s.real, placement)
    beyond = g.stage("voxelize far", voxels.far.voxelize, s.real)
    scene = g.value(
        "real voxel scene",
        voxels.real_scene,
        s.measured,
        s.albedo,
        s.lights,
        lit.real_maps,
        lit.environment,
        *lit.mirrored,
    )
    lit_real = g.stage("light real voxels", voxels.light_real, real, scene)
    far = g.stage("light far voxels", voxels.far.light, beyond, scene)
    filtered = g.stage("filter mu", voxels.filter_real, lit_real)
    mu, bounced = g.stages(
        "bounces real",
        voxels.bounce_real,
        *(lit_real, filtered, far, scene),
        outputs=("bounces real", "bounced real voxels"),
    )
    objects = g.stage("voxelize objects", voxels.voxelize_objects, s.objects, placement)
    joint = g.value("joint voxel scene", voxels.joint_scene, scene, s.objects, lit.object_maps, objects)
    lit_joint = g.stage("light joint voxels", voxels.light_joint, bounced, objects, s.objects, joint)
    filtered_joint, spent_joint = g.stages(
        "filter rho", voxels.filter_joint, lit_joint, outputs=("filter rho", "filtered joint voxels")
    )
    rho, _ = g.stages(
        "bounces joint",
        voxels.bounce_joint,
        *(spent_joint, filtered_joint, joint),
        outputs=("bounces joint", "bounced joint voxels"),
    )
    return mu, rho


def object_voxels(
    objects: GeometryState, placements: Placements
) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    """Returns the bounds of the voxels that hold objects, of each volume: (min x, y, z, -max x, y, z)."""
    if len(placements) == 1:
        return placements[0].voxel_bounds(np.stack(objects.bounds))
    boxes = [each.bounds for each in objects.extents]
    return np.concatenate([_met_voxels(each, boxes) for each in placements])


def _met_voxels(
    placement: VolumePlacement, boxes: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    met = [np.stack(box) for box in boxes if placement.meets(*box)]
    if not met:
        return np.array([placement.size] * 3 + [1] * 3, np.int32)
    return placement.voxel_bounds(np.concatenate(met))


def placed_volume(voxels: VoxelSet) -> PlacedVolume:
    """Where the voxels lie."""
    return voxels.volume


class JointVoxels(Protocol):
    """Voxels that hold rho in a mipmap of its own."""

    rho: VoxelMipmap


def joint_voxels(voxels: JointVoxels) -> VoxelMipmap:
    """The voxels of real and virtual surfaces."""
    return voxels.rho
