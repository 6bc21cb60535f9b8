"""Pixel coverage of the virtual objects, and antialiasing and unmixing of the edges around it."""

import math

import moderngl

from deltalight.render_server.gpu.clearing import clear_buffer
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import LIST_HEADER_BYTES, MOST_WALKERS, list_threads
from deltalight.render_server.gpu.textures import release_all, release_target, texture_2d
from deltalight.render_server.passes.gbuffer import (
    TRIANGLE_BYTES,
    GeometryBuffer,
    MeshBuffers,
    RasterGeometry,
)
from deltalight.render_server.view import CameraView, Rectangle

# Sample positions in 1/16 pixels from the pixel's centre, nearest first. Of all patterns of eight with one sample in
# each column and row of eighths (an upright edge is exact to 1/16) this one has the least worst-case error for an
# edge at any angle and position: 0.17 of a pixel, 0.06 r.m.s. It is point symmetric.
PATTERN_8 = ((-3, 1), (3, -1), (1, 5), (-1, -5), (-5, -3), (5, 3), (-7, 7), (7, -7))
# Rotated by a quarter turn each: one sample in each column and row of quarters.
PATTERN_4 = ((-2, -6), (6, -2), (2, 6), (-6, 2))
PATTERNS = {len(pattern): pattern for pattern in (PATTERN_4, PATTERN_8)}
STEPS = 16
TILE = 2  # texels an edge, as in shaders/common/raster_tiles.glsl
RIM_SIGHT = 6
"""Pixels within which an edge pixel finds both the real thing and the background unmixed.

Behind the two pixels that may be mixed there are four more on either side.
"""
SURFACE_REACH = 22
"""Pixels within which the surface that represents a mixed pixel may lie: half floats hold so many offsets exactly."""


class EdgeTriangles:
    """The triangles of a mesh that may show in marked tiles of a raster, in its order; a `Drawable`."""

    def __init__(self, gpu: GpuContext, raster: tuple[int, int]) -> None:
        self._gpu, self._raster = gpu, raster
        self.tiles = gpu.ctx.buffer(reserve=4 * math.prod(-(-edge // TILE) for edge in raster))
        self.indices = gpu.ctx.buffer(reserve=4)
        self._thin = Kernel(gpu, "edge_triangles", FIND_THIN=1)
        self._chosen = Kernel(gpu, "edge_triangles")
        self._mesh: MeshBuffers | None = None

    @property
    def bindings(self) -> dict[str, Binding]:
        """The tiles, for what marks and reads them."""
        return {"Tiles": self.tiles, "raster_size": self._raster}

    @property
    def triangle_count(self) -> int:
        """Triangles that are drawn, those that are left out among them."""
        return 0 if self._mesh is None else self._mesh.triangle_count

    def clear(self) -> None:
        """Marks no tile."""
        clear_buffer(self._gpu, self.tiles)

    def find_thin(self, mesh: MeshBuffers, view: CameraView, raster: GeometryBuffer, scene: Bindings) -> None:
        """Marks the tiles with triangles of `mesh` that may lie between the samples that `raster` has."""
        self._run(self._thin, mesh, view, scene, raster.bindings)

    def choose(self, mesh: MeshBuffers, view: CameraView, scene: Bindings) -> None:
        """Takes the triangles of `mesh` for the tiles that are marked."""
        self._mesh, needed = mesh, TRIANGLE_BYTES * mesh.triangle_count
        if self.indices.size < needed:
            self.indices.orphan(needed)
        self._run(self._chosen, mesh, view, scene, {"EdgeIndices": self.indices})

    def _run(
        self, kernel: Kernel, mesh: MeshBuffers, view: CameraView, scene: Bindings, more: Bindings
    ) -> None:
        if not mesh.triangle_count:
            return
        kernel.run(
            (min(mesh.triangle_count, MOST_WALKERS),),
            scene,
            mesh.solid,
            self.bindings,
            more,
            clip_from_camera=view.clip_from_camera_at((0.0, 0.0)),
            triangle_count=mesh.triangle_count,
            behind=0.0,
        )

    def draw(self, program: moderngl.Program) -> None:
        """Draws them with `program`."""
        assert self._mesh is not None
        self._mesh.draw(program, self.indices)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.tiles, self.indices, self._thin, self._chosen)


class SampleCoverage:
    """Draws the objects once per sample and gathers what the picture's pixels see through the lens.

    After the first sample, only the pixels that may differ between samples, and what may show in them. All rasters
    share one buffer, so memory does not grow with the number of samples. `surface` is the geometry buffer on the
    picture's grid; `texture` (RGBA16F) holds the fraction in front of the real surface, the fraction behind it, and
    that fraction times its mean depth; `second_surface` (RGBA32F) the position and fraction of samples that show
    another surface than `surface`; `pixels` lists those with more than one sample.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], raster: tuple[int, int], samples: int) -> None:
        self._gpu, self._pattern = gpu, PATTERNS[samples]
        self.surface = GeometryBuffer(gpu, size)
        self.texture = texture_2d(gpu, size, 4, "f2")
        self.second_surface = texture_2d(gpu, size, 4, "f4")
        self._sums = gpu.ctx.framebuffer([self.texture, self.second_surface])
        self._filled: Rectangle = (0, 0, *size)  # what may hold anything
        self.pixels = gpu.ctx.buffer(reserve=LIST_HEADER_BYTES + 4 * math.prod(size))
        self._threads = list_threads(gpu, math.prod(size))
        self.triangles = EdgeTriangles(gpu, raster)
        self._first = Kernel(gpu, "sample_coverage", FIRST=1)
        self._further = Kernel(gpu, "sample_coverage")

    def run(
        self,
        geometry: RasterGeometry,
        raster: GeometryBuffer,
        mesh: MeshBuffers,
        *,
        view: CameraView,
        rectangles: tuple[Rectangle, Rectangle],
        scene: Bindings,
    ) -> None:
        """Fills the textures in the first of the `rectangles` (picture, raster).

        `scene` brings the camera of `view`, which looks at `raster` through the lens: not `with_antialiasing`.
        """
        in_picture, in_raster = rectangles
        self._clear(in_picture)
        for number, (x, y) in enumerate(self._pattern):
            offset = (x / STEPS, y / STEPS)
            geometry.run(
                raster,
                self.triangles if number else mesh,
                view,
                scene,
                offset=offset,
                rectangle=in_raster,
                sample=number / len(self._pattern),
                sample_coverage=self.texture,
            )
            own = self._sampled(offset, in_picture, in_raster)
            if number:
                self._further.run((self._threads,), raster.bindings, scene, own)
            else:
                self.triangles.find_thin(mesh, view, raster, scene)
                self._first.run(in_picture[2:], raster.bindings, scene, own, self.triangles.bindings)
                self.triangles.choose(mesh, view, scene)

    def _sampled(
        self, offset: tuple[float, float], in_picture: Rectangle, in_raster: Rectangle
    ) -> dict[str, Binding]:
        return {
            "position_out": self.surface.position,
            "normal_out": self.surface.normal,
            "uv_out": self.surface.uv,
            "tint_out": self.surface.tint,
            "sample_coverage": self.texture,
            "second_surface": self.second_surface,
            "Texels": self.pixels,
            "rectangle": in_picture,
            "raster_rectangle": in_raster,
            "offset": offset,
            "weight": 1.0 / len(self._pattern),
        }

    def _clear(self, rectangle: Rectangle) -> None:
        """Clears what was filled before and what will be, and the list of pixels."""
        for each in (self._filled, rectangle):
            self.surface.clear(each)
            self._sums.use()
            self._sums.clear(viewport=each)
        self._filled = rectangle
        self._gpu.clear_start(self.pixels, LIST_HEADER_BYTES)
        self.triangles.clear()

    def release(self) -> None:
        """Frees the GL objects."""
        release_target(self._sums)
        release_all(self.surface, self.texture, self.second_surface, self.pixels, self.triangles)
        release_all(self._first, self._further)


class ObjectCoverage:
    """Fraction of each pixel that shows an object (R16F); a work list of the pixels at `edges` of real things."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._gpu = gpu
        self.texture = texture_2d(gpu, size, 1, "f2")
        self._target = gpu.ctx.framebuffer([self.texture])
        self.edges = gpu.ctx.buffer(bytes(4 * (1 + size[0] * size[1])))
        self._kernel = Kernel(gpu, "object_coverage")

    def run(
        self, rectangle: Rectangle, scene: Bindings, sample_coverage: moderngl.Texture | None = None
    ) -> None:
        """Compares depths within `rectangle`, and softens the result along edges of the picture.

        `sample_coverage` is the texture of `SampleCoverage`; None: the geometry buffer has one sample per pixel.
        """
        self._target.use()
        self._target.clear()
        self._gpu.clear_start(self.edges, LIST_HEADER_BYTES)
        x, y, width, height = rectangle
        if width <= 0 or height <= 0:
            return
        self._kernel.run(
            (width, height),
            scene,
            first_pixel=(x, y),
            sample_coverage=sample_coverage,
            antialiased=sample_coverage is not None,
            object_coverage_out=self.texture,
            Texels=self.edges,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_target(self._target)
        release_all(self.texture, self.edges, self._kernel)


class EdgeUnmixing:
    """Unmixes pixels at the edge of a real thing in front of an object.

    Corrects the objects' coverage by the fraction of the pixel that the thing fills. `texture` (RGBA16F) removes the
    old background from a pixel's radiance, and says which pixel shows the thing's surface.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._threads = list_threads(gpu)
        self.texture = texture_2d(gpu, size, 4, "f2")
        self._target = gpu.ctx.framebuffer(color_attachments=[self.texture])
        self._kernel = Kernel(gpu, "edge_unmixing", RIM_SIGHT=RIM_SIGHT, SURFACE_REACH=SURFACE_REACH)

    def run(
        self, coverage: ObjectCoverage, scene: Bindings, sample_coverage: moderngl.Texture | None = None
    ) -> None:
        """Unmixes the pixels that `coverage` listed; pass the other arguments as to it."""
        self._target.use()
        self._target.clear()
        self._kernel.run(
            (self._threads,),
            scene,
            sample_coverage=sample_coverage,
            antialiased=sample_coverage is not None,
            object_coverage=coverage.texture,
            edge_correction=self.texture,
            Texels=coverage.edges,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_target(self._target)
        release_all(self.texture, self._kernel)


class InteriorEdgeAA:
    """Antialiases edges between objects.

    `radiance` (RGBA16F) is the objects' light, mixed where a pixel's samples show two surfaces.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.radiance = texture_2d(gpu, size, 4, "f2")
        self._kernel = Kernel(gpu, "interior_edge_aa")

    def run(self, radiance: moderngl.Texture, coverage: SampleCoverage, rectangle: Rectangle) -> None:
        """Mixes `radiance`, which was shaded at one representative sample per pixel."""
        self._kernel.run(
            rectangle[2:],
            coverage.surface.bindings,
            radiance=radiance,
            sample_coverage=coverage.texture,
            second_surface=coverage.second_surface,
            radiance_out=self.radiance,
            rectangle=rectangle,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.radiance, self._kernel)
