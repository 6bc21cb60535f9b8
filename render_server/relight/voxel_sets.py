"""The touched voxels of the real scene and of the objects over one placement of the volume (METHOD 4.2)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32

from render_server.gpu.context import GpuContext
from render_server.passes.clear_voxels import ClearVoxelsPass
from render_server.passes.light_table import LightTable
from render_server.passes.light_voxels import bind_picture
from render_server.passes.volume import Pyramid, VolumePlacement
from render_server.passes.voxel_store import VoxelStore
from render_server.passes.voxelize import VoxelizePass
from render_server.relight.frame import GeometryState, RelightInput

SURFEL_SHADOW_SAMPLES = 4  # of a light's area: a voxel averages many surfels
DEPTH_TOLERANCE = 0.02  # a surfel this near (relative) to what the camera sees is what it sees


class VoxelSets:
    """Two voxel stores, each rebuilt when its geometry moves; what lights them is the operator's."""

    def __init__(self, gpu: GpuContext, placement: VolumePlacement, directions: int) -> None:
        self.placement = placement
        self._real = VoxelStore(gpu, placement.size)
        self._virtual = VoxelStore(gpu, placement.size)
        self._voxelize = VoxelizePass(gpu)
        self._clear = ClearVoxelsPass(gpu, directions)
        self._virtual_version: int | None = None

    def _voxelize_real(
        self,
        corners: Float32[np.ndarray, "m 3 10"],
        placement: VolumePlacement,
        pyramids: Sequence[Pyramid],
    ) -> None:
        """Replace the real set; the pyramids lose its old texels. The objects go too if the volume moved."""
        if placement != self.placement:
            self._clear.run(self._virtual, pyramids, self.placement)
            self._virtual_version = None
        self._clear.run(self._real, pyramids, self.placement)
        self.placement = placement
        self._voxelize.run(self._real, corners, placement)

    def _voxelize_virtual(self, virtual: GeometryState, pyramids: Sequence[Pyramid]) -> bool:
        """Replace the objects; the pyramids lose the texels of the old ones. Returns whether there are new voxels.

        Objects that stood still keep their voxels, only their light is forgotten.
        """
        if virtual.version == self._virtual_version:
            self._virtual.sums.clear()
            return False
        self._virtual_version = virtual.version
        self._clear.run(self._virtual, pyramids, self.placement)
        self._voxelize.run(self._virtual, virtual.corners, self.placement)
        return True

    def counts(self) -> dict[str, tuple[int, int]]:
        """Touched voxels and surfels of both sets; waits for the GPU."""
        return {"real": self._real.counts(), "virtual": self._virtual.counts()}

    def release(self) -> None:
        """Free the GL objects."""
        for item in vars(self).values():
            if hasattr(item, "release"):
                item.release()


def bind_lighting(frame: RelightInput, table: LightTable) -> None:
    """Bind what lights voxels: lights, the objects' materials, the picture."""
    table.bind()
    frame.virtual.materials.bind()
    bind_picture(frame.picture.linear, frame.real_surface.position)
    frame.unseen_albedo.bind()


def lighting_uniforms(
    frame: RelightInput, uniforms: dict[str, Any], *, measured: bool = True
) -> dict[str, Any]:
    """Uniforms of the passes that light voxels; without `measured`, no surface counts as seen by the camera."""
    bias = 3.0 * frame.noise_sigma * frame.typical_depth**2
    own = {
        "shadow_samples": SURFEL_SHADOW_SAMPLES,
        "bias_real": bias,
        "bias_virtual": bias,
        "depth_tolerance": DEPTH_TOLERANCE if measured else -1.0,
        **frame.unseen_albedo.uniforms(),
        "picture_lod": 2.0,
    }
    return {**uniforms, **own}
