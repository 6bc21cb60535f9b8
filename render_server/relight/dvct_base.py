"""What both operators of delta voxel cone tracing share (METHOD 4)."""

from protocol.scene_method import DvctMethod
from render_server.gpu.context import GpuContext
from render_server.passes.direct_light import DirectLightPass
from render_server.passes.volume import VolumePlacement, place_volume
from render_server.relight.defaults import ResolvedSettings, march_defines
from render_server.relight.frame import RelightInput
from render_server.relight.relight_base import RelightBase


class DvctBase(RelightBase):
    """An operator says how its voxels are made and its cones traced."""

    directions: int  # of the operator's pyramids

    def __init__(
        self, gpu: GpuContext, settings: DvctMethod, resolved: ResolvedSettings, size: tuple[int, int]
    ) -> None:
        cones = self.directions if settings.resolved_shadow == "cone" else None
        direct = DirectLightPass(gpu, size, shadow_cones=cones)
        exact = settings.operator == "exact"
        super().__init__(
            gpu,
            resolved,
            size,
            settings.shadow_samples,
            direct,
            caustics=settings.caustics and exact,
            mirrors_lights=exact and settings.mirrored_lights,
            screen_space=settings.screen_space and exact,
            march=march_defines(settings) if exact else None,
        )
        self._settings = settings

    def _placement(self, frame: RelightInput) -> VolumePlacement:
        low, high = frame.virtual.lasting_bounds
        return place_volume(low, high, self._resolved.volume_size, self._settings.volume_edge_m)
