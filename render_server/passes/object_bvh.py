"""The objects' hierarchy for rays, in textures."""

from collections.abc import Sequence
from concurrent.futures import Future

import numpy as np
from jaxtyping import Float64

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding
from deltalight.render_server.gpu.texel_rows import TexelRows
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.scene.bvh_forest import BvhForest, Forest, Tree
from deltalight.render_server.scene.gpu_mesh import GpuMesh
from deltalight.render_server.scene.threads import submit

BVH_WIDTH = 1024  # texels of a row, as shaders/common/ray_mesh.glsl has it
NODE_TEXELS, FACE_TEXELS = 2, 3


class BvhTextures:
    """Nodes and triangles of a forest as shaders/common/ray_mesh.glsl reads them."""

    def __init__(self, gpu: GpuContext) -> None:
        self._nodes, self._faces = TexelRows(gpu, BVH_WIDTH, "u4"), TexelRows(gpu, BVH_WIDTH, "u4")
        self._held: Sequence[Tree] = ()
        self._held_above: set[tuple[int, bytes]] = set()  # place and contents of each node

    def write(self, forest: Forest) -> None:
        """Replaces the contents; trees that they have already are not packed again."""
        self._nodes.reserve(NODE_TEXELS * forest.node_count)
        self._faces.reserve(FACE_TEXELS * sum(len(each.bvh.order) for each in forest.trees))
        held = set(self._held)
        for tree in forest.trees:
            if tree not in held:
                self._write_tree(tree)
        above = {(at, row.tobytes()) for at, row in zip(forest.above_at.tolist(), forest.above, strict=True)}
        for at, packed in above - self._held_above:
            texels = np.frombuffer(packed, np.float32).reshape(-1, 4)
            self._nodes.renewed(NODE_TEXELS * at, NODE_TEXELS)[:] = texels
        self._held, self._held_above = forest.trees, above

    def _write_tree(self, tree: Tree) -> None:
        part, bvh = tree.part, tree.bvh
        nodes = bvh.packed(tree.first_node, part.first_triangle)
        node_texels = self._nodes.renewed(NODE_TEXELS * tree.first_node, NODE_TEXELS * len(nodes))
        node_texels[:] = nodes.reshape(-1, 4)
        faces = self._faces.renewed(FACE_TEXELS * part.first_triangle, FACE_TEXELS * len(part.triangles))
        out = faces.reshape(-1, FACE_TEXELS, 4)
        bvh.packed_triangles(part.vertices[:, :3], part.triangles, part.first_vertex, out)

    @property
    def bindings(self) -> dict[str, Binding]:
        """The textures by GLSL name, brought up to date."""
        return {"bvh_nodes": self._nodes.texture, "bvh_faces": self._faces.texture}

    def release(self) -> None:
        """Frees the textures."""
        release_all(self._nodes, self._faces)


class ObjectBvh:
    """Bounding volume hierarchy of the objects; updated only when they moved and rays are traced.

    Where rays were traced before, that begins on another thread as soon as the objects are set.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._forest = BvhForest()
        self._textures = BvhTextures(gpu)
        self._shape: GpuMesh | None = None
        self._built: GpuMesh | None = None
        self._mesh: MeshBuffers | None = None
        self._packed: Future[None] | None = None  # what was built last, until it is uploaded
        self._is_traced = False  # since the triangles changed
        self.centre = np.zeros(3)
        self.radius = 0.0

    def set_triangles(
        self,
        shape: GpuMesh,
        bounds: tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]],
        mesh: MeshBuffers,
    ) -> None:
        """Sets triangles, their bounds (m) and the vertices on the GPU; another mesh is another shape."""
        low, high = bounds
        self.centre, self.radius = (low + high) / 2, float(np.linalg.norm(high - low) / 2)
        self._shape, self._mesh = shape, mesh
        if self._is_traced and shape is not self._built:
            self._begin()

    @property
    def bindings(self) -> dict[str, Binding]:
        """The bindings of shaders/common/ray_mesh.glsl; brings the hierarchy up to date first."""
        assert self._mesh is not None
        if self._shape is not self._built:
            self._begin()
        if self._packed is not None:
            self._packed.result()
            self._packed = None
        self._is_traced = True
        return {**self._textures.bindings, **self._mesh.storage}

    def _begin(self) -> None:
        """Begins to bring the hierarchy up to date, after what was begun before."""
        assert self._shape is not None
        before, shape = self._packed, self._shape
        self._built, self._is_traced = shape, False

        def pack() -> None:
            if before is not None:
                before.result()
            self._textures.write(self._forest.fitted_to(shape.parts))

        self._packed = submit(pack)

    def release(self) -> None:
        """Frees the textures."""
        self._textures.release()
