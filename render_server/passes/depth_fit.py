"""A depth image on the GPU and planes fitted to it, as render_server/scene/depth_surface.py does in numpy."""

import cv2
import moderngl
import numpy as np

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Kernel
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.scene.depth_surface import MAX_RADIUS, jump_terms, window_radius


def upload_depth(texture: moderngl.Texture, depth: DepthImage) -> None:
    """Fills a texture (R32F) with a depth image, m; 0 where it is unknown."""
    known = cv2.copyTo(depth.depth_m, depth.valid.view(np.uint8))
    texture.write(known.astype(np.float32, copy=False), alignment=1)


class DepthFit:
    """A depth image of one size, with a plane fitted to the surroundings of every pixel."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._size = size
        self._depth, self._inverse = texture_2d(gpu, size, 1, "f4"), texture_2d(gpu, size, 1, "f4")
        self._row_moments = texture_2d(gpu, size, 4, "f4")
        self._row_depth = texture_2d(gpu, size, 2, "f4")
        self._fits = texture_2d(gpu, size, 4, "f4")
        self._sum_rows = Kernel(gpu, "depth_rows", MAX_RADIUS=MAX_RADIUS)
        self._fit = Kernel(gpu, "depth_columns")

    def take(self, depth: DepthImage, camera: CameraModel) -> dict[str, Binding]:
        """Uploads and fits a depth image; returns it (`depth_map`: m, 0 unknown) and what fitted_normal.glsl reads.

        All of that is overwritten when the next one is taken.
        """
        upload_depth(self._depth, depth)
        found: dict[str, Binding] = {
            "depth_map": self._depth,
            "inverse_depth": self._inverse,
            "window_radius": window_radius(depth, camera),
            "window_fits": self._fits,
        }
        self._sum_rows.run(
            self._size,
            found,
            jump_threshold=jump_terms(depth, camera),
            inverse_out=self._inverse,
            row_moments_out=self._row_moments,
            row_depth_out=self._row_depth,
        )
        self._fit.run(
            self._size,
            found,
            row_moments=self._row_moments,
            row_depth=self._row_depth,
            window_fits_out=self._fits,
        )
        return found

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._depth, self._inverse, self._row_moments, self._row_depth, self._fits)
        release_all(self._sum_rows, self._fit)
