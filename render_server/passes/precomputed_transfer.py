"""Light by precomputed transfer: dot products at the vertices, and a raster of them ([D] 4.3.1)."""

import moderngl
import numpy as np
from jaxtyping import Float64

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.raster_kernel import RasterKernel
from deltalight.render_server.gpu.textures import release_all, release_target, texture_2d
from deltalight.render_server.scene.precomputed_transfer import ObjectTransfer
from deltalight.render_server.view import CameraView

MOST_COEFFICIENTS = 16
_ATTRIBUTES = ("in_position", "in_normal")


class TransferMesh:
    """An object's vertices with their transfer, and the light there once a kernel computed it."""

    def __init__(self, gpu: GpuContext, made: ObjectTransfer) -> None:
        self._ctx = gpu.ctx
        self.vertex_count, self.coefficient_count, _ = made.transfer.shape
        self.triangle_count = len(made.triangles)
        rows = np.hstack([made.positions, made.normals]).astype(np.float32)
        self._vertices = gpu.ctx.buffer(rows.tobytes())
        self._transfer = gpu.ctx.buffer(np.ascontiguousarray(made.transfer).tobytes())
        self._indices = gpu.ctx.buffer(np.ascontiguousarray(made.triangles, np.int32).tobytes())
        self.light = gpu.ctx.buffer(reserve=16 * self.vertex_count)
        self._arrays: dict[int, moderngl.VertexArray] = {}

    @property
    def storage(self) -> dict[str, Binding]:
        """Vertices and transfer, for transfer_light.comp.glsl."""
        return {"TransferVertices": self._vertices, "Transfer": self._transfer}

    def draw(self, program: moderngl.Program) -> None:
        """Draws all triangles with `program`."""
        if program.glo not in self._arrays:
            layout = [(self._vertices, "3f 3f", *_ATTRIBUTES), (self.light, "4f", "in_light")]
            self._arrays[program.glo] = self._ctx.vertex_array(program, layout, self._indices)
        self._arrays[program.glo].render(moderngl.TRIANGLES)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(*self._arrays.values(), self._vertices, self._transfer, self._indices, self.light)


class TransferredLight:
    """The objects' light on their raster: irradiance and open fraction (RGBA16F), and where that is (RGBA32F)."""

    def __init__(self, gpu: GpuContext, raster_size: tuple[int, int]) -> None:
        self.light = texture_2d(gpu, raster_size, 4, "f2")
        self.position = texture_2d(gpu, raster_size, 4, "f4")
        self._depth = gpu.ctx.depth_renderbuffer(raster_size)
        self._target = gpu.ctx.framebuffer([self.light, self.position], self._depth)
        self._at_vertices = Kernel(gpu, "transfer_light")
        self._raster = RasterKernel(gpu, "transfer_raster")
        self.bindings: dict[str, Binding] = {}

    def begin(self, view: CameraView) -> None:
        """Clears the raster of what `view` sees."""
        self._target.use()
        self._target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        self.bindings = {
            "transferred_light": self.light,
            "transferred_position": self.position,
            "transfer_pinhole": tuple(view.raster[0]),
            "transfer_bends": view.camera.has_distortion,
        }

    def draw(
        self,
        mesh: TransferMesh,
        world_from_asset: Float64[np.ndarray, "4 4"],
        coefficients: Float64[np.ndarray, "k 3"],
        view: CameraView,
    ) -> None:
        """Lights an object's vertices (coefficients in the asset's frame) and adds it to the raster."""
        padded = np.zeros((MOST_COEFFICIENTS, 3), np.float32)
        padded[: len(coefficients)] = coefficients
        asset_from_world = np.linalg.inv(world_from_asset)
        viewer = asset_from_world[:3, :3] @ view.position + asset_from_world[:3, 3]
        own: Bindings = {
            "light_coefficients": padded,
            "coefficient_count": mesh.coefficient_count,
            "vertex_count": mesh.vertex_count,
            "viewer": tuple(viewer),
        }
        self._at_vertices.run((mesh.vertex_count,), own, mesh.storage, VertexLight=mesh.light)
        self._raster.draw(
            self._target,
            mesh,
            world_from_asset=world_from_asset,
            clip_from_world=view.clip_from_camera @ view.camera_from_world,
            viewer_position=tuple(view.position),
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_target(self._target)
        release_all(self._depth, self.light, self.position, self._at_vertices, self._raster)
