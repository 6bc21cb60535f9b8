"""Light propagation volumes: buffers, transfer weights, initialisation and propagation.

See docs/method.md 5; shaders/common/light_cells.glsl has the cells' layout.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import moderngl
import numpy as np
from jaxtyping import Float64

from deltalight.render_server.gpu.clearing import clear_buffer
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import list_threads
from deltalight.render_server.gpu.textures import release_all, texture_3d
from deltalight.render_server.passes.mesh_buffers import NO_CUTOUTS
from deltalight.render_server.passes.volumes import VolumePlacement
from deltalight.render_server.passes.voxels import VoxelMipmap, VoxelStore

INJECTED_SUMS = 12  # per cell: 4 coefficients x 3 channels
COVERED_SUMS = 6  # per cell: its low faces on three axes, surfaces that face - and +
INJECTED_BYTES, COVERED_BYTES, TRANSMITTED_BYTES = 4 * INJECTED_SUMS, 4 * COVERED_SUMS, 8  # per cell
JOINED_BYTES = 3 * 16  # per cell of `LpvJoin`: three channels
LIGHT_BYTES = 3 * JOINED_BYTES  # per cell of a `LightVolume`: three textures
LOWER_CELLS = "method.volume_size (objects_volume_size, direct_volume_size)"
CONSTANT, LINEAR = 0.5 / math.sqrt(math.pi), math.sqrt(3 / (4 * math.pi))  # Y_0 and Y_1 along its axis
LOBE = (math.sqrt(math.pi) / 2, math.sqrt(math.pi / 3))  # of the clamped cosine in them
FAR_FACE_SR, SIDE_FACE_SR = 0.40067, 0.42343  # solid angles seen from the centre of the neighbouring cell
DIRECTION_LENGTH = 10 / 32  # of the volume's edge: distance over which a step's filter fades directions
FUSED_STEPS = 4  # per dispatch: half of the cells, with a border of four, still fit 32 KB of shared memory


@dataclass(frozen=True)
class StepWeights:
    """Transfer of a cell's coefficients to a neighbour, for both directions of an axis up to sign.

    `transfer`: (constant from constant, constant from along, along from constant, along from along); `sideways`:
    across from across, the same for both. The 4x4 matrix has no other non-zeros.
    """

    transfer: tuple[float, float, float, float]
    sideways: float


def lobe_weights() -> StepWeights:
    """Weights that send the flux through each far and side face of the cell on as a cosine lobe.

    [P2], docs/method.md 5.
    """
    slant = 2 / math.sqrt(5)  # cosine from the axis to the centre of a side face
    flux = (FAR_FACE_SR + 4 * SIDE_FACE_SR, FAR_FACE_SR + 4 * SIDE_FACE_SR * slant)
    shape = (LOBE[0] / math.pi, LOBE[1] / math.pi)
    transfer = (
        shape[0] * CONSTANT * flux[0],
        shape[0] * LINEAR * flux[1],
        shape[1] * CONSTANT * FAR_FACE_SR,
        shape[1] * LINEAR * FAR_FACE_SR,
    )
    sideways = shape[1] * LINEAR * SIDE_FACE_SR * 2 * math.sqrt(1 - slant**2)
    return StepWeights(transfer, sideways)


def moment_weights(cells: int) -> StepWeights:
    """Weights that preserve direction: the integral of y_i y_j over the directions through the shared face.

    Each face gets a sixth of the sphere, so the six matrices sum to the identity. A small fraction of the linear part
    is then dropped (a filter as for P_N transport, McClarren & Hauck 2010): without it, steps of the truncated series
    overshoot. DIRECTION_LENGTH is chosen so that a square emitter of a quarter of the volume's edge does not light
    itself; it then lights a floor in front of it within 0.02 of the form factor. Cosine lobes light the emitter with
    half of its own radiosity.
    """
    kept = 1 - 1 / (DIRECTION_LENGTH * cells)
    nodes, weights = np.polynomial.legendre.leggauss(32)
    u, v = np.meshgrid(nodes, nodes)
    distance2 = 1 + u**2 + v**2
    solid_angle = np.outer(weights, weights) * distance2**-1.5
    cosine, lateral = distance2**-0.5, u * distance2**-0.5

    def moment(a: Float64[np.ndarray, "n n"], b: Float64[np.ndarray, "n n"]) -> float:
        return float((a * b * solid_angle).sum())

    one = np.full_like(u, CONSTANT)
    along, aside = LINEAR * cosine, LINEAR * lateral
    mixed = moment(one, along)
    transfer = (moment(one, one), mixed, kept * mixed, kept * moment(along, along))
    return StepWeights(transfer, kept * moment(aside, aside))


class LightVolume:
    """The state between steps, and the total: (3 channels x) cells x 4 coefficients each. Steps write to `spare`."""

    def __init__(self, gpu: GpuContext, cells: int) -> None:
        self.cells = cells
        size = (cells, cells, 3 * cells)
        self.state, self.spare, self.total = (texture_3d(gpu, size, 4, "f4") for _ in range(3))
        self.colour = 0  # of the cells that the next half step changes

    def swap_state(self) -> None:
        """Makes what was written to `spare` the current state."""
        self.state, self.spare = self.spare, self.state

    def swap_total(self) -> None:
        """Makes what was written to `spare` the total."""
        self.total, self.spare = self.spare, self.total

    def release(self) -> None:
        """Frees the textures."""
        release_all(self.state, self.spare, self.total)


class PropagatedLight(Protocol):
    """What surfaces read of light volumes."""

    @property
    def cells(self) -> int:
        """Along an edge of each volume."""

    @property
    def total(self) -> moderngl.Texture3D:
        """Those of several volumes side by side in x."""


@dataclass(frozen=True, eq=False)
class JoinedLight:
    """The totals of several volumes."""

    cells: int
    total: moderngl.Texture3D


class LpvJoin:
    """Puts the totals of several volumes side by side; surfaces read that of a single one as it is."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._kernel = Kernel(gpu, "lpv_join")
        self._total: moderngl.Texture3D | None = None

    def run(self, lights: Sequence[LightVolume | None]) -> PropagatedLight | None:
        """Returns all light; None where there are no volumes."""
        given = [light for light in lights if light is not None]
        if len(given) < 2:
            release_all(self._total)
            self._total = None
            return given[0] if given else None
        cells = given[0].cells
        total = self._with_room((len(given) * cells, cells, 3 * cells))
        for index, light in enumerate(given):
            own: Bindings = {"total": light.total, "first": index * cells, "cells": cells}
            self._kernel.run((cells, cells, 3 * cells), own, joined=total)
        return JoinedLight(cells, total)

    def _with_room(self, size: tuple[int, int, int]) -> moderngl.Texture3D:
        if self._total is None or self._total.size != size:
            release_all(self._total)
            self._total = texture_3d(self._gpu, size, 4, "f4")
        return self._total

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._kernel, self._total)


def injected_sums(gpu: GpuContext, cells: int) -> moderngl.Buffer:
    """Creates empty fixed-point sums of injected light."""
    return _zeros(gpu, cells**3 * INJECTED_BYTES)


def covered_sums(gpu: GpuContext, cells: int) -> moderngl.Buffer:
    """Creates empty fixed-point sums of covered faces."""
    return _zeros(gpu, cells**3 * COVERED_BYTES)


def transmitted_fractions(gpu: GpuContext, cells: int) -> moderngl.Texture3D:
    """Creates transmittances into each cell from its six neighbours, a byte each; zero until `LpvTransmit` writes."""
    return texture_3d(gpu, (cells, cells, cells), 2, "u4")


def _zeros(gpu: GpuContext, size: int) -> moderngl.Buffer:
    buffer = gpu.storage_buffer(size, LOWER_CELLS)
    clear_buffer(gpu, buffer)
    return buffer


class LpvStart:
    """Converts fixed-point sums of injected light into the state before the first step."""

    def __init__(self, gpu: GpuContext) -> None:
        self._kernel = Kernel(gpu, "lpv_start")

    def run(
        self,
        volume: LightVolume,
        medium: Bindings,
        injected: moderngl.Buffer,
        more: moderngl.Buffer | None = None,
        *,
        half_step: bool = False,
    ) -> None:
        """Initialises state and total of `volume` with the sums `injected` and `more`, added up.

        `medium` is that of `volume` (`medium_bindings`); `half_step`: also makes the first half step, which takes a
        GPU no dispatch of its own then (`LpvPropagate.starts_with_half_step`).
        """
        self._kernel.run(
            (volume.cells**3,),
            medium,
            First=injected,
            Second=more,
            has_second=more is not None,
            state=volume.state,
            total=volume.total,
            HALF_STEP=half_step,
        )
        volume.colour = int(half_step)

    def release(self) -> None:
        """Frees the GL object."""
        self._kernel.release()


class LpvStartChange:
    """Starts a volume with the light of another one, and with what objects change of it: what they send and block."""

    def __init__(self, gpu: GpuContext) -> None:
        self._kernel = Kernel(gpu, "lpv_start_change")

    def run(
        self,
        volume: LightVolume,
        before: LightVolume,
        change: moderngl.Buffer,
        medium: Bindings,
        through_real: moderngl.Texture3D | None,
        *,
        in_place: bool,
        half_step: bool = False,
    ) -> None:
        """Initialises state and total of `volume` from those `before` and the injected `change`.

        `medium` is that of `volume` (`medium_bindings`); `through_real` lets the light `before` pass; `in_place`: for
        half steps (`LpvPropagate.is_in_place`), of which it makes the first, too, with `half_step`.
        """
        self._kernel.run(
            (volume.cells,) * 3,
            medium,
            light_mu=before.total,
            First=change,
            Second=None,
            has_second=False,
            transmitted_real=through_real,
            state=volume.state,
            total=volume.total,
            in_place=in_place,
            HALF_STEP=half_step,
        )
        volume.colour = int(half_step)

    def release(self) -> None:
        """Frees the GL object."""
        self._kernel.release()


class LpvBoxFilter:
    """Averages light over cubes of cells ([P2] 7: softens the jagged edges of shadows)."""

    def __init__(self, gpu: GpuContext) -> None:
        self._kernel = Kernel(gpu, "lpv_box_filter")

    def run(self, volume: LightVolume, radius: int) -> None:
        """Replaces the total by its mean over cubes of 2 `radius` + 1 cells an edge.

        Beyond the border there is no light.
        """
        if radius == 0:
            return
        threads = (volume.cells, volume.cells, 3 * volume.cells)
        self._kernel.run(
            threads, total=volume.total, filtered=volume.spare, cells=volume.cells, radius=radius
        )
        volume.swap_total()

    def release(self) -> None:
        """Frees the GL object."""
        self._kernel.release()


class LpvShow:
    """Draws the injected change into cells for debug view `volume`."""

    def __init__(self, gpu: GpuContext) -> None:
        self._kernel = Kernel(gpu, "lpv_show")

    def run(
        self,
        shown: VoxelMipmap,
        change: moderngl.Buffer,
        direct: moderngl.Buffer | None = None,
        *,
        volume: int = 0,
    ) -> None:
        """Writes `change`, and what `direct` has in its cells, into level 0 of a `volume` of `shown`.

        `shown` has one direction. Cells of `direct` may be larger or smaller than those of `change`; both fill the
        same cube.
        """
        cells = cells_of(change)
        self._kernel.run(
            (cells, cells, cells),
            shown=shown.texture,
            Change=change,
            Direct=change if direct is None else direct,
            cells=cells,
            direct_cells=0 if direct is None else cells_of(direct),
            first=volume * cells,
        )

    def release(self) -> None:
        """Frees the GL object."""
        self._kernel.release()


def cells_of(sums: moderngl.Buffer) -> int:
    """Cells an edge of injected sums."""
    return round(math.cbrt(sums.size / INJECTED_BYTES))


class LpvCoverFaces:
    """Builds the geometry volume.

    The fraction of each cell face that surfaces cover (Kaplanyan & Dachsbacher 2010).
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu, self._threads = gpu, list_threads(gpu)
        self._kernel = Kernel(gpu, "lpv_cover_faces")

    def run(
        self,
        covered: moderngl.Buffer,
        store: VoxelStore,
        cells: VolumePlacement,
        cutouts: Bindings = NO_CUTOUTS,
    ) -> None:
        """Replaces the sums of `covered` by those of the surfels of `store`.

        `cells` is the placement of the cells; `store` was voxelised at half a cell per edge, from a mesh with these
        `cutouts`.
        """
        clear_buffer(self._gpu, covered)
        self._kernel.run(
            (self._threads,),
            store.bindings,
            cutouts,
            Covered=covered,
            cells=cells.size,
            cell_edge=cells.voxel_edge,
        )

    def release(self) -> None:
        """Frees the GL object."""
        self._kernel.release()


class LpvTransmit:
    """Computes the fraction of light that enters each cell from its neighbours past covered faces."""

    def __init__(self, gpu: GpuContext) -> None:
        self._real = Kernel(gpu, "lpv_transmit")
        self._joint = Kernel(gpu, "lpv_transmit", JOINT=1)

    def run(
        self,
        out: moderngl.Texture3D,
        cells: int,
        real: moderngl.Buffer,
        virtual: moderngl.Buffer | None = None,
    ) -> None:
        """Fills `out` from the covered faces of the real scene, and of the objects if given."""
        kernel = self._real if virtual is None else self._joint
        kernel.run((cells**3,), RealCovered=real, VirtualCovered=virtual, transmitted=out, cells=cells)

    def release(self) -> None:
        """Frees the GL objects."""
        self._real.release()
        self._joint.release()


def medium_bindings(
    cells: int, weights: StepWeights, transmitted: moderngl.Texture3D | None
) -> dict[str, Binding]:
    """Returns the bindings of a step through so many cells an edge; without `transmitted` nothing blocks light."""
    return {
        "transmitted": transmitted,
        "has_geometry": transmitted is not None,
        "transfer": weights.transfer,
        "sideways": weights.sideways,
        "cells": cells,
    }


class LpvPropagate:
    """Propagates light from cell to cell (docs/method.md 5).

    `tiled` runs several steps, or half steps, per dispatch in shared memory (default on a GPU); otherwise each is a
    dispatch.
    """

    def __init__(self, gpu: GpuContext, *, tiled: bool | None = None) -> None:
        self._gpu = gpu
        self._tiled = not gpu.is_software if tiled is None else tiled

    @cached_property
    def _steps(self) -> dict[int, Kernel]:
        """Kernels by how many steps each runs."""
        if not self._tiled:
            return {1: Kernel(self._gpu, "lpv_propagate_plain")}
        return {count: Kernel(self._gpu, "lpv_propagate", FUSED=count) for count in (1, FUSED_STEPS)}

    @cached_property
    def _halves(self) -> dict[int, Kernel]:
        """Kernels by how many half steps each runs."""
        if not self._tiled:
            return {1: Kernel(self._gpu, "lpv_half_step")}
        counts = 1, FUSED_STEPS
        return {count: Kernel(self._gpu, "lpv_propagate", FUSED=count, HALVES=1) for count in counts}

    @staticmethod
    def is_in_place(cells: int, steps: int) -> bool:
        """Whether so many steps in all are best run `in_place`, for half of the work: light crosses the volume."""
        return steps >= cells

    @property
    def starts_with_half_step(self) -> bool:
        """Whether the first half step is best made with what starts the volume: on a GPU, alone it is a dispatch."""
        return self._tiled

    def run(self, volume: LightVolume, medium: Bindings, steps: int, *, in_place: bool = False) -> None:
        """Runs `steps` steps through a medium (`medium_bindings`).

        `in_place`, half steps of alternating colours change the total alone, and the state is what is injected into
        the volume: cells of one colour have a step more. Otherwise the state is the light of the last step.
        """
        if in_place:
            self._run_halves(volume, steps, medium)
        else:
            self._run_whole(volume, steps, medium)

    def _run_whole(self, volume: LightVolume, steps: int, medium: Bindings) -> None:
        channels = 3 if self._tiled else 1  # the plain kernel loops over them
        threads = (volume.cells, volume.cells, channels * volume.cells)
        for kernel, _ in _in_dispatches(self._steps, steps):
            kernel.run(threads, medium, state=volume.state, next_state=volume.spare, total=volume.total)
            volume.swap_state()

    def _run_halves(self, volume: LightVolume, steps: int, medium: Bindings) -> None:
        """Runs half steps, from the colour after the last one; cells of both colours have at least `steps`."""
        cells = volume.cells
        threads = (cells, cells, 3 * cells) if self._tiled else (-(-cells // 2), cells, cells)
        for kernel, count in _in_dispatches(self._halves, steps + (volume.colour == 0)):
            bound: dict[str, Binding] = {
                "state": volume.state,
                "total": volume.total,
                "colour": volume.colour,
            }
            kernel.run(threads, medium, bound, {"next_total": volume.spare})
            if self._tiled:
                volume.swap_total()
            volume.colour = (volume.colour + count) % 2

    def release(self) -> None:
        """Frees the GL objects."""
        for name in ("_steps", "_halves"):
            release_all(*vars(self).get(name, {}).values())


def _in_dispatches(kernels: Mapping[int, Kernel], steps: int) -> Iterator[tuple[Kernel, int]]:
    """Yields the kernels to run, each with how many steps it runs."""
    while steps > 0:
        count = max(count for count in kernels if count <= steps)
        yield kernels[count], count
        steps -= count
