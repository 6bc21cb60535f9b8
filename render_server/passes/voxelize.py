"""From triangles to surfels and touched voxels (docs/method.md 4.2)."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
from deltalight.render_server.passes.volumes import PlacedVolume, VolumePlacement
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


Chosen = Int32[np.ndarray, " k"] | Callable[[moderngl.Buffer], None] | None
"""Numbers of triangles of a mesh, or what lets the GPU write them into a buffer: for each triangle its number or
NOT_CHOSEN (shaders/common/solid_mesh.glsl). None: all."""


@dataclass(frozen=True, eq=False)
class VoxelizedMesh:
    """A mesh for the voxeliser: its triangles or, if `behind_m` is not 0, their backs, so far behind them (m).

    `chosen`: which of them.
    """

    mesh: MeshBuffers
    behind_m: float = 0.0
    chosen: Chosen = None

    @property
    def triangle_count(self) -> int:
        """How many triangles there are, at most if the GPU chooses them."""
        return len(self.chosen) if isinstance(self.chosen, np.ndarray) else self.mesh.triangle_count


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
class FillingSize:
    """How many triangles fill a volume, and which."""

    triangle_count: int
    placement: VolumePlacement

    def is_like(self, other: "FillingSize") -> bool:
        """Whether about as many pairs may be expected: of as many triangles, and as many voxels of about one size."""
        mine, its = self.placement, other.placement
        is_more = self.triangle_count > MORE_TRIANGLES * other.triangle_count
        is_of_one_size = its.voxel_edge / FINER < mine.voxel_edge < its.voxel_edge * FINER
        return not is_more and is_of_one_size and mine.size == its.size


@dataclass(frozen=True, eq=False)
class Filling:
    """A mesh that is to fill a volume, how many triangles it has now, and the bindings of both."""

    mesh: VoxelizedMesh
    triangle_count: int
    placement: VolumePlacement
    bindings: Bindings

    @property
    def size(self) -> FillingSize:
        """What is remembered of it, which does not hold the mesh."""
        return FillingSize(self.triangle_count, self.placement)


class EarlierCounts:
    """What earlier fillings by one mesh tell about the next one, so that the CPU need not wait for the GPU to count.

    Where they tell nothing it waits, and in software always: it has nothing else to do. A filling that has more pairs
    than expected lacks them; two fillings later that is known, and the CPU waits.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._late = DelayedRead(gpu, COUNTS_BYTES)
        self._waiting: deque[tuple[FillingSize, PairCounts]] = deque()  # and the room that each had
        self._known: tuple[FillingSize, PairCounts] | None = None

    def expected(self, filling: FillingSize) -> PairCounts | None:
        """Returns for how many to make room; None: wait and see."""
        header = self._late.pop()
        if header is not None:
            before, room = self._waiting.popleft()
            counts = PairCounts.of(header)
            self._known = (before, counts) if counts.fits(room) else None
        if self._gpu.is_software or self._known is None:
            return None
        before, counts = self._known
        if not filling.is_like(before):
            return None
        pairs = GROWTH * counts.pairs + MORE_A_FACE * filling.placement.size**2
        return PairCounts(int(pairs), LEAST_LONG_PIECES + 2 * counts.long_pieces)

    def wait(self, filling: FillingSize, pairs: moderngl.Buffer) -> PairCounts:
        """Waits for the counts of a filling, and forgets those of earlier ones."""
        self._late.forget()
        self._waiting.clear()
        counts = PairCounts.of(pairs.read(COUNTS_BYTES))
        self._known = filling, counts
        return counts

    def note(self, filling: FillingSize, room: PairCounts, pairs: moderngl.Buffer) -> None:
        """Notes a filling whose counts are not known yet."""
        self._late.push(pairs)
        self._waiting.append((filling, room))

    def release(self) -> None:
        """Frees the buffers."""
        self._late.release()


class VoxelPairs:
    """Pairs of a piece of a triangle and a voxel that it may meet, of one mesh in one volume."""

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

    def begin(self, filling: Filling) -> None:
        """Begins to list the pairs."""
        mesh = filling.mesh.mesh
        if mesh not in self._earlier:
            self._earlier[mesh] = EarlierCounts(self._gpu)
        earlier = self._earlier[mesh]
        expected = earlier.expected(filling.size)
        self._begun = earlier, expected
        guess = PairCounts(PAIRS_PER_TRIANGLE * filling.triangle_count, LEAST_LONG_PIECES)
        self._make_room(expected or guess)
        self._list(filling)

    def bound(self, filling: Filling) -> int:
        """Returns how many pairs there are at most."""
        assert self._begun is not None
        earlier, expected = self._begun
        if expected is not None:
            earlier.note(filling.size, expected, self._pairs)
            return expected.pairs
        counts = earlier.wait(filling.size, self._pairs)
        while not counts.fits(self._room):
            self._make_room(counts)
            self._list(filling)
            counts = earlier.wait(filling.size, self._pairs)
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

    def _list(self, filling: Filling) -> None:
        """Lists the pairs of short triangles, then those of long ones; what has no room is only counted."""
        self._gpu.clear_start(self._pairs, PAIRS_HEADER_BYTES)
        mesh, longest_m = filling.mesh, LONGEST_EDGE_VOXELS * filling.placement.voxel_edge
        shared: Bindings = {
            **filling.bindings,
            **self.bindings,
            "LongPieces": self._long,
            "longest_kept": longest_m,
        }
        self._find.run(
            (filling.triangle_count,),
            shared,
            Chosen=self._write_chosen(mesh),
            is_chosen=mesh.chosen is not None,
            triangle_count=filling.triangle_count,
        )
        self._cut.run((list_threads(self._gpu, self._room.long_pieces),), shared)

    def _write_chosen(self, mesh: VoxelizedMesh) -> moderngl.Buffer | None:
        if mesh.chosen is None:
            return None
        size = NUMBER_BYTES * mesh.triangle_count
        if self._chosen.size != size:
            self._chosen.orphan(size)
        if isinstance(mesh.chosen, np.ndarray):
            self._chosen.write(mesh.chosen.tobytes())
        else:
            mesh.chosen(self._chosen)
        return self._chosen

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._pairs, self._long, self._chosen, self._find, self._cut)
        release_all(*self._earlier.values())


class Voxelize:
    """Clips triangles against the voxels they touch: surfels and touched voxels (docs/method.md 4.2)."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._pairs = [VoxelPairs(gpu)]  # of each filling
        self._clip = Kernel(gpu, "voxelize")

    def run(self, store: VoxelStore, meshes: Meshes, volume: PlacedVolume) -> None:
        """Fills the empty `store` with the surfels of the triangles inside the volume."""
        self.run_all(store, [meshes], volume)

    def run_all(self, store: VoxelStore, meshes: Sequence[Meshes], volume: PlacedVolume) -> None:
        """Fills the empty `store`; `meshes` are those of each volume.

        Raises:
            DeltalightError: the triangles are too long for such small voxels, or no buffer holds their surfels.
        """
        fillings = _fillings(meshes, volume)
        while len(self._pairs) < len(fillings):
            self._pairs.append(VoxelPairs(self._gpu))
        both = list(zip(fillings, self._pairs, strict=False))
        for filling, pairs in both:
            pairs.begin(filling)
        bounds = [pairs.bound(filling) for filling, pairs in both]
        store.reset(sum(bounds))
        for bound, (filling, pairs) in zip(bounds, both, strict=True):
            threads = list_threads(self._gpu, bound)
            self._clip.run((threads,), filling.bindings, pairs.bindings, store.bindings)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._clip, *self._pairs)


def _fillings(meshes: Sequence[Meshes], volume: PlacedVolume) -> list[Filling]:
    """Returns what fills the volumes; `meshes` are those of each."""
    return [
        Filling(
            mesh,
            mesh.triangle_count,
            volume.placements[index],
            {**volume.bindings, **mesh.mesh.solid, "filled_volume": index, "behind": mesh.behind_m},
        )
        for index, own in enumerate(meshes)
        for mesh in own
        if mesh.triangle_count > 0
    ]
