"""Triangle meshes on the GPU: vertices for the raster passes, whole triangles for the voxeliser."""

from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float32

from render_server.gpu.context import GpuContext
from render_server.scene.gpu_mesh import VERTEX_ATTRIBUTES, VERTEX_LAYOUT, GpuMesh

UV, COLOR, MATERIAL = slice(6, 8), slice(8, 11), 11  # columns of a vertex


def triangle_corners(mesh: GpuMesh) -> Float32[np.ndarray, "m 3 10"]:
    """Each triangle's corners as the voxeliser reads them: position, uv, colour, material, double-sided."""
    vertices = mesh.vertices
    double_sided = np.array([material.double_sided for material in mesh.materials], np.float32)
    flags = double_sided[vertices[:, MATERIAL].astype(int)][:, None]
    columns = [vertices[:, :3], vertices[:, UV], vertices[:, COLOR], vertices[:, MATERIAL:], flags]
    return np.asarray(np.concatenate(columns, axis=1)[mesh.triangles], np.float32)


class MeshBuffers:
    """Vertex and index buffers that are rewritten when the mesh changes."""

    def __init__(self, gpu: GpuContext) -> None:
        self._ctx = gpu.ctx
        self._vertices = gpu.ctx.buffer(reserve=4)
        self._indices = gpu.ctx.buffer(reserve=4)
        self._arrays: dict[int, moderngl.VertexArray] = {}
        self._index_count = 0

    def write(self, mesh: GpuMesh) -> None:
        """Take over the contents of `mesh`."""
        vertices = np.ascontiguousarray(mesh.vertices, np.float32).tobytes()
        indices = np.ascontiguousarray(mesh.triangles, np.int32).tobytes()
        self._index_count = mesh.triangles.size
        if len(vertices) > self._vertices.size or len(indices) > self._indices.size:
            self.release()
            self._vertices = self._ctx.buffer(reserve=max(len(vertices), 4))
            self._indices = self._ctx.buffer(reserve=max(len(indices), 4))
        if self._index_count:
            self._vertices.write(vertices)
            self._indices.write(indices)

    def draw(self, program: moderngl.Program) -> None:
        """Draw all triangles with `program`."""
        if not self._index_count:
            return
        if program.glo not in self._arrays:
            layout = [(self._vertices, *_layout_of(program))]
            self._arrays[program.glo] = self._ctx.vertex_array(program, layout, self._indices)
        self._arrays[program.glo].render(moderngl.TRIANGLES, vertices=self._index_count)

    def bind_to_storage(self, vertices: int, corners: int) -> None:
        """Bind vertices (rows of `VERTEX_LAYOUT`) and the vertex indices of triangles for shaders to read."""
        self._vertices.bind_to_storage_buffer(vertices)
        self._indices.bind_to_storage_buffer(corners)

    def release(self) -> None:
        """Free all buffers."""
        for array in self._arrays.values():
            array.release()
        self._arrays.clear()
        self._vertices.release()
        self._indices.release()


def _layout_of(program: moderngl.Program) -> tuple[Any, ...]:
    """Vertex layout, with attributes that the program's compiler removed left out as padding."""
    formats, names = [], []
    for part, name in zip(VERTEX_LAYOUT.split(), VERTEX_ATTRIBUTES, strict=True):
        if program.get(name, None) is None:
            formats.append(f"{int(part[0]) * 4}x")
        else:
            formats.append(part)
            names.append(name)
    return " ".join(formats), *names
