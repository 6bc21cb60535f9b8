"""What fills and propagates the light volumes of DLPV (METHOD 5)."""

from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float32

from protocol.scene_method import DlpvMethod
from render_server.gpu.context import GpuContext
from render_server.passes.light_table import LightTable
from render_server.passes.light_volume import (
    LightVolume,
    covered_sums,
    injected_sums,
    lobe_weights,
    moment_weights,
    transmitted_shares,
)
from render_server.passes.lpv_bounce import LpvBouncePass
from render_server.passes.lpv_cover_faces import LpvCoverFacesPass
from render_server.passes.lpv_inject_maps import LpvInjectMapsPass
from render_server.passes.lpv_inject_surfaces import LpvInjectSurfacesPass
from render_server.passes.lpv_propagate import LpvPropagatePass
from render_server.passes.lpv_show import LpvShowPass
from render_server.passes.lpv_start import LpvStartPass
from render_server.passes.lpv_transmit import LpvTransmitPass
from render_server.passes.real_albedo import RealAlbedoPass
from render_server.passes.volume import Pyramid, VolumePlacement
from render_server.passes.voxel_store import VoxelStore
from render_server.passes.voxelize import VoxelizePass
from render_server.relight.frame import RelightInput
from render_server.relight.voxel_sets import bind_lighting, lighting_uniforms


class DlpvVolumes:
    """V_rho, and beside it V_mu (`mu`), or for the paper the change (`change`).

    Injected are two sums: the real scene's light without objects, and the change that objects make. V_mu starts with
    the first, V_rho with both, the paper's V_delta with the second and the negative lobes of direct light. What V_rho
    brings to surfaces they reflect: it is propagated anew with that, once a bounce.
    `shown`: what was injected of the change, for people who look.
    """

    def __init__(self, gpu: GpuContext, settings: DlpvMethod, cells: int) -> None:
        self._settings = settings
        self._steps = settings.steps or cells
        self._weights = (
            moment_weights(cells) if settings.resolved_propagation == "moments" else lobe_weights()
        )
        self.placement = VolumePlacement((0.0, 0.0, 0.0), 1.0, cells)
        self.rho = LightVolume(gpu, cells)
        is_paper = settings.operator == "paper"
        self.mu = None if is_paper else LightVolume(gpu, cells)
        self.change = LightVolume(gpu, cells) if is_paper else None
        self._real_light, self._change_light, self._bounced_light, self._shadow_light = (
            injected_sums(gpu, cells) for _ in range(4)
        )
        self._real_covered, self._virtual_covered = (covered_sums(gpu, cells) for _ in range(2))
        self._through_real, self._through_joint = (transmitted_shares(gpu, cells) for _ in range(2))
        self._real, self._virtual = (VoxelStore(gpu, 2 * cells) for _ in range(2))
        self._voxelize = VoxelizePass(gpu)
        self._albedo = RealAlbedoPass(gpu)
        self._maps = LpvInjectMapsPass(gpu)
        self._surfaces = LpvInjectSurfacesPass(gpu)
        self._cover = LpvCoverFacesPass(gpu)
        self._transmit = LpvTransmitPass(gpu)
        self._start = LpvStartPass(gpu)
        self._propagate = LpvPropagatePass(gpu)
        self._bounce = LpvBouncePass(gpu)
        self._show = LpvShowPass(gpu)
        self.shown = Pyramid(gpu, cells, 1)
        self._virtual_key: object = None

    @property
    def has_geometry(self) -> bool:
        """Whether surfaces block light between cells."""
        return self._settings.resolved_geometry_volume

    @property
    def query_uniforms(self) -> dict[str, Any]:
        """How light is read from the volumes (passes/common/lpv_light.glsl)."""
        return {"has_geometry": self.has_geometry, "damping": self._settings.resolved_damping}

    @property
    def _blocks_surroundings(self) -> bool:
        return self._settings.resolved_ambient == "blocked"

    def _half_cells(self) -> VolumePlacement:
        cells = self.placement
        return VolumePlacement(cells.origin, cells.voxel_edge / 2, 2 * cells.size)

    def _surfels(self, store: VoxelStore, corners: Float32[np.ndarray, "m 3 10"]) -> None:
        """Surfels of half cells; only these are used of the store."""
        store.grid.clear()
        self._voxelize.run(store, corners, self._half_cells())

    def _lighting(self, frame: RelightInput, uniforms: dict[str, Any]) -> dict[str, Any]:
        own = {"blocks_surroundings": self._blocks_surroundings}
        return {**lighting_uniforms(frame, uniforms), **own}

    def rebuild_real(
        self, frame: RelightInput, table: LightTable, placement: VolumePlacement, uniforms: dict[str, Any]
    ) -> None:
        """Surfels, albedo and light of the real scene; V_mu."""
        self.placement = placement
        if self.has_geometry or self._blocks_surroundings or self._settings.resolved_bounces > 0:
            with frame.timers.measure("voxelize"):
                self._surfels(self._real, frame.real.solid_corners(placement.voxel_edge))
        lighting = self._lighting(frame, uniforms)
        with frame.timers.measure("real albedo"):
            frame.picture.build_levels()
            bind_lighting(frame, table)
            self._albedo.run(table, lighting)
        with frame.timers.measure("inject real"):
            self._real_light.clear()
            self._maps.add_real(self._real_light, table, self._albedo.atlas, lighting)
            if self._blocks_surroundings:
                bind_lighting(frame, table)
                self._surfaces.add_real(self._real_light, self._real, lighting)
        if self.has_geometry:
            with frame.timers.measure("geometry volume"):
                self._cover.run(self._real_covered, self._real, placement)
                self._transmit.run(self._through_real, placement.size, self._real_covered)
        if self.mu is not None:
            with frame.timers.measure("propagate mu"):
                self._start.run(self.mu, self._real_light)
                through = self._through_real if self.has_geometry else None
                self._propagate.run(self.mu, self._weights, self._steps, through)

    def rebuild_virtual(self, frame: RelightInput, table: LightTable, uniforms: dict[str, Any]) -> None:
        """Surfels and light of the objects; V_rho, and the paper's V_delta."""
        key = (frame.virtual.version, self.placement)
        if key != self._virtual_key:
            self._virtual_key = key
            with frame.timers.measure("voxelize"):
                self._surfels(self._virtual, frame.virtual.corners)
        lighting = self._lighting(frame, uniforms)
        with frame.timers.measure("inject change"):
            bind_lighting(frame, table)
            self._change_light.clear()
            self._maps.add_change(self._change_light, table, self._albedo.atlas, lighting)
            self._surfaces.add_virtual(self._change_light, self._virtual, lighting)
        if self.has_geometry:
            with frame.timers.measure("geometry volume"):
                self._cover.run(self._virtual_covered, self._virtual, self.placement)
                self._transmit.run(
                    self._through_joint, self.placement.size, self._real_covered, self._virtual_covered
                )
        through = self._through_joint if self.has_geometry else None
        with frame.timers.measure("propagate rho"):
            self._start.run(self.rho, self._real_light, self._change_light)
            self._propagate.run(self.rho, self._weights, self._steps, through)
        self._bounce_light(frame, table, lighting, through)
        if self.change is not None:
            self._rebuild_change(frame, table, lighting)
        self._show.run(self.shown, self.placement.size, self._change_light, self._shadow_light)

    def _bounce_light(
        self,
        frame: RelightInput,
        table: LightTable,
        lighting: dict[str, Any],
        through: moderngl.Buffer | None,
    ) -> None:
        """V_rho once more, with what surfaces reflect of the light that the last one brought them."""
        if self.mu is None:
            return
        stores, light = (self._real, self._virtual), (self.mu, self.rho)
        for _ in range(self._settings.resolved_bounces):
            with frame.timers.measure("bounces"):
                bind_lighting(frame, table)
                self._bounced_light.clear()
                self._bounce.run(self._bounced_light, stores, light, {**lighting, **self.query_uniforms})
                self._start.run(self.rho, self._real_light, self._change_light, self._bounced_light)
                self._propagate.run(self.rho, self._weights, self._steps, through)

    def _rebuild_change(self, frame: RelightInput, table: LightTable, lighting: dict[str, Any]) -> None:
        """V_delta of the paper: one volume of the texels that differ ([P2] 4.3)."""
        assert self.change is not None
        with frame.timers.measure("inject direct"):
            self._shadow_light.clear()
            if self._settings.resolved_shadow == "lobe":
                bind_lighting(frame, table)
                self._maps.add_shadow(self._shadow_light, table, self._albedo.atlas, lighting)
        with frame.timers.measure("propagate delta"):
            self._start.run(self.change, self._change_light, self._shadow_light)
            through = self._through_joint if self.has_geometry else None
            self._propagate.run(self.change, self._weights, self._steps, through)

    def release(self) -> None:
        """Free the GL objects."""
        for item in vars(self).values():
            if hasattr(item, "release"):
                item.release()
