"""Buffers of meshes hold what was written last, though what stays the same is not written again."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.scene.gpu_mesh import GpuMesh
from tests.render_server.voxel_lab import gpu_mesh, solid_buffer

pytestmark = pytest.mark.usefixtures("clean_gl")


def held(buffers: MeshBuffers, mesh: GpuMesh) -> bool:
    """Whether the buffers on the GPU begin with a mesh."""
    names = {"Vertices": mesh.vertices, "Indices": mesh.triangles, "Sides": mesh.material_table[:, 12]}
    return all(
        solid_buffer(buffers, name).read(array.nbytes) == array.tobytes() for name, array in names.items()
    )


def test_buffers_hold_each_mesh_that_is_written(gpu: GpuContext) -> None:
    """One that moved, one of other triangles or sides, one that needs more room, and one after a kernel wrote."""
    box = gpu_mesh(trimesh.creation.box())
    (part,) = box.parts
    moved = replace(box, parts=(replace(part, vertices=part.vertices + np.float32(0.5)),))
    turned = replace(moved, triangles=np.ascontiguousarray(moved.triangles[:, ::-1]))
    other_sides = box.material_table.copy()
    other_sides[:, 12] = 1 - other_sides[:, 12]
    opened, large = replace(turned, material_table=other_sides), gpu_mesh(trimesh.creation.icosphere(2))
    buffers = MeshBuffers(gpu)
    for mesh in (box, moved, turned, opened, large, box, moved):
        buffers.write(mesh)
        assert held(buffers, mesh)
    buffers.reserve(len(moved.vertices), len(moved.triangles), opened)
    solid_buffer(buffers, "Indices").write(bytes(moved.triangles.nbytes))
    buffers.write(moved)
    assert held(buffers, moved)
    buffers.release()
