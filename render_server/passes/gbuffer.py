"""Geometry buffers: what a camera sees of a mesh at each texel of a raster."""

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.raster_kernel import Drawable, RasterKernel
from deltalight.render_server.gpu.textures import release_all, release_target, texture_2d
from deltalight.render_server.view import CameraView, Rectangle


class GeometryBuffer:
    """World position + depth (RGBA32F, w = 0: nothing), normal + material (RGBA16F), uv, vertex colour.

    Of materials with maps, what these give stands in place of uv and vertex colour (common/shown_maps.glsl), and
    `extended` (RGBA32UI) holds what they give of coats, sheens, reflectance and transmission, if any has those.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.size = size
        self.position = texture_2d(gpu, size, 4, "f4")
        self.normal = texture_2d(gpu, size, 4, "f2")
        self.uv = texture_2d(gpu, size, 2, "f4")
        self.tint = texture_2d(gpu, size, 4, "f1")
        self._depth = gpu.ctx.depth_renderbuffer(size)
        self.framebuffer = gpu.ctx.framebuffer([self.position, self.normal, self.uv, self.tint], self._depth)
        self._places = gpu.ctx.framebuffer([self.position], self._depth)
        self._gpu = gpu
        self.extended: moderngl.Texture | None = None
        self._with_extended: moderngl.Framebuffer | None = None

    @property
    def bindings(self) -> dict[str, Binding]:
        """Its textures by GLSL name."""
        return {
            "virtual_raster_position": self.position,
            "virtual_raster_normal": self.normal,
            "virtual_raster_uv": self.uv,
            "virtual_raster_tint": self.tint,
            "virtual_raster_extended": self.extended,
        }

    def with_extended(self) -> moderngl.Framebuffer:
        """Returns its framebuffer with `extended`."""
        if self._with_extended is None:
            self.extended = texture_2d(self._gpu, self.size, 4, "u4")
            textures = [self.position, self.normal, self.uv, self.tint, self.extended]
            self._with_extended = self._gpu.ctx.framebuffer(textures, self._depth)
        return self._with_extended

    def clear(self) -> None:
        """Clears it."""
        self.framebuffer.use()  # a clear heeds the scissor of the framebuffer in use
        self.framebuffer.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)

    def clear_positions(self, rectangle: Rectangle) -> None:
        """Clears positions and depth in the `rectangle`; what else texels without a position hold is of before."""
        self._places.use()
        self._places.clear(0.0, 0.0, 0.0, 0.0, depth=1.0, viewport=rectangle)

    def release(self) -> None:
        """Frees the GL objects."""
        release_target(self.framebuffer)
        release_target(self._places)
        if self._with_extended is not None:
            release_target(self._with_extended)
        release_all(self._depth, self.position, self.normal, self.uv, self.tint, self.extended)


class RasterGeometry:
    """Rasters meshes into a geometry buffer."""

    def __init__(self, gpu: GpuContext) -> None:
        self._kernel = RasterKernel(gpu, "geometry_buffer")

    def run(
        self,
        target: GeometryBuffer,
        mesh: Drawable,
        view: CameraView,
        scene: Bindings,
        *,
        rectangle: Rectangle | None = None,
    ) -> None:
        """Draws `mesh` as `view` sees it at the texels' centres.

        `scene` brings the view's camera and the mesh's own materials. `rectangle` limits drawing to the texels that
        can show the mesh; the others keep their contents.
        """
        if rectangle is None:
            target.clear()
        else:
            target.clear_positions(rectangle)
        self._kernel.draw(
            target.with_extended() if scene["PACKS_EXTENDED"] else target.framebuffer,
            mesh,
            scene,
            clip_from_camera=view.clip_from_camera,
        )

    def release(self) -> None:
        """Frees the program."""
        self._kernel.release()
