"""Triangles of depth images: on the GPU what render_server/scene/depth_mesh.py does in numpy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import moderngl
import numpy as np
from jaxtyping import Float32

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.depth_fit import DepthFit
from deltalight.render_server.passes.depth_views import DepthViewLayers, FittedDepth
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.scene.depth_mesh import node_rays, stride_for_budget
from deltalight.render_server.scene.depth_surface import jump_terms
from deltalight.render_server.scene.triangle_mesh import GpuMesh
from deltalight.render_server.view import CameraView


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """A clean depth image and the view that it was taken from, to which it is registered.

    `grazing` returns the inverse depth of its grazing surfaces (`grazing_depth_fill`).

    Raises:
        DeltalightError: depth and camera differ in size.
    """

    depth: DepthImage
    view: CameraView
    grazing: Callable[[], Float32[np.ndarray, "h w"]]

    def __post_init__(self) -> None:
        if self.depth.depth_m.shape != (self.view.camera.height, self.view.camera.width):
            raise DeltalightError("the depth image and its camera differ in size; correct the calibration.")

    @cached_property
    def jump_terms(self) -> tuple[float, float]:
        """The terms of `jump_threshold`, by pixel."""
        return jump_terms(self.depth, self.view.camera)

    def stride(self, triangle_budget: int) -> int:
        """Returns the pixels of a cell of its mesh within a budget."""
        return stride_for_budget(*self.view.size, triangle_budget)


class _NodeGrid:
    """Textures at the nodes of a mesh, one for each cell of stride x stride pixels."""

    def __init__(self, gpu: GpuContext, camera: CameraModel, stride: int) -> None:
        _, rays = node_rays(camera, stride)
        _, rows, columns = rays.shape
        self.size, self.stride = (columns, rows), stride
        self.quads = columns - 1, rows - 1
        texels = np.ascontiguousarray(rays.transpose(1, 2, 0)).tobytes()
        self.rays = texture_2d(gpu, self.size, 2, "f4", data=texels)
        self.nodes = texture_2d(gpu, self.size, 4, "f4")

    @property
    def node_count(self) -> int:
        """How many vertices there are."""
        return int(self.size[0] * self.size[1])

    @property
    def triangle_count(self) -> int:
        """How many triangles there could be."""
        return int(2 * self.quads[0] * self.quads[1])

    def release(self) -> None:
        release_all(self.rays, self.nodes)


class _CameraTextures:
    """Textures at the pixels of one camera, depth and what is fitted to it among them, and at its meshes' nodes."""

    def __init__(self, gpu: GpuContext, camera: CameraModel) -> None:
        self._gpu = gpu
        size = camera.width, camera.height
        self.camera = camera
        self._grazing = texture_2d(gpu, size, 1, "f4")
        self._rays = texture_2d(gpu, size, 2, "f4", data=camera.rays().astype(np.float32).tobytes())
        self._fit = DepthFit(gpu, size)
        self._grids: dict[int, _NodeGrid] = {}
        self._taken: DepthImage | None = None
        self.fitted: dict[str, Binding] = {}
        self._is_grazing: bool | None = None

    def take(self, depth: DepthImage) -> None:
        self._taken, self._is_grazing = None, None
        self.fitted = self._fit.take(depth, self.camera)
        self._taken = depth

    def holds(self, depth: DepthImage) -> bool:
        return self._taken is depth and self.camera == depth.camera

    def grid(self, stride: int) -> _NodeGrid:
        if stride not in self._grids:
            self._grids[stride] = _NodeGrid(self._gpu, self.camera, stride)
        return self._grids[stride]

    @property
    def pixels(self) -> dict[str, Binding]:
        """What is fitted, and the pixels' rays."""
        return {**self.fitted, "picture_rays": self._rays}

    def with_grazing(self, grazing: Callable[[], Float32[np.ndarray, "h w"]]) -> dict[str, Binding]:
        """Returns what depth_nodes reads; uploads the grazing surfaces once they are asked for."""
        if self._is_grazing is None:
            oblique = grazing()
            self._is_grazing = bool(oblique.any())
            if self._is_grazing:
                self._grazing.write(oblique, alignment=1)
        return {**self.pixels, "grazing_depth": self._grazing, "GRAZING": self._is_grazing}

    def release(self) -> None:
        release_all(self._grazing, self._rays, self._fit, *self._grids.values())


class DepthMesher:
    """Makes triangles of the depth images that a room's cameras took at one moment, without a wait for the GPU.

    Of each as scene/depth_mesh.py does; of several, those stay that scene/depth_views.py keeps. Buffers have room for
    every node and triangle that could be, one camera's after the other's; triangles that are not there have no area.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._make_nodes, self._make_triangles = Kernel(gpu, "depth_nodes"), Kernel(gpu, "depth_triangles")
        self._cameras: list[_CameraTextures] = []
        self._views: DepthViewLayers | None = None
        self._frames: tuple[DepthFrame, ...] = ()
        self._budgets = 0, 0

    def take(self, frames: Sequence[DepthFrame], budgets: tuple[int, int]) -> None:
        """Takes the depth images of all cameras; `budgets`: how many triangles each may have, fine and coarse."""
        lenses = [each.view.camera for each in frames]
        if lenses != [each.camera for each in self._cameras]:
            self._set_cameras(lenses)
        self._frames, self._budgets = tuple(frames), budgets
        for camera, frame in zip(self._cameras, frames, strict=True):
            camera.take(frame.depth)
        if self._views is not None:
            self._views.write(
                [self._fitted(camera, each) for camera, each in zip(self._cameras, frames, strict=True)]
            )

    def _fitted(self, camera: _CameraTextures, frame: DepthFrame) -> FittedDepth:
        fine, coarse = (frame.stride(budget) for budget in self._budgets)
        return FittedDepth(frame.view, camera.pixels, frame.jump_terms, (fine, coarse))

    def _set_cameras(self, lenses: Sequence[CameraModel]) -> None:
        self._forget_cameras()
        self._cameras = [_CameraTextures(self._gpu, each) for each in lenses]
        self._views = DepthViewLayers(self._gpu, lenses) if len(lenses) > 1 else None

    def fitted(self, depth: DepthImage) -> dict[str, Binding] | None:
        """Returns what DepthFit found in a depth image if it is among those taken last, until the next are."""
        return next((camera.fitted for camera in self._cameras if camera.holds(depth)), None)

    def fill(self, buffers: MeshBuffers, materials: GpuMesh, *, coarse: bool = False) -> None:
        """Writes the triangles of the depth images that were taken; `materials`: their only one."""
        strides = [each.stride(self._budgets[coarse]) for each in self._frames]
        grids = [camera.grid(stride) for camera, stride in zip(self._cameras, strides, strict=True)]
        nodes, triangles = (
            [getattr(grid, name) for grid in grids] for name in ("node_count", "triangle_count")
        )
        buffers.reserve(sum(nodes), sum(triangles), materials)
        for number, grid in enumerate(grids):
            place: Bindings = {
                "first_vertex": sum(nodes[:number]),
                "first_triangle": sum(triangles[:number]),
                "depth_view_number": number,
                "coarseness": int(coarse),
            }
            self._write(buffers, number, grid, place)

    def _write(self, buffers: MeshBuffers, number: int, grid: _NodeGrid, place: Bindings) -> None:
        """Writes one camera's triangles."""
        camera, frame = self._cameras[number], self._frames[number]
        slope, least = frame.jump_terms
        self._make_nodes.run(
            grid.size,
            camera.with_grazing(frame.grazing),
            {"SEVERAL_DEPTHS": False} if self._views is None else self._views.bindings,
            buffers.solid,
            place,
            node_rays=grid.rays,
            nodes_out=grid.nodes,
            stride=grid.stride,
            world_from_camera=frame.view.world_from_camera,
        )
        self._make_triangles.run(
            grid.quads,
            buffers.solid,
            place,
            nodes=grid.nodes,
            node_threshold=(grid.stride * slope, least),
        )

    def backs_of(self, mesh: MeshBuffers, behind_m: float) -> Callable[[moderngl.Buffer], None] | None:
        """Returns what lists the triangles that have backs (DepthViewLayers); None with one camera: all have."""
        return None if self._views is None else self._views.backs_of(mesh, behind_m)

    def _forget_cameras(self) -> None:
        release_all(*self._cameras, self._views)
        self._cameras, self._views, self._frames = [], None, ()

    def release(self) -> None:
        """Frees the GL objects."""
        self._forget_cameras()
        release_all(self._make_nodes, self._make_triangles)
