"""The resources of one frame that all methods share, and the stages that compute them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from deltalight.protocol.frames import DepthImage, ViewFrame
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.gpu.uniform_block import UniformBlock
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.passes.camera_image import CameraImage
from deltalight.render_server.passes.coverage import (
    ObjectCoverage,
    SampleCoverage,
)
from deltalight.render_server.passes.gbuffer import GeometryBuffer, RasterGeometry
from deltalight.render_server.passes.matting import Matting
from deltalight.render_server.passes.measured_views import MeasuredViews
from deltalight.render_server.passes.real_surface import RealSurface
from deltalight.render_server.passes.voxel_light import AlbedoTexture
from deltalight.render_server.scene.declared_surfaces import MAX_ROWS, SurfaceTable, plane_fits
from deltalight.render_server.scene.depth_surface import DepthSurface
from deltalight.render_server.view import CameraBlock, CameraView, Rectangle

BIAS_SIGMAS = 3.0  # of depth noise: keeps real surfaces from shadowing themselves


@dataclass(frozen=True, eq=False)
class Scan:
    """The camera's measurement of the real scene, taken when something last moved.

    `depth` is None if the scene gives a model; `fitted` fits a surface to it, once; `on_gpu` returns what DepthFit
    found in it, None if it holds another. `noise_sigma` is the depth noise at 1 m (m, grows with z^2); `median_depth`
    waits for the median depth (m), which another thread finds. `tolerance` bounds the difference at which the fused
    surface still agrees with the depth (m, and m at 1 m); None if nothing is fused.
    """

    depth: DepthImage | None
    fitted: Callable[[], DepthSurface]
    on_gpu: Callable[[], dict[str, Binding] | None]
    noise_sigma: float
    median_depth: Callable[[], float]
    tolerance: tuple[float, float] | None

    @property
    def typical_depth(self) -> float:
        """The median depth, m."""
        return self.median_depth()

    @property
    def bias_m(self) -> float:
        """Offset of real surfaces against self-shadowing, m."""
        return BIAS_SIGMAS * self.noise_sigma * self.typical_depth**2


@dataclass(frozen=True, eq=False)
class Observation:
    """The camera's image and the visible real surfaces, with the shader bindings of both."""

    image: CameraImage
    surface: RealSurface
    scan: Scan
    view: CameraView
    bindings: dict[str, Binding]


@dataclass(frozen=True, eq=False)
class Measurement:
    """What the camera saw when the real scene's geometry was last built from it."""

    frame: ViewFrame
    view: CameraView
    scan: Scan


@dataclass(frozen=True, eq=False)
class ObjectSurface:
    """The objects as the camera sees them: their geometry buffer and how much of each pixel they cover.

    `samples` are the samples that an antialiased geometry buffer was resolved from;
    `rectangle` encloses the objects.
    """

    buffer: GeometryBuffer
    coverage: ObjectCoverage
    samples: SampleCoverage | None
    rectangle: Rectangle


@dataclass(frozen=True, eq=False)
class FrameResources:
    """Resources that every method's stages read. The renderer sets the sources.

    This module's stages compute the rest. `observation` changes only when something moved, so a new picture of a
    scene at rest relights nothing. `measured` is the observation that lights the real scene's voxels and maps: the
    same, or, where the world is kept while the camera moves, that of `measurement`; of several cameras in one room,
    the joint one of all (`join_measurements`), and `own_measured` this camera's part of it. `geometry` holds the
    bindings of both surfaces; `lit_area` requests light in a part of the picture, whatever the objects reach (for
    estimation).
    """

    image: Resource[CameraImage]
    view: Resource[CameraView]
    scan: Resource[Scan]
    measurement: Resource[Measurement] | None
    real: Resource[GeometryState]
    objects: Resource[GeometryState]
    surfaces: Resource[SurfaceTable]
    lights: Resource[LightSet]
    lit_area: Resource[Rectangle]
    albedo: Resource[AlbedoTexture]
    observation: Resource[Observation]
    measured: Resource[Observation]
    own_measured: Resource[Observation]
    object_surface: Resource[ObjectSurface]
    geometry: Resource[dict[str, Binding]]


class ObservationBuffers:
    """The camera's picture and the real surfaces that it shows, in textures of one picture size."""

    def __init__(self, gpu: GpuContext, view: CameraView, geometry: RasterGeometry) -> None:
        self._gpu, self._geometry = gpu, geometry
        self.image = CameraImage(gpu, view.size)
        self.real_surface = RealSurface(gpu, view.size)
        self._model_raster: GeometryBuffer | None = None
        self.camera = UniformBlock[CameraBlock](gpu, view.block())

    def set_camera(self, view: CameraView) -> CameraView:
        """Writes the camera's block."""
        self.camera.write(view.block())
        return view

    def observe(
        self, scan: Scan, real: GeometryState, view: CameraView, declared: Bindings, surfaces: SurfaceTable
    ) -> Observation:
        """Fills the real geometry buffer from depth, from the given model, or from both if depth is fused."""
        raster_scene: dict[str, Binding] = {
            "Camera": self.camera,
            "lens_distortion": view.without_antialiasing.raster_is_bent,
            **self.image.bindings,
            **declared,
            "noise_sigma": scan.noise_sigma,
            "plane_fits": plane_fits(
                surfaces, scan.depth, scan.fitted, view.world_from_camera, scan.noise_sigma
            ),
        }
        if scan.depth is not None:
            self.real_surface.from_depth(scan.depth, scan.fitted, raster_scene, on_gpu=scan.on_gpu())
        if scan.depth is None or scan.tolerance is not None:
            if self._model_raster is None:
                self._model_raster = GeometryBuffer(self._gpu, view.raster[1])
            own = {**raster_scene, **real.materials.bindings}
            self._geometry.run(self._model_raster, real.buffers, view.without_antialiasing, own)
            self.real_surface.from_model(self._model_raster, raster_scene, tolerance=scan.tolerance)
        bindings: dict[str, Binding] = {
            "Camera": self.camera,
            "lens_distortion": view.raster_is_bent,
            **self.image.bindings,
            **self.real_surface.bindings,
            **declared,
            "noise_sigma": scan.noise_sigma,
            "lens_bends": view.camera.has_distortion,
        }
        return Observation(self.image, self.real_surface, scan, view, bindings)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.image, self.real_surface, self._model_raster, self.camera)


class PictureBuffers:
    """Textures and kernels of one picture size that every method shares.

    `measured`: where the world is kept, what lights it: a measurement that outlives the camera's motion.
    """

    def __init__(self, gpu: GpuContext, view: CameraView, *, keeps_world: bool) -> None:
        size, raster_size = view.size, view.raster[1]
        self.key = (size, raster_size)
        self._gpu = gpu
        self._geometry = RasterGeometry(gpu)
        self._observed = ObservationBuffers(gpu, view, self._geometry)
        self.measured = ObservationBuffers(gpu, view, self._geometry) if keeps_world else None
        self.coverage = ObjectCoverage(gpu, size)
        self._raster = GeometryBuffer(gpu, raster_size)
        self._samples: SampleCoverage | None = None
        self._matting: Matting | None = None
        self._surfaces = gpu.ctx.buffer(reserve=MAX_ROWS * 80)

    @property
    def image(self) -> CameraImage:
        """The newest picture."""
        return self._observed.image

    def declare_surfaces(self, table: SurfaceTable) -> dict[str, Binding]:
        """Uploads the declared surfaces of the real scene; returns what shaders read of them."""
        if len(table):
            self._surfaces.write(np.ascontiguousarray(table.packed, np.float32).tobytes())
        return {
            "Surfaces": self._surfaces,
            "surface_count": len(table),
            "specular_surfaces": table.is_specular,
            "DECLARED_SURFACES": len(table) > 0,
        }

    def set_camera(self, view: CameraView) -> CameraView:
        """Writes the camera's block."""
        return self._observed.set_camera(view)

    def observe(
        self, scan: Scan, real: GeometryState, view: CameraView, declared: Bindings, surfaces: SurfaceTable
    ) -> Observation:
        """Fills the real geometry buffer from depth, from the given model, or from both if depth is fused."""
        return self._observed.observe(scan, real, view, declared, surfaces)

    def measure(
        self, taken: Measurement, real: GeometryState, declared: Bindings, surfaces: SurfaceTable
    ) -> Observation:
        """Fills the buffers of the measurement that lights the real scene."""
        assert self.measured is not None
        self.measured.image.upload(taken.frame)
        self.measured.image.linearize()
        self.measured.set_camera(taken.view)
        return self.measured.observe(taken.scan, real, taken.view, declared, surfaces)

    def draw_objects(self, objects: GeometryState, seen: Observation, view: CameraView) -> ObjectSurface:
        """Rasters the objects, computes their coverage of pixels, and unmixes the edges of real things."""
        rectangle = view.rectangle_around(objects.points)
        if view.antialiased:
            samples = self._draw_samples(objects, seen, view, rectangle)
            surface = ObjectSurface(samples.surface, self.coverage, samples, rectangle)
        else:
            scene = {**seen.bindings, **objects.materials.bindings}
            self._geometry.run(self._raster, objects.buffers, view, scene)
            surface = ObjectSurface(self._raster, self.coverage, None, rectangle)
        scene = {**seen.bindings, **surface.buffer.bindings}
        self.coverage.run(rectangle, scene, surface.samples)
        if view.matting_px:
            if self._matting is None:
                self._matting = Matting(self._gpu, view.size, averages=self.measured is not None)
            self._matting.run(
                self.coverage,
                view.matting_px,
                rectangle=rectangle,
                scene=scene,
                sample_coverage=None if surface.samples is None else surface.samples.texture,
            )
        return surface

    def _draw_samples(
        self, objects: GeometryState, seen: Observation, view: CameraView, rectangle: Rectangle
    ) -> SampleCoverage:
        """Draws several samples per pixel and resolves them into one surface."""
        if self._samples is None:
            self._samples = SampleCoverage(self._gpu, view.size, self._raster.size)
        plain = view.without_antialiasing
        self._samples.run(
            self._geometry,
            self._raster,
            objects.buffers,
            view=plain,
            rectangles=(rectangle, plain.raster_rectangle_around(objects.points)),
            scene={
                **seen.bindings,
                **objects.materials.bindings,
                "lens_distortion": plain.raster_is_bent,
            },
        )
        return self._samples

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(
            self._matting,
            self._observed,
            self.measured,
            self.coverage,
            self._raster,
            self._samples,
            self._geometry,
            self._surfaces,
        )


def declare_frame(graph: Graph, buffers: PictureBuffers) -> FrameResources:
    """Declares the sources of a frame and the stages that precede every method's own."""
    image = graph.source("camera image", "view")
    view = graph.source("view", "view")
    scan = graph.source("scan", "view")
    real = graph.source("real geometry", "world")
    objects = graph.source("object geometry", "objects")
    surfaces = graph.source("surface table", "scene")
    lights = graph.source("light set", "lights")
    lit_area = graph.source("lit area", "lights")
    albedo = graph.source("albedo", "world")
    graph.section("surfaces")
    declared = graph.value("declared surfaces", buffers.declare_surfaces, surfaces)
    camera = graph.value("camera", buffers.set_camera, view)
    observation = graph.stage("real surface", buffers.observe, scan, real, camera, declared, surfaces)
    measurement, measured = None, observation
    if buffers.measured is not None:
        measurement = graph.source("measurement", "world", of_each_view=True)
        measured = graph.stage("measured surface", buffers.measure, measurement, real, declared, surfaces)
    surface = graph.stage("object surface", buffers.draw_objects, objects, observation, camera)
    geometry = graph.value("geometry", _geometry_bindings, observation, surface, objects, measured)
    return FrameResources(
        image,
        view,
        scan,
        measurement,
        real,
        objects,
        surfaces,
        lights,
        lit_area,
        albedo,
        observation,
        measured,
        measured,
        surface,
        geometry,
    )


def join_measurements(
    graph: Graph, frames: Sequence[FrameResources], views: Sequence[CameraView]
) -> list[FrameResources]:
    """Declares the joint measurement of a room's cameras, from which its voxels and maps are lit."""
    if len(frames) == 1:
        return list(frames)
    joint = JointMeasurement(graph.gpu, [view.size for view in views])
    measured = graph.stage("measured views", joint.join, *(each.own_measured for each in frames))
    return [replace(each, measured=measured) for each in frames]


class JointMeasurement:
    """What all cameras of a room measure, as one observation: otherwise that of the first."""

    def __init__(self, gpu: GpuContext, sizes: Sequence[tuple[int, int]]) -> None:
        self._views = MeasuredViews(gpu, sizes)

    def join(self, *seen: Observation) -> Observation:
        """Copies the cameras' pictures and depths side by side; keeps the widest offset of real surfaces."""
        self._views.write([each.view for each in seen], [each.bindings for each in seen])
        scan = max((each.scan for each in seen), key=lambda each: each.bias_m)
        return replace(seen[0], scan=scan, bindings={**seen[0].bindings, **self._views.bindings})

    def release(self) -> None:
        """Frees the GL objects."""
        self._views.release()


def _geometry_bindings(
    seen: Observation, surface: ObjectSurface, objects: GeometryState, measured: Observation
) -> dict[str, Binding]:
    """Returns the shader bindings of both geometry buffers, and of the real surface that a kept world shows."""
    return {
        **seen.bindings,
        **surface.buffer.bindings,
        **objects.materials.bindings,
        "object_coverage": surface.coverage.texture,
        "edge_correction": surface.coverage.edge_correction,
        "interior_edges": surface.coverage.interior_edges,
        "KEEPS_WORLD": measured is not seen and measured.scan.depth is not None,
        "kept_position": measured.surface.position,
        "kept_normal": measured.surface.normal,
        "kept_camera_from_world": measured.view.camera_from_world,
    }
