"""Depth images of several cameras in one room: on the GPU what render_server/scene/depth_views.py does in numpy."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import moderngl

from deltalight.protocol.camera_model import CameraModel
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.measured_views import packed_view
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.passes.voxelize import WriteChosen
from deltalight.render_server.view import CameraView

VIEW_TEXELS = 8  # of a DepthView in shaders/common/depth_views.glsl


@dataclass(frozen=True, eq=False)
class FittedDepth:
    """A depth image that was fitted, and the view that it was taken from.

    `bindings` are what DepthFit found and the rays of its pixels, `jump_terms` those of `jump_threshold`, `strides`
    the pixels of a cell of its fine mesh and of its coarse one.
    """

    view: CameraView
    bindings: Bindings
    jump_terms: tuple[float, float]
    strides: tuple[int, int]

    def packed(self) -> bytes:
        """Returns the texels of a DepthView."""
        more = (
            *self.jump_terms,
            *self.view.position,
            self.view.camera.has_distortion,
            *self.strides,
            0.0,
            0.0,
        )
        return packed_view(self.view, more)


class DepthViewLayers:
    """Inverse depths (R32F, 1/m) of cameras of these lenses, and the rays of those that bend, a layer each.

    Those smaller than the largest fill the upper left corner of their layer.
    """

    def __init__(self, gpu: GpuContext, cameras: Sequence[CameraModel]) -> None:
        self.cameras = tuple(cameras)
        shape = max(each.width for each in cameras), max(each.height for each in cameras), len(cameras)
        self._inverse = _layers(gpu, shape, 1)
        self._rays = None
        if any(each.has_distortion for each in cameras):
            self._rays = _layers(gpu, shape, 2)
            for layer, each in enumerate(cameras):
                place = 0, 0, layer, each.width, each.height, 1
                self._rays.write(each.rays().tobytes(), viewport=place, alignment=1)
        self._views = texture_2d(gpu, (VIEW_TEXELS, len(cameras)), 4, "f4")
        self._copy, self._list_backs = Kernel(gpu, "depth_view"), Kernel(gpu, "depth_backs")

    @property
    def bindings(self) -> dict[str, Binding]:
        """What shaders/common/depth_views.glsl reads."""
        return {
            "SEVERAL_DEPTHS": True,
            "depth_view_cameras": self._views,
            "depth_view_inverse": self._inverse,
            "depth_view_rays": self._rays,
        }

    def write(self, seen: Sequence[FittedDepth]) -> None:
        """Copies what is known of each camera's depth."""
        self._views.write(b"".join(each.packed() for each in seen), alignment=1)
        for layer, each in enumerate(seen):
            self._copy.run(each.view.size, each.bindings, inverse_out=self._inverse, layer=layer)

    def backs_of(self, mesh: MeshBuffers, triangles: range, behind_m: float) -> WriteChosen:
        """Returns what lists those triangles of a mesh whose backs, so far behind, do not lie where nothing is."""
        return partial(self._write_backs, mesh, triangles, behind_m)

    def _write_backs(
        self, mesh: MeshBuffers, triangles: range, behind_m: float, chosen: moderngl.Buffer, first: int
    ) -> None:
        self._list_backs.run(
            (len(triangles),),
            self.bindings,
            mesh.solid,
            behind=behind_m,
            first_triangle=triangles.start,
            triangle_count=len(triangles),
            first_chosen=first,
            Chosen=chosen,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._inverse, self._rays, self._views, self._copy, self._list_backs)


def _layers(gpu: GpuContext, shape: tuple[int, int, int], components: int) -> moderngl.TextureArray:
    layers = gpu.ctx.texture_array(shape, components, dtype="f4")
    layers.filter = (moderngl.NEAREST, moderngl.NEAREST)
    return layers
