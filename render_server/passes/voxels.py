"""Mipmaps of voxel volumes; sparse voxel sets, from surfels to filtered texels."""

import math
from collections.abc import Callable, Sequence

import moderngl
import numpy as np

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.clearing import clear_buffer, clear_volume, note_cleared
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import list_threads
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.passes.volumes import MOST_VOLUMES, PlacedVolume

MEGABYTE = 1_000_000
DIRECTIONS = 6  # of an anisotropic volume; isotropic ones have 1
TAIL_CELLS = 8  # along an edge of a volume, of the bounces' tail (shaders/common/bounce_tail.glsl)

SLOT_BYTES = 4  # per voxel of a grid
SURFEL_BYTES = 64
SUMS_PER_SLOT = 24
DELTA_SUMS_PER_SLOT = 18
SURFELS_HEADER_BYTES = 16  # their number, padded
TOUCHED_HEADER_BYTES = 4
LEAST_SURFELS = 1024
# Of what is kept for a surfel or a slot: SUMS_PER_SLOT integers, SURFEL_LIGHT_BYTES (voxel_light.py).
LARGEST_ITEM_BYTES = 96
LOWER_VOLUME, LOWER_SURFELS = "method.volume_size", "method.volume_size or method.triangle_budget"


def mipmap_shape(size: int, directions: int, count: int = 1) -> tuple[int, int, int]:
    """Returns the size (x, y, z) of the texture of all levels and directions (shaders/common/volume.glsl).

    `count`: of volumes, side by side.
    """
    return count * size, size, directions * size + math.ceil(directions / 2) * size // 2


def occupancy_bytes(size: int) -> int:
    """Returns the bytes of a mipmap's occupancy, bits of all levels (shaders/common/occupancy.glsl)."""
    first, above = ((cells + 1) ** 2 * (cells // 32 + 1) for cells in (size, size // 2))
    return 4 * (first + above * size.bit_length()) if size else 0


def mipmap_bytes(size: int, directions: int) -> int:
    """Returns the bytes of an RGBA16F mipmap with its occupancy."""
    return math.prod(mipmap_shape(size, directions)) * 8 + occupancy_bytes(size)


def volume_memory_bytes(size: int, directions: int) -> int:
    """Returns the bytes of an RGBA16F mipmap and of the grids of one voxel set: its slots, and its groups."""
    return mipmap_bytes(size, directions) + size**3 * SLOT_BYTES + group_grid_bytes(size)


def group_grid_bytes(size: int) -> int:
    """Returns the bytes of the grid of groups: an entry for each block of 2^3 voxels and main axis."""
    return DIRECTIONS * (size // 2) ** 3 * 4


def bounce_tail_bytes() -> int:
    """Returns the bytes of the bounces' tail, RGBA16F, which has room for the most volumes (BounceTail)."""
    return MOST_VOLUMES * DIRECTIONS * TAIL_CELLS**3 * 8


def memory_statement(size: int, directions: int, budget_mb: int, far_size: int = 0) -> str:
    """Returns a sentence that states the memory of a volume set: two mipmaps and two voxel sets.

    `far_size`: of the coarse volume beyond, which has one of each. Surfels come on top, as many as there are.

    Raises:
        DeltalightError: it exceeds the budget.
    """
    size_bytes = 2 * volume_memory_bytes(size, directions) + volume_memory_bytes(far_size, DIRECTIONS)
    if directions == DIRECTIONS:
        size_bytes += bounce_tail_bytes()
    needed = within_budget(size_bytes, f"A volume set of {size}^3 voxels", budget_mb, LOWER_VOLUME)
    return f"volume set {size}^3: {needed} MB of a budget of {budget_mb} MB"


def within_budget(size_bytes: int, what: str, budget_mb: int, lower: str) -> int:
    """Returns the MB of `what`, whose settings `lower` make it smaller.

    Raises:
        DeltalightError: it exceeds the budget.
    """
    needed = math.ceil(size_bytes / MEGABYTE)
    if needed > budget_mb:
        raise DeltalightError(
            f"{what} takes {needed} MB, beyond the budget of {budget_mb} MB: "
            f"lower {lower} or raise method.memory_budget_mb."
        )
    return needed


class VoxelMipmap:
    """An RGBA16F volume with mip levels: premultiplied radiance and coverage, a slab per direction.

    `occupied` has a bit for each place where a sample of a level may meet anything (shaders/common/occupancy.glsl).
    """

    def __init__(self, gpu: GpuContext, size: int, directions: int) -> None:
        self._gpu = gpu
        self.directions = directions
        self._allocate(size, 1)

    def resize(self, size: int, count: int) -> None:
        """Makes room for `count` volumes of `size` voxels an edge, all empty."""
        self.release()
        self._allocate(size, count)

    def _allocate(self, size: int, count: int) -> None:
        gpu, shape = self._gpu, mipmap_shape(size, self.directions, count)
        limit = gpu.ctx.info["GL_MAX_3D_TEXTURE_SIZE"]
        if max(shape) > limit:
            raise DeltalightError(
                f"This GPU's 3-D textures end at {limit} texels, {size}^3 voxels need {max(shape)}: "
                "lower method.volume_size."
            )
        self.texture = gpu.ctx.texture3d(shape, 4, dtype="f2")
        self.texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self.texture.repeat_x = self.texture.repeat_y = self.texture.repeat_z = False
        clear_volume(gpu, self.texture)
        self.occupied = gpu.storage_buffer(count * occupancy_bytes(size), LOWER_VOLUME)
        clear_buffer(gpu, self.occupied)

    def release(self) -> None:
        """Frees the texture and the buffer."""
        release_all(self.texture, self.occupied)


class VoxelsOnDemand:
    """Level 0 of a mipmap for debug view `volume`: `draw` fills it when the view is looked at, and only once."""

    def __init__(self, mipmap: VoxelMipmap, draw: Callable[[], None]) -> None:
        self._mipmap = mipmap
        self._draw: Callable[[], None] | None = draw

    @property
    def directions(self) -> int:
        """Number of slabs."""
        return self._mipmap.directions

    @property
    def texture(self) -> moderngl.Texture3D:
        """The mipmap's texture, drawn."""
        if self._draw is not None:
            self._draw()
            self._draw = None
        return self._mipmap.texture


class VoxelStore:
    """Slots, surfels and fixed-point sums of the real or the virtual geometry (shaders/common/voxel_store.glsl).

    Buffers grow with the number of surfels that a mesh can produce; the grid is as large as the volume.
    """

    def __init__(self, gpu: GpuContext, volume_size: int) -> None:
        self._gpu = gpu
        self._allocate_grid(volume_size, 1)
        self._allocate(LEAST_SURFELS)
        self.reset(0)

    def _allocate_grid(self, size: int, count: int) -> None:
        self.volume_size, self.volume_count = size, count
        self.grid = self._gpu.storage_buffer(count * size**3 * SLOT_BYTES, LOWER_VOLUME)
        clear_buffer(self._gpu, self.grid)

    def resize(self, size: int, count: int) -> None:
        """Makes room for `count` volumes of `size` voxels an edge, and forgets all voxels."""
        self.grid.release()
        self._allocate_grid(size, count)
        self._release_growing()
        self._allocate(self.surfel_capacity)
        self.reset(0)

    @property
    def slot_capacity(self) -> int:
        """Greatest number of touched voxels."""
        return min(self.surfel_capacity, self.volume_count * self.volume_size**3)

    @property
    def bindings(self) -> dict[str, Binding]:
        """The blocks of voxel_store.glsl."""
        return {
            "Grid": self.grid,
            "Touched": self.touched,
            "Surfels": self.surfels,
            "Sums": self.sums,
        }

    def _allocate(self, surfels: int) -> None:
        """Allocates the buffers that grow, with room for `surfels` surfels."""
        self.surfel_capacity = surfels
        slots = self.slot_capacity
        sizes = (
            SURFELS_HEADER_BYTES + surfels * SURFEL_BYTES,
            TOUCHED_HEADER_BYTES + slots * 4,
            slots * SUMS_PER_SLOT * 4,
            slots * DELTA_SUMS_PER_SLOT * 4,
        )
        self.surfels, self.touched, self.sums, self.delta_sums = (
            self._gpu.storage_buffer(size, LOWER_SURFELS) for size in sizes
        )

    def _release_growing(self) -> None:
        for buffer in (self.surfels, self.touched, self.sums, self.delta_sums):
            buffer.release()

    def reset(self, surfel_bound: int) -> None:
        """Begins a new voxelisation of at most `surfel_bound` surfels; the old voxels must have been cleared.

        Raises:
            DeltalightError: buffers cannot hold so many; the store is as it was.
        """
        if surfel_bound > self.surfel_capacity:
            self._gpu.check_storage(surfel_bound * LARGEST_ITEM_BYTES, LOWER_SURFELS)
            self._release_growing()
            self._allocate(self._room_for(surfel_bound))
        self._gpu.clear_start(self.surfels, SURFELS_HEADER_BYTES)
        self._gpu.clear_start(self.touched, TOUCHED_HEADER_BYTES)

    def _room_for(self, surfels: int) -> int:
        """Room to grow, up to what a buffer can hold."""
        most = int(self._gpu.ctx.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"]) // LARGEST_ITEM_BYTES
        return max(surfels, min(int(surfels * 1.25) + LEAST_SURFELS, most - 1))

    def counts(self) -> tuple[int, int]:
        """Returns the numbers of touched voxels and surfels; waits for the GPU (tests and reports only)."""
        slots, surfels = (np.frombuffer(each.read(4), np.uint32)[0] for each in (self.touched, self.surfels))
        return int(slots), int(surfels)

    def release(self) -> None:
        """Frees all buffers."""
        self._release_growing()
        self.grid.release()


class ClearVoxels:
    """Clears the voxels that a set touched, instead of whole volumes: its slots and its texels."""

    def __init__(self, gpu: GpuContext, mipmaps: Sequence[VoxelMipmap]) -> None:
        """`mipmaps`: one or two, of as many directions, in which the set's voxels have texels."""
        first, *second = self._mipmaps = mipmaps
        self._threads = list_threads(gpu)
        defines = {"DIRECTIONS": first.directions, **({"TWO": 1} if second else {})}
        # In software, FilterVoxels walks lists, and clearing whole buffers is a memset.
        defines["LEVEL_1" if gpu.is_software else "BUFFERS"] = 1
        self._gpu, self._kernel = gpu, Kernel(gpu, "clear_voxels", **defines)

    def run(
        self,
        store: VoxelStore,
        volume: PlacedVolume,
        *,
        occupied: moderngl.Buffer | None = None,
        group_grid: moderngl.Buffer | None = None,
    ) -> None:
        """Clears the voxels; the lists of `store` are left for the voxelisation that follows to `reset`.

        Also clears an occupancy that holds these voxels alone and, on a GPU, the grid of their groups.
        """
        bound: dict[str, Binding] = {
            name: each.texture for name, each in zip(("mipmap", "second"), self._mipmaps, strict=False)
        }
        if not self._gpu.is_software:
            bound.update(Occupied=occupied, GroupGrid=group_grid)
        elif occupied is not None:
            clear_buffer(self._gpu, occupied)
        self._kernel.run((self._threads,), store.bindings, volume.bindings, **bound)
        if group_grid is not None:
            note_cleared(self._gpu, (group_grid, group_grid.size))

    def release(self) -> None:
        """Frees the program."""
        self._kernel.release()


class ResolveVoxels:
    """Writes sums to level 0: of mu (real alone) and of rho (real with its changed light, and virtual).

    Where they are told to, both mark in the mipmap's occupancy which cells hold anything.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._mu, self._rho = Kernel(gpu, "resolve_voxels"), Kernel(gpu, "resolve_voxels", RHO=1)

    def resolve_mu(
        self, mu: VoxelMipmap, real: VoxelStore, volume: PlacedVolume, *, occupies: bool = False
    ) -> None:
        """Writes (c_mu, a_real); `occupies`: the mipmap's occupancy, which is empty, too."""
        own: Bindings = {"mipmap": mu.texture, "Occupied": mu.occupied, "marks": occupies}
        self._mu.run((self._threads,), own, real.bindings, volume.bindings)

    def resolve_rho(
        self,
        rho: VoxelMipmap,
        real: VoxelStore,
        virtual: VoxelStore,
        volume: PlacedVolume,
        *,
        occupies: bool = False,
    ) -> None:
        """Writes (c_rho, a_real + a_virtual).

        `occupies`: adds the virtual set to the mipmap's occupancy, which is that of mu.
        """
        self._rho.run(
            (self._threads,),
            real.bindings,
            volume.bindings,
            mipmap=rho.texture,
            Occupied=rho.occupied,
            marks=occupies,
            VirtualTouched=virtual.touched,
            **_joint_sums(real, virtual),
        )

    def release(self) -> None:
        """Frees the programs."""
        release_all(self._mu, self._rho)


def _joint_sums(real: VoxelStore, virtual: VoxelStore) -> dict[str, Binding]:
    """What resolved_voxels.glsl reads of both sets besides the real one's own."""
    return {"DeltaSums": real.delta_sums, "VirtualGrid": virtual.grid, "VirtualSums": virtual.sums}


class LevelFilter:
    """Runs a kernel that filters the levels of mipmaps, all in one dispatch on a GPU (common/mipmap_tiles.glsl).

    In software each is a dispatch: workgroups that wait for their own stores take 3.5 times as long there.
    """

    def __init__(self, gpu: GpuContext, name: str, **defines: int) -> None:
        self._gpu, self._is_fused = gpu, not gpu.is_software
        self._kernel = Kernel(gpu, name, **defines, **({"FUSED": 1} if self._is_fused else {}))

    def run(
        self,
        volume: PlacedVolume,
        directions: int,
        *shared: Bindings,
        first: int = 1,
        **images: moderngl.Texture3D,
    ) -> None:
        """Rebuilds the levels from `first` on, of mipmaps of so many directions."""
        levels = volume.placement.levels
        for level in (first,) if self._is_fused else range(first, levels):
            self._filter(volume, directions, level, *shared, {"level_count": levels - level, **images})

    def _filter(self, volume: PlacedVolume, directions: int, level: int, *shared: Bindings) -> None:
        """Filters from a level on, one or all of the levels that are counted."""
        tile = self._kernel.local_size[0] if self._is_fused else 1
        cells = math.ceil((volume.placement.size >> level) / tile) * tile  # whole tiles
        threads = (cells, cells, cells * directions * len(volume.placements))
        own: Bindings = {"first_level": level, "GroupsDone": self._gpu.group_counters}
        self._kernel.run(threads, volume.bindings, own, *shared)

    def release(self) -> None:
        """Frees the program."""
        self._kernel.release()


class FilterVoxels:
    """Filters the levels of an anisotropic mipmap (docs/method.md 4.4).

    In software, level 1 is filtered around the touched voxels alone (ClearVoxels empties what they leave).
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._levels, self._threads = LevelFilter(gpu, "filter_voxels"), list_threads(gpu)
        self._listed = Kernel(gpu, "filter_voxels", LISTED=1) if gpu.is_software else None

    def run(self, mipmap: VoxelMipmap, volume: PlacedVolume, *stores: VoxelStore) -> None:
        """Rebuilds all levels from level 0, of cells that hold anything by the mipmap's occupancy.

        `stores`: all whose voxels level 0 holds; without any, every cell may hold something.
        """
        first = 1 + self._filter_listed(mipmap, volume, stores)
        occupied: Bindings = {"Occupied": mipmap.occupied}
        self._levels.run(volume, DIRECTIONS, occupied, first=first, mipmap=mipmap.texture)

    def _filter_listed(self, mipmap: VoxelMipmap, volume: PlacedVolume, stores: Sequence[VoxelStore]) -> int:
        """Filters the levels where walking the voxels' list is faster; returns how many."""
        if self._listed is None or not stores:
            return 0
        for store in stores:
            self._listed.run(
                (self._threads,),
                volume.bindings,
                mipmap=mipmap.texture,
                Grid=store.grid,
                Touched=store.touched,
            )
        return 1

    def release(self) -> None:
        """Frees the programs."""
        release_all(self._levels, self._listed)


class FillMipmap:
    """Fills mipmaps from the sums of lit voxels; on a GPU in one dispatch: `LightVoxels` marks occupancy."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._resolve, self._filter = ResolveVoxels(gpu), FilterVoxels(gpu)
        self._mu: LevelFilter | None = None
        self._rho: LevelFilter | None = None
        if not gpu.is_software:
            self._mu = LevelFilter(gpu, "filter_voxels", RESOLVES=1)
            self._rho = LevelFilter(gpu, "filter_voxels", RESOLVES=1, RHO=1, SPENDS=1)

    def fill_mu(
        self, mu: VoxelMipmap, real: VoxelStore, volume: PlacedVolume, *, is_first: bool = False
    ) -> None:
        """Writes (c_mu, a_real), and filters it.

        `is_first`: of these voxels; then their occupancy is that which `LightVoxels` marked, or is marked here.
        """
        if self._mu is None:
            self._resolve.resolve_mu(mu, real, volume, occupies=is_first)
            self._filter.run(mu, volume, real)
        else:
            own: Bindings = {"Occupied": mu.occupied}
            self._mu.run(volume, DIRECTIONS, own, real.bindings, mipmap=mu.texture)

    def begin_rho(self, rho: VoxelMipmap, mu: VoxelMipmap) -> moderngl.Buffer:
        """Returns the occupancy of `rho` for `LightVoxels`, which adds the objects to it; it holds that of `mu`."""
        self._gpu.ctx.copy_buffer(rho.occupied, mu.occupied)
        return rho.occupied

    def fill_first_rho(
        self, rho: VoxelMipmap, real: VoxelStore, virtual: VoxelStore, volume: PlacedVolume
    ) -> None:
        """Writes (c_rho, a_real + a_virtual) and filters it; the objects have been lit since `begin_rho`.

        On a GPU it uses up the sums of changed light.
        """
        if self._rho is None:
            self._resolve.resolve_rho(rho, real, virtual, volume, occupies=True)
            self._filter.run(rho, volume, real, virtual)
        else:
            self.fill_rho(rho, real, virtual, volume)

    def fill_rho(
        self,
        rho: VoxelMipmap,
        real: VoxelStore,
        virtual: VoxelStore,
        volume: PlacedVolume,
        *,
        is_last: bool = False,
    ) -> bool:
        """Does the same again, of the same voxels; returns whether it used up the virtual sums, too.

        On a GPU it does where `is_last`: nothing reads them before the objects are lit anew.
        """
        if self._rho is None:
            self._resolve.resolve_rho(rho, real, virtual, volume)
            self._filter.run(rho, volume, real, virtual)
            return False
        own: Bindings = {"Occupied": rho.occupied, "spends_virtual": is_last, **_joint_sums(real, virtual)}
        self._rho.run(volume, DIRECTIONS, own, real.bindings, mipmap=rho.texture)
        note_cleared(self._gpu, (real.delta_sums, real.delta_sums.size))
        return is_last

    def release(self) -> None:
        """Frees the programs."""
        release_all(self._resolve, self._filter, self._mu, self._rho)
