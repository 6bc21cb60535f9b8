"""The objects' triangles on the GPU for rays, with the hierarchy over them."""

import numpy as np
from jaxtyping import Float32, Float64

from render_server.gpu.context import GpuContext
from render_server.passes.mesh_buffers import MeshBuffers
from render_server.scene.bvh import build_bvh


class ObjectTree:
    """Follows the objects; built anew only when they moved and rays are really traced."""

    def __init__(self, gpu: GpuContext) -> None:
        self._ctx = gpu.ctx
        self._nodes = gpu.ctx.buffer(reserve=4)
        self._faces = gpu.ctx.buffer(reserve=4)
        self._version = self._built = 0
        self._corners = np.zeros((0, 3, 3), np.float32)
        self._mesh: MeshBuffers | None = None
        self.centre = np.zeros(3)
        self.radius = 0.0

    def follow(
        self,
        version: int,
        corners: Float32[np.ndarray, "m 3 10"],
        bounds: tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]],
        mesh: MeshBuffers,
    ) -> None:
        """Take over triangles (positions first), what encloses them (m), their vertices, and a number that changes
        with them, from 1 on.
        """
        low, high = bounds
        self.centre, self.radius = (low + high) / 2, float(np.linalg.norm(high - low) / 2)
        self._version, self._corners, self._mesh = version, corners[..., :3], mesh

    def bind(self) -> None:
        """Bind to the places that passes/common/ray_mesh.glsl names."""
        assert self._mesh is not None
        if self._version != self._built:
            self._built = self._version
            tree = build_bvh(self._corners)
            self.release()
            self._nodes = self._ctx.buffer(tree.packed())
            self._faces = self._ctx.buffer(tree.packed_triangles(self._corners))
        self._nodes.bind_to_storage_buffer(2)
        self._faces.bind_to_storage_buffer(3)
        self._mesh.bind_to_storage(4, 5)

    def release(self) -> None:
        """Free the buffers."""
        self._nodes.release()
        self._faces.release()
