"""Real geometry buffer: position and normal of the real surface at each pixel."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from protocol.frames import DepthImage
from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.geometry_buffer import GeometryBuffer
from render_server.passes.picture import Picture
from render_server.view import CameraView


class RealSurface:
    """World position + depth (RGBA32F; w = 0 unknown) and normal + surface entry (RGBA16F) on the picture's grid."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.size = size
        self.position = texture_2d(gpu, size, 4, "f4")
        self.normal = texture_2d(gpu, size, 4, "f2")
        self._depth = texture_2d(gpu, size, 1, "f4")
        self._fitted = texture_2d(gpu, size, 3, "f4")
        folder = Path(__file__).parent
        self._from_depth = ComputeProgram(gpu, folder / "real_surface.comp.glsl")
        self._from_model = ComputeProgram(gpu, folder / "real_surface_model.comp.glsl")

    def from_depth(
        self,
        depth: DepthImage,
        normals: Float32[np.ndarray, "h w 3"],
        picture: Picture,
        view: CameraView,
        surface_count: int,
    ) -> None:
        """Fill from the clean, registered depth map and its normals (optical frame, zero where unknown)."""
        known = np.where(depth.valid, depth.depth_m, 0.0).astype(np.float32)
        self._depth.write(known.tobytes(), alignment=1)
        self._fitted.write(np.ascontiguousarray(normals, np.float32).tobytes(), alignment=1)
        bind_samplers({0: self._depth, 1: picture.rays, 2: self._fitted})
        bind_images(self.position, self.normal)
        self._from_depth.run(self.size, surface_count=surface_count, **view.uniforms())

    def from_model(
        self,
        raster: GeometryBuffer,
        picture: Picture,
        view: CameraView,
        surface_count: int,
        *,
        tolerance: tuple[float, float] | None = None,
    ) -> None:
        """Fill from a raster of the given model or the fused surface, through the lens.

        `tolerance` (m, and m at 1 m that grow with z^2): pixels that the frame's depth filled before keep it where
        the surface differs by more (something moved), and take the surface, the mean of many frames, where it
        agrees. None: everything is taken.
        """
        bind_samplers({6: raster.position, 7: raster.normal, 15: picture.rays})
        bind_images(self.position, self.normal)
        depth: dict[str, Any] = {"fused": tolerance is not None, "tolerance": tolerance or (0.0, 0.0)}
        self._from_model.run(self.size, surface_count=surface_count, **depth, **view.uniforms())

    def bind(self) -> None:
        """Bind to the places that geometry.glsl names."""
        bind_samplers({4: self.position, 5: self.normal})

    def release(self) -> None:
        """Free the GL objects."""
        for item in (
            self.position,
            self.normal,
            self._depth,
            self._fitted,
            self._from_depth,
            self._from_model,
        ):
            item.release()
