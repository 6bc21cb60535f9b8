"""Triangles of depth images: on the GPU what render_server/scene/depth_mesh.py does in numpy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

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
from deltalight.render_server.passes.voxelize import WriteChosen
from deltalight.render_server.scene.depth_mesh import node_rays, stride_for_budget
from deltalight.render_server.scene.depth_surface import jump_terms
from deltalight.render_server.scene.gpu_mesh import GpuMesh
from deltalight.render_server.view import CameraView

Strides = tuple[int, int]
"""Pixels of a cell of a fine mesh and of a coarse one, which is no less."""


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

    def strides(self, budgets: tuple[int, int]) -> Strides:
        """Returns the pixels of a cell of its meshes within their budgets, fine and coarse."""
        fine, coarse = (stride_for_budget(*self.view.size, each) for each in budgets)
        return fine, coarse


class _NodeGrids:
    """Textures at the nodes of both meshes of a depth image (shaders/common/node_grids.glsl)."""

    def __init__(self, gpu: GpuContext, camera: CameraModel, strides: Strides) -> None:
        fine, coarse = (node_rays(camera, stride)[1].transpose(1, 2, 0) for stride in strides)
        self.strides = strides
        self.sizes = fine.shape[1::-1], coarse.shape[1::-1]  # columns, rows
        rays = np.zeros((len(fine) + len(coarse), fine.shape[1], 2), np.float32)
        rays[: len(fine)] = fine
        rays[len(fine) :, : coarse.shape[1]] = coarse
        size = rays.shape[1], rays.shape[0]
        self.rays = texture_2d(gpu, size, 2, "f4", data=rays.tobytes())
        self.nodes = texture_2d(gpu, size, 4, "f4")

    @property
    def node_counts(self) -> tuple[int, int]:
        """How many vertices each has."""
        fine, coarse = (columns * rows for columns, rows in self.sizes)
        return fine, coarse

    @property
    def triangle_counts(self) -> tuple[int, int]:
        """How many triangles each could have."""
        fine, coarse = (2 * (columns - 1) * (rows - 1) for columns, rows in self.sizes)
        return fine, coarse

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
        self._grids: dict[Strides, _NodeGrids] = {}
        self._taken: DepthImage | None = None
        self.fitted: dict[str, Binding] = {}
        self._is_grazing: bool | None = None

    def take(self, depth: DepthImage) -> None:
        self._taken, self._is_grazing = None, None
        self.fitted = self._fit.take(depth, self.camera)
        self._taken = depth

    def holds(self, depth: DepthImage) -> bool:
        return self._taken is depth and self.camera == depth.camera

    def grids(self, strides: Strides) -> _NodeGrids:
        if strides not in self._grids:
            self._grids[strides] = _NodeGrids(self._gpu, self.camera, strides)
        return self._grids[strides]

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
    every node and triangle that could be, one camera's after the other's, those of coarse meshes behind all of the
    fine ones; triangles that are not there have no area.
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
        return FittedDepth(frame.view, camera.pixels, frame.jump_terms, frame.strides(self._budgets))

    def _set_cameras(self, lenses: Sequence[CameraModel]) -> None:
        self._forget_cameras()
        self._cameras = [_CameraTextures(self._gpu, each) for each in lenses]
        self._views = DepthViewLayers(self._gpu, lenses) if len(lenses) > 1 else None

    def fitted(self, depth: DepthImage) -> dict[str, Binding] | None:
        """Returns what DepthFit found in a depth image if it is among those taken last, until the next are."""
        return next((camera.fitted for camera in self._cameras if camera.holds(depth)), None)

    def fill(self, buffers: MeshBuffers, materials: GpuMesh) -> None:
        """Writes the triangles of the depth images that were taken; `materials`: their only one."""
        strides = [each.strides(self._budgets) for each in self._frames]
        grids = [camera.grids(each) for camera, each in zip(self._cameras, strides, strict=True)]
        vertices = _starts([each.node_counts for each in grids])
        triangles = _starts([each.triangle_counts for each in grids])
        coarse = range(triangles[0][1], triangles[-1][1])
        buffers.reserve(vertices[-1][1], triangles[0][1], materials, coarse)
        for number, each in enumerate(grids):
            place: Bindings = {
                "grid_sizes": (*each.sizes[0], *each.sizes[1]),
                "first_vertices": vertices[number],
                "first_triangles": triangles[number],
                "depth_view_number": number,
            }
            self._write(buffers, number, each, place)

    def _write(self, buffers: MeshBuffers, number: int, grids: _NodeGrids, place: Bindings) -> None:
        """Writes one camera's triangles."""
        camera, frame = self._cameras[number], self._frames[number]
        columns, rows = grids.sizes[0]
        slope, least = frame.jump_terms
        self._make_nodes.run(
            (columns, rows, len(grids.sizes)),
            camera.with_grazing(frame.grazing),
            {"SEVERAL_DEPTHS": False} if self._views is None else self._views.bindings,
            buffers.solid,
            place,
            node_rays=grids.rays,
            nodes_out=grids.nodes,
            node_strides=grids.strides,
            world_from_camera=frame.view.world_from_camera,
        )
        self._make_triangles.run(
            (columns - 1, rows - 1, len(grids.sizes)),
            buffers.solid,
            place,
            nodes=grids.nodes,
            node_slopes=tuple(slope * stride for stride in grids.strides),
            least_step=least,
        )

    def backs_of(self, mesh: MeshBuffers, triangles: range, behind_m: float) -> WriteChosen | None:
        """Returns what lists the triangles that have backs (DepthViewLayers); None with one camera: all have."""
        return None if self._views is None else self._views.backs_of(mesh, triangles, behind_m)

    def _forget_cameras(self) -> None:
        release_all(*self._cameras, self._views)
        self._cameras, self._views, self._frames = [], None, ()

    def release(self) -> None:
        """Frees the GL objects."""
        self._forget_cameras()
        release_all(self._make_nodes, self._make_triangles)


def _starts(counts: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Returns where each camera's fine and coarse items begin, coarse ones behind all fine ones; last, the ends."""
    fine, coarse = ([count[coarseness] for count in counts] for coarseness in range(2))
    return list(zip(accumulate(fine, initial=0), accumulate(coarse, initial=sum(fine)), strict=True))
