"""What smooth virtual surfaces reflect of the real scene that the camera sees ([D] 4.4.2)."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.caustics import GREATEST_ALPHA
from render_server.passes.direct_light import DirectLightPass
from render_server.passes.object_tree import ObjectTree
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.trace_cones import ConeFields

# A lobe that holds 85 % of its energy within 45 degrees and more is as good as diffuse: the wider cones serve.
ROUGHEST = GREATEST_ALPHA**0.5
CONE_COUNT = 4
# A disc of even weight whose median is that of the GGX lobe has so many times alpha as its half-angle (rad): half of
# the lobe lies within 2 alpha, half of a disc within 1 / sqrt(2) of its radius. The cones share the disc.
MEDIAN_DISC = 2.0 * 2.0**0.5 / CONE_COUNT**0.5


class ScreenConesPass:
    """`reflected` (RGBA16F): radiance times share of the specular lobe, and that share, on the picture's grid.

    `march`: the defines of march.glsl where what the picture does not show is looked for among voxels, bound by the
    caller, and in the environment; the share is 1 then. None: that share of the lobe remains for others.
    """

    def __init__(self, gpu: GpuContext, grid: SamplingGrid, march: dict[str, int] | None) -> None:
        self._grid = grid
        self._threads = list_threads(gpu, grid.picture_size[0] * grid.picture_size[1])
        self.reflected = texture_2d(gpu, grid.picture_size, 4, "f2")
        defines = {"ROUGHEST": ROUGHEST, "CONE_COUNT": CONE_COUNT, "MEDIAN_DISC": MEDIAN_DISC}
        if march is not None:
            defines |= {"VOXELS": 1, **march}
        self._program = ComputeProgram(gpu, Path(__file__).with_name("screen_cones.comp.glsl"), defines)

    def run(
        self,
        matte: moderngl.Texture,
        direct: DirectLightPass,
        cones: ConeFields,
        objects: ObjectTree,
        uniforms: dict[str, Any],
    ) -> None:
        """Trace; geometry, materials and the picture with its levels (`bind_picture`) must be bound."""
        objects.bind()
        bind_samplers(
            {0: self._grid.pixels, 1: matte, 13: direct.mu, 17: direct.rho, 10: cones.mu, 11: cones.rho}
        )
        bind_images(self.reflected)
        self._grid.virtual_texels.bind_to_storage_buffer(6)
        self._program.run((self._threads,), scale=self._grid.scale, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        self.reflected.release()
        self._program.release()
