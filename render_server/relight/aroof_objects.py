"""The objects of a scene as occlusion fields have them: samples on the GPU, light around each, where each stands."""

from dataclasses import dataclass, field
from typing import Any

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext
from render_server.occlusion_fields import OcclusionFields
from render_server.passes.light_probe import LightProbe
from render_server.passes.object_field import FieldTextures, field_texture, standing_uniforms
from render_server.relight.frame import PlacedObject
from render_server.scene.occlusion_field import FieldSettings, OcclusionField


@dataclass(eq=False)
class FieldObject:
    """One object; without `textures` its field is still being computed."""

    probe: LightProbe
    textures: FieldTextures | None
    glow: moderngl.Texture3D | None
    uniforms: dict[str, Any] = field(default_factory=dict)

    def release(self) -> None:
        """Free the GL objects that are its own."""
        self.probe.release()
        if self.glow is not None:
            self.glow.release()


class FieldObjects:
    """Follows the scene's objects; objects of one asset share its samples."""

    def __init__(self, gpu: GpuContext, fields: OcclusionFields, settings: FieldSettings) -> None:
        self._gpu = gpu
        self._fields = fields
        self._settings = settings
        self._textures: dict[OcclusionField, FieldTextures] = {}
        self._shown: tuple[tuple[PlacedObject, ...], tuple[OcclusionField | None, ...]] = ((), ())
        self.items: list[FieldObject] = []

    def follow(self, objects: tuple[PlacedObject, ...]) -> bool:
        """Take over the objects as they stand; returns whether anything changed, a field's arrival included.

        Raises:
            DeltalightError: a field cannot be computed.
        """
        shown = (objects, tuple(self._fields.find(item, self._settings) for item in objects))
        if shown == self._shown:
            return False
        if shown[1] != self._shown[1]:
            self._make(shown[1])
        self._shown = shown
        for item, placed, found in zip(self.items, *shown, strict=True):
            item.uniforms = _uniforms(placed, found)
        return True

    def _make(self, needed: tuple[OcclusionField | None, ...]) -> None:
        """Make anew what lies on the GPU; samples that are there already stay."""
        for one in set(self._textures) - set(needed):
            self._textures.pop(one).release()
        for item in self.items:
            item.release()
        self.items = [self._made(one) for one in needed]

    def _made(self, found: OcclusionField | None) -> FieldObject:
        if found is not None and found not in self._textures:
            self._textures[found] = FieldTextures(self._gpu, found)
        textures = None if found is None else self._textures[found]
        glow = None
        if textures is not None and textures.transfer is not None:
            glow = field_texture(self._gpu, textures.glow_shape)
        return FieldObject(LightProbe(self._gpu, self._settings.order**2), textures, glow)

    def release(self) -> None:
        """Free the GL objects."""
        for item in self.items:
            item.release()
        for textures in self._textures.values():
            textures.release()
        self.items, self._textures = [], {}


def _uniforms(item: PlacedObject, found: OcclusionField | None) -> dict[str, Any]:
    """Where the object stands, and what it reflects where the field's own colours are 1."""
    bounds = np.array([mesh.bounds() for mesh in item.meshes])
    around = np.stack([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])
    given = item.material
    diffuse = np.ones(3) if given is None else (1 - given.metallic) * given.base_color
    reflectance = tuple(float(value) for value in diffuse)
    return {**standing_uniforms(item.world_from_asset, found, around), "reflectance": reflectance}
