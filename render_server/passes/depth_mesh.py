"""Triangles of a depth image: on the GPU what render_server/scene/depth_mesh.py does in numpy."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Kernel
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.depth_fit import DepthFit
from deltalight.render_server.passes.gbuffer import MeshBuffers
from deltalight.render_server.scene.depth_mesh import node_rays, stride_for_budget
from deltalight.render_server.scene.depth_surface import jump_terms
from deltalight.render_server.scene.triangle_mesh import GpuMesh


class _PixelGrid:
    """Textures at the pixels of a camera: depth and what is fitted to it, grazing surfaces, rays."""

    def __init__(self, gpu: GpuContext, camera: CameraModel) -> None:
        size = camera.width, camera.height
        self.camera = camera
        self._grazing = texture_2d(gpu, size, 1, "f4")
        self._rays = texture_2d(gpu, size, 2, "f4", data=camera.rays().astype(np.float32).tobytes())
        self._fit = DepthFit(gpu, size)

    def take(self, depth: DepthImage, grazing: Callable[[], Float32[np.ndarray, "h w"]]) -> "_Taken":
        fitted, oblique = self._fit.take(depth, self.camera), grazing()
        has_grazing = bool(oblique.any())
        if has_grazing:
            self._grazing.write(oblique, alignment=1)
        read: dict[str, Binding] = {
            **fitted,
            "picture_rays": self._rays,
            "grazing_depth": self._grazing,
            "GRAZING": has_grazing,
        }
        return _Taken(depth, fitted, read, jump_terms(depth, self.camera))

    def release(self) -> None:
        release_all(self._grazing, self._rays, self._fit)


class _NodeGrid:
    """Textures at the nodes of a mesh, one for each cell of stride x stride pixels."""

    def __init__(self, gpu: GpuContext, camera: CameraModel, stride: int) -> None:
        _, rays = node_rays(camera, stride)
        _, rows, columns = rays.shape
        self.size, self.stride = (columns, rows), stride
        self.quads = columns - 1, rows - 1
        texels = np.ascontiguousarray(rays.transpose(1, 2, 0)).tobytes()
        self.rays = texture_2d(gpu, self.size, 2, "f4", data=texels)
        self.nodes = texture_2d(gpu, self.size, 2, "f4")

    def release(self) -> None:
        release_all(self.rays, self.nodes)


@dataclass(frozen=True, eq=False)
class _Taken:
    """A depth image that was taken: what is fitted to it, what depth_nodes reads, its jump threshold by pixel."""

    depth: DepthImage
    fitted: dict[str, Binding]
    bindings: dict[str, Binding]
    jump_terms: tuple[float, float]


class DepthMesher:
    """Makes triangles of one depth image at a time, as scene/depth_mesh.py does, without a wait for the GPU.

    Buffers have room for every node and triangle that could be; triangles that are not there have no area.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._make_nodes, self._make_triangles = Kernel(gpu, "depth_nodes"), Kernel(gpu, "depth_triangles")
        self._pixels: _PixelGrid | None = None
        self._grids: dict[int, _NodeGrid] = {}
        self._taken: _Taken | None = None

    def take(
        self, depth: DepthImage, camera: CameraModel, grazing: Callable[[], Float32[np.ndarray, "h w"]]
    ) -> None:
        """Takes a clean depth image, registered to `camera`, and the inverse depth of its grazing surfaces.

        `grazing` is asked for that once the GPU is at work.

        Raises:
            DeltalightError: depth and camera differ in size.
        """
        if depth.depth_m.shape != (camera.height, camera.width):
            raise DeltalightError("the depth image and its camera differ in size; correct the calibration.")
        if self._pixels is None or self._pixels.camera != camera:
            self._forget_camera()
            self._pixels = _PixelGrid(self._gpu, camera)
        self._taken = None
        self._taken = self._pixels.take(depth, grazing)

    def fitted(self, depth: DepthImage) -> dict[str, Binding] | None:
        """Returns what DepthFit found in a depth image if it was the last to be taken, until the next one is."""
        if self._pixels is None or self._taken is None or self._taken.depth is not depth:
            return None
        return self._taken.fitted if self._pixels.camera == depth.camera else None

    def fill(
        self,
        buffers: MeshBuffers,
        world_from_camera: Float64[np.ndarray, "4 4"],
        triangle_budget: int,
        materials: GpuMesh,
    ) -> None:
        """Writes the triangles of the depth image that was taken, within a budget; `materials`: their only one."""
        assert self._pixels is not None
        assert self._taken is not None
        grid = self._grid(self._pixels.camera, triangle_budget)
        quads = grid.quads[0] * grid.quads[1]
        buffers.reserve(grid.size[0] * grid.size[1], 2 * quads, materials)
        self._make_nodes.run(
            grid.size,
            self._taken.bindings,
            buffers.solid,
            node_rays=grid.rays,
            nodes_out=grid.nodes,
            stride=grid.stride,
            world_from_camera=world_from_camera,
        )
        slope, least = self._taken.jump_terms
        self._make_triangles.run(
            grid.quads, buffers.solid, nodes=grid.nodes, node_threshold=(grid.stride * slope, least)
        )

    def _grid(self, camera: CameraModel, triangle_budget: int) -> _NodeGrid:
        stride = stride_for_budget(camera.width, camera.height, triangle_budget)
        if stride not in self._grids:
            self._grids[stride] = _NodeGrid(self._gpu, camera, stride)
        return self._grids[stride]

    def _forget_camera(self) -> None:
        release_all(self._pixels, *self._grids.values())
        self._pixels, self._taken = None, None
        self._grids.clear()

    def release(self) -> None:
        """Frees the GL objects."""
        self._forget_camera()
        release_all(self._make_nodes, self._make_triangles)
