"""Voxels filled with emissive meshes, and single cones fired through them."""

from dataclasses import dataclass
from pathlib import Path

import moderngl
import numpy as np
import trimesh

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Kernel
from deltalight.render_server.gpu.uniform_block import UniformBlock
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.mesh_buffers import MaterialTable, MeshBuffers
from deltalight.render_server.passes.volumes import FarVolumeBlock, PlacedVolume, VolumePlacement
from deltalight.render_server.passes.voxel_light import LightVoxels
from deltalight.render_server.passes.voxelize import Voxelize, VoxelizedMesh
from deltalight.render_server.passes.voxels import (
    DIRECTIONS,
    SURFEL_BYTES,
    SURFELS_HEADER_BYTES,
    FilterVoxels,
    ResolveVoxels,
    VoxelMipmap,
    VoxelStore,
)
from deltalight.render_server.scene.gpu_mesh import GpuMesh, merge_for_gpu
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.triangle_mesh import TriangleMesh, smooth_normals


def gpu_mesh(mesh: trimesh.Trimesh, radiance: float = 0.0, *, inside_out: bool = False) -> GpuMesh:
    """One black mesh that glows; `inside_out` turns its faces to the inside."""
    triangles = np.asarray(mesh.faces, np.int32)
    triangles = np.ascontiguousarray(triangles[:, ::-1] if inside_out else triangles)
    positions = np.asarray(mesh.vertices, np.float32)
    source, triangles, normals = smooth_normals(positions, triangles)
    material = Material(
        base_color=np.zeros(3, np.float32), specular=0.0, emission=np.full(3, radiance, np.float32)
    )
    return merge_for_gpu([TriangleMesh(positions[source], normals, triangles, None, material)])


def solid_buffer(buffers: MeshBuffers, name: str) -> moderngl.Buffer:
    """Of a mesh on the GPU."""
    buffer = buffers.solid[name]
    assert isinstance(buffer, moderngl.Buffer)
    return buffer


@dataclass
class Voxels:
    """Mipmaps of one filling: mu is empty, rho holds the mesh."""

    mu: VoxelMipmap
    rho: VoxelMipmap
    store: VoxelStore
    empty: VoxelStore

    def release(self) -> None:
        for item in (self.mu, self.rho, self.store, self.empty):
            item.release()


class VoxelLab:
    """A cube of `size`^3 voxels of edge 1 with its low corner at the origin, so that world = voxel coordinates."""

    def __init__(self, gpu: GpuContext, size: int = 64) -> None:
        self.gpu = gpu
        self.placement = VolumePlacement((0.0, 0.0, 0.0), 1.0, size)
        self._volume = PlacedVolume(gpu, self.placement)
        self._beyond = UniformBlock[FarVolumeBlock](gpu, self.placement.far_block(is_used=False))
        self._voxelize, self._mesh = Voxelize(gpu), MeshBuffers(gpu)
        self._light = LightVoxels(gpu)
        self._resolve = ResolveVoxels(gpu)
        self._filter = FilterVoxels(gpu)
        self._lights = LightBuffers(gpu, 64, 4)
        self._lights.set_environment(np.zeros((16, 16, 3), np.float32))
        self._cones = Kernel(gpu, Path(__file__).with_name("cones"))

    def place(self, voxel_edge: float) -> None:
        """Replaces the cube by one of other voxels."""
        self.placement = VolumePlacement((0.0, 0.0, 0.0), voxel_edge, self.placement.size)
        self._volume.place(self.placement)

    def voxelize(
        self, store: VoxelStore, mesh: GpuMesh, behind_m: float = 0.0, chosen: np.ndarray | None = None
    ) -> None:
        """Fills the empty store with the mesh, or with its backs, or with the chosen triangles."""
        self._mesh.write(mesh)
        self._voxelize.run(store, [VoxelizedMesh(self._mesh, behind_m, chosen)], self._volume)

    def surfels(
        self, mesh: GpuMesh, behind_m: float = 0.0, chosen: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """World positions, areas, unit normals and voxel coordinates of a mesh's surfels."""
        store = VoxelStore(self.gpu, self.placement.size)
        self.voxelize(store, mesh, behind_m, chosen)
        _, count = store.counts()
        assert count <= store.surfel_capacity
        content = store.surfels.read(count * SURFEL_BYTES, offset=SURFELS_HEADER_BYTES) if count else b""
        data = np.frombuffer(content, np.float32).reshape(-1, 16).copy()
        store.release()
        index = data[:, 10].copy().view(np.uint32).astype(int)
        size = self.placement.size
        voxels = np.stack([index % size, index // size % size, index // size**2], axis=1)
        return data[:, :3], data[:, 3], data[:, 4:7], voxels

    def fill(self, mesh: GpuMesh) -> Voxels:
        """Voxelise, light by its own glow, filter."""
        size = self.placement.size
        mipmaps = [VoxelMipmap(self.gpu, size, DIRECTIONS) for _ in range(2)]
        stores = [VoxelStore(self.gpu, size) for _ in range(2)]
        voxels = Voxels(mipmaps[0], mipmaps[1], stores[0], stores[1])
        materials = MaterialTable(self.gpu, mesh)
        scene: dict[str, Binding] = {
            **self._volume.bindings,
            **self._lights.bindings,
            **materials.bindings,
            "SEVERAL_VIEWS": False,
            "bias_real": 0.0,
            "bias_object": 0.0,
            "has_caustics": False,
            "lens_distortion": False,
        }
        self.voxelize(voxels.store, mesh)
        self._light.light_virtual(voxels.store, scene)
        self._resolve.resolve_rho(voxels.rho, voxels.empty, voxels.store, self._volume, occupies=True)
        self._filter.run(voxels.rho, self._volume, voxels.store)
        materials.release()
        return voxels

    def level_zero(self, voxels: Voxels) -> np.ndarray:
        """(direction, z, y, x, rgba) of the finest level of rho."""
        size = self.placement.size
        texels = np.frombuffer(voxels.rho.texture.read(), np.float16).reshape(-1, size, size, 4)
        return np.asarray(texels[: DIRECTIONS * size].reshape(DIRECTIONS, size, size, size, 4), float)

    def trace(self, voxels: Voxels, starts: np.ndarray, directions: np.ndarray, ratio: float) -> np.ndarray:
        """(n, 4): radiance and transmittance of mu and of rho; `ratio` = cone diameter / distance."""
        count = len(starts)
        rays = np.zeros((count, 8), np.float32)
        rays[:, :3], rays[:, 3], rays[:, 4:7] = starts, ratio, directions
        ray_buffer = self.gpu.ctx.buffer(rays.tobytes())
        results = self.gpu.ctx.buffer(reserve=count * 16)
        everywhere = np.array([0, 0, 0, *[-self.placement.size] * 3], np.int32)
        self._light.reset_support(everywhere)
        self._cones.run(
            (count,),
            self._volume.bindings,
            self._light.bindings,
            mipmap_mu=voxels.mu.texture,
            mipmap_rho=voxels.rho.texture,
            Occupied=voxels.rho.occupied,
            mipmap_far=None,
            OccupiedFar=None,
            FarVolume=self._beyond,
            Rays=ray_buffer,
            Results=results,
            ray_count=count,
        )
        found = np.frombuffer(results.read(), np.float32).reshape(count, 4).copy()
        ray_buffer.release()
        results.release()
        return found

    def release(self) -> None:
        for item in (
            self._volume,
            self._beyond,
            self._voxelize,
            self._mesh,
            self._light,
            self._resolve,
            self._filter,
            self._lights,
            self._cones,
        ):
            item.release()


def directions_everywhere(count: int, rng: np.random.Generator) -> np.ndarray:
    found = rng.normal(size=(count, 3))
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def cosine_directions(count: int, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Directions of density cos/pi about a unit normal."""
    share, angle = rng.uniform(size=count), rng.uniform(0, 2 * np.pi, count)
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(helper, normal)
    x /= np.linalg.norm(x)
    across = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * np.cross(normal, x)
    return np.asarray(np.sqrt(share)[:, None] * across + np.sqrt(1 - share)[:, None] * normal)
