"""Reflective shadow maps: depth, normal and texture coordinate of what each light sees first."""

from collections.abc import Sequence
from pathlib import Path

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext
from render_server.gpu.program import raster_program, set_uniforms
from render_server.gpu.textures import release_target, texture_2d
from render_server.passes.light_maps import LightView, tile_columns
from render_server.passes.mesh_buffers import MeshBuffers

CLIP_DISTANCE0 = 0x3000  # GL_CLIP_DISTANCE0, which moderngl does not name


class ShadowMapAtlas:
    """One depth texture and its reflective layers, a tile for every light view of one geometry set."""

    def __init__(self, gpu: GpuContext, tiles: int, tile_size: int) -> None:
        columns = tile_columns(tiles)
        rows = max(1, -(-tiles // columns))
        size = (columns * tile_size, rows * tile_size)
        self.tiles, self.tile_size, self.columns, self.size = tiles, tile_size, columns, size
        self._ctx = gpu.ctx
        self.normal = texture_2d(gpu, size, 4, "f2")
        self.uv = texture_2d(gpu, size, 4, "f4")
        self.depth = gpu.ctx.depth_texture(size)
        self.depth.compare_func = ""
        self.depth.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._target = gpu.ctx.framebuffer([self.normal, self.uv], self.depth)
        self.clear()

    def clear(self) -> None:
        """Empty all tiles."""
        self._target.use()
        self._target.viewport = (0, 0, *self.size)
        self._target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)

    def begin_tile(self, tile: int) -> None:
        """Draw into one tile from now on."""
        x, y = tile % self.columns, tile // self.columns
        self._target.use()
        box = (x * self.tile_size, y * self.tile_size, self.tile_size, self.tile_size)
        self._target.viewport = box
        self._target.scissor = box
        self._ctx.enable_only(moderngl.DEPTH_TEST)

    def end(self) -> None:
        """Lift the tile limits."""
        self._target.scissor = (0, 0, *self.size)

    def release(self) -> None:
        """Free the GL objects."""
        release_target(self._target)
        for item in (self.depth, self.normal, self.uv):
            item.release()


class ReflectiveShadowMapPass:
    """Draws meshes into the tiles of an atlas."""

    def __init__(self, gpu: GpuContext) -> None:
        self._ctx = gpu.ctx
        self._program = raster_program(gpu, Path(__file__).with_name("reflective_shadow_map"))

    def run(
        self,
        atlas: ShadowMapAtlas,
        meshes: Sequence[MeshBuffers],
        views: Sequence[LightView],
        first_view: int,
    ) -> None:
        """Draw all `meshes` for each view; the views' records begin at `first_view` of the bound storage buffer."""
        atlas.clear()
        for tile, view in enumerate(views):
            atlas.begin_tile(tile)
            if view.front is not None:
                self._ctx.enable_direct(CLIP_DISTANCE0)
            set_uniforms(self._program, {"view_index": first_view + tile})
            for mesh in meshes:
                mesh.draw(self._program)
            if view.front is not None:
                self._ctx.disable_direct(CLIP_DISTANCE0)
        atlas.end()

    def release(self) -> None:
        """Free the program."""
        self._program.release()


def texel_size_m(view: LightView, tile_size: int, distance_m: float) -> float:
    """What a texel spans at a distance from the light, m."""
    span = view.texel_span / tile_size
    return span if view.orthographic else span * float(np.abs(distance_m))
