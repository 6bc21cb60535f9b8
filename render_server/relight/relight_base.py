"""What the methods that follow lights into a volume share: lights, maps, when to rebuild, shading (METHOD 3 to 5)."""

from abc import ABC, abstractmethod
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float64

from render_server.gpu.context import GpuContext
from render_server.lights.mirror_lights import MirrorLight, mirror_lights
from render_server.passes.caustics import GREATEST_ALPHA, CausticsPass
from render_server.passes.change_ratio import ChangeRatioPass
from render_server.passes.composite import RelitLayers
from render_server.passes.direct_light import DirectLightPass
from render_server.passes.light_table import LightTable
from render_server.passes.light_voxels import bind_picture
from render_server.passes.mirror_shares import MirrorSharesPass
from render_server.passes.object_tree import ObjectTree
from render_server.passes.reflective_shadow_map import ReflectiveShadowMapPass
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.screen_cones import ROUGHEST, ScreenConesPass
from render_server.passes.trace_cones import ConeFields
from render_server.passes.virtual_surface import VirtualSurfacePass
from render_server.passes.volume import Pyramid, VolumePlacement
from render_server.relight.defaults import ResolvedSettings
from render_server.relight.frame import RelightInput

SHADOW_REACH = 4.0  # in longest edges of the objects' bounds: how far around them real shadows are resolved
LARGE_TRIANGLE = 0.1  # of that reach: from here on a triangle's own extent matters, not only its corners
BIAS_SIGMAS = 3.0  # of depth noise: no real surface shadows itself
SELF_SHADOW_TEXELS = 1.5  # a virtual receiver is lifted by so many texels of the depth map


class RelightBase(ABC):
    """One frame as a list of passes; a method says how its volume is made and how fields are read from it."""

    def __init__(
        self,
        gpu: GpuContext,
        resolved: ResolvedSettings,
        size: tuple[int, int],
        shadow_samples: int,
        direct: DirectLightPass,
        *,
        caustics: bool = False,
        mirrors_lights: bool = False,
        screen_space: bool = False,
        march: dict[str, int] | None = None,
    ) -> None:
        self._resolved = resolved
        self._objects = ObjectTree(gpu)
        self.table = LightTable(gpu, resolved.rsm_size, shadow_samples)
        self._shadow_maps = ReflectiveShadowMapPass(gpu)
        self._grid = SamplingGrid(gpu, size, resolved.cone_scale)
        self._cones = ConeFields(gpu, self._grid.size)
        self._direct = direct
        self._surface = VirtualSurfacePass(gpu, size)
        self._change = ChangeRatioPass(gpu, self._grid.size)
        self._mirror_shares = MirrorSharesPass(gpu) if mirrors_lights else None
        self._reflection: moderngl.Texture | None = None
        self._caustics = CausticsPass(gpu, self._grid, self._objects) if caustics else None
        self._screen = ScreenConesPass(gpu, self._grid, march) if screen_space else None
        self._placed_key: object = None
        self._real_key: object = None
        self._object_key: object = None
        self._virtual_map_key: object = None
        self._shade_key: object = None
        self._environment_version = -1

    @abstractmethod
    def _placement(self, frame: RelightInput) -> VolumePlacement:
        """Where the volume lies for these objects."""

    @abstractmethod
    def _rebuild_real(
        self, frame: RelightInput, placement: VolumePlacement, uniforms: dict[str, Any]
    ) -> None:
        """Make everything anew that depends on the real scene alone."""

    @abstractmethod
    def _rebuild_virtual(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        """Make everything anew that depends on the objects."""

    @abstractmethod
    def _trace(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        """Fill the cone fields; geometry, lights and materials are bound."""

    @abstractmethod
    def _joint(self) -> Pyramid:
        """The voxels that view `volume` shows."""

    def _reflect(self, frame: RelightInput, uniforms: dict[str, Any]) -> moderngl.Texture | None:  # noqa: ARG002
        """Objects in smooth real surfaces (passes/mirror_objects.py); None leaves these to the cones."""
        return None

    def _bind_march(self, uniforms: dict[str, Any]) -> dict[str, Any]:
        """Bind what cones through voxels read; return the uniforms of passes that march, here none of their own."""
        return uniforms

    def relight(self, frame: RelightInput) -> RelitLayers:
        """Compute everything that composition needs."""
        placement = self._placement(frame)
        scene_key = (frame.real.version, frame.lights_version, frame.everywhere, placement)
        virtual_map_key = (frame.lights_version, frame.virtual.version)
        placed_key = (scene_key, frame.virtual.lasting_points.tobytes())
        if placed_key != self._placed_key:
            self._place_lights(frame)
            self._placed_key = placed_key
        real_key = (scene_key, self.table.real_records)  # objects that move take the real views with them
        object_key = (real_key, frame.virtual.version)
        uniforms = self._uniforms(frame, placement)
        if real_key != self._real_key:
            self._draw_real_maps(frame)
        if virtual_map_key != self._virtual_map_key:
            self._draw_virtual_maps(frame)
        if (real_key, virtual_map_key) != (self._real_key, self._virtual_map_key):
            self._map_mirrors(frame, uniforms)
        if real_key != self._real_key:
            self._rebuild_real(frame, placement, uniforms)
        if object_key != self._object_key:
            self._rebuild_virtual(frame, uniforms)
        if (object_key, frame.view) != self._shade_key:
            self._shade(frame, placement, uniforms)
        self._real_key, self._object_key, self._virtual_map_key = real_key, object_key, virtual_map_key
        self._shade_key = (object_key, frame.view)
        return RelitLayers(
            frame.matte,
            self._surface.radiance,
            self._direct,
            self._cones,
            self._grid,
            self._change,
            self._joint(),
            placement,
            self.table,
            self._reflection,
        )

    def _place_lights(self, frame: RelightInput) -> None:
        if self._environment_version != frame.lights_version:
            self.table.set_environment(frame.lights.environment)
            self._environment_version = frame.lights_version
        receivers = frame.real.points if frame.everywhere else shadow_receivers(frame)
        lasting, lights = frame.virtual.lasting_points, list(frame.lights.lights)
        mirrors: list[MirrorLight] = []
        if self._mirror_shares is not None and frame.surfaces is not None:
            mirrors = mirror_lights(lights, frame.surfaces, np.mean(lasting, axis=0))
        if mirrors or self.table.mirrors:
            self._virtual_map_key = None  # there may be other views than before
        self.table.place(lights, frame.real.points, receivers, lasting, mirrors)

    def _draw_real_maps(self, frame: RelightInput) -> None:
        with frame.timers.measure("RSM real"):
            self.table.bind_records()
            self._shadow_maps.run(self.table.real_atlas, [frame.real.buffers], self.table.real_views, 0)

    def _draw_virtual_maps(self, frame: RelightInput) -> None:
        with frame.timers.measure("RSM virtual"):
            self.table.bind_records()
            first = self.table.first_virtual_view
            self._shadow_maps.run(
                self.table.virtual_atlas, [frame.virtual.buffers], self.table.virtual_views, first
            )

    def _map_mirrors(self, frame: RelightInput, uniforms: dict[str, Any]) -> None:
        """Where smooth planes show the lights."""
        if self._mirror_shares is None or not self.table.mirrors:
            return
        frame.bind_geometry()
        self.table.bind()
        noise_m = BIAS_SIGMAS * frame.noise_sigma * frame.typical_depth**2
        with frame.timers.measure("mirrored lights"):
            self._mirror_shares.run(self.table, noise_m, uniforms)

    def _uniforms(self, frame: RelightInput, placement: VolumePlacement) -> dict[str, Any]:
        centre = np.mean(np.stack(frame.virtual.bounds), axis=0)
        pixel = frame.view.camera.matrix[0, 0]
        bounds = placement.voxel_bounds(np.stack(frame.virtual.bounds)).astype(float)
        return {
            **frame.view.uniforms(),
            **placement.uniforms(),
            **self.table.uniforms(),
            **frame.surface_uniforms,
            "noise_sigma": frame.noise_sigma,
            "normal_offset": SELF_SHADOW_TEXELS * self.table.virtual_texel_m(centre),
            "sample_distance": 1.5 * self._resolved.cone_scale / pixel,
            "object_low": tuple(bounds[:3]),
            "object_high": tuple(1.0 - bounds[3:]),
            "everywhere": frame.everywhere,
            "has_caustics": self._has_caustics(frame),
            "hidden_too": self._reflects_screen(frame),
            "lens_bends": frame.view.camera.has_distortion,
        }

    def _reflects_screen(self, frame: RelightInput) -> bool:
        return self._screen is not None and frame.virtual.materials.smoothest < ROUGHEST

    def _has_caustics(self, frame: RelightInput) -> bool:
        return self._caustics is not None and frame.virtual.materials.smoothest**2 < GREATEST_ALPHA

    def _throw_light(self, frame: RelightInput, placement: VolumePlacement, uniforms: dict[str, Any]) -> None:
        """Beams from the objects' smooth surfaces."""
        assert self._caustics is not None
        own = {
            "bias_real": BIAS_SIGMAS * frame.noise_sigma * frame.typical_depth**2,
            "reach": placement.size * placement.voxel_edge,
        }
        with frame.timers.measure("caustics"):
            self._caustics.run(self.table, {**uniforms, **own})

    def _shade(self, frame: RelightInput, placement: VolumePlacement, uniforms: dict[str, Any]) -> None:
        """Cones at reduced resolution, direct light and virtual surfaces at full."""
        virtual = frame.virtual
        self._objects.follow(virtual.version, virtual.corners, virtual.bounds, virtual.buffers)
        frame.bind_geometry()
        with frame.timers.measure("sampling grid"):
            self._grid.run(frame.matte, uniforms)
        self.table.bind()
        frame.virtual.materials.bind()
        self._trace(frame, uniforms)
        if uniforms["has_caustics"]:
            self._throw_light(frame, placement, uniforms)
        with frame.timers.measure("direct light"):
            self._joint().texture.use(location=3)
            self._grid.pixels.use(location=0)
            self._light_directly({**uniforms, "scale": self._grid.scale})
        self._reflection = self._reflect(frame, uniforms)
        with frame.timers.measure("change of light"):
            self._change.run(self._grid, self._direct, self._cones, self._reflection)
        screen = self._look_across(frame, uniforms) if uniforms["hidden_too"] else None
        if self._caustics is not None:
            self._caustics.bind()  # reflections may have put something else in its place
        with frame.timers.measure("virtual surface"):
            self._surface.run(
                frame.matte, frame.virtual_raster, self._cones, self._grid, uniforms, screen=screen
            )

    def _look_across(self, frame: RelightInput, uniforms: dict[str, Any]) -> moderngl.Texture:
        """What smooth objects reflect of the picture; needs how light changes there."""
        assert self._screen is not None
        with frame.timers.measure("screen cones"):
            frame.picture.build_levels()
            bind_picture(frame.picture.linear, frame.real_surface.position)
            own = self._bind_march(uniforms)
            self._screen.run(frame.matte, self._direct, self._cones, self._objects, own)
        self.table.bind()
        return self._screen.reflected

    def _light_directly(self, uniforms: dict[str, Any]) -> None:
        """Fill the direct fields; leaves the lights that shade objects bound."""
        self._direct.run(uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        for item in vars(self).values():
            if hasattr(item, "release"):
                item.release()


def shadow_receivers(frame: RelightInput) -> Float64[np.ndarray, "n 3"]:
    """Real points around the objects; all of them where nothing is near.

    Vertices within reach, and what triangles too large to have any there bring into the cube of that reach.
    """
    low, high = frame.virtual.lasting_bounds
    centre, reach = (low + high) / 2, SHADOW_REACH * float(np.max(high - low))
    points = frame.real.points
    near = points[np.linalg.norm(points - centre, axis=1) <= reach]
    corners = frame.real.corners[..., :3].astype(np.float64)
    first, last = corners.min(axis=1), corners.max(axis=1)
    meets = np.all((first <= centre + reach) & (last >= centre - reach), axis=1)
    large = meets & (np.max(last - first, axis=1) > LARGE_TRIANGLE * reach)
    clipped = np.clip(corners[large].reshape(-1, 3), centre - reach, centre + reach)
    return np.concatenate([near, clipped]) if len(near) or len(clipped) else points
