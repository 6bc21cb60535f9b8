"""Small light propagation volumes on a GPU: what begins them and all of their half steps in one dispatch."""

from dataclasses import dataclass

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.passes.lpv import LightVolume

MOST_CELLS = 16  # along an edge: half of the cells of a colour channel just fit 32 KB of shared memory
CHANNELS = 3  # a workgroup each


@dataclass(frozen=True)
class HalfSteps:
    """Half steps through a medium (`medium_bindings`) that a small volume takes."""

    small: "SmallVolume"
    medium: Bindings
    count: int

    def run(self, volume: LightVolume, own: Bindings, **kind: int) -> None:
        """Begins `volume` as shaders/lpv_small_volume.comp.glsl does with the defines `kind`, and takes them."""
        self.small.run(volume, self, own, **kind)


class SmallVolume:
    """Propagates light in a volume of up to MOST_CELLS cells an edge, to the totals of `LpvPropagate`'s half steps.

    Three workgroups take as long for a half step as those of larger volumes; what they save is dispatches.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._kernels: dict[tuple[str, ...], Kernel] = {}

    @staticmethod
    def serves(gpu: GpuContext, cells: int, *, in_place: bool) -> bool:
        """Whether it is for volumes of so many cells an edge; half steps are `in_place`."""
        return in_place and cells <= MOST_CELLS and not gpu.is_software

    def start(
        self,
        volume: LightVolume,
        half_steps: HalfSteps,
        injected: moderngl.Buffer,
        more: moderngl.Buffer | None,
    ) -> None:
        """Starts `volume` with the sums `injected` and `more`, added up (`LpvStart`), and propagates it."""
        volume.colour = 0
        own: Bindings = {"First": injected, "Second": more, "has_second": more is not None}
        half_steps.run(volume, own, STARTS=1)

    def start_change(
        self,
        volume: LightVolume,
        half_steps: HalfSteps,
        before: LightVolume,
        change: moderngl.Buffer,
        through_real: moderngl.Texture3D | None,
    ) -> None:
        """Starts `volume` with the light `before` and a `change` of it (`LpvStartChange`), and propagates it."""
        volume.colour = 0
        own: Bindings = {
            "light_mu": before.total,
            "First": change,
            "Second": None,
            "has_second": False,
            "transmitted_real": through_real,
        }
        half_steps.run(volume, own, CHANGE=1)

    def run(self, volume: LightVolume, half_steps: HalfSteps, own: Bindings, **kind: int) -> None:
        """Begins `volume` by the defines `kind`, and takes half steps from the colour after the last one.

        Cells of both colours then have taken at least `half_steps.count`.
        """
        count = half_steps.count + (volume.colour == 0)
        kernel = self._kernel(kind)
        bound: dict[str, Binding] = {"state": volume.state, "total": volume.total, "colour": volume.colour}
        kernel.run((CHANNELS * kernel.local_size[0],), half_steps.medium, own, bound, steps=count)
        volume.colour = (volume.colour + count) % 2

    def _kernel(self, kind: dict[str, int]) -> Kernel:
        """Returns the kernel of these defines, compiled on first use."""
        key = tuple(kind)
        if key not in self._kernels:
            self._kernels[key] = Kernel(self._gpu, "lpv_small_volume", **kind)
        return self._kernels[key]

    def release(self) -> None:
        """Frees the programs."""
        release_all(*self._kernels.values())
