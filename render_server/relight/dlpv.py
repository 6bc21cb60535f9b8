"""Delta light propagation volumes ([P2], METHOD 5)."""

from typing import Any

import moderngl

from protocol.scene_method import DlpvMethod
from render_server.gpu.context import GpuContext
from render_server.passes.direct_light import DirectLightPass
from render_server.passes.lpv_query import LpvQueryPass, bind_light_volumes
from render_server.passes.volume import Pyramid, VolumePlacement, place_volume
from render_server.relight.defaults import ResolvedSettings
from render_server.relight.dlpv_volumes import DlpvVolumes
from render_server.relight.frame import RelightInput
from render_server.relight.mirrored_objects import MirroredObjects
from render_server.relight.relight_base import RelightBase


class Dlpv(RelightBase):
    """V_rho and V_mu subtracted, or the paper's one volume of the change."""

    def __init__(
        self, gpu: GpuContext, settings: DlpvMethod, resolved: ResolvedSettings, size: tuple[int, int]
    ) -> None:
        objects_shadow = settings.resolved_shadow == "map"
        direct = DirectLightPass(gpu, size, objects_shadow=objects_shadow)
        super().__init__(
            gpu,
            resolved,
            size,
            settings.shadow_samples,
            direct,
            caustics=settings.resolved_caustics,
            screen_space=settings.resolved_screen_space,
        )
        self._settings = settings
        self.volumes = DlpvVolumes(gpu, settings, resolved.volume_size)
        self._query = LpvQueryPass(gpu)
        self._mirrored = MirroredObjects(gpu, self._grid, self._objects, "gather_lpv", {})

    def _placement(self, frame: RelightInput) -> VolumePlacement:
        low, high = frame.virtual.lasting_bounds
        return place_volume(low, high, self._resolved.volume_size, self._settings.volume_edge_m)

    def _rebuild_real(
        self, frame: RelightInput, placement: VolumePlacement, uniforms: dict[str, Any]
    ) -> None:
        self.volumes.rebuild_real(frame, self.table, placement, uniforms)

    def _rebuild_virtual(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        self.volumes.rebuild_virtual(frame, self.table, uniforms)

    def _trace(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        volumes = self.volumes
        uniforms = {**uniforms, **volumes.query_uniforms}
        seen = volumes.rho if volumes.change is None else volumes.change
        with frame.timers.measure("query real"):
            self._query.read_real(self._cones, self._grid, volumes.mu, seen, uniforms)
        with frame.timers.measure("query virtual"):
            self._query.read_virtual(self._cones, self._grid, volumes.rho, uniforms)

    def _reflect(self, frame: RelightInput, uniforms: dict[str, Any]) -> moderngl.Texture | None:
        own = {**uniforms, **self.volumes.query_uniforms}
        wanted = self._settings.resolved_reflections == "rays"
        return self._mirrored.run(frame, self._bind_light, own, wanted=wanted)

    def _bind_light(self) -> None:
        bind_light_volumes(self.volumes.rho, self.volumes.rho)

    def _joint(self) -> Pyramid:
        return self.volumes.shown
