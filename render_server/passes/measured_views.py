"""What several cameras measure of one room: surfels take their radiance from the one that shows them largest."""

from collections.abc import Sequence

import moderngl
import numpy as np

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.view import CameraView

SURFEL_PIXELS = 4  # along an axis, of the picture: one sample covers a surfel's
VIEW_TEXELS = 6  # of a MeasuredView in shaders/common/measured_views.glsl


class MeasuredViews:
    """Linear pictures (RGBA16F, camera units) and depth (R32F, m) of all cameras, a layer each.

    Pictures are reduced to what surfels read: means of SURFEL_PIXELS x SURFEL_PIXELS pixels. Those smaller than the
    largest fill the upper left corner of their layer.
    """

    def __init__(self, gpu: GpuContext, sizes: Sequence[tuple[int, int]]) -> None:
        width, height = (max(size[axis] for size in sizes) for axis in (0, 1))
        self._radiance = gpu.ctx.texture_array((*_reduced((width, height)), len(sizes)), 4, dtype="f2")
        self._radiance.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self._depth = gpu.ctx.texture_array((width, height, len(sizes)), 1, dtype="f4")
        self._depth.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._cameras = texture_2d(gpu, (VIEW_TEXELS, len(sizes)), 4, "f4")
        self._copy_depth = Kernel(gpu, "measured_view")
        self._copy_picture = Kernel(gpu, "measured_view", PICTURE=1)

    @property
    def bindings(self) -> dict[str, Binding]:
        """What real_radiance.glsl reads instead of one camera's picture."""
        return {
            "SEVERAL_VIEWS": True,
            "view_cameras": self._cameras,
            "view_radiance": self._radiance,
            "view_depth": self._depth,
        }

    def write(self, views: Sequence[CameraView], scenes: Sequence[Bindings]) -> None:
        """Copies the pictures and depths that the `scenes` bind, one for each view."""
        self._cameras.write(b"".join(packed_view(view) for view in views), alignment=1)
        for layer, (view, scene) in enumerate(zip(views, scenes, strict=True)):
            self._copy_depth.run(view.size, scene, depth_out=self._depth, layer=layer)
            self._copy_picture.run(
                _reduced(view.size),
                scene,
                radiance_out=self._radiance,
                block=SURFEL_PIXELS,
                layer=layer,
            )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._radiance, self._depth, self._cameras, self._copy_depth, self._copy_picture)


def _reduced(size: tuple[int, int]) -> tuple[int, int]:
    """Returns the size of a picture as surfels read it."""
    return -(-size[0] // SURFEL_PIXELS), -(-size[1] // SURFEL_PIXELS)


def packed_view(view: CameraView, more: Sequence[float] = (0.0, 0.0)) -> bytes:
    """Returns the texels of a MeasuredView: matrix by columns, pinhole, extent and `more`, by fours."""
    matrix = view.camera.matrix
    pinhole = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    values = np.concatenate([view.camera_from_world.T.ravel(), pinhole, view.size, more])
    return values.astype(np.float32).tobytes()
