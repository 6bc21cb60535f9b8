"""What a relighting method gets for one picture."""

from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float32, Float64

from render_server.gpu.timers import PassTimers
from render_server.passes.geometry_buffer import GeometryBuffer
from render_server.passes.materials import MaterialTable
from render_server.passes.mesh_buffers import MeshBuffers
from render_server.passes.picture import Picture
from render_server.passes.real_surface import RealSurface
from render_server.passes.unseen_albedo import UnseenAlbedo
from render_server.scene.lights import LightSet
from render_server.view import CameraView


@dataclass(frozen=True, eq=False)
class GeometryState:
    """One set of triangles in the world and a number that changes with them.

    `corners` are for the voxeliser (passes/mesh_buffers.py), `points` enclose the set (for fitting light views).
    """

    version: int
    buffers: MeshBuffers
    corners: Float32[np.ndarray, "m 3 10"]
    points: Float64[np.ndarray, "n 3"]
    materials: MaterialTable
    coarse_corners: Float32[np.ndarray, "k 3 10"] | None = (
        None  # fewer triangles for what lies far; None: all
    )

    @property
    def bounds(self) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Least and greatest coordinates, m."""
        return self.points.min(axis=0), self.points.max(axis=0)


@dataclass(frozen=True, eq=False)
class RelightInput:
    """The picture, both geometries and the lights. `noise_sigma` is the depth noise at 1 m (m, grows with z^2)."""

    view: CameraView
    picture: Picture
    real_surface: RealSurface
    virtual_raster: GeometryBuffer
    matte: moderngl.Texture
    real: GeometryState
    virtual: GeometryState
    lights: LightSet
    lights_version: int
    noise_sigma: float
    typical_depth: float
    surface_uniforms: dict[str, Any]
    unseen_albedo: UnseenAlbedo
    timers: PassTimers
    everywhere: bool = False  # light every pixel, not only where the objects reach (photometric registration)

    def bind_geometry(self) -> None:
        """Bind the geometry buffers to the places that geometry.glsl names."""
        self.real_surface.bind()
        self.virtual_raster.position.use(location=6)
        self.virtual_raster.normal.use(location=7)
        self.picture.rays.use(location=15)
