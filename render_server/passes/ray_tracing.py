"""The objects' triangles and a bounding volume hierarchy over them on the GPU, for ray tracing."""

import numpy as np
from jaxtyping import Float32, Float64

from render_server.gpu.context import GpuContext
from render_server.gpu.kernel import Binding
from render_server.passes.gbuffer import MeshBuffers
from render_server.scene.bvh import Bvh, build_bvh

# Refitting costs a tenth of building (9 000 triangles: 5 against 51 ms; 78 000: 53 against 806), so rays through a
# hierarchy may become half as expensive again before it is rebuilt.
WORN = 1.5


class ObjectBvh:
    """Bounding volume hierarchy of the objects; updated only when they moved and rays are traced."""

    def __init__(self, gpu: GpuContext) -> None:
        self._ctx = gpu.ctx
        self._nodes = gpu.ctx.buffer(reserve=4)
        self._faces = gpu.ctx.buffer(reserve=4)
        self._corners = self._built = np.zeros((0, 3, 3), np.float32)
        self._mesh: MeshBuffers | None = None
        self._bvh: Bvh | None = None
        self._fresh_cost = 0.0
        self.centre = np.zeros(3)
        self.radius = 0.0

    def set_triangles(
        self,
        corners: Float32[np.ndarray, "m 3 10"],
        bounds: tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]],
        mesh: MeshBuffers,
    ) -> None:
        """Sets triangles (positions first), their bounds (m) and vertices; a changed array is a changed shape."""
        low, high = bounds
        self.centre, self.radius = (low + high) / 2, float(np.linalg.norm(high - low) / 2)
        self._corners, self._mesh = corners, mesh

    @property
    def bindings(self) -> dict[str, Binding]:
        """The bindings of shaders/common/ray_mesh.glsl; brings the hierarchy up to date first."""
        assert self._mesh is not None
        if self._corners is not self._built:
            self._built = self._corners
            positions = self._corners[..., :3]
            bvh = self._renewed(positions)
            self.release()
            self._nodes = self._ctx.buffer(bvh.packed())
            self._faces = self._ctx.buffer(bvh.packed_triangles(positions, self._mesh.triangles))
        return {"Nodes": self._nodes, "Faces": self._faces, **self._mesh.storage}

    def _renewed(self, positions: Float32[np.ndarray, "m 3 3"]) -> Bvh:
        """Returns the hierarchy of the current triangles: the old one refitted, as long as it is good enough."""
        bvh = self._bvh
        if bvh is not None and len(bvh.order) == len(positions):
            bvh = bvh.refitted(positions)
            if bvh.cost <= WORN * self._fresh_cost:
                return bvh
        self._bvh = build_bvh(positions)
        self._fresh_cost = self._bvh.cost
        return self._bvh

    def release(self) -> None:
        """Frees the buffers."""
        self._nodes.release()
        self._faces.release()
