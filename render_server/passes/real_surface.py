"""The real surfaces that the camera sees: from its depth, or from the given or fused geometry."""

from collections.abc import Callable

import moderngl
import numpy as np

from deltalight.protocol.frames import DepthImage
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.picture_kernel import PictureKernel
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.depth_fit import DepthFit, upload_depth
from deltalight.render_server.passes.gbuffer import GeometryBuffer
from deltalight.render_server.scene.depth_surface import DepthSurface


class RealSurface:
    """World position + depth (RGBA32F; w = 0 unknown) and normal + surface entry (RGBA16F) on the picture's grid.

    Positions are filled into two textures in turn, so that what was there before can be looked up without a copy.
    `fits_depth`: the GPU fits normals to depth; default: if it is one, because Mesa's software renderer takes longer
    for it than numpy.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], *, fits_depth: bool | None = None) -> None:
        self.size = size
        self.position, self._last_position = (texture_2d(gpu, size, 4, "f4") for _ in range(2))
        self._fillings = 0
        self.normal = texture_2d(gpu, size, 4, "f2")
        self._gpu = gpu
        self._fits_depth = not gpu.is_software if fits_depth is None else fits_depth
        self._fit: DepthFit | None = None  # made when asked to fit what nobody has fitted yet
        self._depth: moderngl.Texture | None = None
        self._slopes: tuple[moderngl.Texture, ...] = ()
        if self._fits_depth:
            self._from_depth = PictureKernel(gpu, "real_surface", FITS_DEPTH=1)
        else:
            self._depth, *slopes = (texture_2d(gpu, size, 1, "f4") for _ in range(3))
            self._slopes = tuple(slopes)
            self._from_depth = PictureKernel(gpu, "real_surface")
        self._from_model = Kernel(gpu, "real_surface_model")

    @property
    def bindings(self) -> dict[str, Binding]:
        """Its textures by GLSL name; `real_surface_fillings`: how often it was filled, for LightHistory."""
        return {
            "real_surface_position": self.position,
            "real_surface_normal": self.normal,
            "real_surface_fillings": self._fillings,
        }

    def from_depth(
        self,
        depth: DepthImage,
        fitted: Callable[[], DepthSurface],
        scene: Bindings,
        *,
        on_gpu: dict[str, Binding] | None = None,
    ) -> None:
        """Fills it from the clean, registered depth map.

        `fitted` fits it on the CPU if need be; `on_gpu`: what DepthFit found in it if it has taken it already.
        """
        if not self._fits_depth:
            found = self._fitted_by_cpu(depth, fitted)
        else:
            found = self._fitted_by_gpu(depth) if on_gpu is None else on_gpu
        self._begin()
        self._from_depth.run((0, 0, *self.size), scene, found, **self._images())

    def _fitted_by_gpu(self, depth: DepthImage) -> dict[str, Binding]:
        if self._fit is None:
            self._fit = DepthFit(self._gpu, self.size)
        return self._fit.take(depth, depth.camera)

    def _fitted_by_cpu(self, depth: DepthImage, fitted: Callable[[], DepthSurface]) -> dict[str, Binding]:
        assert self._depth is not None
        upload_depth(self._depth, depth)
        for texture, slope in zip(self._slopes, fitted().gradient, strict=True):
            texture.write(np.ascontiguousarray(slope), alignment=1)
        slope_x, slope_y = self._slopes
        return {"depth_map": self._depth, "slope_x": slope_x, "slope_y": slope_y}

    def from_model(
        self, raster: GeometryBuffer, scene: Bindings, *, tolerance: tuple[float, float] | None = None
    ) -> None:
        """Fills it from a raster of the given model or the fused surface, through the lens.

        `tolerance` (m, and m at 1 m that grow with z^2): a pixel that depth filled before keeps its depth where the
        surface differs by more (something moved), and takes the surface, the mean of many frames, where it agrees.
        None: every pixel takes the surface.
        """
        if tolerance is None:
            self._begin()
        self._from_model.run(
            self.size,
            scene,
            model_raster_position=raster.position,
            model_raster_normal=raster.normal,
            keeps_depth=tolerance is not None,
            tolerance=tolerance or (0.0, 0.0),
            **self._images(),
        )

    def _begin(self) -> None:
        """Begins to fill it: the positions stay in the other texture until the next time."""
        self.position, self._last_position = self._last_position, self.position
        self._fillings += 1

    def _images(self) -> dict[str, Binding]:
        return {"position_out": self.position, "normal_out": self.normal}

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.position, self._last_position, self.normal, self._depth, *self._slopes, self._fit)
        release_all(self._from_depth, self._from_model)
