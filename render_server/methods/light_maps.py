"""Stages that fit the lights' views around objects and room, and draw their depth maps (docs/method.md 4.1)."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from operator import eq
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float64

from deltalight.protocol import short_axis
from deltalight.protocol.quality import BEST, QualityTier
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.geometry_state import GeometryState, ObjectExtent
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.light_models import Light
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.lights.mirror_lights import mirror_lights
from deltalight.render_server.methods.method import ResolvedSettings
from deltalight.render_server.methods.object_groups import points_of_groups
from deltalight.render_server.passes.lights import LightBuffers, MirrorVisibility
from deltalight.render_server.passes.object_bvh import ObjectBvh
from deltalight.render_server.passes.shadow_maps import ShadowMaps
from deltalight.render_server.scene.declared_surfaces import SurfaceTable
from deltalight.render_server.view import NOWHERE, Rectangle

SHADOW_REACH = 4.0  # in longest edges of the objects' bounds: how far around them real shadows are resolved
SELF_SHADOW_TEXELS = 1.5  # a virtual receiver is lifted by so many texels of the depth map
LARGE_TRIANGLE = 0.1  # of that reach: from here on a triangle's own extent matters, not only its corners

Points = Float64[np.ndarray, "n 3"]
Fitted = tuple[
    tuple[Light, ...], tuple[Light, ...], GeometryState, ObjectExtent, SurfaceTable, bool, ObjectExtent
]
"""Lights, those that come with objects, room, objects, mirrors, whether only the objects' shadows count, and all
objects that block light."""


@dataclass(frozen=True, eq=False)
class LitScene:
    """The lights' buffers, and the resources whose stages fill parts of them.

    `real_maps` and `object_maps` are depth maps of the real scene and of the objects; `mirrored`, where smooth planes
    show mirror images of the lights, is empty if the method ignores these.
    """

    buffers: LightBuffers
    environment: Resource[Any]
    real_maps: Resource[LightBuffers]
    object_maps: Resource[LightBuffers]
    mirrored: tuple[Resource[moderngl.TextureArray | None], ...] = ()

    @property
    def all(self) -> tuple[Resource[Any], ...]:
        """Everything that shading under these lights depends on."""
        return self.environment, self.real_maps, self.object_maps, *self.mirrored


class LightStages:
    """Fits the lights' views to their casters and receivers, and draws their depth maps.

    With `keeps_views`, the views of real shadows stay while objects move a little.
    """

    def __init__(
        self,
        gpu: GpuContext,
        tile_size: int,
        shadow_samples: int,
        *,
        mirrors: bool = False,
        keeps_views: bool = False,
    ) -> None:
        self._keeps_views = keeps_views
        self._receivers: tuple[GeometryState, Points, Points] | None = None
        self._fitted: Fitted | None = None  # what the views are fitted to
        self.buffers = LightBuffers(gpu, tile_size, shadow_samples)
        self._mirrors = mirrors
        self._maps = ShadowMaps(gpu)
        self._visibility = MirrorVisibility(gpu)

    def set_environment(self, lights: LightSet) -> moderngl.TextureArray:
        """Uploads the residual environment."""
        return self.buffers.set_environment(lights.environment)

    def fit_views(
        self,
        lights: LightSet,
        lamps: tuple[Light, ...],
        real: GeometryState,
        extent: ObjectExtent,
        surfaces: SurfaceTable,
        area: Rectangle,
        blocking: ObjectExtent | None = None,
    ) -> tuple[bytes, bytes]:
        """Fits the views: of real shadows around the objects, and closely around the objects.

        If an `area` of the picture is to be lit too, or lamps of objects shine everywhere, the views of real shadows
        enclose the whole scene. `blocking` are all objects, if the `extent` is that of some. Returns the packed views
        of both: their maps are redrawn only if these change.
        """
        is_around_objects = area == NOWHERE and not lamps
        fitted = lights.lights, lamps, real, extent, surfaces, is_around_objects, blocking or extent
        if self._fitted is None or any(
            one is not other for one, other in zip(fitted, self._fitted, strict=True)
        ):
            self._place(*fitted)
            self._fitted = fitted
        return self.buffers.real_records, self.buffers.object_records

    def _place(
        self,
        lights: tuple[Light, ...],
        lamps: tuple[Light, ...],
        real: GeometryState,
        extent: ObjectExtent,
        surfaces: SurfaceTable,
        is_around_objects: bool,
        blocking: ObjectExtent,
    ) -> None:
        receivers = self._receivers_of(real, extent) if is_around_objects else real.points
        mirrors = (
            mirror_lights([*lights, *lamps], surfaces, short_axis.mean(extent.points))
            if self._mirrors and len(surfaces)
            else []
        )
        self.buffers.place(
            list(lights),
            real.points,
            receivers,
            extent.points,
            mirrors=mirrors,
            object_lamps=lamps,
            blocking=blocking.points,
            groups=points_of_groups(extent),
        )

    def _receivers_of(self, real: GeometryState, extent: ObjectExtent) -> Points:
        """Returns the real points on which objects may cast shadows: the same array while neither moves."""
        around = _snapped(extent.upright) if self._keeps_views else extent.upright
        known = self._receivers
        if known is None or known[0] is not real or not np.array_equal(known[1], around):
            known = self._receivers = real, around, shadow_receivers(real, around)
        return known[2]

    def draw_real(self, _views: bytes, real: GeometryState) -> LightBuffers:
        """Draws the real scene as seen from the lights."""
        buffers = self.buffers
        self._maps.run(buffers.real_atlas, [real.buffers], buffers.real_views)
        return buffers

    def draw_objects(self, _views: bytes, objects: GeometryState) -> LightBuffers:
        """Draws the objects as seen from the lights."""
        buffers = self.buffers
        self._maps.run(buffers.object_atlas, [objects.buffers], buffers.object_views)
        self._maps.measure_distances(buffers.object_atlas)
        return buffers

    def map_mirrors(
        self,
        _real: LightBuffers,
        _objects: LightBuffers,
        _lights: LightSet,
        _extent: ObjectExtent,
        seen: Observation,
    ) -> moderngl.TextureArray | None:
        """Maps where smooth planes show the lights; None where no plane does."""
        if not self.buffers.mirrors:
            return None
        self._visibility.run(self.buffers, seen.scan.bias_m, {**seen.bindings, **self.buffers.bindings})
        return self.buffers.mirror_visibility

    def release(self) -> None:
        """Frees the GL objects."""
        for item in (self.buffers, self._maps, self._visibility):
            item.release()


class TracedObjects:
    """The objects in one bounding volume hierarchy, for the rays of all views."""

    def __init__(self, gpu: GpuContext) -> None:
        self._bvh = ObjectBvh(gpu)

    def set_objects(self, objects: GeometryState) -> ObjectBvh:
        """Sets the objects' triangles; their hierarchy is built in the background, or when rays are first traced."""
        self._bvh.set_triangles(objects.drawn.mesh, objects.bounds, objects.buffers)
        return self._bvh

    def release(self) -> None:
        """Frees the GL objects."""
        self._bvh.release()


def light_stages(
    g: Graph,
    s: FrameResources,
    resolved: ResolvedSettings,
    shadow_samples: int,
    tier: QualityTier = BEST,
    *,
    mirrors: bool = False,
) -> LitScene:
    """Declares environment, light views, depth maps of both geometries, and mirror images of the lights."""
    g.section("lights")
    object_bvh(g, s)
    keeps_views = tier.refresh_tiles > 0
    stages = g.shared(
        "lights",
        lambda: LightStages(
            g.gpu, resolved.rsm_size, shadow_samples, mirrors=mirrors, keeps_views=keeps_views
        ),
    )
    extent = object_extent(g, s)
    environment = g.stage("environment", stages.set_environment, s.lights)
    fitted = s.lights, object_lamps(g, s), s.real, extent, s.surfaces, s.lit_area
    views = "light views real", "light views objects"
    real_views, object_views = g.stages("light views", stages.fit_views, *fitted, outputs=views, same=eq)
    real_maps = g.stage("shadow maps real", stages.draw_real, real_views, s.real)
    object_maps = g.stage("shadow maps objects", stages.draw_objects, object_views, s.objects)
    mirrored = []
    if mirrors:
        given = real_maps, object_maps, s.lights, extent, s.measured
        mirrored = [g.stage("mirror visibility", stages.map_mirrors, *given, same=_both_none)]
    return LitScene(stages.buffers, environment, real_maps, object_maps, tuple(mirrored))


def lagging_behind_objects(
    g: Graph, s: FrameResources, lit: LitScene, tier: QualityTier, *also: Resource[Any]
) -> AbstractContextManager[None]:
    """Context whose stages may lag some frames behind moving objects (`QualityTier.bounce_turns`, `Graph.lagging`).

    So a frame with a moved object need not wait for its bounced light. `also`: other resources that follow the
    objects.
    """
    followers = s.objects, object_extent(g, s), lit.object_maps
    return g.lagging(tier.bounce_turns, *followers, *lit.mirrored, *also)


def _both_none(old: object, new: object) -> bool:
    return old is None and new is None


def object_bvh(g: Graph, s: FrameResources) -> Resource[ObjectBvh]:
    """Declares the objects' hierarchy: early in the frame, so that it is built while the GPU has other work."""
    if "object bvh" in g:
        return g.resource("object bvh")
    traced = g.shared("traced objects", lambda: TracedObjects(g.gpu))
    return g.stage("object bvh", traced.set_objects, s.objects)


def object_extent(g: Graph, s: FrameResources) -> Resource[ObjectExtent]:
    """Declares the bounds that volumes and light views are fitted to."""
    if "object extent" in g:
        return g.resource("object extent")
    return g.value("object extent", _extent_of, s.objects, same=ObjectExtent.equals)


def object_lamps(g: Graph, s: FrameResources) -> Resource[tuple[Light, ...]]:
    """Declares the lights that come with the objects."""
    if "object lamps" in g:
        return g.resource("object lamps")
    return g.value("object lamps", _lamps_of, s.objects, same=_same_lights)


def _lamps_of(objects: GeometryState) -> tuple[Light, ...]:
    """The lights that come with the objects, in the world."""
    return objects.lamps


def _same_lights(old: tuple[Light, ...], new: tuple[Light, ...]) -> bool:
    return len(old) == len(new) and all(one is other for one, other in zip(old, new, strict=True))


def _extent_of(objects: GeometryState) -> ObjectExtent:
    """Returns the bounds of the objects over all of their animations."""
    return objects.extent


def _snapped(extent: Points) -> Points:
    """Returns the corners of a box around points, snapped to half of its longest edge."""
    low, high = short_axis.bounds(extent)
    step = max(float((high - low).max()) / 2, 1e-6)
    step = 2.0 ** np.ceil(np.log2(step))  # an object that turns keeps it
    return np.array([np.floor(low / step) * step, np.ceil(high / step) * step])


def shadow_receivers(real: GeometryState, extent: Points) -> Points:
    """Returns the real points around the objects, or all of them if none is near.

    These are the vertices within reach, and the parts within reach of a model's triangles that are too large to have
    a vertex there. Of measured surfaces, which are meshed finely except at grazing angles, only vertices count.
    """
    low, high = short_axis.bounds(extent)
    centre, reach = (low + high) / 2, SHADOW_REACH * float(np.max(high - low))
    points = real.points
    near = points[short_axis.lengths(points - centre) <= reach]
    if real.is_measured:
        return near if len(near) else points
    first, last = real.triangle_boxes
    meets = short_axis.all_of((first <= centre + reach) & (last >= centre - reach))
    large = meets & (real.triangle_edges > LARGE_TRIANGLE * reach)
    corners = real.corners[large].astype(np.float64)
    clipped = np.clip(corners.reshape(-1, 3), centre - reach, centre + reach)
    return np.concatenate([near, clipped]) if len(near) or len(clipped) else points
