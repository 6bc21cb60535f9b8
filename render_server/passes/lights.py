"""Lights, their shadow maps and the residual environment, as all passes that shade read them."""

from collections.abc import Sequence
from dataclasses import dataclass

import moderngl
import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol import short_axis
from deltalight.protocol.octahedral import resize_octahedral
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.textures import release_all, texture_2d, texture_rows
from deltalight.render_server.gpu.uniform_block import Block, Float, Int, UniformBlock
from deltalight.render_server.lights.light_models import DirectionalLight, Light, RectangleLight
from deltalight.render_server.lights.mirror_lights import MirrorLight
from deltalight.render_server.lights.octahedral import prefilter
from deltalight.render_server.passes.group_views import views_of_groups
from deltalight.render_server.passes.shadow_maps import (
    NEAREST_M,
    FittedViews,
    LightView,
    ShadowMapAtlas,
    frame_along,
    mirror_views,
    pack_view,
    require_atlas_fits,
    texel_size_m,
    tile_columns,
)

LIGHT_BYTES = 160  # of a std430 Light (shaders/common/light_shapes.glsl)
TEXEL_BYTES, LIGHT_TEXELS, VIEW_TEXELS = 16, 10, 7  # of a Light and a LightView (shaders/common/)
BRIGHTEST = float(np.finfo(np.float16).max)
GREATEST_IRRADIANCE = BRIGHTEST / 16  # of a map: what bounces and voxels add up has to fit, too
MIRROR_MAP_TEXELS = 256  # an edge of the map of where a plane mirrors a light
MIRROR_MAP_MARGIN = 1.1  # of the extent that the map has to cover
NOT_MIRRORED = (0.0,) * 7 + (-1.0,) + (0.0,) * 8
OBJECT_LAMP = (0.0,) * 7 + (-2.0,) + (0.0,) * 8

MapAxes = tuple[Float64[np.ndarray, "4"], Float64[np.ndarray, "4"]]


@dataclass(frozen=True, eq=False)
class LightingBlock(Block):
    """The number of lights, and the layers of the residual environment."""

    light_count: Int = 0
    environment_layers: Int = 0
    environment_first_half_angle: Float = 0.0
    """Radians, of layer 0; the last layer's is pi/2, cosine-weighted."""


class _Rows:
    """Records in a texture, a row each, with rows of zeros (`texture_rows`)."""

    def __init__(self, gpu: GpuContext, texels: int) -> None:
        self._gpu, self._texels = gpu, texels
        self._data = self._padded(b"")
        self.texture = self._made()

    def write(self, records: bytes) -> None:
        """Replaces the records, if they are others: in a new texture if these rows do not hold them."""
        before, self._data = self._data, self._padded(records)
        if len(before) != len(self._data):
            self.texture.release()
            self.texture = self._made()
        elif before != self._data:
            self.texture.write(self._data)

    def _padded(self, records: bytes) -> bytes:
        row_bytes = self._texels * TEXEL_BYTES
        return records.ljust(texture_rows(-(-len(records) // row_bytes)) * row_bytes, b"\0")

    def _made(self) -> moderngl.Texture:
        size = self._texels, len(self._data) // (self._texels * TEXEL_BYTES)
        return texture_2d(self._gpu, size, 4, "u4", data=self._data)

    def release(self) -> None:
        """Frees the texture."""
        self.texture.release()


class LightBuffers:
    """GPU buffers of the lights: their records, and reflective shadow maps (RSM) of real scene and objects.

    Lamps that come with objects shine in rho alone, because the picture was taken without them. With `is_joint`, the
    buffers are those of rho alone, and their `real` maps show the objects too (methods/differential.py).
    """

    def __init__(
        self, gpu: GpuContext, tile_size: int, shadow_samples: int, *, is_joint: bool = False
    ) -> None:
        self._is_joint = is_joint
        self._object_lamp_count = 0  # lamps that come with objects follow the lights of the scene
        self._gpu = gpu
        self.tile_size = tile_size
        self.shadow_samples = shadow_samples
        self.lights: list[Light] = []
        self.mirrors: list[MirrorLight] = []  # the last of the lights
        self.mirror_visibility = gpu.ctx.texture_array((1, 1, 1), 2, dtype="f2")
        self.real_views: list[LightView] = []
        self.object_views: list[LightView] = []
        self.views_of_lights: list[tuple[range, range]] = []
        self._views_around_objects, self._views_of_objects = FittedViews(), FittedViews()
        # Records of the views as shaders read them: they change when these do.
        self.real_records = self.object_records = b""
        self.real_atlas = ShadowMapAtlas(gpu, 1, tile_size)
        self.object_atlas = ShadowMapAtlas(gpu, 1, tile_size)
        self._light_rows, self._view_rows = _Rows(gpu, LIGHT_TEXELS), _Rows(gpu, VIEW_TEXELS)
        self._environment: moderngl.TextureArray | None = None
        self._environment_half_angle = 0.0
        self._block = UniformBlock(gpu, LightingBlock())

    @property
    def bindings(self) -> dict[str, Binding]:
        """All bindings of the lights, by GLSL name."""
        return {
            "light_rows": self._light_rows.texture,
            "light_view_rows": self._view_rows.texture,
            "Lighting": self._block,
            "real_rsm_depth": self.real_atlas.depth,
            "object_rsm_depth": self.object_atlas.depth,
            "caster_distance": self.object_atlas.caster_distance,
            "real_rsm_normal": self.real_atlas.normal,
            "object_rsm_normal": self.object_atlas.normal,
            "object_rsm_uv": self.object_atlas.uv,
            "mirror_visibility": self.mirror_visibility,
            "environment_map": self._environment,
            "shadow_samples": self.shadow_samples,
            "has_rectangles": any(isinstance(light, RectangleLight) for light in self.lights),
            "has_mirror_images": bool(self.mirrors),
            "has_object_lamps": self.has_object_lamps,
        }

    @property
    def has_object_lamps(self) -> bool:
        """Whether any lamp comes with an object."""
        return self._object_lamp_count > 0

    def set_environment(self, radiance: Float32[np.ndarray, "n n 3"]) -> moderngl.TextureArray:
        """Uploads the residual environment R (octahedral), averaged over cones of doubling half-angle."""
        if self._environment is not None:
            self._environment.release()
        self._environment, self._environment_half_angle = environment_texture(self._gpu, radiance)
        self._write_block()
        return self._environment

    def place(
        self,
        lights: list[Light],
        real_points: Float64[np.ndarray, "n 3"],
        receivers: Float64[np.ndarray, "k 3"],
        object_points: Float64[np.ndarray, "m 3"],
        *,
        mirrors: Sequence[MirrorLight] = (),
        object_lamps: Sequence[Light] = (),
        blocking: Float64[np.ndarray, "b 3"] | None = None,
        groups: Sequence[Float64[np.ndarray, "g 3"]] = (),
    ) -> None:
        """Fits the views of each light: to the real points that may receive the objects' shadow, and to the objects.

        `mirrors` are mirror images of the lights, whose views are limited to the front of their planes;
        `object_lamps` come with objects; `blocking` are points of all objects, if `object_points` are those of some;
        `groups` are points of each group of objects far apart.
        """
        self.mirrors, self._object_lamp_count = list(mirrors), len(object_lamps)
        lights = [*lights, *object_lamps]
        self._make_mirror_maps()
        shown = np.concatenate([receivers, object_points]) if mirrors else receivers
        axes = [mirror_map_axes(mirror, shown) for mirror in mirrors]
        real = self._views_around_objects.of(lights, receivers, real_points)
        blocking = object_points if blocking is None else blocking
        around_all = self._views_of_objects.of(lights, object_points, blocking)
        objects = views_of_groups(lights, groups, blocking, around_all)
        for mirror in mirrors:
            real.append(mirror_views(mirror, receivers, real_points, mirror.tolerance_m))
            objects.append(mirror_views(mirror, object_points, object_points))
        self.lights = [*lights, *(mirror.light for mirror in mirrors)]
        self.real_views = [view for views in real for view in views]
        self.object_views = [view for views in objects for view in views]
        self.real_atlas = self._atlas_for(self.real_atlas, len(self.real_views))
        self.object_atlas = self._atlas_for(self.object_atlas, len(self.object_views))
        self._write_records(real, objects, axes)
        self._write_block()

    def _make_mirror_maps(self) -> None:
        old, count = self.mirror_visibility, len(self.mirrors)
        if not count or (old.width, old.layers) == (MIRROR_MAP_TEXELS, count):
            return
        old.release()
        size = (MIRROR_MAP_TEXELS, MIRROR_MAP_TEXELS, count)
        self.mirror_visibility = self._gpu.ctx.texture_array(size, 2, dtype="f2")
        self.mirror_visibility.build_mipmaps()
        self.mirror_visibility.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self.mirror_visibility.repeat_x = self.mirror_visibility.repeat_y = False

    def _atlas_for(self, atlas: ShadowMapAtlas, tiles: int) -> ShadowMapAtlas:
        if atlas.tiles == max(tiles, 1):
            return atlas
        require_atlas_fits(self._gpu, tiles, self.tile_size)
        atlas.release()
        return ShadowMapAtlas(self._gpu, max(tiles, 1), self.tile_size)

    def _write_records(
        self, real: list[list[LightView]], objects: list[list[LightView]], axes: Sequence[MapAxes]
    ) -> None:
        """Writes the records of all lights and views; the real views come first."""
        records = b""
        self.views_of_lights = []
        first_real, first_object = 0, len(self.real_views)
        first_mirror = len(self.lights) - len(self.mirrors)
        first_lamp = -self._object_lamp_count if not self._is_joint else 0
        for index, (light, real_part, object_part) in enumerate(
            zip(self.lights, real, objects, strict=True), start=-first_mirror
        ):
            ranges = (first_real, len(real_part), first_object, len(object_part))
            if index < 0:
                records += _pack_light(
                    light, ranges, tail=OBJECT_LAMP if index >= first_lamp else NOT_MIRRORED
                )
            else:
                records += _pack_mirror(self.mirrors[index], index, axes[index], ranges)
            first_real += len(real_part)
            first_object += len(object_part)
            self.views_of_lights.append((range(ranges[0], first_real), range(ranges[2], first_object)))
        self.real_records = self._packed(self.real_views)
        self.object_records = self._packed(self.object_views)
        self._light_rows.write(records)
        self._view_rows.write(self.real_records + self.object_records)

    def _packed(self, views: list[LightView]) -> bytes:
        columns = tile_columns(len(views))
        records = [pack_view(view, tile, columns, self.tile_size) for tile, view in enumerate(views)]
        return np.array(records, np.float32).tobytes()

    def _write_block(self) -> None:
        layers = 0 if self._environment is None else self._environment.layers
        self._block.write(LightingBlock(len(self.lights), layers, self._environment_half_angle))

    @property
    def real_views_of_object_lamps(self) -> range:
        """Numbers of the real views of lamps that come with objects."""
        first = len(self.lights) - len(self.mirrors) - self._object_lamp_count
        own = self.views_of_lights[first : first + self._object_lamp_count]
        return range(own[0][0].start, own[-1][0].stop) if own else range(0)

    @property
    def first_object_view(self) -> int:
        """Index of the first record of a view of objects."""
        return len(self.real_views)

    def object_texel_m(self, point: Float64[np.ndarray, "3"]) -> float:
        """Largest texel of the objects' maps at `point`, m."""
        return self._texel_m(self.object_views, point)

    def real_texel_m(self, point: Float64[np.ndarray, "3"]) -> float:
        """Largest texel of the real scene's maps at `point`, m."""
        return self._texel_m(self.real_views, point)

    def _texel_m(self, views: list[LightView], point: Float64[np.ndarray, "3"]) -> float:
        sizes, place = [], np.array([*point.tolist(), 1.0])
        for view in views:
            depth = (view.view_from_world @ place)[2]
            sizes.append(texel_size_m(view, self.tile_size, float(depth)))
        return max(sizes, default=0.0)

    def release(self) -> None:
        """Frees the GL objects."""
        for item in (self.real_atlas, self.object_atlas, self.mirror_visibility, self._block):
            item.release()
        release_all(self._light_rows, self._view_rows)
        if self._environment is not None:
            self._environment.release()


class MirrorVisibility:
    """Computes maps of where smooth real planes mirror the lights, one per mirror image (lights/mirror_lights.py).

    A map holds the fraction of the light that each point of the plane shows, without and with the objects; its mip
    levels average over larger and larger footprints.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._kernel = Kernel(gpu, "mirror_visibility")

    def run(self, lights: LightBuffers, noise_m: float, scene: Bindings) -> None:
        """Fills `lights.mirror_visibility`; `noise_m` is the depth noise, m."""
        count = len(lights.mirrors)
        self._kernel.run(
            (MIRROR_MAP_TEXELS, MIRROR_MAP_TEXELS, count),
            scene,
            visibility_out=lights.mirror_visibility,
            mirror_visibility=None,  # of the lights that are no images, which alone are asked for
            first_image=len(lights.lights) - count,
            bias_real=noise_m,
            noise_m=noise_m,
        )
        lights.mirror_visibility.build_mipmaps()

    def release(self) -> None:
        """Frees the program."""
        self._kernel.release()


def environment_texture(
    gpu: GpuContext, radiance: Float32[np.ndarray, "n n 3"]
) -> tuple[moderngl.TextureArray, float]:
    """Returns a map averaged over cones (shaders/common/environment.glsl), and the half-angle of layer 0 (rad).

    Half floats have to hold it and the light it gives: a map of more irradiance than `GREATEST_IRRADIANCE` is
    darkened as a whole, which no picture shows, because all that it lights is white by far.
    """
    prefiltered = prefilter(radiance)
    size, count = len(radiance), len(prefiltered.levels)
    layers = [radiance, *(resize_octahedral(level, size) for level in prefiltered.levels[1:])]
    irradiance = np.pi * float(prefiltered.levels[-1].max())
    if irradiance > GREATEST_IRRADIANCE:
        layers = [layer * (GREATEST_IRRADIANCE / irradiance) for layer in layers]
    rgba = np.ones((count, size, size, 4), np.float16)
    rgba[..., :3] = np.minimum(np.stack(layers), BRIGHTEST)
    texture = gpu.ctx.texture_array((size, size, count), 4, rgba.tobytes(), dtype="f2")
    texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
    texture.repeat_x = texture.repeat_y = False
    return texture, float(prefiltered.half_angles[0])


def mirror_map_axes(mirror: MirrorLight, points: Float64[np.ndarray, "n 3"]) -> MapAxes:
    """Returns rows that map (x, y, z, 1) to a map's coordinates (0..1) on the plane.

    The map covers the part of the plane that shows the light to the `points`.
    """
    normal, plane = mirror.plane[:3], mirror.plane
    heights = points @ normal + plane[3]
    points, heights = points[heights > 0], heights[heights > 0, None]
    if isinstance(mirror.light, DirectionalLight):
        to_light = np.broadcast_to(-mirror.light.direction.astype(float), points.shape)
    else:
        to_light = mirror.light.position.astype(float) - points
    on_plane = points + to_light * (heights / -(to_light @ normal)[:, None])
    axes = frame_along(normal)[:2]
    local = on_plane @ axes.T
    if not len(local):
        local = np.zeros((1, 2))
    low, high = short_axis.bounds(local)
    extent = max(float((high - low).max()), NEAREST_M) * MIRROR_MAP_MARGIN
    offset = 0.5 - (low + high) / 2 / extent
    u, v = (np.append(axis / extent, shift) for axis, shift in zip(axes, offset, strict=True))
    return u, v


def _pack_mirror(mirror: MirrorLight, layer: int, axes: MapAxes, ranges: Sequence[int]) -> bytes:
    """Packs the std430 Light of a mirror image."""
    own = mirror.tolerance_m, mirror.roughness, float(mirror.surface), float(mirror.source)
    tail = [*mirror.plane, *mirror.f0, float(layer), *axes[0], *axes[1]]
    return _pack_light(mirror.light, ranges, own, tail)


def _pack_light(
    light: Light,
    ranges: Sequence[int],
    own: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    tail: Sequence[float] = NOT_MIRRORED,
) -> bytes:
    """Packs a std430 Light: position, colour, shape, two axes and mirror data as floats, view ranges as integers."""
    r = light.record()
    floats = [
        *r.place,
        r.kind,
        *r.color,
        own[0],
        *r.shape,
        own[1],
        *r.axis_u,
        own[2],
        *r.axis_v,
        own[3],
        *tail,
    ]
    return np.array(floats, np.float32).tobytes() + np.array(ranges, np.int32).tobytes()
