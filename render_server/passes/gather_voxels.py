"""Light that groups of surfels gather from the voxels around them (METHOD 4.3)."""

from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.gpu.textures import bind_samplers
from render_server.passes.group_surfels import SurfelGroups
from render_server.passes.volume import Pyramid
from render_server.passes.voxel_store import VoxelStore

SHADER = Path(__file__).with_name("gather_voxels.comp.glsl")
GATHER_CONES = 4  # as good as 16 in pictures: the cones that see gathered light average over many groups
# In software, by 64 voxels an edge: lists are short here, and the last round of more walkers would mostly be idle.
# Groups lie on surfaces, so their number grows with the square of the edge; so few each keep a walker's loops short
# of where Mesa cuts them off (SOFTWARE_SHARE in gpu/program.py).
SOFTWARE_WALKERS = 256


class GatherVoxelsPass:
    """A few cones a group; lights, the far pyramid and the support must be bound. `defines`: those of march.glsl."""

    def __init__(self, gpu: GpuContext, defines: dict[str, int]) -> None:
        self._gpu = gpu
        self._one = ComputeProgram(gpu, SHADER, defines)
        self._dual = ComputeProgram(gpu, SHADER, {"DUAL": 1, **defines})

    def gather_unseen(
        self, store: VoxelStore, groups: SurfelGroups, mu: Pyramid, uniforms: dict[str, Any]
    ) -> None:
        """E_mu of the groups that hold surfels which the camera does not see."""
        self._run(self._one, store, groups, (mu, mu), {**uniforms, "only_unseen": True})

    def gather_real(
        self, store: VoxelStore, groups: SurfelGroups, mu: Pyramid, rho: Pyramid, uniforms: dict[str, Any]
    ) -> None:
        """E_mu and E_rho of every group."""
        self._run(self._dual, store, groups, (mu, rho), {**uniforms, "only_unseen": False})

    def gather_virtual(
        self, store: VoxelStore, groups: SurfelGroups, rho: Pyramid, uniforms: dict[str, Any]
    ) -> None:
        """E_rho of every group."""
        self._run(self._one, store, groups, (rho, rho), {**uniforms, "only_unseen": False})

    def _run(
        self,
        program: ComputeProgram,
        store: VoxelStore,
        groups: SurfelGroups,
        pyramids: tuple[Pyramid, Pyramid],
        uniforms: dict[str, Any],
    ) -> None:
        store.bind()
        groups.bind()
        bind_samplers({2: pyramids[0].texture, 3: pyramids[1].texture})
        edge = int(uniforms["volume_size"]) / 64
        few = max(SOFTWARE_WALKERS, round(SOFTWARE_WALKERS * edge * edge))
        threads = few if self._gpu.is_software else list_threads(self._gpu)
        program.run((threads,), cone_count=GATHER_CONES, **uniforms)

    def release(self) -> None:
        """Free the programs."""
        self._one.release()
        self._dual.release()
