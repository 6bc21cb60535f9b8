"""The lights' common factor, estimated from the picture (docs/method.md 1)."""

from render_server.estimation.registration_fit import (
    Registration,
    registration_from_albedo_percentile,
    registration_from_patch,
)
from render_server.estimation.samples import bounced_light, sample_light
from render_server.frame_graph import FrameGraph
from render_server.lights.lights import LightSet


def register_lights(graph: FrameGraph, lights: LightSet) -> Registration:
    """Estimates a factor R G B on all lights: from white paper and grey cards, else from the brightest albedo.

    `lights` are not registered yet. Light that other real surfaces reflect is measured, so it is in camera units
    already; the cones are therefore traced twice, with and without the environment.
    """
    samples = sample_light(graph, lights, bounced_light(graph, lights))
    known = samples.usable & (samples.albedo > 0)
    found = registration_from_patch(
        samples.measured[known], samples.light[known], samples.bounce[known], samples.albedo[known]
    )
    if found is not None:
        return found
    lit = samples.usable & samples.unshadowed
    return registration_from_albedo_percentile(samples.measured[lit], samples.light[lit], samples.bounce[lit])
