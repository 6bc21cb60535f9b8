"""Light of voxels.

Direct and measured, and light that surfels gather from voxels around them (docs/method.md 4.3).
"""

from collections.abc import Mapping
from typing import Any, Final

import moderngl
import numpy as np
from jaxtyping import Float32

from deltalight.render_server.gpu.clearing import clear_buffer, clear_volume
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import list_threads
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.passes.caustics import GREATEST_ALPHA
from deltalight.render_server.passes.volumes import MOST_VOLUMES
from deltalight.render_server.passes.voxels import (
    DIRECTIONS,
    LOWER_SURFELS,
    LOWER_VOLUME,
    TAIL_CELLS,
    VoxelMipmap,
    VoxelStore,
    group_grid_bytes,
)
from deltalight.render_server.scene.albedo import MEAN_ALBEDO, AlbedoVolume

SUPPORT_BYTES = 24 * MOST_VOLUMES
_FAR_AWAY = 1 << 20  # voxels
NO_SUPPORT: Final = np.full(6 * MOST_VOLUMES, _FAR_AWAY, np.int32).tobytes()  # mu and rho differ nowhere

SURFEL_LIGHT_BYTES = 2 * 48  # front and back
GROUP_SUMS_BYTES = 44
GROUP_LIGHT_BYTES = 32
HEADER_BYTES = 4
NO_GROUPS: Final[Bindings] = {"SurfelLights": None}

# Of shaders/common/bounce_tail.glsl: the sums of a volume.
TAIL_SUMS_BYTES = DIRECTIONS * TAIL_CELLS**3 * 6 * 4

GATHER_CONES = 4  # as good as 16 in pictures: cones that see gathered light average over many groups
# In software, per 64 voxels of edge: lists are short, and more walkers would mostly idle in the last round. Groups
# lie on surfaces, so their number grows with the square of the edge; this many keep each walker's loops short of
# where Mesa cuts them off (SOFTWARE_DIVISOR in gpu/kernel.py).
SOFTWARE_WALKERS = 256


class SurfelGroups:
    """Groups of surfels that gather light together, and each surfel's own light, for one voxel store.

    There is room for one group per surfel; blocks of 2^3 voxels mostly hold many surfels of one main axis.
    """

    def __init__(self, gpu: GpuContext, volume_size: int) -> None:
        self._gpu = gpu
        self._grid = gpu.storage_buffer(group_grid_bytes(volume_size), LOWER_VOLUME)
        self._is_filled = False
        self._allocate(0)

    def resize(self, size: int, count: int) -> None:
        """Makes room for the groups of `count` volumes of `size` voxels an edge; `reset` is next."""
        self._grid.release()
        self._grid = self._gpu.storage_buffer(count * group_grid_bytes(size), LOWER_VOLUME)
        self._is_filled = False

    @property
    def filled_grid(self) -> moderngl.Buffer | None:
        """The grid, for whoever clears it together with the voxels; None: there are no groups."""
        return self._grid if self._is_filled else None

    @property
    def bindings(self) -> dict[str, Binding]:
        """The blocks of surfel_groups.glsl and surfel_light.glsl."""
        return {
            "GroupGrid": self._grid,
            "GroupEntries": self._entries,
            "GroupSums": self._sums,
            "GroupLight": self._light,
            "SurfelLights": self.lights,
        }

    def reset(self, store: VoxelStore) -> None:
        """Clears all groups and makes room for those of `store`."""
        if store.surfel_capacity != self._room:
            self._release_growing()
            self._allocate(store.surfel_capacity)
        clear_buffer(self._gpu, self._grid)
        self._is_filled = True
        self._gpu.clear_start(self._entries, HEADER_BYTES)

    def _allocate(self, surfels: int) -> None:
        """Allocates the buffers that grow, with room for `surfels` surfels."""
        self._room = surfels
        room = max(surfels, 1)
        sizes = (
            room * SURFEL_LIGHT_BYTES,
            HEADER_BYTES + surfels * 4,
            room * GROUP_SUMS_BYTES,
            room * GROUP_LIGHT_BYTES,
        )
        self.lights, self._entries, self._sums, self._light = (
            self._gpu.storage_buffer(size, LOWER_SURFELS) for size in sizes
        )

    def _release_growing(self) -> None:
        for buffer in (self.lights, self._entries, self._sums, self._light):
            buffer.release()

    def release(self) -> None:
        """Frees all buffers."""
        self._release_growing()
        self._grid.release()


class LightVoxels:
    """Sums the radiance and opacity of each surfel per direction, by kind of sum.

    The kinds are real light without objects, the real change, virtual light, and real light of a full solution. With
    `gathered`, gathered light replaces unoccluded ambient light, and the sums change by the difference; direct light
    is that of the last run without. With `from_mu`, the light that was gathered from mu is there from the start.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._threads = list_threads(gpu)
        self._kernels: dict[tuple[str, ...], Kernel] = {}
        self.support = gpu.ctx.buffer(reserve=SUPPORT_BYTES)

    @property
    def bindings(self) -> dict[str, Binding]:
        """Bounds of the voxels where mu and rho differ, as march.glsl reads them."""
        return {"Support": self.support}

    def light_real(
        self,
        store: VoxelStore,
        scene: Bindings,
        groups: SurfelGroups | None = None,
        *,
        gathered: bool = False,
        finds_groups: bool = False,
        occupied: moderngl.Buffer | None = None,
    ) -> None:
        """Sums c_mu and a_real; `groups` keep each surfel's light. `finds_groups`: gives groups slots on the way.

        On a GPU, also marks the voxels in the occupancy of their mipmap, which is empty; in software,
        `ResolveVoxels` does, because that walks fewer.
        """
        more = [*["FINDS_GROUPS"] * finds_groups, *["MARKS"] * self._marks(occupied)]
        self._run("REAL", store, groups, scene, *more, gathered=gathered, occupied=occupied)

    def _marks(self, occupied: moderngl.Buffer | None) -> bool:
        return occupied is not None and not self._gpu.is_software

    def light_real_delta(
        self,
        store: VoxelStore,
        scene: Bindings,
        groups: SurfelGroups,
        *,
        gathered: bool = False,
        from_mu: bool = False,
    ) -> None:
        """Sums c_rho - c_mu of real surfaces, whose L_mu `groups` hold; extends the support."""
        clear_buffer(self._gpu, store.delta_sums)
        self._run("REAL_DELTA", store, groups, scene, gathered=gathered, from_mu=from_mu)

    def light_virtual(
        self,
        store: VoxelStore,
        scene: Bindings,
        groups: SurfelGroups | None = None,
        *,
        gathered: bool = False,
        from_mu: bool = False,
        occupied: moderngl.Buffer | None = None,
    ) -> None:
        """Sums c and a of virtual surfaces; `groups` keep each surfel's light.

        On a GPU, also marks the voxels in the occupancy, which already holds the real ones.
        """
        more = ["MARKS"] * self._marks(occupied)
        self._run(
            "VIRTUAL", store, groups, scene, *more, gathered=gathered, from_mu=from_mu, occupied=occupied
        )

    def light_solution(
        self,
        store: VoxelStore,
        scene: Bindings,
        groups: SurfelGroups,
        *,
        with_objects: bool,
        gathered: bool = False,
        occupied: moderngl.Buffer | None = None,
    ) -> None:
        """Sums all light and opacity of real surfaces under the maps of `scene`; `occupied` as of `light_real`.

        Run it without objects first, so that `groups` hold E_mu for the other solution.
        """
        clear_buffer(self._gpu, store.sums)
        kind, more = "REAL_RHO" if with_objects else "REAL_MU", ["MARKS"] * self._marks(occupied)
        self._run(kind, store, groups, scene, *more, gathered=gathered, occupied=occupied)

    def _run(
        self,
        kind: str,
        store: VoxelStore,
        groups: SurfelGroups | None,
        scene: Bindings,
        *more: str,
        gathered: bool,
        from_mu: bool = False,
        occupied: moderngl.Buffer | None = None,
    ) -> None:
        self._kernel(kind, *more, *["GATHERED"] * gathered, *["FROM_MU"] * from_mu).run(
            (self._threads,),
            store.bindings,
            NO_GROUPS if groups is None else groups.bindings,
            {"Occupied": occupied},
            scene,
            keep_light=groups is not None,
            DeltaSums=store.delta_sums,
            Support=self.support,
        )

    def _kernel(self, *names: str) -> Kernel:
        """Returns the kernel of these defines, compiled on first use."""
        if names not in self._kernels:
            defines = {**dict.fromkeys(names, 1), "GREATEST_ALPHA": GREATEST_ALPHA}
            self._kernels[names] = Kernel(self._gpu, "light_voxels", **defines)
        return self._kernels[names]

    def reset_support(self, bounds: np.ndarray[Any, np.dtype[np.int32]]) -> None:
        """Resets the support of the delta to the voxels of the objects: min x, y, z, -max x, y, z of each volume."""
        self.support.write(bounds.tobytes())

    def release(self) -> None:
        """Frees the GL objects."""
        for kernel in self._kernels.values():
            kernel.release()
        self.support.release()


class GroupSurfels:
    """Walks the surfels twice: finds the groups, then sums each group's area, normal and position."""

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._find = Kernel(gpu, "group_surfels")
        self._sum = Kernel(gpu, "group_surfels", SUM=1)

    def run(self, store: VoxelStore, groups: SurfelGroups, scene: Bindings) -> None:
        """Fills `groups` (after their `reset`)."""
        self._find.run((self._threads,), store.bindings, groups.bindings, scene)
        self.sum(store, groups, scene, has_seen=False)

    def sum(self, store: VoxelStore, groups: SurfelGroups, scene: Bindings, *, has_seen: bool) -> None:
        """Sums up groups that were found; with `has_seen`, its surfel lights mark what the camera sees."""
        self._sum.run((self._threads,), store.bindings, groups.bindings, scene, has_seen=has_seen)

    def release(self) -> None:
        """Frees the programs."""
        self._find.release()
        self._sum.release()


def gather_threads(gpu: GpuContext, store: VoxelStore) -> int:
    """Returns the number of threads that walk the groups of a store's surfels."""
    if not gpu.is_software:
        return list_threads(gpu)
    edge = store.volume_size / 64
    return max(SOFTWARE_WALKERS, round(SOFTWARE_WALKERS * edge * edge)) * store.volume_count


def gather_bindings(
    store: VoxelStore, groups: SurfelGroups, mu: VoxelMipmap, rho: VoxelMipmap
) -> dict[str, Binding]:
    """Returns what all kernels of gather_voxels read; it comes before the scene, whose cones are others."""
    return {
        **store.bindings,
        **groups.bindings,
        "mipmap_mu": mu.texture,
        "mipmap_rho": rho.texture,
        "Occupied": rho.occupied,
        "cone_count": GATHER_CONES,
    }


class GatherVoxels:
    """Gathers the light of a few cones for each group. `defines` are those of march.glsl."""

    def __init__(self, gpu: GpuContext, defines: Mapping[str, int]) -> None:
        self._gpu = gpu
        self._whole = Kernel(gpu, "gather_voxels", **defines)
        self._change = Kernel(gpu, "gather_voxels", CHANGE=1, **defines)

    def gather(
        self,
        store: VoxelStore,
        groups: SurfelGroups,
        mipmap: VoxelMipmap,
        scene: Bindings,
        *,
        only_unseen: bool = False,
        keeps_mu: bool = False,
    ) -> None:
        """Gathers E_mu and E_rho of every group from one mipmap.

        `only_unseen`: of those with surfels that the camera does not see; `keeps_mu`: E_rho alone.
        """
        own = {"only_unseen": only_unseen, "keeps_mu": keeps_mu}
        self._run(self._whole, store, groups, (mipmap, mipmap), {**scene, **own})

    def gather_change(
        self, store: VoxelStore, groups: SurfelGroups, mu: VoxelMipmap, rho: VoxelMipmap, scene: Bindings
    ) -> None:
        """Gathers E_rho of every group: its E_mu, and what the objects change."""
        own = {"only_unseen": False, "keeps_mu": True}
        self._run(self._change, store, groups, (mu, rho), {**scene, **own})

    def _run(
        self,
        kernel: Kernel,
        store: VoxelStore,
        groups: SurfelGroups,
        mipmaps: tuple[VoxelMipmap, VoxelMipmap],
        scene: Bindings,
    ) -> None:
        kernel.run((gather_threads(self._gpu, store),), gather_bindings(store, groups, *mipmaps), scene)

    def release(self) -> None:
        """Frees the programs."""
        release_all(self._whole, self._change)


class BounceTail:
    """What further bounces than those that the voxels hold change on real surfaces (docs/method.md 4.3).

    Irradiance in cells of a coarse grid of each volume (shaders/common/bounce_tail.glsl); zero until it is found.
    """

    def __init__(self, gpu: GpuContext, defines: Mapping[str, int]) -> None:
        self._gpu = gpu
        self._sums = gpu.ctx.buffer(bytes(MOST_VOLUMES * TAIL_SUMS_BYTES))
        shape = MOST_VOLUMES * TAIL_CELLS, TAIL_CELLS, DIRECTIONS * TAIL_CELLS
        self.irradiance = gpu.ctx.texture3d(shape, 4, dtype="f2")
        self.irradiance.filter = (moderngl.LINEAR, moderngl.LINEAR)
        clear_volume(gpu, self.irradiance)
        # In software, a workgroup that waits for its own stores takes longer than another dispatch (LevelFilter).
        fused = {} if gpu.is_software else {"FUSED": 1}
        self._gather = Kernel(gpu, "gather_voxels", TAIL=1, **fused, **defines)
        self._sum = Kernel(gpu, "bounce_tail") if gpu.is_software else None

    def find(
        self,
        store: VoxelStore,
        groups: SurfelGroups,
        mu: VoxelMipmap,
        rho: VoxelMipmap,
        scene: Bindings,
    ) -> None:
        """Finds it from what one more gathering from `rho` would add to what `groups` hold."""
        own: Bindings = {
            "TailSums": self._sums,
            "bounce_tail": self.irradiance,
            "GroupsDone": self._gpu.group_counters,
        }
        gathered = {**gather_bindings(store, groups, mu, rho), "only_unseen": False}
        self._gather.run((gather_threads(self._gpu, store),), own, gathered, scene)
        if self._sum is not None:
            self._sum.run((store.volume_count * self._sum.local_size[0],), own)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._sums, self.irradiance, self._gather, self._sum)


class AlbedoTexture:
    """A 3-D texture of albedo over a cube in world axes, for real surfaces out of the camera's view.

    Until something was observed, it holds the mean of rooms.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._texture: moderngl.Texture3D | None = None
        self.clear(MEAN_ALBEDO)

    @property
    def bindings(self) -> dict[str, Binding]:
        """The bindings of real_radiance.glsl."""
        return {"albedo_volume": self._texture, "albedo_cube": self._cube}

    def clear(self, albedo: float) -> None:
        """Sets the same albedo everywhere."""
        self._replace(np.full((1, 1, 1, 3), albedo, np.float32))
        self._cube = (0.0, 0.0, 0.0, 1.0)

    def upload(self, memory: AlbedoVolume) -> None:
        """Uploads everything that was observed."""
        self._replace(memory.filled())
        x, y, z = (float(v) for v in memory.origin)
        self._cube = (x, y, z, 1 / memory.edge)

    def _replace(self, albedo: Float32[np.ndarray, "z y x 3"]) -> None:
        self.release()
        texels = np.concatenate([albedo, np.ones_like(albedo[..., :1])], axis=-1).astype(np.float16)
        depth, height, width = albedo.shape[:3]
        texture = self._gpu.ctx.texture3d(
            (width, height, depth), 4, texels.tobytes(), dtype="f2", alignment=1
        )
        texture.repeat_x = texture.repeat_y = texture.repeat_z = False
        self._texture = texture

    def release(self) -> None:
        """Frees the texture."""
        if self._texture is not None:
            self._texture.release()
