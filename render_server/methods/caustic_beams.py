"""The stage that traces caustics: beams of light off and through smooth objects (docs/method.md 4.10).

They are traced once for all views, up to the objects that they meet; each view ends them at its own real surfaces.
"""

from collections.abc import Callable
from dataclasses import dataclass

from deltalight.protocol.quality import QualityTier
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.methods.light_maps import SELF_SHADOW_TEXELS, LitScene, lagging_behind_objects
from deltalight.render_server.passes.caustics import GREATEST_ALPHA, CausticBeams
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.object_bvh import ObjectBvh
from deltalight.render_server.passes.volumes import PlacedVolume


def casts_caustics(objects: GeometryState) -> bool:
    """Whether any object is smooth enough to cast caustics."""
    return bool(objects.materials.smoothest**2 < GREATEST_ALPHA)


@dataclass(frozen=True, eq=False)
class TracedBeams:
    """Beams up to the objects that they meet, and how far from an object they are followed (m)."""

    beams: CausticBeams
    reach_m: float


class BeamStages:
    """Traces the beams that smooth objects cast, for all views."""

    def __init__(self, gpu: GpuContext, lights: LightBuffers, tier: QualityTier) -> None:
        self._lights = lights
        self._beams = CausticBeams(gpu, blocks=tier.caustic_blocks)

    def trace(
        self,
        objects: GeometryState,
        bvh: ObjectBvh,
        seen: Observation,
        volume: PlacedVolume,
        _lights: LightSet,
        *_maps: object,
    ) -> TracedBeams | None:
        """Traces the beams that smooth objects cast; None if none is smooth enough."""
        if not casts_caustics(objects):
            return None
        low, high = objects.bounds
        offset = SELF_SHADOW_TEXELS * self._lights.object_texel_m((low + high) / 2)
        materials = objects.materials
        scene = {**seen.bindings, **materials.bindings, **self._lights.bindings, "normal_offset": offset}
        self._beams.trace(self._lights, bvh, materials, scene, bias_m=seen.scan.bias_m)
        reach = max(each.size * each.voxel_edge for each in volume.placements)
        return TracedBeams(self._beams, reach)

    def release(self) -> None:
        """Frees the GL objects."""
        self._beams.release()


def no_beams(*_: object) -> None:
    """Of a method without caustics."""


def beam_stages(
    g: Graph,
    s: FrameResources,
    lit: LitScene,
    tier: QualityTier,
    volume: Resource[PlacedVolume],
    bvh: Resource[ObjectBvh],
    *,
    casts: bool,
) -> Resource[TracedBeams | None]:
    """Declares the beams that smooth objects cast; none of a method that `casts` none."""
    trace: Callable[..., TracedBeams | None] = no_beams
    if casts:
        trace = g.shared("caustic beams", lambda: BeamStages(g.gpu, lit.buffers, tier)).trace
    with lagging_behind_objects(g, s, lit, tier, bvh):
        return g.stage("caustic beams", trace, s.objects, bvh, s.measured, volume, s.lights, *lit.all)
