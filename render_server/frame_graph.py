"""The graph of one scene's frames: shared stages, the method's own stages, and composition."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import eq, is_
from typing import Any, TypeVar

import moderngl
import numpy as np
from jaxtyping import Float64

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene_output import Output
from deltalight.render_server.frame import (
    FrameResources,
    Measurement,
    Observation,
    PictureBuffers,
    Scan,
    declare_frame,
    join_measurements,
)
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings
from deltalight.render_server.gpu.textures import read_texture
from deltalight.render_server.gpu.timers import PassTimers
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.methods.registry import MethodChoice
from deltalight.render_server.methods.surface_shading import Layers
from deltalight.render_server.passes.camera_image import CameraImage
from deltalight.render_server.passes.composite import Composite, DebugViews, RelitLayers
from deltalight.render_server.passes.cones import ConeFields, LowResGrid
from deltalight.render_server.passes.coverage import mixed_radiance
from deltalight.render_server.passes.gbuffer import GeometryBuffer
from deltalight.render_server.passes.real_surface import RealSurface
from deltalight.render_server.passes.shading import DirectLight
from deltalight.render_server.passes.voxel_light import AlbedoTexture
from deltalight.render_server.precomputation.precomputed import Precomputed
from deltalight.render_server.scene.declared_surfaces import SurfaceTable
from deltalight.render_server.view import NOWHERE, CameraView, Rectangle

T = TypeVar("T")


@dataclass(frozen=True)
class CompositeOptions:
    """Options of composition, from a scene document's `output` and `method`.

    `with_linear` requests the linear picture too.
    """

    output: Output
    additive: bool
    relights_real: bool
    with_linear: bool

    @property
    def bindings(self) -> Bindings:
        """Returns the uniforms of composite.comp.glsl."""
        return {
            "additive": self.additive,
            "relights_real": self.relights_real,
            "filmic": self._is_filmic,
            "store_linear": self._needs_linear,
            "whole": self._needs_linear or self._is_filmic,
        }

    @property
    def reuses_ratio(self) -> bool:
        """Whether a new picture in the same light can be composed by the ratio of the last one."""
        is_whole = self._needs_linear or self._is_filmic or self.output.view != "composite"
        return not (is_whole or self.additive)

    @property
    def _needs_linear(self) -> bool:
        return self.with_linear or self.output.view in ("effects", "delta")

    @property
    def _is_filmic(self) -> bool:
        return self.output.tone == "aces"


@dataclass(frozen=True, eq=False)
class FrameInputs:
    """Everything that one frame is rendered from; setting the same objects again changes nothing.

    `measurement` is what `real` was built from; only a graph that keeps the world reads it.
    """

    frame: ViewFrame
    view: CameraView
    scan: Scan
    measurement: Measurement
    real: GeometryState
    objects: GeometryState
    surfaces: SurfaceTable
    lights: LightSet
    albedo: AlbedoTexture


@dataclass(frozen=True, eq=False)
class EvaluatedLight:
    """Light that `FrameGraph.evaluate` found at the camera's pixels."""

    direct: DirectLight
    cones: ConeFields
    grid: LowResGrid


@dataclass(frozen=True, eq=False)
class ShownBuffers:
    """The newest frame's geometry buffers, for picking."""

    view: CameraView
    object_coverage: moderngl.Texture
    object_buffer: GeometryBuffer
    real_surface: RealSurface
    objects: GeometryState


@dataclass(frozen=True, eq=False)
class ComposedPicture:
    """A composed picture, and what it was composed of."""

    composite: Composite
    layers: RelitLayers
    scene: Bindings


class Composition:
    """Composes the picture, or overwrites it with a debug view on request."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._composite = Composite(gpu, size)
        self._views = DebugViews(gpu)

    def compose(
        self,
        image: CameraImage,
        scene: Bindings,
        options: CompositeOptions,
        *layers: Any,  # noqa: ANN401 (of RelitLayers, in their order)
    ) -> ComposedPicture:
        """Composes the relit picture, and keeps by which ratio it changed."""
        return self.compose_layers(image, scene, options, RelitLayers(scene["object_coverage"], *layers))

    def compose_layers(
        self, image: CameraImage, scene: Bindings, options: CompositeOptions, relit: RelitLayers
    ) -> ComposedPicture:
        """Composes the relit picture of layers that belong together."""
        self._composite.run(image, relit, {**scene, **options.bindings})
        view = options.output.view
        if view == "volume" and relit.voxels is not None:
            self._views.volume(self._composite.code, image, relit.voxels, relit.volume, scene)
        elif view == "error":
            error = None if relit.error is None else relit.error()
            self._views.error(self._composite.code, error, relit.grid.scale)
        elif view == "rsm":
            self._views.shadow_maps(self._composite.code, relit.lights)
        elif view in ("effects", "delta"):
            self._views.change(
                self._composite.code,
                image,
                self._composite.linear,
                relit.object_coverage,
                effects=view == "effects",
            )
        return ComposedPicture(self._composite, relit, scene)

    def compose_again(self, image: CameraImage, relit: ComposedPicture) -> Composite:
        """Composes the newest picture by the kept ratio, unless it is composed already."""
        if not image.is_linear:
            relit.composite.run_again(image, relit.layers, relit.scene)
        return relit.composite

    def release(self) -> None:
        """Frees the GL objects."""
        self._composite.release()
        self._views.release()


class FrameGraph:
    """The stages of one camera's frames for one method and picture size: declared once, then run for every frame.

    Each camera in a room has one (`frame_graphs`). They share one `graph`, in which stages that do not depend on the
    camera run once.
    """

    def __init__(
        self,
        graph: Graph,
        buffers: PictureBuffers,
        resources: FrameResources,
        method: MethodChoice,
        precomputed: Precomputed,
    ) -> None:
        self.method, self.graph = method, graph
        self.buffers, self.resources = buffers, resources
        size = buffers.key[0]
        setup = method.setup(size, precomputed.fields)
        layers = method.declare(graph, resources, setup)
        self.layers: Layers = method.shaded(graph, resources, layers, size, precomputed.transfers)
        self._options: Resource[CompositeOptions] = graph.source("output", "scene")
        self._linear: Resource[CameraImage] = graph.source("linear picture", "view")
        self._all: Sequence[FrameGraph] = (self,)  # of all cameras in the room
        self._others: tuple[int, ...] = ()  # versions of the other sources
        self._views: Composition | None = None  # made when somebody looks at another view
        self._composite = self._declare_composition(Composition(graph.gpu, size))
        self._inputs: FrameInputs | None = None
        self._kept: dict[Callable[..., Any], tuple[object, Any]] = {}

    def _declare_composition(self, composition: Composition) -> Resource[Composite]:
        g, s, layers = self.graph, self.resources, self.layers
        relit = self._relit = g.stage(
            "relit picture",
            composition.compose,
            self._linear,
            "shading scene",
            self._options,
            layers.radiance,
            layers.direct,
            layers.cones,
            layers.grid,
            layers.change,
            layers.voxels,
            layers.volume,
            layers.lights,
            layers.reflection,
            *(() if layers.error is None else (layers.error,)),
        )
        return g.stage("composite", composition.compose_again, s.image, relit)

    def fits(self, view: CameraView) -> bool:
        """Whether its pictures have the size of this view's."""
        return self.buffers.key == (view.size, view.raster[1])

    def upload(self, frame: ViewFrame) -> None:
        """Begins a frame by uploading its picture."""
        if self is self._all[0]:
            self.graph.begin_frame()
        self.buffers.image.upload(frame)
        self.resources.image.write(self.buffers.image)

    def set_inputs(self, inputs: FrameInputs) -> None:
        """Sets all sources except picture and output."""
        s = self.resources
        s.view.write(inputs.view, eq)
        s.scan.write(inputs.scan, is_)
        if s.measurement is not None:
            s.measurement.write(inputs.measurement, is_)
        s.real.write(inputs.real, is_)
        s.objects.write(inputs.objects, is_)
        s.surfaces.write(inputs.surfaces, is_)
        s.lights.write(inputs.lights, is_)
        s.lit_area.write(NOWHERE, eq)
        s.albedo.write(inputs.albedo, is_)
        self._inputs = inputs

    def set_lights(self, lights: LightSet) -> None:
        """Sets other lights for the same frame."""
        self._inputs = replace(self.inputs, lights=lights)
        self.resources.lights.write(lights, is_)
        self.resources.lit_area.write(NOWHERE, eq)

    def renew_albedo(self) -> None:
        """Marks the contents of the albedo texture as changed."""
        self.resources.albedo.write(self.resources.albedo.value)

    @property
    def inputs(self) -> FrameInputs:
        """Everything that the frame is rendered from."""
        assert self._inputs is not None
        return self._inputs

    def kept(self, make: Callable[..., T], *of: Resource[Any], **constants: int) -> T:
        """Returns `make(*values of the resources, **constants)`, computed again only if any of them changed."""
        self._run(*of)
        seen = *(item.version for item in of), constants
        if make not in self._kept or self._kept[make][0] != seen:
            self._kept[make] = seen, make(*(item.value for item in of), **constants)
        found: T = self._kept[make][1]
        return found

    @property
    def observation(self) -> Observation:
        """The visible real surfaces, brought up to date."""
        self._run(self.resources.observation)
        return self.resources.observation.value

    def shown(self) -> ShownBuffers:
        """The geometry buffers, brought up to date."""
        s = self.resources
        self._run(s.geometry)
        surface = s.object_surface.value
        return ShownBuffers(
            s.view.value,
            surface.coverage.texture,
            surface.buffer,
            s.observation.value.surface,
            s.objects.value,
        )

    def radiance(self) -> Float64[np.ndarray, "h w 3"]:
        """Radiance of the virtual objects as composed, camera units; undefined where they cover nothing."""
        radiance, surface = self.layers.radiance, self.resources.object_surface
        self._run(radiance, surface)
        edges = surface.value.coverage.interior_edges
        return mixed_radiance(read_texture(radiance.value)[..., :3], read_texture(edges))

    def evaluate(self, lights: LightSet) -> EvaluatedLight:
        """Evaluates the light without objects under other lights, at every pixel and not only near the objects.

        Only mu of the result is sure to follow these lights. They stay set until `set_lights` or `set_inputs`.
        """
        cones, layers = self.gather(lights, (0, 0, *self.resources.view.value.size)), self.layers
        direct = layers.direct_mu or layers.direct
        self._run(direct, layers.grid)
        return EvaluatedLight(direct.value, cones, layers.grid.value)

    def gather(self, lights: LightSet, area: Rectangle) -> ConeFields:
        """Gathers the light that cones find under other lights, in a part of the picture; else as `evaluate`."""
        s, layers = self.resources, self.layers
        s.lights.write(lights, is_)
        s.lit_area.write(area, eq)
        cones = layers.cones_mu or layers.cones
        self._run(cones)
        return cones.value

    def advance(self, options: CompositeOptions, until_s: float) -> bool:
        """Runs stages of the frame until then (time.monotonic()); returns whether all have run."""
        self._options.write(options, eq)
        return self._run(self._composite, until_s=until_s)

    def render(self, options: CompositeOptions) -> Composite:
        """Composes the frame."""
        self._options.write(options, eq)
        self._run(self._composite)
        return self._composite.value

    def render_view(self, options: CompositeOptions) -> Composite:
        """Composes the frame once more with other options, into textures of its own.

        What `render` composed stays, so that the next frame at rest can still be composed by the kept ratio.
        """
        image, relit = self.buffers.image, self._relit.value
        if not image.is_linear:
            image.linearize()
        if self._views is None:
            self._views = Composition(self.graph.gpu, self.resources.view.value.size)
            self.graph.own(self._views)
        assert self.graph.timers is not None
        with self.graph.timers.measure("other views"):
            return self._views.compose_layers(image, relit.scene, options, relit.layers).composite

    def _run(self, *targets: Resource[Any], until_s: float | None = None) -> bool:
        """Brings the targets up to date; before, linearises the newest pictures unless the scene is at rest.

        The GPU makes the real scene's triangles first, unless the targets do not need them.
        """
        if not {self.resources.geometry, self.resources.observation}.issuperset(targets):
            self.inputs.real.fill()
        others = *(version for each in self._all for version in each._versions()), self._options.version
        for each in self._all:
            each._linearize(others)
        return self.graph.run(*targets, until_s=until_s)

    def _versions(self) -> tuple[int, ...]:
        """Returns the versions of all sources except picture and output."""
        s = self.resources
        sources = s.view, s.scan, s.measurement, s.real, s.objects, s.surfaces, s.lights, s.lit_area, s.albedo
        return tuple(item.version for item in sources if item is not None)

    def _linearize(self, others: tuple[int, ...]) -> None:
        """Computes the newest picture's linear radiance, unless the versions of the `others` show a scene at rest."""
        image = self.buffers.image
        options = self._options.value if self._options.version else None
        is_specular = self.resources.surfaces.value.is_specular
        reuses_ratio = options is not None and options.reuses_ratio and not is_specular
        is_at_rest = others == self._others and not self.graph.is_lagging
        if not image.is_linear and not (reuses_ratio and is_at_rest):
            image.linearize(begins_frame=True)
            self._linear.write(image)
        self._others = others

    def release(self) -> None:
        """Frees the GL objects, those of the other cameras in the room too."""
        self.graph.release()


def frame_graphs(
    gpu: GpuContext,
    views: Sequence[CameraView],
    method: MethodChoice,
    precomputed: Precomputed,
    timers: PassTimers,
    *,
    checks: bool = False,
) -> list[FrameGraph]:
    """Returns the frame graph of each camera's view of one room.

    `timers` outlive the graphs, so the caller passes them in. `checks` is as for `Graph`.
    """
    graph = Graph(gpu, timers, checks=checks)
    buffers: list[PictureBuffers] = []
    resources: list[FrameResources] = []
    made: list[FrameGraph] = []
    try:
        for number, view in enumerate(views):
            with graph.of_view(number):
                buffers.append(PictureBuffers(gpu, view, keeps_world=method.keeps_world))
                graph.own(buffers[-1])
                resources.append(declare_frame(graph, buffers[-1]))
        parts = zip(buffers, join_measurements(graph, resources, views), strict=True)
        for number, (held, measured) in enumerate(parts):
            with graph.of_view(number):
                made.append(FrameGraph(graph, held, measured, method, precomputed))
    except BaseException:
        graph.release()
        raise
    for each in made:
        each._all = tuple(made)
    return made
