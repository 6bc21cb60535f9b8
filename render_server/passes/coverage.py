"""Pixel coverage of the virtual objects, and antialiasing and unmixing of the edges around it."""

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings, Kernel
from deltalight.render_server.gpu.list_groups import LIST_HEADER_BYTES, list_threads
from deltalight.render_server.gpu.textures import release_all, release_target, texture_2d
from deltalight.render_server.passes.gbuffer import GeometryBuffer, MeshBuffers, RasterGeometry
from deltalight.render_server.view import CameraView, Rectangle

# Sample positions in 1/16 pixels from the pixel's centre, nearest first. Of all patterns of eight with one sample in
# each column and row of eighths (an upright edge is exact to 1/16) this one has the least worst-case error for an
# edge at any angle and position: 0.17 of a pixel, 0.06 r.m.s. It is point symmetric.
PATTERN_8 = ((-3, 1), (3, -1), (1, 5), (-1, -5), (-5, -3), (5, 3), (-7, 7), (7, -7))
# Rotated by a quarter turn each: one sample in each column and row of quarters.
PATTERN_4 = ((-2, -6), (6, -2), (2, 6), (-6, 2))
PATTERNS = {len(pattern): pattern for pattern in (PATTERN_4, PATTERN_8)}
STEPS = 16
RIM_SIGHT = 6
"""Pixels within which an edge pixel finds both the real thing and the background unmixed.

Behind the two pixels that may be mixed there are four more on either side.
"""
SURFACE_REACH = 22
"""Pixels within which the surface that represents a mixed pixel may lie: half floats hold so many offsets exactly."""


class SampleCoverage:
    """Draws the objects once per sample and gathers what the picture's pixels see through the lens.

    All rasters share one buffer, so memory does not grow with the number of samples, unlike vertex work. `surface` is
    the geometry buffer on the picture's grid; `texture` (RGBA16F) holds the fraction in front of the real surface,
    the fraction behind it, and that fraction times its mean depth; `second_surface` (RGBA32F) the position and
    fraction of samples that show another surface than `surface`.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], samples: int) -> None:
        self._pattern = PATTERNS[samples]
        self.surface = GeometryBuffer(gpu, size)
        self.texture = texture_2d(gpu, size, 4, "f2")
        self.second_surface = texture_2d(gpu, size, 4, "f4")
        self._sums = gpu.ctx.framebuffer([self.texture, self.second_surface])
        self._filled: Rectangle = (0, 0, *size)  # what may hold anything
        self._kernel = Kernel(gpu, "sample_coverage")

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
                mesh,
                view,
                scene,
                offset=offset,
                rectangle=in_raster,
                sample=number / len(self._pattern),
                sample_coverage=self.texture,
            )
            self._kernel.run(
                in_picture[2:],
                raster.bindings,
                scene,
                position_out=self.surface.position,
                normal_out=self.surface.normal,
                uv_out=self.surface.uv,
                tint_out=self.surface.tint,
                sample_coverage=self.texture,
                second_surface=self.second_surface,
                rectangle=in_picture,
                raster_rectangle=in_raster,
                offset=offset,
                weight=1.0 / len(self._pattern),
            )

    def _clear(self, rectangle: Rectangle) -> None:
        """Clears what was filled before and what will be."""
        for each in (self._filled, rectangle):
            self.surface.clear(each)
            self._sums.use()
            self._sums.clear(viewport=each)
        self._filled = rectangle

    def release(self) -> None:
        """Frees the GL objects."""
        release_target(self._sums)
        release_all(self.surface, self.texture, self.second_surface, self._kernel)


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
