"""The objects' triangles on the GPU for rays, with the hierarchy over them."""

import numpy as np
from jaxtyping import Float32, Float64

from render_server.gpu.context import GpuContext
from render_server.passes.mesh_buffers import MeshBuffers
from render_server.scene.bvh import Bvh, build_bvh

# Refitting costs a tenth of building (9 000 triangles: 5 against 51 ms; 78 000: 53 against 806), so a tree may come
# to cost rays half as much again before it is built anew.
WORN = 1.5


class ObjectTree:
    """Follows the objects; renewed only when they moved and rays are really traced."""

    def __init__(self, gpu: GpuContext) -> None:
        self._ctx = gpu.ctx
        self._nodes = gpu.ctx.buffer(reserve=4)
        self._faces = gpu.ctx.buffer(reserve=4)
        self._version = self._built = 0
        self._corners = np.zeros((0, 3, 3), np.float32)
        self._mesh: MeshBuffers | None = None
        self._tree: Bvh | None = None
        self._fresh_cost = 0.0
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
            tree = self._renewed()
            self.release()
            self._nodes = self._ctx.buffer(tree.packed())
            self._faces = self._ctx.buffer(tree.packed_triangles(self._corners))
        self._nodes.bind_to_storage_buffer(2)
        self._faces.bind_to_storage_buffer(3)
        self._mesh.bind_to_storage(4, 5)

    def _renewed(self) -> Bvh:
        """The tree around the triangles as they are: the old one refitted, as long as it serves."""
        tree = self._tree
        if tree is not None and len(tree.order) == len(self._corners):
            tree = tree.refitted(self._corners)
            if tree.cost <= WORN * self._fresh_cost:
                return tree
        self._tree = build_bvh(self._corners)
        self._fresh_cost = self._tree.cost
        return self._tree

    def release(self) -> None:
        """Free the buffers."""
        self._nodes.release()
        self._faces.release()
