"""From triangles to surfels and touched voxels (docs/method.md 4.2)."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from jaxtyping import Int32

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import list_threads
from deltalight.render_server.gpu.textures import DelayedRead, release_all
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.passes.volumes import MOST_VOLUMES, PlacedVolume, VolumePlacement
from deltalight.render_server.passes.voxels import LOWER_SURFELS, VoxelStore

PAIR_BYTES, PAIRS_HEADER_BYTES, COUNTS_BYTES = 12, 16, 12  # shaders/common/voxel_pieces.glsl
LONG_PIECE_BYTES = 8
NUMBER_BYTES = 4  # of a chosen triangle
LEAST_LONG_PIECES = 4096
PAIRS_PER_TRIANGLE = 2  # to begin with
# How many pairs are expected by those of earlier frames: so many times as many, and so many a voxel of a face.
GROWTH, MORE_A_FACE = 1.5, 2.0
MORE_TRIANGLES = 1.25  # beyond so many times as many, earlier frames tell nothing
FINER = 1.1  # likewise with edges of voxels, whose number grows with the square: within GROWTH
LONGEST_EDGE_VOXELS = 8.0  # longer triangles are cut: balances the threads, bounds each one's loops
MOST_FILLINGS = 2 * MOST_VOLUMES  # shaders/common/voxel_pieces.glsl: triangles and backs of one mesh


WriteChosen = Callable[[moderngl.Buffer, int], None]
"""Lets the GPU write, from a number of a buffer on, for each triangle its number or NOT_CHOSEN
(shaders/common/solid_mesh.glsl)."""
Chosen = Int32[np.ndarray, " k"] | WriteChosen | None
"""Numbers of triangles, or what writes them. None: all."""


@dataclass(frozen=True, eq=False)
class VoxelizedMesh:
    """A mesh for the voxeliser: its triangles or, if `behind_m` is not 0, their backs, so far behind them (m).

    `triangles`: those that are meant (default: all that are drawn); `chosen`: which of them, counted from the first.
    """

    mesh: MeshBuffers
    behind_m: float = 0.0
    chosen: Chosen = None
    triangles: range | None = None

    @property
    def first_triangle(self) -> int:
        """Where its triangles begin in the buffers."""
        return 0 if self.triangles is None else self.triangles.start

    @property
    def triangle_count(self) -> int:
        """How many triangles there are, at most if the GPU chooses them."""
        if isinstance(self.chosen, np.ndarray):
            return len(self.chosen)
        return self.mesh.triangle_count if self.triangles is None else len(self.triangles)


Meshes = Sequence[VoxelizedMesh]


@dataclass(frozen=True)
class PairCounts:
    """How many pairs and long pieces were found, with those that had no room; pieces too long to be cut."""

    pairs: int
    long_pieces: int
    refused: int = 0

    @classmethod
    def of(cls, header: bytes) -> "PairCounts":
        """Returns the counts of the pairs' header.

        Raises:
            DeltalightError: pieces were refused.
        """
        counts = cls(*np.frombuffer(header, np.uint32).tolist())
        if counts.refused:
            raise DeltalightError(
                "a mesh has triangles of more than a hundred thousand voxels; use fewer voxels or a smaller mesh."
            )
        return counts

    def fits(self, room: "PairCounts") -> bool:
        """Whether so many have room."""
        return self.pairs <= room.pairs and self.long_pieces <= room.long_pieces


@dataclass(frozen=True, eq=False)
class BatchSize:
    """How many triangles fill volumes together, and which volume each filling fills."""

    triangle_count: int
    placements: tuple[VolumePlacement, ...]

    def is_like(self, other: "BatchSize") -> bool:
        """Whether about as many pairs may be expected: of as many triangles, and as many voxels of about one size."""
        is_more = self.triangle_count > MORE_TRIANGLES * other.triangle_count
        return not is_more and len(self.placements) == len(other.placements) and self._is_of_one_size(other)

    def _is_of_one_size(self, other: "BatchSize") -> bool:
        return all(
            its.voxel_edge / FINER < mine.voxel_edge < its.voxel_edge * FINER and mine.size == its.size
            for mine, its in zip(self.placements, other.placements, strict=True)
        )

    def room(self, earlier: PairCounts) -> PairCounts:
        """Returns for how many to make room if as many were found as `earlier`, and some more."""
        more = MORE_A_FACE * sum(each.size**2 for each in self.placements)
        return PairCounts(int(GROWTH * earlier.pairs + more), LEAST_LONG_PIECES + 2 * earlier.long_pieces)


@dataclass(frozen=True, eq=False)
class Filling:
    """A mesh that is to fill the volume of a number."""

    mesh: VoxelizedMesh
    volume: int


@dataclass(frozen=True, eq=False)
class Batch:
    """Fillings with triangles of the same buffers, which kernels take together."""

    fillings: Sequence[Filling]
    volume: PlacedVolume

    @property
    def buffers(self) -> MeshBuffers:
        """What holds the triangles."""
        return self.fillings[0].mesh.mesh

    @cached_property
    def longest(self) -> int:
        """The number of triangles of the filling that has most."""
        return max(each.mesh.triangle_count for each in self.fillings)

    @cached_property
    def size(self) -> BatchSize:
        """What is remembered of it, which does not hold the meshes."""
        placements = self.volume.placements
        count = sum(each.mesh.triangle_count for each in self.fillings)
        return BatchSize(count, tuple(placements[each.volume] for each in self.fillings))

    @cached_property
    def chosen_starts(self) -> list[int]:
        """Where each filling's list of chosen triangles begins if it has one, and where the last one ends."""
        counts = (each.mesh.triangle_count * (each.mesh.chosen is not None) for each in self.fillings)
        return list(accumulate(counts, initial=0))

    @cached_property
    def bindings(self) -> dict[str, Binding]:
        """The fillings of voxel_pieces.glsl, and their volumes and triangles."""
        unused = MOST_FILLINGS - len(self.fillings)
        rows = [
            (own.first_triangle, own.triangle_count, -1 if own.chosen is None else start, each.volume)
            for each, start in zip(self.fillings, self.chosen_starts, strict=False)
            for own in [each.mesh]
        ]
        behind = [each.mesh.behind_m for each in self.fillings]
        return {
            **self.volume.bindings,
            **self.buffers.solid,
            "fillings": (*rows, *[(0, 0, 0, 0)] * unused),
            "behind": (*behind, *[0.0] * unused),
        }


class EarlierCounts:
    """What earlier batches of one mesh tell about the next one, so that the CPU need not wait for the GPU to count.

    Where they tell nothing it waits, and in software always: it has nothing else to do. A batch that has more pairs
    than expected lacks them; two batches later that is known, and the CPU waits.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._late = DelayedRead(gpu, COUNTS_BYTES)
        self._waiting: deque[tuple[BatchSize, PairCounts]] = deque()  # and the room that each had
        self._known: tuple[BatchSize, PairCounts] | None = None

    def expected(self, batch: BatchSize) -> PairCounts | None:
        """Returns for how many to make room; None: wait and see."""
        header = self._late.pop()
        if header is not None:
            before, room = self._waiting.popleft()
            counts = PairCounts.of(header)
            self._known = (before, counts) if counts.fits(room) else None
        if self._gpu.is_software or self._known is None:
            return None
        before, counts = self._known
        return batch.room(counts) if batch.is_like(before) else None

    def wait(self, batch: BatchSize, pairs: moderngl.Buffer) -> PairCounts:
        """Waits for the counts of a batch, and forgets those of earlier ones."""
        self._late.forget()
        self._waiting.clear()
        counts = PairCounts.of(pairs.read(COUNTS_BYTES))
        self._known = batch, counts
        return counts

    def note(self, batch: BatchSize, room: PairCounts, pairs: moderngl.Buffer) -> None:
        """Notes a batch whose counts are not known yet."""
        self._late.push(pairs)
        self._waiting.append((batch, room))

    def release(self) -> None:
        """Frees the buffers."""
        self._late.release()


class VoxelPairs:
    """Pairs of a piece of a triangle and a voxel that it may meet, of one batch."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._pairs, self._long, self._chosen = (gpu.ctx.buffer(reserve=4) for _ in range(3))
        self._find = Kernel(gpu, "voxel_pairs")
        self._cut = Kernel(gpu, "voxel_pairs", LONG=1)
        # By mesh: the pairs of one tell nothing of another's.
        self._earlier: WeakKeyDictionary[MeshBuffers, EarlierCounts] = WeakKeyDictionary()
        self._begun: tuple[EarlierCounts, PairCounts | None] | None = None  # and what they tell

    @property
    def bindings(self) -> dict[str, Binding]:
        """The pairs."""
        return {"Pairs": self._pairs}

    @property
    def _room(self) -> PairCounts:
        pairs = (self._pairs.size - PAIRS_HEADER_BYTES) // PAIR_BYTES
        return PairCounts(pairs, self._long.size // LONG_PIECE_BYTES)

    def begin(self, batch: Batch) -> None:
        """Begins to list the pairs."""
        mesh = batch.buffers
        if mesh not in self._earlier:
            self._earlier[mesh] = EarlierCounts(self._gpu)
        earlier = self._earlier[mesh]
        expected = earlier.expected(batch.size)
        self._begun = earlier, expected
        guess = PairCounts(PAIRS_PER_TRIANGLE * batch.size.triangle_count, LEAST_LONG_PIECES)
        self._make_room(expected or guess)
        self._list(batch)

    def bound(self, batch: Batch) -> int:
        """Returns how many pairs there are at most."""
        assert self._begun is not None
        earlier, expected = self._begun
        if expected is not None:
            earlier.note(batch.size, expected, self._pairs)
            return expected.pairs
        counts = earlier.wait(batch.size, self._pairs)
        while not counts.fits(self._room):
            self._make_room(counts)
            self._list(batch)
            counts = earlier.wait(batch.size, self._pairs)
        return counts.pairs

    def _make_room(self, wanted: PairCounts) -> None:
        """Makes room for so many and some more; what was found is lost."""
        sizes = (
            (self._pairs, PAIRS_HEADER_BYTES + PAIR_BYTES * wanted.pairs),
            (self._long, LONG_PIECE_BYTES * wanted.long_pieces),
        )
        for buffer, size in sizes:
            if buffer.size < size:
                self._gpu.check_storage(size, LOWER_SURFELS)
                buffer.orphan(size * 5 // 4)

    def _list(self, batch: Batch) -> None:
        """Lists the pairs of short triangles, then those of long ones; what has no room is only counted."""
        self._gpu.clear_start(self._pairs, PAIRS_HEADER_BYTES)
        self._write_chosen(batch)
        shared: Bindings = {
            **batch.bindings,
            **self.bindings,
            "LongPieces": self._long,
            "longest_voxels": LONGEST_EDGE_VOXELS,
        }
        self._find.run((batch.longest, len(batch.fillings)), shared, Chosen=self._chosen)
        self._cut.run((list_threads(self._gpu, self._room.long_pieces),), shared)

    def _write_chosen(self, batch: Batch) -> None:
        """Writes the lists of chosen triangles."""
        size = NUMBER_BYTES * batch.chosen_starts[-1]
        if size and self._chosen.size != size:
            self._chosen.orphan(size)
        for filling, start in zip(batch.fillings, batch.chosen_starts, strict=False):
            chosen = filling.mesh.chosen
            if isinstance(chosen, np.ndarray):
                self._chosen.write(chosen.tobytes(), offset=NUMBER_BYTES * start)
            elif chosen is not None:
                chosen(self._chosen, start)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._pairs, self._long, self._chosen, self._find, self._cut)
        release_all(*self._earlier.values())


class Voxelize:
    """Clips triangles against the voxels they touch: surfels and touched voxels (docs/method.md 4.2)."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._pairs = [VoxelPairs(gpu)]  # of each batch
        self._clip = Kernel(gpu, "voxelize")

    def run(self, store: VoxelStore, meshes: Meshes, volume: PlacedVolume) -> None:
        """Fills the empty `store` with the surfels of the triangles inside the volume."""
        self.run_all(store, [meshes], volume)

    def run_all(self, store: VoxelStore, meshes: Sequence[Meshes], volume: PlacedVolume) -> None:
        """Fills the empty `store`; `meshes` are those of each volume, two of the same buffers at most.

        Raises:
            DeltalightError: the triangles are too long for such small voxels, or no buffer holds their surfels.
        """
        batches = _batches(meshes, volume)
        while len(self._pairs) < len(batches):
            self._pairs.append(VoxelPairs(self._gpu))
        both = list(zip(batches, self._pairs, strict=False))
        for batch, pairs in both:
            pairs.begin(batch)
        bounds = [pairs.bound(batch) for batch, pairs in both]
        store.reset(sum(bounds))
        for bound, (batch, pairs) in zip(bounds, both, strict=True):
            threads = list_threads(self._gpu, bound)
            self._clip.run((threads,), batch.bindings, pairs.bindings, store.bindings)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._clip, *self._pairs)


def _batches(meshes: Sequence[Meshes], volume: PlacedVolume) -> list[Batch]:
    """Returns what fills the volumes, by buffers; `meshes` are those of each volume."""
    found: dict[MeshBuffers, list[Filling]] = {}
    for index, own in enumerate(meshes):
        for mesh in own:
            if mesh.triangle_count > 0:
                found.setdefault(mesh.mesh, []).append(Filling(mesh, index))
    return [Batch(fillings, volume) for fillings in found.values()]
