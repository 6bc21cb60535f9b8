"""A method for measurements alone, as cheap as a picture with objects gets: rasterised and composited.

Lamps light the objects without shadows, the mean of all other light lights them evenly. Nothing real changes, and the
real scene is neither voxelised nor lit. It is written as a plugin's method is (docs/plugins.md), but known in the
measuring process only: no scene document may name it.
"""

from functools import partial
from importlib.metadata import EntryPoint
from typing import TYPE_CHECKING, Literal

import numpy as np

from deltalight.protocol.methods import GROUP, PLUGINS, InstalledMethod
from deltalight.protocol.plugins import Plugin
from deltalight.protocol.scene_method import MethodSettings
from deltalight.render_server.methods.method import RelightingMethod, ResolvedSettings

if TYPE_CHECKING:
    from deltalight.render_server.frame import FrameResources
    from deltalight.render_server.gpu.kernel import Bindings
    from deltalight.render_server.graph import Graph, Resource
    from deltalight.render_server.lights.lights import LightSet
    from deltalight.render_server.methods.method import Setup
    from deltalight.render_server.methods.surface_shading import Layers, SurfaceShading
    from deltalight.render_server.passes.cones import ConeFields, LowResGrid
    from deltalight.render_server.passes.lights import LightBuffers

LEAST = ResolvedSettings(volume_size=32, cone_scale=4, rsm_size=16, triangle_budget=1000)
"""Nothing reads the volume, the shadow maps or the real triangles."""


class RasterMethod(MethodSettings):
    """Objects rasterised over the picture, under lamps without shadows."""

    name: Literal["raster"] = "raster"


def declare(g: "Graph", s: "FrameResources", setup: "Setup[RasterMethod]") -> "Layers":
    """Declares lamps without views, even light instead of cones, and no change of light."""
    from deltalight.render_server.methods import surface_shading
    from deltalight.render_server.methods.light_maps import LitScene
    from deltalight.render_server.passes.lights import LightBuffers
    from deltalight.render_server.passes.shading import DirectLight
    from deltalight.render_server.passes.volumes import PlacedVolume, VolumePlacement

    size = setup.picture_size
    buffers, direct = LightBuffers(g.gpu, LEAST.rsm_size, 1), DirectLight(g.gpu, size, objects_shadow=False)
    for light in (direct.light, direct.lobes):
        light.clear()  # none without objects, and none with them
    options = surface_shading.ShadingOptions()
    shading = surface_shading.SurfaceShading(g.gpu, size, setup.resolved, buffers, direct, options)

    def gather(_scene: "Resource[Bindings]", _grid: "Resource[LowResGrid]") -> "Resource[ConeFields]":
        return g.stage("even light", partial(_even_light, shading), s.lights)

    g.own(buffers)
    lamps = g.stage("lamps", partial(_place_lamps, buffers), s.lights)
    volume = PlacedVolume(g.gpu, VolumePlacement((0.0, 0.0, 0.0), 1.0, LEAST.volume_size))
    placed = g.value("volume", lambda _: volume, s.surfaces)
    g.own(volume)
    lit = LitScene(buffers, lamps, lamps, lamps)
    own = surface_shading.MethodStages(placed, gather, light_directly=lambda *_: direct)
    return surface_shading.shading_stages(g, s, shading, lit, own)


def _place_lamps(buffers: "LightBuffers", lights: "LightSet") -> "LightBuffers":
    """Gives the lamps to the shaders; without points to shine on they get no shadow maps."""
    nowhere = np.zeros((0, 3))
    buffers.set_environment(lights.environment)
    buffers.place(list(lights.lights), nowhere, nowhere, nowhere)
    return buffers


def _even_light(shading: "SurfaceShading", lights: "LightSet") -> "ConeFields":
    """Writes the mean of the environment in place of what cones gather."""
    width, height = shading.grid.size
    even = np.ones((height, width, 4), np.float16)
    even[..., :3] = lights.environment.mean(axis=(0, 1))
    fields = shading.cones
    for radiance in (fields.specular_mu, fields.specular_rho, fields.virtual_specular):
        radiance.write(even)
    even[..., :3] *= np.pi
    for irradiance in (fields.mu, fields.rho, fields.virtual):
        irradiance.write(even)
    return fields


def _resolve(_settings: RasterMethod, _defaults: ResolvedSettings) -> ResolvedSettings:
    return LEAST


def register_raster() -> None:
    """Makes the renderer of this process know the method."""
    plugin = Plugin(EntryPoint(RasterMethod.method_name(), "deltalight.benchmarks.raster:METHOD", GROUP))
    PLUGINS.values.setdefault(plugin.name, InstalledMethod(plugin, RasterMethod, METHOD))


METHOD = RelightingMethod(RasterMethod, declare, _resolve)
