"""AR object occlusion fields: natural light by precomputed shells of what rigid objects hide ([D] 5.2, METHOD 6)."""

from typing import Any

import numpy as np

from protocol.scene_method import AroofMethod
from render_server.gpu.context import GpuContext
from render_server.occlusion_fields import OcclusionFields
from render_server.passes.composite import RelitLayers
from render_server.passes.direct_light import DirectLightPass
from render_server.passes.light_change import LightChangePass
from render_server.passes.light_probe import LightProbePass
from render_server.passes.natural_fields import NaturalFieldsPass
from render_server.passes.object_glow import ObjectGlowPass
from render_server.passes.occlusion_shade import OcclusionShadePass
from render_server.passes.occlusion_show import OcclusionShowPass
from render_server.passes.volume import Pyramid, VolumePlacement, place_volume
from render_server.relight.aroof_objects import FieldObject, FieldObjects
from render_server.relight.defaults import ResolvedSettings
from render_server.relight.frame import RelightInput
from render_server.relight.relight_base import RelightBase
from render_server.scene.occlusion_field import FieldSettings


class Aroof(RelightBase):
    """Lamps by shadow maps, natural light by fields; there is no volume but the one that is looked at."""

    def __init__(
        self,
        gpu: GpuContext,
        settings: AroofMethod,
        resolved: ResolvedSettings,
        size: tuple[int, int],
        fields: OcclusionFields,
    ) -> None:
        super().__init__(
            gpu,
            resolved,
            size,
            settings.shadow_samples,
            DirectLightPass(gpu, size),
            caustics=settings.caustics,
            screen_space=settings.screen_space,
        )
        self._settings = settings
        length = settings.sh_order**2
        self.objects = FieldObjects(gpu, fields, field_settings(settings))
        self._probes = LightProbePass(gpu, length)
        self._occlusion = OcclusionShadePass(gpu, self._grid.size, length)
        self._light_change = LightChangePass(gpu, self._grid.size)
        self._glow = ObjectGlowPass(gpu, self._grid.size)
        self._natural = NaturalFieldsPass(gpu)
        self._show = OcclusionShowPass(gpu)
        self._shown = Pyramid(gpu, resolved.volume_size, 1)

    def relight(self, frame: RelightInput) -> RelitLayers:
        """As the base does; a field that has arrived since the last frame counts like an object that moved."""
        with frame.timers.measure("fields upload"):
            if self.objects.follow(frame.virtual.objects):
                self._object_key = self._shade_key = None
        return super().relight(frame)

    def _placement(self, frame: RelightInput) -> VolumePlacement:
        """All that the fields reach: lamps must be known there, and view `volume` shows it."""
        low, high = frame.virtual.bounds
        reach = [
            item.uniforms["object_radius"] * item.uniforms["object_scale"] for item in self.objects.items
        ]
        edge = float(np.max(high - low)) + 2 * self._settings.reach * max(reach)
        return place_volume(low, high, self._resolved.volume_size, edge)

    def _rebuild_real(
        self, frame: RelightInput, placement: VolumePlacement, uniforms: dict[str, Any]
    ) -> None:
        """Nothing is made of the real scene beforehand."""

    def _rebuild_virtual(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        with frame.timers.measure("fields shown"):
            for number, item in enumerate(self.objects.items):
                own = {**uniforms, **item.uniforms}
                self._show.run(self._shown, item.textures, own, first=number == 0)

    def _trace(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        items = self.objects.items
        uniforms = {**uniforms, "hidden_too": True}  # what objects hide in the picture shines on them
        with frame.timers.measure("light around"):
            frame.picture.build_levels()
            self._find_light(frame, uniforms, changed=False)
        with frame.timers.measure("occlusion real"):
            self._hide(items, uniforms, real=True)
        with frame.timers.measure("light around"):
            self._find_light(frame, uniforms, changed=True)
        glowing = [item for item in items if item.glow is not None]
        with frame.timers.measure("reflected"):
            self._probes.bind_table()
            for item in glowing:
                assert item.textures is not None
                assert item.glow is not None
                self._glow.light(item.textures, item.probe, item.glow, {**uniforms, **item.uniforms})
        with frame.timers.measure("fields real"):
            self._finish(glowing, uniforms, real=True)
        with frame.timers.measure("fields virtual"):
            self._hide(items, uniforms, real=False)
            self._finish(glowing, uniforms, real=False)

    def _find_light(self, frame: RelightInput, uniforms: dict[str, Any], *, changed: bool) -> None:
        """Light around each object, without the objects or (`changed`) with what they change nearby."""
        measured = self._settings.near_light == "measured"
        if changed and not measured:
            return
        if changed:
            self._light_change.run(self._grid, self._occlusion, uniforms)
        changes = self._light_change.changes if changed else None
        for item in self.objects.items:
            own = {**uniforms, **item.uniforms}
            self._probes.forget()
            if measured:
                self._probes.gather(frame.picture, self._grid, own, changes)
            self._probes.resolve(item.probe, own)

    def _hide(self, items: list[FieldObject], uniforms: dict[str, Any], *, real: bool) -> None:
        for number, item in enumerate(items):
            own = {**uniforms, **item.uniforms}
            self._occlusion.run(self._grid, item.probe, item.textures, own, first=number == 0, real=real)

    def _finish(self, glowing: list[FieldObject], uniforms: dict[str, Any], *, real: bool) -> None:
        for number, item in enumerate(glowing):
            assert item.glow is not None
            own = {**uniforms, **item.uniforms}
            self._glow.shade(self._grid, item.glow, own, first=number == 0, real=real)
        glow = self._glow if glowing else None
        self._natural.run(self._cones, self._grid, self._occlusion, glow, uniforms, real=real)

    def _joint(self) -> Pyramid:
        return self._shown


def field_settings(settings: AroofMethod) -> FieldSettings:
    """What of the method's settings a field depends on."""
    return FieldSettings(
        settings.sh_order,
        settings.shells,
        settings.resolution,
        settings.reach,
        settings.rays,
        settings.indirect,
    )
