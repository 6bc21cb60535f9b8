"""Albedo of real surfaces, remembered for when the camera looks elsewhere (docs/method.md 2)."""

from deltalight.render_server.estimation.samples import BackoffSchedule, sample_light
from deltalight.render_server.frame_graph import FrameGraph
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.passes.voxel_light import AlbedoTexture
from deltalight.render_server.scene.albedo import MEAN_ALBEDO, AlbedoVolume


class AlbedoEstimator:
    """Estimates the albedo volume of one real scene, with exponential back-off.

    If the scene gives an albedo there is nothing to estimate.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self.texture = AlbedoTexture(gpu)
        self._volume = AlbedoVolume()
        self._schedule = BackoffSchedule()
        self._is_given = False

    def observe(self, graph: FrameGraph, lights: LightSet) -> bool:
        """Adds this frame's observations under registered `lights`, if a measurement is due.

        Returns whether it did.
        """
        if self._is_given or not self._schedule.is_due(graph.inputs.frame.timestamp_ns):
            return False
        samples = sample_light(graph, lights, None)
        lit = samples.of(samples.usable & samples.unshadowed)
        self._volume.observe(graph.inputs.real.bounds, lit.position, lit.measured, lit.light)
        self.texture.upload(self._volume)
        return True

    def reset(self, given: float | None) -> None:
        """Resets the estimate for another real scene, whose albedo may be `given`."""
        self._volume, self._schedule = AlbedoVolume(), BackoffSchedule()
        self._is_given = given is not None
        self.texture.clear(MEAN_ALBEDO if given is None else given)

    def release(self) -> None:
        """Frees the texture."""
        self.texture.release()
