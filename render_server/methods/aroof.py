"""AR object occlusion fields: natural light by precomputed shells of what rigid objects hide ([D] 5.2,
docs/method.md 6).
"""

from dataclasses import dataclass, field
from functools import partial
from operator import eq

import moderngl
import numpy as np

from deltalight.protocol.scene_method import AroofMethod
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.geometry_state import GeometryState, PlacedObject
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.methods.light_maps import light_stages
from deltalight.render_server.methods.method import RelightingMethod, ResolvedSettings, Setup
from deltalight.render_server.methods.surface_shading import (
    Layers,
    MethodStages,
    ShadingOptions,
    SurfaceShading,
    shading_stages,
)
from deltalight.render_server.passes.cones import ConeFields, LowResGrid
from deltalight.render_server.passes.occlusion_fields import (
    FieldTextures,
    LightChange,
    LightProbe,
    LightProbeCapture,
    NaturalFields,
    ObjectBounceLight,
    OcclusionShade,
    OcclusionShow,
    field_texture,
    standing_uniforms,
)
from deltalight.render_server.passes.shading import DirectLight
from deltalight.render_server.passes.volumes import PlacedVolume, VolumePlacement, place_volume
from deltalight.render_server.passes.voxels import VoxelMipmap, VoxelsOnDemand
from deltalight.render_server.precomputation.occlusion_fields import (
    OcclusionFields,
    field_settings,
    require_rigid,
)
from deltalight.render_server.scene.occlusion_field import FieldSettings, OcclusionField

SHOWN_CELLS = 64  # for view `volume` alone; the method has no volume


@dataclass(eq=False)
class FieldObject:
    """One object: the samples of its field, the light around it, and its pose (`place`).

    `textures` is None while the field is still being computed.
    """

    probe: LightProbe
    textures: FieldTextures | None
    bounce_light: moderngl.Texture3D | None
    place: dict[str, Binding] = field(default_factory=dict)

    def release(self) -> None:
        """Frees the GL objects that it owns."""
        release_all(self.probe, self.bounce_light)


class FieldObjects:
    """The scene's objects as occlusion fields describe them; objects of one asset share its samples."""

    def __init__(self, gpu: GpuContext, fields: OcclusionFields, settings: FieldSettings) -> None:
        self._gpu = gpu
        self._fields = fields
        self._settings = settings
        self._textures: dict[OcclusionField, FieldTextures] = {}
        self._made_for: tuple[OcclusionField | None, ...] | None = None
        self.items: list[FieldObject] = []

    def find(self, objects: GeometryState) -> tuple[OcclusionField | None, ...]:
        """Returns the objects' fields, None for those still being computed.

        Raises:
            DeltalightError: a field cannot be computed.
        """
        return tuple(self._fields.find(item, self._settings) for item in objects.objects)

    def place(self, objects: GeometryState, found: tuple[OcclusionField | None, ...]) -> list[FieldObject]:
        """Uploads new fields and updates the objects' poses."""
        if found != self._made_for:
            self._make(found)
            self._made_for = found
        for item, placed, own in zip(self.items, objects.objects, found, strict=True):
            item.place = _standing(placed, own)
        return self.items

    def _make(self, needed: tuple[OcclusionField | None, ...]) -> None:
        """Creates the GPU data of the objects; keeps samples that exist already."""
        for one in set(self._textures) - set(needed):
            if one is not None:
                self._textures.pop(one).release()
        release_all(*self.items)
        self.items = [self._made(one) for one in needed]

    def _made(self, found: OcclusionField | None) -> FieldObject:
        if found is not None and found not in self._textures:
            self._textures[found] = FieldTextures(self._gpu, found)
        textures = None if found is None else self._textures[found]
        bounce_light = None
        if textures is not None and textures.transfer is not None:
            bounce_light = field_texture(self._gpu, textures.bounce_shape)
        return FieldObject(LightProbe(self._gpu, self._settings.order**2), textures, bounce_light)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(*self.items, *self._textures.values())
        self.items, self._textures, self._made_for = [], {}, None


def _standing(item: PlacedObject, found: OcclusionField | None) -> dict[str, Binding]:
    """Returns the object's pose, and its reflectance where the field's own colours are 1."""
    bounds = np.array([mesh.bounds() for mesh in item.meshes])
    around = np.stack([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])
    given = item.material
    diffuse = np.ones(3) if given is None else given.diffuse_reflectance
    reflectance = tuple(float(value) for value in diffuse)
    return {**standing_uniforms(item.world_from_asset, found, around), "reflectance": reflectance}


class FieldShading:
    """Computes natural light at real surfaces and objects, as occluded by the fields."""

    def __init__(self, gpu: GpuContext, settings: AroofMethod, cells: int, fields: ConeFields) -> None:
        size, length = fields.mu.size, settings.sh_order**2
        self._settings, self._fields, self._cells = settings, fields, cells
        self._volume = PlacedVolume(gpu, VolumePlacement((0.0, 0.0, 0.0), 1.0, cells))
        self._shown = VoxelMipmap(gpu, cells, 1)
        self._probes = LightProbeCapture(gpu, length)
        self._at_real, self._at_objects = (
            OcclusionShade(gpu, size, length, real=real) for real in (True, False)
        )
        self._change = LightChange(gpu, size)
        self._bounce = ObjectBounceLight(gpu, size)
        self._natural = NaturalFields(gpu)
        self._show = OcclusionShow(gpu)

    def place(self, items: list[FieldObject], objects: GeometryState) -> PlacedVolume:
        """Returns the extent of the fields: lamps need shadow maps there, and debug view `volume` shows it."""
        low, high = objects.bounds
        reach = [float(item.place["object_radius"]) * float(item.place["object_scale"]) for item in items]  # type: ignore[arg-type]
        edge = float(np.max(high - low)) + 2 * self._settings.reach * max(reach)
        return self._volume.place(place_volume(low, high, self._cells, edge))

    def show(self, items: list[FieldObject], volume: PlacedVolume) -> VoxelsOnDemand:
        """Shows what the fields occlude in cells, once somebody looks at debug view `volume`."""
        return VoxelsOnDemand(self._shown, partial(self._draw, items, volume))

    def _draw(self, items: list[FieldObject], volume: PlacedVolume) -> None:
        for number, item in enumerate(items):
            self._show.run(self._shown, item.textures, volume.bindings, item.place, first=number == 0)

    def find_light(
        self, items: list[FieldObject], scene: Bindings, grid: LowResGrid, seen: Observation
    ) -> list[FieldObject]:
        """Captures the light around each object, without the objects."""
        seen.image.build_levels()
        self._capture(items, _with_hidden(scene), grid, None)
        return items

    def hide(self, items: list[FieldObject], scene: Bindings, grid: LowResGrid) -> OcclusionShade:
        """Computes the natural light that the objects leave at real surfaces."""
        return _occluded(self._at_real, items, _with_hidden(scene), grid)

    def find_changed_light(
        self, items: list[FieldObject], scene: Bindings, grid: LowResGrid, shade: OcclusionShade
    ) -> list[FieldObject]:
        """Captures the light around each object, including the changes that objects cause nearby."""
        if self._settings.near_light == "measured":
            own = _with_hidden(scene)
            self._change.run(grid, shade, own)
            self._capture(items, own, grid, self._change.changes)
        return items

    def _capture(
        self,
        items: list[FieldObject],
        scene: Bindings,
        grid: LowResGrid,
        changes: moderngl.Texture | None,
    ) -> None:
        for item in items:
            self._probes.forget()
            if self._settings.near_light == "measured":
                self._probes.gather(grid, scene, item.place, changes)
            self._probes.resolve(item.probe, scene, item.place)

    def reflect(self, items: list[FieldObject], scene: Bindings) -> list[FieldObject]:
        """Computes the light that each object reflects; returns the objects that reflect any."""
        reflecting = [item for item in items if item.bounce_light is not None]
        own = {**_with_hidden(scene), **self._probes.bindings}
        for item in reflecting:
            assert item.textures is not None
            assert item.bounce_light is not None
            self._bounce.light(item.textures, item.probe, item.bounce_light, own, item.place)
        return reflecting

    def write_fields(
        self,
        items: list[FieldObject],
        reflecting: list[FieldObject],
        scene: Bindings,
        grid: LowResGrid,
        hidden: OcclusionShade,
    ) -> ConeFields:
        """Writes the fields of real surfaces, then those of the objects, which occlude each other too."""
        own = _with_hidden(scene)
        self._finish(hidden, reflecting, own, grid, real=True)
        self._finish(_occluded(self._at_objects, items, own, grid), reflecting, own, grid, real=False)
        return self._fields

    def _finish(
        self,
        hidden: OcclusionShade,
        reflecting: list[FieldObject],
        scene: Bindings,
        grid: LowResGrid,
        *,
        real: bool,
    ) -> None:
        for number, item in enumerate(reflecting):
            assert item.bounce_light is not None
            self._bounce.shade(grid, item.bounce_light, scene, item.place, first=number == 0, real=real)
        bounce = self._bounce if reflecting else None
        self._natural.run(self._fields, grid, hidden, bounce, scene, real=real)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(
            self._volume,
            self._shown,
            self._probes,
            self._at_real,
            self._at_objects,
            self._change,
            self._bounce,
            self._natural,
            self._show,
        )


def _occluded(
    shade: OcclusionShade, items: list[FieldObject], scene: Bindings, grid: LowResGrid
) -> OcclusionShade:
    """Computes the natural light that the objects leave."""
    for number, item in enumerate(items):
        shade.run(grid, item.probe, item.textures, scene, item.place, first=number == 0)
    return shade


def _with_hidden(scene: Bindings) -> dict[str, Binding]:
    """Returns the scene for objects, which also receive light from surfaces that objects hide in the picture."""
    return {**scene, "hidden_too": True}


def aroof(g: Graph, s: FrameResources, setup: Setup[AroofMethod]) -> Layers:
    """Lamps by shadow maps, natural light by occlusion fields; the volume exists only for its debug view."""
    settings, resolved, size = setup.settings, setup.resolved, setup.picture_size
    lit = light_stages(g, s, resolved, settings.shadow_samples, settings.tier)
    options = ShadingOptions(caustics=settings.caustics, screen_space=settings.screen_space)
    shading = SurfaceShading(g.gpu, size, resolved, lit.buffers, DirectLight(g.gpu, size), options)
    own = FieldShading(g.gpu, settings, resolved.volume_size, shading.cones)
    objects = FieldObjects(g.gpu, setup.fields, field_settings(settings))
    g.section("occlusion fields")
    found = g.polled("found fields", "objects", lambda: objects.find(s.objects.value), eq)
    items = g.stage("occlusion fields", objects.place, s.objects, found)
    volume = g.value("volume", own.place, items, s.objects)
    shown = g.value("shown cells", own.show, items, volume)

    def trace(scene: Resource[Bindings], grid: Resource[LowResGrid]) -> Resource[ConeFields]:
        around = g.stage("light around objects", own.find_light, items, scene, grid, s.observation)
        hidden = g.stage("occlusion real", own.hide, around, scene, grid)
        changed = g.stage("changed light around objects", own.find_changed_light, around, scene, grid, hidden)
        reflecting = g.stage("object bounce light", own.reflect, changed, scene)
        return g.stage("cones", own.write_fields, changed, reflecting, scene, grid, hidden)

    return shading_stages(g, s, shading, lit, MethodStages(volume, trace, shown))


def resolve(settings: AroofMethod, defaults: ResolvedSettings) -> ResolvedSettings:
    """Takes the document's values, or the machine's defaults where it says null."""
    return ResolvedSettings(
        SHOWN_CELLS,
        settings.shading_scale or defaults.cone_scale,
        settings.rsm_size or defaults.rsm_size,
        settings.triangle_budget or defaults.triangle_budget,
    )


AROOF = RelightingMethod(AroofMethod, aroof, resolve, require=require_rigid)
