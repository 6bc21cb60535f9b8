"""Virtual objects in smooth real surfaces, by rays: cones through voxels would blur them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.object_tree import ObjectTree
from render_server.passes.sampling_grid import SamplingGrid

FOLDER = Path(__file__).parent
# Of equal energy each: up to RAY_ROUGHNESS they stand closer than voxels do. There the cone of the lobe is 48 degrees
# wide and the rays some 12 apart: a fifth of an object's length away from it, six of 64 voxels.
RAY_COUNT = 16
# Of surfaces; from here on cones serve. They span many voxels there, and so few rays would show as grain.
RAY_ROUGHNESS = 0.3
DEFINES = {"RAY_ROUGHNESS": RAY_ROUGHNESS, "RAY_COUNT": RAY_COUNT}
GROUP = 64  # invocations of a workgroup, one a ray
ROW = 256  # workgroups a row: OpenGL promises no more than 65535


class MirrorObjectsPass:
    """`reflection` (RGBA16F): radiance of the objects times the share of the lobe that they fill, and that share.

    `gather`: the pass (mirror_gather...) that finds the light of reflected points; `defines`: those that it needs.
    """

    def __init__(
        self,
        gpu: GpuContext,
        grid: SamplingGrid,
        objects: ObjectTree,
        gather: str,
        defines: dict[str, int],
    ) -> None:
        self._grid, self._objects = grid, objects
        self.reflection = texture_2d(gpu, grid.picture_size, 4, "f2")
        self._traced = texture_2d(gpu, grid.picture_size, 4, "f2")
        self._way = texture_2d(gpu, grid.picture_size, 1, "f2")
        self._position = texture_2d(gpu, grid.size, 4, "f4")
        self._normal = texture_2d(gpu, grid.size, 4, "f2")
        self._irradiance = texture_2d(gpu, grid.size, 4, "f2")
        self._specular = texture_2d(gpu, grid.size, 4, "f2")
        self._pixels = gpu.ctx.buffer(reserve=4 + 4 * grid.picture_size[0] * grid.picture_size[1])
        self._texels = gpu.ctx.buffer(reserve=4 + 4 * grid.size[0] * grid.size[1])
        self._select, self._hits, self._gather, self._trace, self._smooth = (
            ComputeProgram(gpu, FOLDER / f"mirror_{name}.comp.glsl", {**DEFINES, **defines})
            for name in ("select", "hits", gather, "objects", "smooth")
        )

    def run(self, matte: moderngl.Texture, bind_light: Callable[[], None], uniforms: dict[str, Any]) -> None:
        """Fill `reflection`; lights, geometry, surfaces and materials must be bound.

        `bind_light` binds what the gathering pass reads beside them. Waits for the GPU to say how many pixels need
        rays: where none do, nothing is built or traced.
        """
        count = self._list_pixels(matte, uniforms)
        if not count:
            return
        self._objects.bind()
        self._gather_light(bind_light, uniforms)
        self._pixels.bind_to_storage_buffer(6)
        self._trace_rays(count, uniforms)
        bind_samplers({1: matte, 2: self._traced, 3: self._way})
        bind_images(self.reflection)
        self._smooth.run((count,), **uniforms)

    def _list_pixels(self, matte: moderngl.Texture, uniforms: dict[str, Any]) -> int:
        _empty(self._pixels)
        bind_samplers({1: matte})
        bind_images(self.reflection, self._traced, self._way)
        sphere: dict[str, Any] = {
            "bounds_centre": tuple(self._objects.centre),
            "bounds_radius": self._objects.radius,
        }
        self._select.run(self._grid.picture_size, **sphere, **uniforms)
        return _count(self._pixels)

    def _gather_light(self, bind_light: Callable[[], None], uniforms: dict[str, Any]) -> None:
        """Light at reflected points, at the resolution of the cones."""
        _empty(self._texels)
        bind_samplers({0: self._grid.pixels})
        bind_images(self._position, self._normal)
        self._hits.run(self._grid.size, scale=self._grid.scale, **uniforms)
        bind_light()
        bind_samplers({1: self._position, 8: self._normal})
        bind_images(self._irradiance, self._specular)
        self._gather.run((_count(self._texels),), **uniforms)

    def _trace_rays(self, count: int, uniforms: dict[str, Any]) -> None:
        bind_samplers({0: self._grid.pixels, 1: self._position, 2: self._normal, 3: self._irradiance})
        bind_samplers({8: self._specular})
        bind_images(self._traced, self._way)
        groups = -(-count * RAY_COUNT // GROUP)
        threads = (GROUP * min(groups, ROW), -(-groups // ROW))
        self._trace.run(threads, scale=self._grid.scale, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        for item in vars(self).values():
            if hasattr(item, "release") and item not in (self._grid, self._objects):
                item.release()


def _empty(texels: moderngl.Buffer) -> None:
    """Bind an empty list (passes/common/texel_list.glsl)."""
    texels.write(bytes(4))
    texels.bind_to_storage_buffer(6)


def _count(texels: moderngl.Buffer) -> int:
    return int(np.frombuffer(texels.read(4), np.uint32)[0])
