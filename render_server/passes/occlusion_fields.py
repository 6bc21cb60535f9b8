"""Occlusion fields of rigid objects: light around them, occlusion and reflection of it ([D] 5.2, docs/method.md 6).

`place` holds one object's pose (`standing_uniforms`, shaders/common/object_field.glsl).
"""

import moderngl
import numpy as np
from jaxtyping import Float16, Float32, Float64

from deltalight.protocol.octahedral import octahedral_grid, texel_solid_angles
from deltalight.render_server.gpu.clearing import clear_buffer
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.textures import texture_2d
from deltalight.render_server.lights.octahedral import MAX_ORDER, harmonics
from deltalight.render_server.passes.cones import ConeFields, LowResGrid
from deltalight.render_server.passes.voxels import VoxelMipmap
from deltalight.render_server.scene.occlusion_field import OcclusionField
from deltalight.render_server.scene.occlusion_transfer import LENGTH

MOST_SHELLS = 6
COEFFICIENTS_PER_TEXEL = 4
PROBE_SIZE = 32
PROBE_TEXELS = PROBE_SIZE**2


class FieldTextures:
    """The samples of one field (RGBA16F, four coefficients per slab), and the transfer of reflected light."""

    def __init__(self, gpu: GpuContext, field: OcclusionField) -> None:
        self.field = field
        self.occlusion = _slabs(gpu, field.occlusion)
        self.transfer: moderngl.Buffer | None = None
        self.bounce_size = 0
        if field.transfer is not None:
            self.bounce_size = field.transfer.shape[1]
            self.transfer = gpu.ctx.buffer(np.ascontiguousarray(field.transfer).tobytes())

    @property
    def slabs(self) -> int:
        """Number of slabs of `occlusion` per shell."""
        return _slab_count(self.field.occlusion)

    @property
    def bounce_shape(self) -> tuple[int, int, int]:
        """Size of the texture of light reflected under one light: a slab per shell and coefficient."""
        size = self.bounce_size
        return size, size, size * len(self.field.occlusion) * LENGTH

    def release(self) -> None:
        """Frees the GL objects."""
        self.occlusion.release()
        if self.transfer is not None:
            self.transfer.release()


def _slab_count(samples: Float16[np.ndarray, "shells n n n k"]) -> int:
    coefficients: int = samples.shape[-1]
    return -(-coefficients // COEFFICIENTS_PER_TEXEL)


def _slabs(gpu: GpuContext, samples: Float16[np.ndarray, "shells n n n k"]) -> moderngl.Texture3D:
    shells, n, *_, count = samples.shape
    slabs, width = _slab_count(samples), COEFFICIENTS_PER_TEXEL
    padded = np.zeros((shells, n, n, n, width * slabs), np.float16)
    padded[..., :count] = samples
    stacked = np.moveaxis(padded.reshape(shells, n, n, n, slabs, width), 4, 1)
    texture = field_texture(gpu, (n, n, n * shells * slabs))
    texture.write(np.ascontiguousarray(stacked).tobytes(), alignment=1)
    return texture


def field_texture(gpu: GpuContext, shape: tuple[int, int, int]) -> moderngl.Texture3D:
    """Creates an RGBA16F volume with trilinear filtering."""
    texture = gpu.ctx.texture3d(shape, 4, dtype="f2")
    texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
    texture.repeat_x = texture.repeat_y = texture.repeat_z = False
    return texture


def standing_uniforms(
    world_from_asset: Float64[np.ndarray, "4 4"],
    field: OcclusionField | None,
    bounds: Float32[np.ndarray, "2 3"],
) -> dict[str, Binding]:
    """Returns the pose of an object and its shells; without a field, `bounds` (asset's frame) locate its middle."""
    linear = world_from_asset[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    low, high = bounds.astype(np.float64)
    centre, half = (low + high) / 2, (high - low) / 2
    halves = np.ones((1, 3)) if field is None else field.grid.halves
    padded = np.concatenate([halves, np.repeat(halves[-1:], MOST_SHELLS - len(halves), axis=0)])
    return {
        "object_position": tuple(world_from_asset[:3, 3]),
        "world_from_object": linear / scale,
        "object_scale": scale,
        "field_centre": tuple(centre if field is None else field.grid.centre),
        "object_half": tuple(half),
        "object_radius": float(np.linalg.norm(half)) if field is None else field.radius,
        "shell_halves": [tuple(row) for row in padded],
        "shells": len(halves),
        "resolution": 2 if field is None else field.occlusion.shape[1],
    }


class LightProbe:
    """Light around one object.

    `radiance`: RGBA16F, octahedral in the asset's axes, a: fraction seen by the camera. `products`: those of that
    radiance with transfer and harmonics, for every normal.
    """

    def __init__(self, gpu: GpuContext, length: int) -> None:
        size = (PROBE_SIZE, PROBE_SIZE)
        self.radiance = texture_2d(gpu, size, 4, "f2", linear=True)
        self.products = field_texture(gpu, (*size, length + 1))

    def release(self) -> None:
        """Frees the textures."""
        self.radiance.release()
        self.products.release()


class LightProbeCapture:
    """Captures probes one after the other; `length` is the number of harmonics of an occlusion field."""

    def __init__(self, gpu: GpuContext, length: int) -> None:
        self._gpu, self._length = gpu, length
        self._table = gpu.ctx.buffer(_direction_table().tobytes())
        self._sums = gpu.ctx.buffer(reserve=PROBE_TEXELS * 16)
        self._pairs = gpu.ctx.buffer(reserve=MAX_ORDER**2 * length * 16)
        self._gather = Kernel(gpu, "probe_gather")
        self._gather_changed = Kernel(gpu, "probe_gather", CHANGED=1)
        self._resolve = Kernel(gpu, "probe_resolve")
        self._pair = Kernel(gpu, "light_products", SH_LENGTH=length, PAIRS=1)
        self._tabulate = Kernel(gpu, "light_products", SH_LENGTH=length)

    @property
    def bindings(self) -> dict[str, Binding]:
        """The directions of a probe's texels (shaders/common/light_probe.glsl)."""
        return {"ProbeTable": self._table}

    def gather(
        self, grid: LowResGrid, scene: Bindings, place: Bindings, changes: moderngl.Texture | None = None
    ) -> None:
        """Sums what the camera sees around the object; reads mip levels of `linear_picture`.

        `changes` is the factor by which objects change the light at each texel of the grid, applied to the sum.
        """
        clear_buffer(self._gpu, self._sums)
        kernel = self._gather if changes is None else self._gather_changed
        kernel.run(
            grid.size,
            grid.bindings,
            place,
            scene,
            self.bindings,
            ProbeSums=self._sums,
            changes=changes,
        )

    def forget(self) -> None:
        """Drops what was gathered, so that only the environment is left."""
        clear_buffer(self._gpu, self._sums)

    def resolve(self, probe: LightProbe, scene: Bindings, place: Bindings) -> None:
        """Computes radiance from the gathered sums and the environment, and its products."""
        threads = (PROBE_TEXELS,)
        self._resolve.run(threads, place, scene, self.bindings, ProbeSums=self._sums, probe=probe.radiance)
        self.multiply(probe)

    def multiply(self, probe: LightProbe) -> None:
        """Computes the products of a probe's radiance."""
        pairs = MAX_ORDER**2 * self._length
        self._pair.run((pairs,), self.bindings, Pairs=self._pairs, probe=probe.radiance)
        texels = (PROBE_TEXELS, self._length + 1)
        self._tabulate.run(texels, self.bindings, Pairs=self._pairs, products=probe.products)

    def release(self) -> None:
        """Frees the GL objects."""
        for buffer in (self._table, self._sums, self._pairs):
            buffer.release()
        for kernel in (self._gather, self._gather_changed, self._resolve, self._pair, self._tabulate):
            kernel.release()


def _direction_table() -> Float32[np.ndarray, "texels columns"]:
    """Returns the solid angle (sr) and harmonics of each texel of a probe."""
    directions = octahedral_grid(PROBE_SIZE).reshape(-1, 3)
    solid_angles = texel_solid_angles(PROBE_SIZE).ravel()
    table = np.column_stack([solid_angles, harmonics(directions, MAX_ORDER)])
    return np.ascontiguousarray(table, np.float32)


class OcclusionShade:
    """Computes the natural light that objects leave on the reduced grid, one object after the other.

    At the real surfaces (`real`), or at those of the objects. RGBA32F each: `unoccluded` is the remaining fraction of
    the irradiance; `natural` the weighted irradiance of each object's surroundings; `mirrored` the weighted radiance
    in mirrors there, a: remaining fraction.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], length: int, *, real: bool) -> None:
        self.unoccluded, self.natural, self.mirrored = (texture_2d(gpu, size, 4, "f4") for _ in range(3))
        self._kernel = Kernel(gpu, "occlusion_shade", SH_LENGTH=length, **({"REAL": 1} if real else {}))

    def run(
        self,
        grid: LowResGrid,
        probe: LightProbe,
        field: FieldTextures | None,
        scene: Bindings,
        place: Bindings,
        *,
        first: bool,
    ) -> None:
        """Accumulates one object; the `first` one clears the sums. An object without a field occludes nothing."""
        self._kernel.run(
            grid.size,
            grid.bindings,
            place,
            scene,
            occlusion=None if field is None else field.occlusion,
            products=probe.products,
            probe=probe.radiance,
            unoccluded=self.unoccluded,
            natural=self.natural,
            mirrored=self.mirrored,
            has_field=field is not None,
            first=first,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        for item in (self.unoccluded, self.natural, self.mirrored, self._kernel):
            item.release()


class OcclusionShow:
    """Draws occlusion fields into cells for debug view `volume`."""

    def __init__(self, gpu: GpuContext) -> None:
        self._kernel = Kernel(gpu, "occlusion_show")

    def run(
        self,
        shown: VoxelMipmap,
        field: FieldTextures | None,
        scene: Bindings,
        place: Bindings,
        *,
        first: bool,
    ) -> None:
        """Adds one object to level 0 of `shown`, which has one direction.

        The `first` object clears it. An object without a field shows nothing.
        """
        cells = shown.texture.width
        self._kernel.run(
            (cells, cells, cells),
            place,
            scene,
            shown=shown.texture,
            occlusion=None if field is None else field.occlusion,
            slabs=1 if field is None else field.slabs,
            has_field=field is not None,
            first=first,
        )

    def release(self) -> None:
        """Frees the GL object."""
        self._kernel.release()


class LightChange:
    """Computes the factor by which objects change the light of real surfaces, on the reduced grid.

    `changes` (RGBA16F): E_rho / E_mu of lamps and natural light.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.changes = texture_2d(gpu, size, 4, "f2")
        self._kernel = Kernel(gpu, "light_change", REAL=1)

    def run(self, grid: LowResGrid, shade: OcclusionShade, scene: Bindings) -> None:
        """Computes the factor from what `shade` found for the real surfaces."""
        self._kernel.run(
            grid.size,
            grid.bindings,
            scene,
            unoccluded=shade.unoccluded,
            natural=shade.natural,
            changes=self.changes,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        self.changes.release()
        self._kernel.release()


class ObjectBounceLight:
    """Computes the light that objects reflect onto their surroundings, from their transfer fields.

    `irradiance` and `mirrored` (radiance of objects in mirrors) are RGBA32F on the reduced grid.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.irradiance, self.mirrored = (texture_2d(gpu, size, 4, "f4") for _ in range(2))
        self._incident = gpu.ctx.buffer(reserve=LENGTH * 16)
        self._light = Kernel(gpu, "object_bounce_light", LIGHT=1)
        self._collapse = Kernel(gpu, "object_bounce_light")
        self._real = Kernel(gpu, "bounce_light_shade", REAL=1)
        self._virtual = Kernel(gpu, "bounce_light_shade")

    def light(
        self,
        field: FieldTextures,
        probe: LightProbe,
        bounce_light: moderngl.Texture3D,
        scene: Bindings,
        place: Bindings,
    ) -> None:
        """Writes the light that the object reflects into `bounce_light`.

        `scene` includes the bindings of the `LightProbeCapture`, `place` the object's `reflectance`.
        """
        assert field.transfer is not None
        self._light.run((LENGTH,), place, scene, probe=probe.radiance, Incident=self._incident)
        samples = len(field.field.occlusion) * field.bounce_size**3
        self._collapse.run(
            (samples, LENGTH),
            place,
            scene,
            Transfer=field.transfer,
            Incident=self._incident,
            bounce_light=bounce_light,
        )

    def shade(
        self,
        grid: LowResGrid,
        bounce_light: moderngl.Texture3D,
        scene: Bindings,
        place: Bindings,
        *,
        first: bool,
        real: bool,
    ) -> None:
        """Adds one object's light; the `first` one clears the sums."""
        kernel = self._real if real else self._virtual
        kernel.run(
            grid.size,
            grid.bindings,
            place,
            scene,
            bounce_light=bounce_light,
            bounce_irradiance=self.irradiance,
            bounce_mirrored=self.mirrored,
            first=first,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        for item in (self.irradiance, self.mirrored, self._incident):
            item.release()
        for kernel in (self._light, self._collapse, self._real, self._virtual):
            kernel.release()


class NaturalFields:
    """Writes natural light without and with the objects into the fields that other methods trace by cones."""

    def __init__(self, gpu: GpuContext) -> None:
        self._real = Kernel(gpu, "natural_fields", REAL=1)
        self._virtual = Kernel(gpu, "natural_fields")

    def run(
        self,
        fields: ConeFields,
        grid: LowResGrid,
        shade: OcclusionShade,
        bounce_light: ObjectBounceLight | None,
        scene: Bindings,
        *,
        real: bool,
    ) -> None:
        """Writes the fields of real or of virtual surfaces; without `bounce_light` objects reflect nothing."""
        kernel = self._real if real else self._virtual
        written: Bindings = {"irradiance_rho": fields.virtual, "specular_rho": fields.virtual_specular}
        if real:
            written = {
                "irradiance_mu": fields.mu,
                "irradiance_rho": fields.rho,
                "specular_mu": fields.specular_mu,
                "specular_rho": fields.specular_rho,
            }
        kernel.run(
            grid.size,
            grid.bindings,
            scene,
            unoccluded=shade.unoccluded,
            natural=shade.natural,
            mirrored=shade.mirrored,
            bounce_irradiance=None if bounce_light is None else bounce_light.irradiance,
            bounce_mirrored=None if bounce_light is None else bounce_light.mirrored,
            has_bounce_light=bounce_light is not None,
            **written,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        self._real.release()
        self._virtual.release()
