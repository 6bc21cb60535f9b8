"""The lit voxels of the real scene (mu) and of real + virtual (rho), rebuilt where something moved (METHOD 4)."""

from typing import Any

import numpy as np

from protocol.scene_method import DvctMethod
from render_server.gpu.context import GpuContext
from render_server.passes.clear_voxels import ClearVoxelsPass
from render_server.passes.filter_voxels import FilterVoxelsPass
from render_server.passes.gather_voxels import GatherVoxelsPass
from render_server.passes.group_surfels import GroupSurfelsPass, SurfelGroups
from render_server.passes.light_table import LightTable
from render_server.passes.light_voxels import LightVoxelsPass
from render_server.passes.resolve_voxels import ResolveVoxelsPass
from render_server.passes.volume import Pyramid, VolumePlacement, place_volume
from render_server.passes.voxel_store import VoxelStore
from render_server.passes.voxelize import VoxelizePass
from render_server.relight.defaults import march_defines
from render_server.relight.frame import RelightInput
from render_server.relight.voxel_sets import VoxelSets, bind_lighting, lighting_uniforms

DIRECTIONS = 6
FAR_SIZE = 32  # voxels an edge of the coarse volume beyond
FAR_EDGE_M = 20.0  # its greatest edge: what lies farther lights little through a cone's solid angle
FAR_MARGIN = 1.05


class FarScene:
    """The real scene beyond the volume: a coarse mu pyramid around everything that the camera sees.

    What leaves the volume meets the radiance that the camera measured there, not the environment; unless the
    volume is not `is_used`.
    """

    def __init__(self, gpu: GpuContext, *, is_used: bool) -> None:
        self._is_used = is_used
        self.pyramid = Pyramid(gpu, FAR_SIZE, DIRECTIONS)
        self._store = VoxelStore(gpu, FAR_SIZE)
        self._placement = VolumePlacement((0.0, 0.0, 0.0), 1.0, FAR_SIZE)
        self._version: int | None = None
        self._lit_key: object = None
        self._stale = False

    def voxelize(self, frame: RelightInput, voxelize: VoxelizePass, clear: ClearVoxelsPass) -> None:
        """Voxelise the whole real scene, unless it stood still."""
        if not self._is_used or frame.real.version == self._version:
            return
        self._version = frame.real.version
        clear.run(self._store, [self.pyramid], self._placement)
        low, high = frame.real.bounds
        edge = min(float(np.max(high - low)), FAR_EDGE_M) * FAR_MARGIN
        self._placement = place_volume(low, high, FAR_SIZE, edge)
        coarse = frame.real.coarse_corners
        voxelize.run(self._store, frame.real.corners if coarse is None else coarse, self._placement)

    def light(
        self, frame: RelightInput, table: LightTable, light: LightVoxelsPass, lighting: dict[str, Any]
    ) -> None:
        """Give its voxels the radiance that the camera measured, unless they and the light maps are as before."""
        key = (frame.real.version, frame.lights_version, table.real_records)
        self._stale = self._is_used and key != self._lit_key
        if self._stale:
            self._lit_key = key
            self._store.sums.clear()
            light.light_real(self._store, {**lighting, **self._placement.uniforms()})

    def filter(self, resolve: ResolveVoxelsPass, filter_pass: FilterVoxelsPass) -> None:
        """Resolve and filter."""
        if self._stale:
            resolve.resolve_mu(self.pyramid, self._store, self._placement.uniforms())
            filter_pass.run(self.pyramid, self._placement)

    def uniforms(self) -> dict[str, Any]:
        """Every uniform that march.glsl reads of it."""
        return {
            "far_origin": self._placement.origin,
            "far_edge": self._placement.voxel_edge,
            "far_size": self._placement.size if self._is_used else 0,
            "far_levels": self._placement.levels,
        }

    def release(self) -> None:
        """Free the GL objects."""
        self.pyramid.release()
        self._store.release()


class VoxelScene(VoxelSets):
    """Two directional pyramids over one placement of the volume.

    Light is gathered `settings.bounces` times from voxel to voxel, beyond direct and unoccluded ambient light.
    """

    def __init__(self, gpu: GpuContext, placement: VolumePlacement, settings: DvctMethod) -> None:
        super().__init__(gpu, placement, DIRECTIONS)
        self.mu = Pyramid(gpu, placement.size, DIRECTIONS)
        self.rho = Pyramid(gpu, placement.size, DIRECTIONS)
        self.far = FarScene(gpu, is_used=settings.far_volume)
        self._bounces = settings.bounces
        self._measured = settings.radiance == "measured"
        self._real_groups = SurfelGroups(gpu, placement.size)
        self._virtual_groups = SurfelGroups(gpu, placement.size)
        self._light = LightVoxelsPass(gpu)
        self._group = GroupSurfelsPass(gpu)
        self._gather = GatherVoxelsPass(gpu, march_defines(settings))
        self._resolve = ResolveVoxelsPass(gpu)
        self._filter = FilterVoxelsPass(gpu)

    def rebuild_real(
        self, frame: RelightInput, table: LightTable, placement: VolumePlacement, uniforms: dict[str, Any]
    ) -> None:
        """Voxelise, light and filter the real scene (the mu set)."""
        timers = frame.timers
        with timers.measure("voxelize"):
            self._voxelize_real(
                frame.real.solid_corners(placement.voxel_edge), placement, [self.mu, self.rho]
            )
            self.far.voxelize(frame, self._voxelize, self._clear)
        with timers.measure("light voxels"):
            frame.picture.build_levels()
            bind_lighting(frame, table)
            lighting = lighting_uniforms(frame, uniforms, measured=self._measured)
            self._real_groups.start(self._real)
            self._light.light_real(self._real, lighting, self._real_groups)
            self.far.light(frame, table, self._light, lighting)
        with timers.measure("filter"):
            self.far.filter(self._resolve, self._filter)
            self._filter_mu()
        if self._bounces > 0:
            with timers.measure("bounces"):
                self._bounce_unseen(lighting)

    def _filter_mu(self) -> None:
        self._resolve.resolve_mu(self.mu, self._real, self.placement.uniforms())
        self._filter.run(self.mu, self.placement)

    def _bounce_unseen(self, lighting: dict[str, Any]) -> None:
        """Real surfaces that the camera does not see: what they gather from mu in place of all ambient light."""
        self._group.run(self._real, self._real_groups, lighting, has_seen=True)
        _, unseen = self._real_groups.counts()
        for _ in range(self._bounces if unseen else 0):
            self._bind_for_gathering()
            marching = {**lighting, **self.far.uniforms()}
            self._gather.gather_unseen(self._real, self._real_groups, self.mu, marching)
            self._light.light_real(self._real, lighting, self._real_groups, gathered=True)
            self._filter_mu()

    def rebuild_virtual(self, frame: RelightInput, table: LightTable, uniforms: dict[str, Any]) -> None:
        """Voxelise and light the objects, change the light of real surfaces, filter the rho set."""
        timers = frame.timers
        with timers.measure("voxelize"):
            moved = self._voxelize_virtual(frame.virtual, [self.rho])
        with timers.measure("light voxels"):
            bind_lighting(frame, table)
            lighting = lighting_uniforms(frame, uniforms, measured=self._measured)
            self._light.start_support(self.placement.voxel_bounds(np.stack(frame.virtual.bounds)))
            if moved:
                self._virtual_groups.start(self._virtual)
            self._light_rho(lighting, gathered=False)
        with timers.measure("filter"):
            self._filter_rho()
        if self._bounces > 0:
            with timers.measure("bounces"):
                if moved:
                    self._group.run(self._virtual, self._virtual_groups, lighting, has_seen=False)
                for _ in range(self._bounces):
                    self._bounce(lighting)

    def _light_rho(self, lighting: dict[str, Any], *, gathered: bool) -> None:
        self._light.light_virtual(self._virtual, lighting, self._virtual_groups, gathered=gathered)
        self._light.light_real_delta(self._real, lighting, self._real_groups, gathered=gathered)

    def _filter_rho(self) -> None:
        self._resolve.resolve_rho(self.rho, self._real, self._virtual, self.placement.uniforms())
        self._filter.run(self.rho, self.placement)

    def _bounce(self, lighting: dict[str, Any]) -> None:
        """Gather light from mu and rho, light the objects and change the real surfaces by it."""
        self._bind_for_gathering()
        marching = {**lighting, **self.far.uniforms()}
        self._gather.gather_real(self._real, self._real_groups, self.mu, self.rho, marching)
        self._gather.gather_virtual(self._virtual, self._virtual_groups, self.rho, marching)
        self._light_rho(lighting, gathered=True)
        self._filter_rho()

    def _bind_for_gathering(self) -> None:
        self.bind_support()
        self.far.pyramid.texture.use(location=16)

    def bind_support(self) -> None:
        """Bind the bounds of the voxels where mu and rho differ."""
        self._light.bind_support()
