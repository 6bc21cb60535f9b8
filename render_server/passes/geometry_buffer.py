"""Geometry buffer: meshes rastered from the camera (virtual objects, or a given model of the real scene)."""

from pathlib import Path

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import raster_program, set_uniforms
from render_server.gpu.textures import release_target, texture_2d
from render_server.passes.mesh_buffers import MeshBuffers
from render_server.view import CameraView, Rectangle


class GeometryBuffer:
    """World position + depth (RGBA32F, w = 0: nothing), normal + material (RGBA16F), uv, vertex colour."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._ctx = gpu.ctx
        self.size = size
        self.position = texture_2d(gpu, size, 4, "f4")
        self.normal = texture_2d(gpu, size, 4, "f2")
        self.uv = texture_2d(gpu, size, 2, "f4")
        self.tint = texture_2d(gpu, size, 4, "f1")
        self._depth = gpu.ctx.depth_renderbuffer(size)
        self._target = gpu.ctx.framebuffer([self.position, self.normal, self.uv, self.tint], self._depth)

    def begin(self, rectangle: Rectangle | None = None) -> None:
        """Make this the raster target, emptied (only in the `rectangle`, if one is given)."""
        self._target.use()
        self._target.viewport = (0, 0, *self.size)
        self._target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0, viewport=rectangle)
        self._ctx.enable_only(moderngl.DEPTH_TEST)

    def release(self) -> None:
        """Free the GL objects."""
        release_target(self._target)
        for item in (self._depth, self.position, self.normal, self.uv, self.tint):
            item.release()


class GeometryPass:
    """Rasters meshes into a geometry buffer."""

    def __init__(self, gpu: GpuContext) -> None:
        self._program = raster_program(gpu, Path(__file__).with_name("geometry_buffer"))

    def run(
        self,
        target: GeometryBuffer,
        mesh: MeshBuffers,
        view: CameraView,
        offset: tuple[float, float] = (0.0, 0.0),
        rectangle: Rectangle | None = None,
    ) -> None:
        """Draw `mesh` as `view` sees it, `offset` pixels beside the texels' centres.

        `rectangle`: the texels that can show it; the others keep what they held.
        """
        target.begin(rectangle)
        clip_from_camera = view.clip_from_camera_at(offset)
        set_uniforms(self._program, {**view.uniforms(), "clip_from_camera": clip_from_camera})
        mesh.draw(self._program)

    def release(self) -> None:
        """Free the program."""
        self._program.release()
