"""Lighting of the voxels: radiance and opacity of each surfel, summed per direction (METHOD 4.3)."""

from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.passes.caustics import GREATEST_ALPHA
from render_server.passes.group_surfels import SurfelGroups
from render_server.passes.voxel_store import VoxelStore

SHADER = Path(__file__).with_name("light_voxels.comp.glsl")


class LightVoxelsPass:
    """Variants of one walk over the surfels: real without objects, real's change, virtual; real of a full solution.

    With `gathered`, what the surfels' groups gathered takes the place of the unoccluded ambient light, and the sums
    change by that; direct light is that of the last walk without.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._threads = list_threads(gpu)
        self._programs: dict[tuple[str, bool], ComputeProgram] = {}
        self.support = gpu.ctx.buffer(reserve=24, dynamic=True)

    def light_real(
        self,
        store: VoxelStore,
        uniforms: dict[str, Any],
        groups: SurfelGroups | None = None,
        *,
        gathered: bool = False,
    ) -> None:
        """Sum c_mu and a_real; `groups` keep each surfel's light."""
        self._run("REAL", store, groups, uniforms, gathered=gathered)

    def light_real_delta(
        self, store: VoxelStore, uniforms: dict[str, Any], groups: SurfelGroups, *, gathered: bool = False
    ) -> None:
        """Sum c_rho - c_mu of real surfaces, of which `groups` keep L_mu; the support grows."""
        store.delta_sums.clear()
        store.delta_sums.bind_to_storage_buffer(8)
        self.bind_support()
        self._run("REAL_DELTA", store, groups, uniforms, gathered=gathered)

    def light_virtual(
        self,
        store: VoxelStore,
        uniforms: dict[str, Any],
        groups: SurfelGroups | None = None,
        *,
        gathered: bool = False,
    ) -> None:
        """Sum c and a of the virtual surfaces; `groups` keep each surfel's light."""
        self._run("VIRTUAL", store, groups, uniforms, gathered=gathered)

    def light_solution(
        self,
        store: VoxelStore,
        uniforms: dict[str, Any],
        groups: SurfelGroups,
        *,
        with_objects: bool,
        gathered: bool = False,
    ) -> None:
        """Sum anew all light and opacity of real surfaces under the maps that are bound; without objects first, as
        `groups` keep E_mu for the other.
        """
        store.sums.clear()
        self._run("REAL_RHO" if with_objects else "REAL_MU", store, groups, uniforms, gathered=gathered)

    def _run(
        self,
        kind: str,
        store: VoxelStore,
        groups: SurfelGroups | None,
        uniforms: dict[str, Any],
        *,
        gathered: bool,
    ) -> None:
        store.bind()
        if groups is not None:
            groups.bind()
        program = self._program(kind, gathered=gathered)
        program.run((self._threads,), keep_light=groups is not None, **uniforms)

    def _program(self, kind: str, *, gathered: bool) -> ComputeProgram:
        """Compiled when it is first needed."""
        if (kind, gathered) not in self._programs:
            defines = {kind: 1, "GREATEST_ALPHA": GREATEST_ALPHA, **({"GATHERED": 1} if gathered else {})}
            self._programs[kind, gathered] = ComputeProgram(self._gpu, SHADER, defines)
        return self._programs[kind, gathered]

    def start_support(self, bounds: np.ndarray[Any, np.dtype[np.int32]]) -> None:
        """Begin the support of the delta anew with the voxels of the objects (min x, y, z, -max x, y, z)."""
        self.support.write(bounds.tobytes())

    def bind_support(self) -> None:
        """Bind the support's bounds to the place that march.glsl names."""
        self.support.bind_to_storage_buffer(9)

    def release(self) -> None:
        """Free the GL objects."""
        for program in self._programs.values():
            program.release()
        self.support.release()


def bind_picture(linear_picture: moderngl.Texture, real_position: moderngl.Texture) -> None:
    """Bind what picture.glsl reads."""
    linear_picture.use(location=8)
    real_position.use(location=9)
