"""Composition of the relit picture, as camera codes and linear radiance, and debug views."""

from collections.abc import Callable
from dataclasses import dataclass

import moderngl
import numpy as np
from jaxtyping import UInt8

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel
from deltalight.render_server.gpu.list_groups import LIST_HEADER_BYTES, list_threads
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.camera_image import CameraImage, rgba
from deltalight.render_server.passes.cones import ConeFields, LowResGrid
from deltalight.render_server.passes.coverage import SURFACE_REACH
from deltalight.render_server.passes.distant import LATTICE_STEP
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.reflections import RAY_ROUGHNESS
from deltalight.render_server.passes.shading import DirectLight
from deltalight.render_server.passes.volumes import PlacedVolume
from deltalight.render_server.passes.voxels import VoxelMipmap, VoxelsOnDemand

LAST_TURN = 2**31 - 1
FILL_RADIUS = 3  # texels of the reduced grid by which the change extends into a hole


class ChangeRatio:
    """The change of light on the reduced grid: extends into holes of the depth map, limits composition to changes.

    `ratio`: rgb E_rho / E_mu, a: 0 unknown, 1 unchanged, 2 changed. `texels`: work list of texels near a change.
    `distant`: the relative change beyond the volumes (RGBA16F), if that was found.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._gpu = gpu
        self._size = size
        self.ratio = texture_2d(gpu, size, 4, "f2")
        self.distant: moderngl.Texture | None = None
        self.texels = gpu.ctx.buffer(bytes(4 * (1 + size[0] * size[1])))
        own, lists = (
            {"RATIO": 1, "REAL": 1, "LATTICE_STEP": LATTICE_STEP},
            {"LISTS": 1, "FILL_RADIUS": FILL_RADIUS},
        )
        # On a GPU it also lists the texels; in software, workgroups that wait for each other take longer.
        self._ratio = Kernel(gpu, "change_ratio", **own, **({} if gpu.is_software else lists))
        self._near = Kernel(gpu, "change_ratio", **lists) if gpu.is_software else None
        self._marks = None if gpu.is_software else gpu.ctx.buffer(bytes(4 * size[0] * size[1]))
        self._turn = 0

    def run(
        self,
        grid: LowResGrid,
        direct: DirectLight,
        cones: ConeFields,
        reflection: moderngl.Texture | None,
        distant: Bindings | None = None,
    ) -> None:
        """Computes the ratio from one frame's fields; `reflection` as in RelitLayers, `distant` of DistantChange."""
        if distant is not None and self.distant is None:
            self.distant = texture_2d(self._gpu, self._size, 4, "f2")
        self._gpu.clear_start(self.texels, LIST_HEADER_BYTES)
        self._ratio.run(
            grid.size,
            distant or {},
            self._listing(),
            grid.bindings,
            direct_mu=direct.light.mu,
            direct_rho=direct.light.rho,
            cone_mu=cones.mu,
            cone_rho=cones.rho,
            cone_specular_mu=cones.specular_mu,
            cone_specular_rho=cones.specular_rho,
            reflection=reflection,
            has_reflection=reflection is not None,
            DISTANT_CHANGE=distant is not None,
            distant_change_out=self.distant,
            change_ratio_out=self.ratio,
        )
        if self._near is not None:
            self._near.run(grid.size, sample_pixels=grid.pixels, change_ratio=self.ratio, Texels=self.texels)

    def _listing(self) -> dict[str, Binding]:
        """What lists the texels in the same dispatch, if that does; a new turn needs no marks cleared."""
        if self._marks is None:
            return {"Texels": None}
        self._turn = self._turn % LAST_TURN + 1
        return {"Texels": self.texels, "Marks": self._marks, "turn": self._turn}

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.ratio, self.distant, self.texels, self._marks, self._ratio, self._near)


@dataclass(frozen=True)
class RelitLayers:
    """The values of a method's `Layers` (methods/surface_shading.py) in one frame, and the objects' coverage.

    `voxels`, `volume`, `lights` and `error` are for debug views.
    """

    object_coverage: Binding
    virtual_radiance: moderngl.Texture
    direct: DirectLight
    cones: ConeFields
    grid: LowResGrid
    change: ChangeRatio
    voxels: VoxelMipmap | VoxelsOnDemand | None
    volume: PlacedVolume
    lights: LightBuffers
    reflection: moderngl.Texture | None = None
    """Objects in smooth real surfaces (`MirrorRays`); None: these surfaces use the cones' reflection."""
    error: Callable[[], moderngl.Texture] | None = None
    """Traces the error of the delta (`DeltaError.run`); None: the method makes none."""


class Composite:
    """Writes `code` (RGBA8UI, with the camera's response) and `linear` (RGBA16F, camera units).

    Keeps the ratio by which each pixel's radiance changed, so that the next picture in the same light costs little.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._threads = list_threads(gpu, size[0] * size[1])
        self.code = texture_2d(gpu, size, 4, "u1")
        self.linear = texture_2d(gpu, size, 4, "f2")
        self._ratio = texture_2d(gpu, size, 4, "f4")
        self._again = Kernel(gpu, "recompose")
        self._kernel = Kernel(
            gpu,
            "composite",
            FILL_RADIUS=FILL_RADIUS,
            SURFACE_REACH=SURFACE_REACH,
            RAY_ROUGHNESS=RAY_ROUGHNESS,
        )

    def run(self, image: CameraImage, layers: RelitLayers, scene: Bindings) -> None:
        """Composes the picture.

        Besides camera, geometry (with `edge_correction` and `interior_edges`) and declared surfaces, `scene` brings
        the options `additive`, `relights_real`, `filmic`, `store_linear` (fills `linear`) and `whole` (composes every
        pixel, not only those near a change).
        """
        self.code.write(image.codes, alignment=1)
        cones, direct = layers.cones, layers.direct
        self._kernel.run(
            (self._threads,),
            scene,
            picture=image.code,
            linear_picture=image.linear,
            inverse_response=image.inverse_response,
            exposure_scale=image.exposure_scale,
            object_coverage=layers.object_coverage,
            virtual_radiance=layers.virtual_radiance,
            sample_pixels=layers.grid.pixels,
            scale=layers.grid.scale,
            direct_mu=direct.light.mu,
            direct_rho=direct.light.rho,
            lobe_mu=direct.lobes.mu,
            lobe_rho=direct.lobes.rho,
            cone_mu=cones.mu,
            cone_rho=cones.rho,
            cone_specular_mu=cones.specular_mu,
            cone_specular_rho=cones.specular_rho,
            change_ratio=layers.change.ratio,
            Texels=layers.change.texels,
            has_object_lamps=layers.lights.has_object_lamps,
            reflection=layers.reflection,
            has_reflection=layers.reflection is not None,
            distant_change=layers.change.distant,
            DISTANT_CHANGE=layers.change.distant is not None,
            code_out=self.code,
            linear_out=self.linear,
            ratio_out=self._ratio,
        )

    def run_again(self, image: CameraImage, layers: RelitLayers, scene: Bindings) -> None:
        """Composes a new picture in the light of the last run, of which nothing but the picture changed.

        Without options of `run`, and without smooth surfaces: what these show depends on more than the ratio.
        """
        self.code.write(image.codes, alignment=1)
        self._again.run(
            (self._threads,),
            scene,
            picture=image.code,
            code_radiance=image.code_radiance,
            inverse_response=image.inverse_response,
            exposure_scale=image.exposure_scale,
            relit_ratio=self._ratio,
            virtual_radiance=layers.virtual_radiance,
            object_coverage=layers.object_coverage,
            sample_pixels=layers.grid.pixels,
            scale=layers.grid.scale,
            Texels=layers.change.texels,
            code_out=self.code,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.code, self.linear, self._ratio, self._kernel, self._again)


class Enlarge:
    """Enlarges a relit picture to the camera's size, with the camera's own detail; `code` is RGBA8UI."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.size = size
        self._picture, self.code = (texture_2d(gpu, size, 4, "u1") for _ in range(2))
        self._kernel = Kernel(gpu, "enlarge")

    def run(
        self,
        color: UInt8[np.ndarray, "h w 3"],
        image: CameraImage,
        small: Composite,
        coverage: moderngl.Texture,
    ) -> None:
        """Enlarges the composite `small` of `image`; `color` is the camera's picture at this size."""
        self._picture.write(rgba(color), alignment=1)
        self._kernel.run(
            self.size,
            picture=self._picture,
            small_picture=image.code,
            small_composite=small.code,
            object_coverage=coverage,
            code_out=self.code,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._picture, self.code, self._kernel)


class Crossfade:
    """One picture going over into another of the same frame and size; `code` is RGBA8UI."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.size = size
        self.code = texture_2d(gpu, size, 4, "u1")
        self._kernel = Kernel(gpu, "crossfade")

    def run(self, before: moderngl.Texture, after: moderngl.Texture, weight: float) -> None:
        """Mixes two pictures' codes; `weight` (0..1) is that of `after`."""
        self._kernel.run(self.size, before=before, after=after, weight=weight, code_out=self.code)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.code, self._kernel)


Picture = Composite | Enlarge | Crossfade
"""What has a relit picture as `code`."""


class DebugViews:
    """Overwrites a composite's `code` (RGBA8UI) with a debug view: effects, delta, its error, voxels, shadow maps."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._kernels: dict[tuple[object, ...], Kernel] = {}

    def change(
        self,
        code: moderngl.Texture,
        image: CameraImage,
        relit: moderngl.Texture,
        object_coverage: Binding,
        *,
        effects: bool,
    ) -> None:
        """Shows the signed change of light, or the effects on grey."""
        kernel = self._kernel("delta_view", **({"EFFECTS": 1} if effects else {}))
        kernel.run(
            image.size,
            linear_picture=image.linear,
            relit=relit,
            object_coverage=object_coverage,
            code_out=code,
        )

    def volume(
        self,
        code: moderngl.Texture,
        image: CameraImage,
        voxels: VoxelMipmap | VoxelsOnDemand,
        volume: PlacedVolume,
        scene: Bindings,
    ) -> None:
        """Shows voxels as cubes; `scene` brings the camera."""
        kernel = self._kernel("volume_view", DIRECTIONS=voxels.directions)
        kernel.run(
            image.size,
            volume.bindings,
            scene,
            picture=image.code,
            picture_rays=image.rays,
            voxels=voxels.texture,
            code_out=code,
        )

    def error(self, code: moderngl.Texture, error: moderngl.Texture | None, scale: int) -> None:
        """Shows the error of the delta, of a grid at 1/scale of the picture; black if there is none."""
        self._kernel("error_view").run(
            code.size, delta_error=error, has_error=error is not None, scale=scale, code_out=code
        )

    def shadow_maps(self, code: moderngl.Texture, lights: LightBuffers) -> None:
        """Shows the maps of the real scene on the left, those of the objects on the right."""
        self._kernel("rsm_view").run(code.size, lights.bindings, code_out=code)

    def _kernel(self, name: str, **defines: int) -> Kernel:
        key = name, *defines.items()
        if key not in self._kernels:
            self._kernels[key] = Kernel(self._gpu, name, **defines)
        return self._kernels[key]

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(*self._kernels.values())
