"""Sparse voxel sets of one geometry each, how many the memory allows, and what lights them (docs/method.md 4.2)."""

import math
from collections.abc import Sequence

from deltalight.protocol.scene_method import DvctMethod
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.gpu.clearing import clear_buffer
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.methods.method import VOLUME_STEP, Setup
from deltalight.render_server.methods.volume_placement import Placements, volume_placements
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.measured_views import SURFEL_PIXELS
from deltalight.render_server.passes.volumes import PlacedVolume, VolumePlacement
from deltalight.render_server.passes.voxel_light import AlbedoTexture, SurfelGroups
from deltalight.render_server.passes.voxelize import Meshes, Voxelize
from deltalight.render_server.passes.voxels import (
    DIRECTIONS,
    MEGABYTE,
    ClearVoxels,
    VoxelMipmap,
    VoxelStore,
    bounce_tail_bytes,
    volume_memory_bytes,
)

FAR_SIZE = 32  # voxels an edge of the coarse volume beyond
SURFEL_SHADOW_SAMPLES = 4  # of a light's area: a voxel averages many surfels
DEPTH_TOLERANCE = 0.02  # a surfel this near (relative) to what the camera sees is what it sees


def sets_memory_mb(size: int, count: int, directions: int = DIRECTIONS) -> int:
    """Returns the memory of `count` volume sets, MB; with six directions, of the coarse volume beyond, too."""
    taken = 2 * count * volume_memory_bytes(size, directions)
    if directions == DIRECTIONS:
        taken += volume_memory_bytes(FAR_SIZE, DIRECTIONS) + bounce_tail_bytes()
    return math.ceil(taken / MEGABYTE)


def affordable_size(
    size: int, count: int, budget_mb: int, gpu: GpuContext | None = None, directions: int = DIRECTIONS
) -> int:
    """Returns how many voxels an edge each of `count` volumes may have, `size` at most; 0 where no size fits.

    The budget limits several, and what the GPU can hold, if it is given; one that does not fit is refused elsewhere.
    """
    while count > 1 and size > 0 and not _fits(size, count, budget_mb, gpu, directions):
        size -= VOLUME_STEP
    return size


def _fits(size: int, count: int, budget_mb: int, gpu: GpuContext | None, directions: int) -> bool:
    if sets_memory_mb(size, count, directions) > budget_mb:
        return False
    if gpu is None:
        return True
    longest, largest = (
        gpu.ctx.info[f"GL_MAX_{name}"] for name in ("3D_TEXTURE_SIZE", "SHADER_STORAGE_BLOCK_SIZE")
    )
    return bool(count * size <= longest and count * size**3 * 4 <= largest)


class VoxelSet:
    """The sparse voxels of one geometry: the placement that they were filled for, their surfels and groups.

    `mipmaps` are filtered from them; replaced voxels are cleared from them, also from the occupancy of the one that
    is `own`, which holds no other voxels. `is_lit`: the sums hold light, which must be cleared before relighting.
    """

    def __init__(
        self,
        gpu: GpuContext,
        size: int,
        mipmaps: Sequence[VoxelMipmap],
        *,
        own: VoxelMipmap | None = None,
    ) -> None:
        self._gpu, self._own = gpu, own
        self.store = VoxelStore(gpu, size)
        self.volume = PlacedVolume(gpu, VolumePlacement((0.0, 0.0, 0.0), 1.0, size))
        self.groups = SurfelGroups(gpu, size)
        self.is_lit = False
        self._voxelize = Voxelize(gpu)
        self._clear = ClearVoxels(gpu, mipmaps)

    def fill(self, meshes: Meshes, placement: VolumePlacement) -> None:
        """Replaces the voxels by those of the triangles, and clears the old ones from the mipmaps."""
        self.fill_all([meshes], (placement,))

    def fill_all(self, meshes: Sequence[Meshes], placements: Sequence[VolumePlacement]) -> None:
        """Fills several volumes, each with the triangles of its own."""
        occupied = None if self._own is None else self._own.occupied
        self._clear.run(self.store, self.volume, occupied=occupied, group_grid=self.groups.filled_grid)
        self.volume.place(*placements)
        self._voxelize.run_all(self.store, meshes, self.volume)
        self.is_lit = False

    def resize(self, size: int, count: int) -> None:
        """Makes room for `count` volumes of `size` voxels an edge, as the mipmaps must have; all voxels are gone."""
        self.store.resize(size, count)
        self.groups.resize(size, count)

    def forget_light(self) -> None:
        """Clears the sums if they hold light."""
        if self.is_lit:
            clear_buffer(self._gpu, self.store.sums)
        self.is_lit = True

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.store, self.volume, self.groups, self._voxelize, self._clear)


def make_room(real: VoxelSet, others: Sequence[VoxelSet | VoxelMipmap], placements: Placements) -> None:
    """Makes room for so many volumes in the sets and mipmaps, or gives back what more of them took."""
    wanted = placements[0].size, len(placements)
    if wanted != (real.store.volume_size, real.store.volume_count):
        for each in (real, *others):
            each.resize(*wanted)


def voxel_placements(
    g: Graph, s: FrameResources, setup: Setup[DvctMethod], directions: int
) -> Resource[Placements]:
    """Declares the cubes of voxels around the objects, in the sizes that the memory budget and the GPU allow."""
    settings, size = setup.settings, setup.resolved.volume_size

    def size_of(count: int) -> int:
        return affordable_size(size, count, settings.memory_budget_mb, g.gpu, directions)

    return volume_placements(g, s, size_of, settings.volume_edge_m, settings.tier)


def surfel_scene(
    seen: Observation, lights: LightBuffers, albedo: AlbedoTexture, *, measured: bool = True
) -> dict[str, Binding]:
    """Returns the bindings for lighting real surfels; without `measured`, none counts as seen by the camera."""
    return {
        "SEVERAL_VIEWS": False,
        **seen.bindings,
        **lights.bindings,
        **albedo.bindings,
        "shadow_samples": SURFEL_SHADOW_SAMPLES,
        "bias_real": seen.scan.bias_m,
        "bias_object": seen.scan.bias_m,
        "depth_tolerance": DEPTH_TOLERANCE if measured else -1.0,
        "picture_lod": math.log2(SURFEL_PIXELS),
    }
