"""What has to be found from the picture: the factor of the lights (METHOD 1) and the albedo of real surfaces."""

from protocol.frames import ViewFrame
from render_server.estimation.registration_fit import (
    Registration,
    registration_from_albedo_percentile,
    registration_from_patch,
)
from render_server.light_samples import Relight, bounced_light, sample_light
from render_server.relight.frame import RelightInput
from render_server.scene.albedo_volume import AlbedoVolume


def register_lights(frame: ViewFrame, scene: RelightInput, relight: Relight) -> Registration:
    """Factor R G B on all lights: from white paper and grey cards, else from the brightest albedo.

    `scene.lights` are not registered yet. The light that other real surfaces throw is in camera units already (it
    is measured), so the cones are traced twice: with the environment and without.
    """
    samples = sample_light(frame, scene, bounced_light(scene, relight), relight)
    known = samples.usable & (samples.albedo > 0)
    found = registration_from_patch(
        samples.measured[known], samples.light[known], samples.bounce[known], samples.albedo[known]
    )
    if found is not None:
        return found
    lit = samples.usable & samples.unshadowed
    return registration_from_albedo_percentile(samples.measured[lit], samples.light[lit], samples.bounce[lit])


def observe_albedo(frame: ViewFrame, scene: RelightInput, memory: AlbedoVolume, relight: Relight) -> None:
    """Add what this frame shows of the real surfaces' albedo; `scene.lights` are registered."""
    samples = sample_light(frame, scene, None, relight)
    lit = samples.usable & samples.unshadowed
    memory.observe(scene.real.bounds, samples.position[lit], samples.measured[lit], samples.light[lit])
