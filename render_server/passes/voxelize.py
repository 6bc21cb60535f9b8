"""From triangles to surfels and touched voxels (docs/method.md 4.2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel, list_threads
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.passes.gbuffer import MeshBuffers
from deltalight.render_server.passes.volumes import PlacedVolume
from deltalight.render_server.passes.voxels import LOWER_SURFELS, VoxelStore

PAIR_BYTES, PAIRS_HEADER_BYTES = 12, 16  # shaders/common/voxel_pieces.glsl
LONG_PIECE_BYTES = 8
LEAST_LONG_PIECES = 4096
PAIRS_PER_TRIANGLE = 2  # to begin with
LONGEST_EDGE_VOXELS = 8.0  # longer triangles are cut: balances the threads, bounds each one's loops


@dataclass(frozen=True, eq=False)
class VoxelizedMesh:
    """A mesh for the voxeliser: its triangles or, if `behind_m` is not 0, their backs, so far behind them (m).

    `chosen`: numbers of the triangles; None: all.
    """

    mesh: MeshBuffers
    behind_m: float = 0.0
    chosen: Int32[np.ndarray, " k"] | None = None

    @property
    def triangle_count(self) -> int:
        """How many triangles there are."""
        return self.mesh.triangle_count if self.chosen is None else len(self.chosen)


Meshes = Sequence[VoxelizedMesh]


@dataclass(frozen=True)
class PairCounts:
    """How many pairs and long pieces were found, with those that had no room, and pieces too long to be cut."""

    pairs: int
    long_pieces: int
    refused: int


class VoxelPairs:
    """Pairs of a piece of a triangle and a voxel that it may meet, of one mesh in one volume."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._pairs, self._long, self._chosen = (gpu.ctx.buffer(reserve=4) for _ in range(3))
        self.make_room(PairCounts(0, LEAST_LONG_PIECES, 0))

    @property
    def bindings(self) -> dict[str, Binding]:
        """The pairs."""
        return {"Pairs": self._pairs}

    @property
    def pair_capacity(self) -> int:
        """How many pairs there is room for."""
        return (self._pairs.size - PAIRS_HEADER_BYTES) // PAIR_BYTES

    @property
    def _long_capacity(self) -> int:
        return self._long.size // LONG_PIECE_BYTES

    def find(
        self, find: Kernel, cut: Kernel, mesh: VoxelizedMesh, volume: Bindings, longest_m: float
    ) -> None:
        """Lists the pairs; those without room are only counted."""
        self.make_room(PairCounts(PAIRS_PER_TRIANGLE * mesh.triangle_count, 0, 0))
        self._pairs.write(bytes(PAIRS_HEADER_BYTES))
        if mesh.chosen is not None:
            self._chosen.orphan(max(mesh.chosen.nbytes, 4))
            self._chosen.write(mesh.chosen.tobytes())
        shared: Bindings = {
            **volume,
            **mesh.mesh.solid,
            **self.bindings,
            "LongPieces": self._long,
            "longest_kept": longest_m,
        }
        count = mesh.triangle_count
        chosen = None if mesh.chosen is None else self._chosen
        find.run((count,), shared, Chosen=chosen, is_chosen=chosen is not None, triangle_count=count)
        cut.run((list_threads(self._gpu, self._long_capacity),), shared)

    def counts(self) -> PairCounts:
        """Returns what `find` counted; waits for the GPU."""
        return PairCounts(*np.frombuffer(self._pairs.read(12), np.uint32).tolist())

    def holds(self, counts: PairCounts) -> bool:
        """Whether there is room for so many."""
        return counts.pairs <= self.pair_capacity and counts.long_pieces <= self._long_capacity

    def make_room(self, counts: PairCounts) -> None:
        """Makes room for so many and some more; what was found is lost."""
        wanted = (
            (self._pairs, PAIRS_HEADER_BYTES, PAIR_BYTES, counts.pairs),
            (self._long, 0, LONG_PIECE_BYTES, counts.long_pieces),
        )
        for buffer, header, item_bytes, count in wanted:
            if buffer.size < header + item_bytes * count:
                self._gpu.check_storage(header + item_bytes * count, LOWER_SURFELS)
                buffer.orphan(header + item_bytes * count * 5 // 4)

    def release(self) -> None:
        """Frees the buffers."""
        release_all(self._pairs, self._long, self._chosen)


class Voxelize:
    """Clips triangles against the voxels they touch: surfels and touched voxels (docs/method.md 4.2)."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._find = Kernel(gpu, "voxel_pairs")
        self._cut = Kernel(gpu, "voxel_pairs", LONG=1)
        self._clip = Kernel(gpu, "voxelize")
        self._pairs: list[VoxelPairs] = []

    def run(self, store: VoxelStore, meshes: Meshes, volume: PlacedVolume) -> None:
        """Fills the empty `store` with the surfels of the triangles inside the volume."""
        self.run_all(store, [meshes], volume)

    def run_all(self, store: VoxelStore, meshes: Sequence[Meshes], volume: PlacedVolume) -> None:
        """Fills the empty `store`; `meshes` are those of each volume.

        Raises:
            DeltalightError: the triangles are too long for such small voxels, or no buffer holds their surfels.
        """
        placed = [
            (index, mesh) for index, own in enumerate(meshes) for mesh in own if mesh.triangle_count > 0
        ]
        while len(self._pairs) < len(placed):
            self._pairs.append(VoxelPairs(self._gpu))
        fillings = [
            _Filling(
                pairs,
                mesh,
                {**volume.bindings, "filled_volume": index, "behind": mesh.behind_m},
                LONGEST_EDGE_VOXELS * volume.placements[index].voxel_edge,
            )
            for pairs, (index, mesh) in zip(self._pairs, placed, strict=False)
        ]
        for each in fillings:
            self._list(each)
        counts = [self._counted(each) for each in fillings]
        store.reset(sum(counts))
        for each, count in zip(fillings, counts, strict=True):
            shared: Bindings = {**each.volume, **each.mesh.mesh.solid, **each.pairs.bindings}
            self._clip.run((list_threads(self._gpu, count),), shared, store.bindings)

    def _list(self, each: "_Filling") -> None:
        each.pairs.find(self._find, self._cut, each.mesh, each.volume, each.longest_m)

    def _counted(self, each: "_Filling") -> int:
        """Returns how many pairs there are, and makes room for all of them."""
        counts = each.pairs.counts()
        while not each.pairs.holds(counts):
            each.pairs.make_room(counts)
            self._list(each)
            counts = each.pairs.counts()
        if counts.refused:
            raise DeltalightError(
                "a mesh has triangles of more than a hundred thousand voxels; use fewer voxels or a smaller mesh."
            )
        return counts.pairs

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._find, self._cut, self._clip, *self._pairs)


@dataclass(frozen=True, eq=False)
class _Filling:
    """A mesh, the bindings of the volume that it is to fill, and from which edge on (m) triangles are cut."""

    pairs: VoxelPairs
    mesh: VoxelizedMesh
    volume: Bindings
    longest_m: float
