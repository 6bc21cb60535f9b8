"""Split injection: light of reflective shadow maps goes into the voxels of V_delta and V_rho ([P1] 3.2)."""

import moderngl

from deltalight.render_server.gpu.clearing import clear_buffers, clear_volume
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings, Kernel
from deltalight.render_server.gpu.list_groups import list_threads, map_threads
from deltalight.render_server.gpu.textures import release_all, texture_2d
from deltalight.render_server.passes.cones import LowResGrid
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.volumes import PlacedVolume
from deltalight.render_server.passes.voxels import LevelFilter, VoxelMipmap, VoxelStore

LIGHT_SUMS = 14  # per slot: shaders/common/split_sums.glsl


class RealAlbedo:
    """Albedo of the real scene as seen from the lights ([P2] eq. 1): an RGBA16F atlas like the real depth maps.

    Only texels that may lie inside the volume are filled.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self.atlas = texture_2d(gpu, (1, 1), 4, "f2")
        self._kernel = Kernel(gpu, "real_albedo")

    def run(self, lights: LightBuffers, scene: Bindings, volume: int = 0) -> None:
        """Fills the atlas, of texels in one of the scene's volumes."""
        if self.atlas.size != lights.real_atlas.size:
            self.atlas.release()
            self.atlas = texture_2d(self._gpu, lights.real_atlas.size, 4, "f2")
        threads = (list_threads(self._gpu, lights.tile_size**2),)
        for view in range(len(lights.real_views)):
            own: Bindings = {"view_index": view, "filled_volume": volume}
            self._kernel.run(threads, own, scene, albedo_out=self.atlas)

    def release(self) -> None:
        """Frees the GL objects."""
        self.atlas.release()
        self._kernel.release()


class SplitInjection:
    """Sums into `delta_sums` of both stores, in fixed point, so that the order of threads does not matter."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._real = Kernel(gpu, "split_inject")
        self._virtual = Kernel(gpu, "split_inject", VIRTUAL=1)
        self._divide, self._threads = Kernel(gpu, "split_radiance"), list_threads(gpu)

    def begin(self, *stores: VoxelStore) -> None:
        """Clears the sums."""
        clear_buffers(
            self._gpu, *((store.delta_sums, store.slot_capacity * LIGHT_SUMS * 4) for store in stores)
        )

    def add(
        self,
        real: VoxelStore,
        virtual: VoxelStore,
        lights: LightBuffers,
        real_albedo: moderngl.Texture,
        scene: Bindings,
        *,
        volume: int = 0,
    ) -> None:
        """Injects all lights into one of the volumes; `scene` brings the objects' materials."""
        chosen: Bindings = {"filled_volume": volume}
        real_sums: Bindings = {**real.bindings, **chosen, "Sums": real.delta_sums, "real_albedo": real_albedo}
        virtual_sums: Bindings = {**virtual.bindings, **chosen, "Sums": virtual.delta_sums}
        both: Bindings = {"VirtualTouched": virtual.touched, "VirtualSums": virtual.delta_sums}
        threads = (map_threads(self._gpu, lights.tile_size),)
        for real_views, object_views in lights.views_of_lights:
            for view in real_views:
                self._real.run(threads, real_sums, scene, view_index=view)
            for view in object_views:
                self._virtual.run(threads, virtual_sums, scene, view_index=view)
            self._divide.run((self._threads,), real_sums, both)

    def release(self) -> None:
        """Frees the programs."""
        for kernel in (self._real, self._virtual, self._divide):
            kernel.release()


class ResolveInjection:
    """Writes the radiance to level 0 of V_delta and V_rho, with the marker of V_eta.

    Processes the real set, then what only the virtual set touched.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._kernel = Kernel(gpu, "resolve_light")

    def run(
        self,
        delta: VoxelMipmap,
        rho: VoxelMipmap,
        real: VoxelStore,
        virtual: VoxelStore,
        volume: PlacedVolume,
    ) -> None:
        """Writes the texels of all touched voxels."""
        self._kernel.run(
            (self._threads,),
            real.bindings,
            volume.bindings,
            delta=delta.texture,
            rho=rho.texture,
            Light=real.delta_sums,
            VirtualGrid=virtual.grid,
            VirtualTouched=virtual.touched,
            VirtualLight=virtual.delta_sums,
        )

    def release(self) -> None:
        """Frees the program."""
        self._kernel.release()


class FilterIsotropic:
    """Filters the levels of V_delta and V_rho above level 0, of both together."""

    def __init__(self, gpu: GpuContext) -> None:
        self._levels = LevelFilter(gpu, "filter_isotropic", DIRECTIONS=1)

    def run(self, delta: VoxelMipmap, rho: VoxelMipmap, volume: PlacedVolume) -> None:
        """Rebuilds all levels from level 0."""
        self._levels.run(volume, 1, delta=delta.texture, rho=rho.texture)

    def release(self) -> None:
        """Frees the program."""
        self._levels.release()


class DeltaError:
    """[P1] eq. 9, E = C_rho - (C_mu + C_delta): the error of tracing volumes that were filtered apart.

    V_mu, with the real scene's own opacity, is made of the same sums.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], volume_size: int) -> None:
        self._gpu, self._threads = gpu, list_threads(gpu)
        self._mu = VoxelMipmap(gpu, volume_size, 1)
        self._error = texture_2d(gpu, size, 4, "f2")
        self._resolve, self._trace = (
            Kernel(gpu, "resolve_real_light"),
            Kernel(gpu, "delta_error", DIRECTIONS=1, REAL=1),
        )
        self._filter = FilterIsotropic(gpu)

    def run(
        self,
        delta: VoxelMipmap,
        rho: VoxelMipmap,
        real: VoxelStore,
        volume: PlacedVolume,
        *,
        grid: LowResGrid,
        scene: Bindings,
    ) -> moderngl.Texture:
        """Traces the nine diffuse cones through all three; returns E at real surfaces.

        RGBA16F: irradiance, camera units; a: 1 where known. The size is the reduced grid's.
        """
        if self._mu.texture.size != rho.texture.size:
            self._mu.resize(real.volume_size, real.volume_count)
        clear_volume(self._gpu, self._mu.texture)
        own: Bindings = {**real.bindings, **volume.bindings}
        self._resolve.run((self._threads,), own, mu=self._mu.texture, Light=real.delta_sums)
        self._filter.run(self._mu, self._mu, volume)
        self._trace.run(
            grid.size,
            grid.bindings,
            scene,
            volume_mu=self._mu.texture,
            volume_rho=rho.texture,
            volume_delta=delta.texture,
            error_out=self._error,
        )
        return self._error

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._mu, self._error, self._resolve, self._trace, self._filter)
