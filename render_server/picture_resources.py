"""Textures and passes of one picture size that every method shares."""

from typing import Any

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext
from render_server.passes.coverage import CoveragePass
from render_server.passes.geometry_buffer import GeometryBuffer, GeometryPass
from render_server.passes.inner_edges import InnerEdgesPass
from render_server.passes.matte import MattePass
from render_server.passes.picture import Picture
from render_server.passes.real_surface import RealSurface
from render_server.passes.rims import RimsPass
from render_server.real_geometry import RealGeometry
from render_server.relight.frame import GeometryState
from render_server.scene.declared_surfaces import DIFFUSE_BOX, MAX_SURFACES, SurfaceTable
from render_server.view import CameraView, Rectangle


class PictureResources:
    """The picture, both geometry buffers and the matte."""

    def __init__(self, gpu: GpuContext, view: CameraView) -> None:
        size, raster_size = view.size, view.raster[1]
        self.key = (size, raster_size)
        self.picture = Picture(gpu, size)
        self.real_surface = RealSurface(gpu, size)
        self._raster = GeometryBuffer(gpu, raster_size)
        self.virtual_raster = self._raster
        self._coverage: CoveragePass | None = None
        self._inner_edges: InnerEdgesPass | None = None
        self._rectangle: Rectangle = 0, 0, 0, 0
        self._model_raster: GeometryBuffer | None = None
        self.matte = MattePass(gpu, size)
        self._rims = RimsPass(gpu, self.picture)
        self._geometry = GeometryPass(gpu)
        self._gpu = gpu
        self._rastered: object = None
        self._surfaces = gpu.ctx.buffer(reserve=MAX_SURFACES * 80 + 80)
        self.surface_uniforms: dict[str, Any] = {"surface_count": 0, "specular_surfaces": False}
        self.surface_table: SurfaceTable | None = None

    def declare_surfaces(self, table: SurfaceTable) -> None:
        """Take over the declared surfaces of the real scene."""
        self.surface_table = table
        if len(table):
            self._surfaces.write(np.ascontiguousarray(table.packed, np.float32).tobytes())
        specular = bool((table.packed[:, 3, 3] < DIFFUSE_BOX).any())
        self.surface_uniforms = {"surface_count": len(table), "specular_surfaces": specular}

    def rasterise(
        self,
        real: RealGeometry,
        virtual: GeometryState,
        view: CameraView,
        moved: bool,
        antialiasing: bool = False,
    ) -> None:
        """Real geometry buffer (if it `moved`), virtual raster and matte (if anything did).

        With `antialiasing` the virtual raster is on the picture's grid: passes need `view.with_antialiasing`.
        """
        self._surfaces.bind_to_storage_buffer(14)
        if moved:
            self._fill_real(real, view)
        key = (view, virtual.version, antialiasing)
        if not moved and key == self._rastered:
            return
        self._rastered = key
        virtual.materials.bind()
        self.real_surface.bind()
        if antialiasing:
            self._draw_samples(virtual, view, real.noise_sigma)
        else:
            self._draw_centres(virtual, view, real.noise_sigma)

    def _draw_centres(self, virtual: GeometryState, view: CameraView, noise_sigma: float) -> None:
        """Virtual raster and matte of one sample a pixel."""
        self.virtual_raster = self._raster
        self._geometry.run(self._raster, virtual.buffers, view)
        self._raster.position.use(location=6)
        self._raster.normal.use(location=7)
        self.picture.rays.use(location=15)
        rectangle = view.rectangle_around(virtual.points)
        uniforms = {**view.uniforms(), "noise_sigma": noise_sigma}
        self.matte.run(self.picture, rectangle, uniforms)
        self._rims.run(self.matte, uniforms)

    def _draw_samples(self, virtual: GeometryState, view: CameraView, noise_sigma: float) -> None:
        """The same of several samples a pixel."""
        if self._coverage is None:
            self._coverage = CoveragePass(self._gpu, view.size)
        coverage, rectangle = self._coverage, view.rectangle_around(virtual.points)
        self._rectangle = rectangle
        self.virtual_raster = coverage.surface
        rectangles = rectangle, view.raster_rectangle_around(virtual.points)
        coverage.run(
            self._geometry,
            self._raster,
            virtual.buffers,
            picture=self.picture,
            view=view,
            rectangles=rectangles,
            noise_sigma=noise_sigma,
        )
        self.virtual_raster.position.use(location=6)
        uniforms = {**view.with_antialiasing.uniforms(), "noise_sigma": noise_sigma}
        self.matte.run(self.picture, rectangle, uniforms, coverage.texture)
        self._rims.run(self.matte, uniforms, coverage.texture)

    def with_inner_edges(self, radiance: moderngl.Texture) -> moderngl.Texture:
        """The objects' shaded radiance with the edges before each other antialiased; after `rasterise` with it."""
        assert self._coverage is not None
        if self._inner_edges is None:
            self._inner_edges = InnerEdgesPass(self._gpu, self._coverage.surface.size)
        self._inner_edges.run(radiance, self._coverage, self._rectangle)
        return self._inner_edges.radiance

    def _fill_real(self, real: RealGeometry, view: CameraView) -> None:
        count = int(self.surface_uniforms["surface_count"])
        if not real.is_model:
            assert real.frame is not None
            assert real.frame.depth is not None
            assert real.surface is not None
            self.real_surface.from_depth(real.frame.depth, real.surface.normals, self.picture, view, count)
            if real.fused_tolerance is None:
                return
        if self._model_raster is None:
            self._model_raster = GeometryBuffer(self._gpu, self._raster.size)
        assert real.state is not None
        real.state.materials.bind()
        self._geometry.run(self._model_raster, real.state.buffers, view)
        self.real_surface.from_model(
            self._model_raster, self.picture, view, count, tolerance=real.fused_tolerance
        )

    def release(self) -> None:
        """Free the GL objects."""
        for item in (
            self._rims,
            self.picture,
            self.real_surface,
            self._raster,
            self._coverage,
            self._inner_edges,
            self._model_raster,
            self.matte,
            self._geometry,
            self._surfaces,
        ):
            if item is not None:
                item.release()
