"""Stages that shade the objects by a map of all light around them ([D] 4.2, docs/method.md 6.6), with any method."""

from operator import eq

import moderngl
import numpy as np
from jaxtyping import Float32

from deltalight.protocol.scene_output import Shading
from deltalight.render_server.frame import FrameResources, ObjectSurface
from deltalight.render_server.geometry_state import GeometryState, ObjectExtent, PlacedObject
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.light_map import light_map
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.methods.light_maps import object_extent
from deltalight.render_server.passes.image_based import AmbientOcclusion, ImageBasedRadiance, SurroundingLight
from deltalight.render_server.scene.triangle_mesh import bounds_of


class ImageBasedShading:
    """Finds the light around the objects, what they hide of it, and shades them."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int], settings: Shading) -> None:
        self._radius_m = settings.occlusion_radius_m
        self._light = SurroundingLight(gpu)
        self._occlusion = AmbientOcclusion(gpu, size)
        self._radiance = ImageBasedRadiance(gpu, size, settings.samples)

    def set_light(self, radiance: Float32[np.ndarray, "n n 3"]) -> SurroundingLight:
        """Averages the map over cones, and finds its irradiance."""
        self._light.set_map(radiance)
        return self._light

    def reach_m(self, objects: GeometryState) -> float:
        """Within which distance objects keep light off themselves in full, m."""
        if self._radius_m is not None:
            return self._radius_m
        return max(_longest_edge(item) for item in objects.objects)

    def occlude(self, scene: Bindings, surface: ObjectSurface, radius_m: float) -> AmbientOcclusion:
        """Finds what the objects hide of the light from everywhere, as the picture shows them."""
        self._occlusion.run(surface.rectangle, scene, radius_m)
        return self._occlusion

    def shade(
        self, scene: Bindings, surface: ObjectSurface, light: SurroundingLight, occlusion: AmbientOcclusion
    ) -> moderngl.Texture:
        """Shades the objects by the map alone."""
        self._radiance.run(light, occlusion.bindings, surface.rectangle, scene)
        return self._radiance.texture

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self._light, self._occlusion, self._radiance)


def image_based_radiance(
    g: Graph, s: FrameResources, settings: Shading, size: tuple[int, int]
) -> Resource[moderngl.Texture]:
    """Declares the stages; returns the objects' radiance, to take the place of a method's own."""
    g.section("image-based shading")
    own = ImageBasedShading(g.gpu, size, settings)
    radiance = g.value("map of light", map_light, s.lights, object_extent(g, s), same=np.array_equal)
    light = g.stage("filtered light", own.set_light, radiance)
    reach_m = g.value("occlusion radius", own.reach_m, s.objects, same=eq)
    occlusion = g.stage("ambient occlusion", own.occlude, s.geometry, s.object_surface, reach_m)
    return g.stage("image-based radiance", own.shade, s.geometry, s.object_surface, light, occlusion)


def map_light(lights: LightSet, extent: ObjectExtent) -> Float32[np.ndarray, "n n 3"]:
    """Puts the lights as the objects' middle sees them back into the environment."""
    low, high = extent.bounds
    return light_map(lights, (low + high) / 2)


def _longest_edge(item: PlacedObject) -> float:
    """Longest edge of an object's box (its asset's axes), m."""
    scale = np.cbrt(np.linalg.det(item.world_from_asset[:3, :3]))
    return float(scale * np.ptp(bounds_of(item.meshes), axis=0).max())
