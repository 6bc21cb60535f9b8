"""The lights' maps around each of several volumes: texels of one around all objects would be as large as voxels."""

from collections.abc import Sequence
from operator import eq

import numpy as np

from deltalight.protocol.quality import QualityTier
from deltalight.render_server.frame import FrameResources
from deltalight.render_server.geometry_state import GeometryState, ObjectExtent
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.light_models import DirectionalLight, Light
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.methods.light_maps import (
    LightStages,
    LitScene,
    Points,
    object_extent,
    object_lamps,
)
from deltalight.render_server.methods.method import ResolvedSettings
from deltalight.render_server.methods.per_volume import PerVolume
from deltalight.render_server.methods.volume_placement import Placements, own_extents
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.volumes import VolumePlacement
from deltalight.render_server.scene.declared_surfaces import SurfaceTable
from deltalight.render_server.view import NOWHERE

DISTANT_M = 1e3  # where lights of parallel rays count as standing


class VolumeLights:
    """Fits and draws the lights' maps for each of several volumes; a single one is served by those of the frame."""

    def __init__(
        self, gpu: GpuContext, resolved: ResolvedSettings, shadow_samples: int, tier: QualityTier
    ) -> None:
        self._gpu, self._tile_size, self._shadow_samples = gpu, resolved.rsm_size, shadow_samples
        self._keeps_views = tier.refresh_tiles > 0
        self._own: list[LightStages] = []
        self._environment: object = None

    def _make_room(self, count: int) -> None:
        if count == len(self._own):
            return
        self.release()
        self._own = [
            LightStages(self._gpu, self._tile_size, self._shadow_samples, keeps_views=self._keeps_views)
            for _ in range(count)
        ]
        self._environment = None

    def fit_views(
        self,
        placements: Placements,
        lights: LightSet,
        lamps: tuple[Light, ...],
        real: GeometryState,
        extent: ObjectExtent,
        surfaces: SurfaceTable,
    ) -> tuple[PerVolume[bytes], PerVolume[bytes]]:
        """Fits the views to each volume's own objects; returns their records (`LightStages.fit_views`)."""
        self._make_room(len(placements) if len(placements) > 1 else 0)
        if self._environment is not lights.environment:
            for stages in self._own:
                stages.set_environment(lights)
            self._environment = lights.environment
        if not self._own:
            return PerVolume([b""]), PerVolume([b""])
        all_lights = [*lights.lights, *lamps]
        groups = zip(self._own, placements, own_extents(extent.parts, placements), strict=True)
        views = [
            stages.fit_views(
                lights,
                lamps,
                real,
                seen_extent(own, extent, placement, all_lights),
                surfaces,
                NOWHERE,
                extent,
            )
            for stages, placement, own in groups
        ]
        return PerVolume(around for around, _ in views), PerVolume(closely for _, closely in views)

    def draw_real(
        self, views: PerVolume[bytes], common: LightBuffers, real: GeometryState
    ) -> PerVolume[LightBuffers]:
        """Draws the real scene as seen from the lights, around each volume's objects."""
        if not self._own:
            return PerVolume([common])
        return PerVolume(stages.draw_real(own, real) for stages, own in zip(self._own, views, strict=True))

    def draw_objects(
        self, views: PerVolume[bytes], common: LightBuffers, objects: GeometryState
    ) -> PerVolume[LightBuffers]:
        """Draws the objects as seen from the lights, around each volume's."""
        if not self._own:
            return PerVolume([common])
        return PerVolume(
            stages.draw_objects(own, objects) for stages, own in zip(self._own, views, strict=True)
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(*self._own)
        self._own = []


def seen_extent(
    own: Sequence[ObjectExtent], every: ObjectExtent, placement: VolumePlacement, lights: Sequence[Light]
) -> ObjectExtent:
    """Returns what the maps of a volume must show: its own objects, or all of it where others may shade it."""
    corners = placement.corners
    around = ObjectExtent.around(own) if own else ObjectExtent(corners, corners[[0, -1]])
    others = [each for each in every.parts if not any(each is mine for mine in own)]
    if not any(_stands_before(light, corners, others) for light in lights):
        return around
    return ObjectExtent(np.concatenate([around.points, corners]), around.upright)


def _stands_before(light: Light, corners: Points, others: Sequence[ObjectExtent]) -> bool:
    """Whether boxes around others meet the box of the volume's corners and the light."""
    if isinstance(light, DirectionalLight):
        sources = corners - DISTANT_M * np.asarray(light.direction, float)
    else:
        sources = np.asarray(light.position, float)[None]
    between = np.concatenate([corners, sources])
    low, high = between.min(axis=0), between.max(axis=0)
    bounds = [each.bounds for each in others]
    return any(bool((first < high).all() and (last > low).all()) for first, last in bounds)


def volume_light_stages(
    g: Graph,
    s: FrameResources,
    lit: LitScene,
    placements: Resource[Placements],
    lights: VolumeLights,
) -> tuple[Resource[PerVolume[LightBuffers]], Resource[PerVolume[LightBuffers]]]:
    """Declares the maps of the real scene and of the objects for each volume."""
    fitted = placements, s.lights, object_lamps(g, s), s.real, object_extent(g, s), s.surfaces
    names = "volume views real", "volume views objects"
    real, objects = g.stages("volume views", lights.fit_views, *fitted, outputs=names, same=eq)
    real_maps = g.stage("volume maps real", lights.draw_real, real, lit.real_maps, s.real)
    object_maps = g.stage("volume maps objects", lights.draw_objects, objects, lit.object_maps, s.objects)
    return real_maps, object_maps
