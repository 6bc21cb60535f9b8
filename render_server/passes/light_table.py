"""Lights, their depth maps and the environment, bound for every pass that shades."""

from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float32, Float64

from render_server.gpu.context import GpuContext
from render_server.lights.lights import Light
from render_server.lights.mirror_lights import MirrorLight
from render_server.lights.octahedral import octahedral_grid, prefilter, sample_octahedral
from render_server.passes.light_maps import (
    SHARE_TEXELS,
    LightView,
    light_views,
    mirror_views,
    pack_light,
    pack_mirror,
    pack_view,
    share_map,
    tile_columns,
)
from render_server.passes.reflective_shadow_map import ShadowMapAtlas, texel_size_m

LIGHT_BYTES = 160  # of a std430 Light (passes/common/lights.glsl)
EMPTY = b"\0" * 256


class LightTable:
    """What the lights see of the real scene and of the virtual objects, and the records that tell shaders so."""

    def __init__(self, gpu: GpuContext, tile_size: int, shadow_samples: int) -> None:
        self._gpu = gpu
        self.tile_size = tile_size
        self.shadow_samples = shadow_samples
        self.lights: list[Light] = []
        self.mirrors: list[MirrorLight] = []  # the last of the lights
        self.mirror_shares = gpu.ctx.texture_array((1, 1, 1), 2, dtype="f2")
        self.real_views: list[LightView] = []
        self.virtual_views: list[LightView] = []
        self.real_records = b""  # of the real views, as shaders read them: changes when these do
        self.real_atlas = ShadowMapAtlas(gpu, 1, tile_size)
        self.virtual_atlas = ShadowMapAtlas(gpu, 1, tile_size)
        self._light_buffer = gpu.ctx.buffer(EMPTY, dynamic=True)
        self._view_buffer = gpu.ctx.buffer(EMPTY, dynamic=True)
        self._environment: moderngl.TextureArray | None = None
        self._environment_uniforms: dict[str, Any] = {}

    def set_environment(self, radiance: Float32[np.ndarray, "n n 3"]) -> None:
        """Upload the residual environment R (octahedral), averaged over cones of doubling half-angle."""
        prefiltered = prefilter(radiance)
        size, count = len(radiance), len(prefiltered.levels)
        directions = octahedral_grid(size)
        layers = [radiance, *(sample_octahedral(level, directions) for level in prefiltered.levels[1:])]
        rgba = np.ones((count, size, size, 4), np.float16)
        rgba[..., :3] = np.stack(layers)
        if self._environment is not None:
            self._environment.release()
        self._environment = self._gpu.ctx.texture_array((size, size, count), 4, rgba.tobytes(), dtype="f2")
        self._environment.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self._environment.repeat_x = self._environment.repeat_y = False
        self._environment_uniforms = {
            "environment_layers": count,
            "environment_first_half_angle": prefiltered.half_angles[0],
        }

    def place(
        self,
        lights: list[Light],
        real_points: Float64[np.ndarray, "n 3"],
        receivers: Float64[np.ndarray, "k 3"],
        virtual_points: Float64[np.ndarray, "m 3"],
        mirrors: Sequence[MirrorLight] = (),
    ) -> None:
        """Fit each light's views: around the real points that may receive the objects' shadow, and closely around
        the virtual objects; those of mirror images before their planes.
        """
        self.mirrors = list(mirrors)
        self._make_shares()
        self._maps = [share_map(mirror, np.concatenate([receivers, virtual_points])) for mirror in mirrors]
        real = [light_views(light, receivers, real_points) if len(receivers) else [] for light in lights]
        virtual = [
            light_views(light, virtual_points, virtual_points) if len(virtual_points) else []
            for light in lights
        ]
        for mirror in mirrors:
            real.append(mirror_views(mirror, receivers, real_points, mirror.tolerance_m))
            virtual.append(mirror_views(mirror, virtual_points, virtual_points))
        self.lights = [*lights, *(mirror.light for mirror in mirrors)]
        self.real_views = [view for views in real for view in views]
        self.virtual_views = [view for views in virtual for view in views]
        self.real_atlas = self._atlas_for(self.real_atlas, len(self.real_views))
        self.virtual_atlas = self._atlas_for(self.virtual_atlas, len(self.virtual_views))
        self._write_records(real, virtual)

    def _make_shares(self) -> None:
        old, count = self.mirror_shares, len(self.mirrors)
        if not count or (old.width, old.layers) == (SHARE_TEXELS, count):
            return
        old.release()
        self.mirror_shares = self._gpu.ctx.texture_array((SHARE_TEXELS, SHARE_TEXELS, count), 2, dtype="f2")
        self.mirror_shares.build_mipmaps()
        self.mirror_shares.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self.mirror_shares.repeat_x = self.mirror_shares.repeat_y = False

    def _atlas_for(self, atlas: ShadowMapAtlas, tiles: int) -> ShadowMapAtlas:
        if atlas.tiles == max(tiles, 1):
            return atlas
        atlas.release()
        return ShadowMapAtlas(self._gpu, max(tiles, 1), self.tile_size)

    def _write_records(self, real: list[list[LightView]], virtual: list[list[LightView]]) -> None:
        """Records of all lights and views; the real views come first."""
        records = b""
        first_real, first_virtual = 0, len(self.real_views)
        first_mirror = len(self.lights) - len(self.mirrors)
        for light, real_part, virtual_part in zip(self.lights, real, virtual, strict=True):
            ranges = (first_real, len(real_part), first_virtual, len(virtual_part))
            layer = len(records) // LIGHT_BYTES - first_mirror
            if layer < 0:
                records += pack_light(light, ranges)
            else:
                records += pack_mirror(self.mirrors[layer], layer, self._maps[layer], ranges)
            first_real += len(real_part)
            first_virtual += len(virtual_part)
        self.real_records = self._packed(self.real_views)
        packed = self.real_records + self._packed(self.virtual_views)
        self._light_buffer.orphan(max(len(records), 16))
        self._view_buffer.orphan(max(len(packed), 16))
        self._light_buffer.write(records or EMPTY[:16])
        self._view_buffer.write(packed or EMPTY[:16])

    def _packed(self, views: list[LightView]) -> bytes:
        columns = tile_columns(len(views))
        records = [pack_view(view, tile, columns, self.tile_size) for tile, view in enumerate(views)]
        return np.array(records, np.float32).tobytes()

    @property
    def first_virtual_view(self) -> int:
        """Index of the first virtual view's record."""
        return len(self.real_views)

    def virtual_texel_m(self, point: Float64[np.ndarray, "3"]) -> float:
        """Largest texel of the virtual depth maps at `point`, m."""
        return self._texel_m(self.virtual_views, point)

    def real_texel_m(self, point: Float64[np.ndarray, "3"]) -> float:
        """Largest texel of the real depth maps at `point`, m."""
        return self._texel_m(self.real_views, point)

    def _texel_m(self, views: list[LightView], point: Float64[np.ndarray, "3"]) -> float:
        sizes = []
        for view in views:
            depth = (view.view_from_world @ np.append(point, 1.0))[2]
            sizes.append(texel_size_m(view, self.tile_size, float(depth)))
        return max(sizes, default=0.0)

    def bind_records(self) -> None:
        """Bind the records alone (while depth maps are being drawn)."""
        self._light_buffer.bind_to_storage_buffer(0)
        self._view_buffer.bind_to_storage_buffer(1)

    def bind(self) -> None:
        """Bind everything to the places that lights.glsl and environment.glsl name."""
        self.bind_records()
        self.real_atlas.depth.use(location=10)
        self.virtual_atlas.depth.use(location=11)
        self.mirror_shares.use(location=22)
        if self._environment is not None:
            self._environment.use(location=12)

    def uniforms(self) -> dict[str, Any]:
        """Every uniform that shaders read of the lights."""
        return {
            "light_count": len(self.lights),
            "shadow_samples": self.shadow_samples,
            **self._environment_uniforms,
        }

    def release(self) -> None:
        """Free the GL objects."""
        self.real_atlas.release()
        self.virtual_atlas.release()
        self.mirror_shares.release()
        self._light_buffer.release()
        self._view_buffer.release()
        if self._environment is not None:
            self._environment.release()
