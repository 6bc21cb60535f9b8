"""Stages that shade rigid objects by their precomputed transfer ([D] 4.3, docs/method.md 6.5), with any method."""

from operator import eq

import moderngl
import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol.scene_output import Shading
from deltalight.render_server.frame import FrameResources, ObjectSurface
from deltalight.render_server.geometry_state import GeometryState, PlacedObject
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.lights.light_map import coefficients_around, distant_coefficients
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.lights.octahedral import turned_harmonics
from deltalight.render_server.methods.image_based import map_light
from deltalight.render_server.methods.light_maps import object_extent
from deltalight.render_server.passes.image_based import ImageBasedRadiance, SurroundingLight
from deltalight.render_server.passes.precomputed_transfer import TransferMesh, TransferredLight
from deltalight.render_server.precomputation.light_transfers import ObjectTransfers, transfer_settings
from deltalight.render_server.scene.precomputed_transfer import ObjectTransfer
from deltalight.render_server.scene.triangle_mesh import bounds_of
from deltalight.render_server.view import CameraView

Found = tuple[ObjectTransfer | None, ...]


class TransferShading:
    """Finds the objects' transfer, puts light on it, and shades them by it and by what they mirror."""

    def __init__(
        self, gpu: GpuContext, size: tuple[int, int], settings: Shading, transfers: ObjectTransfers
    ) -> None:
        self._gpu, self._transfers = gpu, transfers
        self._settings = transfer_settings(settings)
        self._meshes: dict[ObjectTransfer, TransferMesh] = {}
        self._transferred: TransferredLight | None = None
        self._light = SurroundingLight(gpu)
        self._radiance = ImageBasedRadiance(gpu, size, settings.samples, precomputed=True)

    def find(self, objects: GeometryState) -> Found:
        """Returns the objects' transfer, None for that still being computed.

        Raises:
            DeltalightError: a transfer cannot be computed.
        """
        return tuple(self._transfers.find(item, self._settings) for item in objects.objects)

    def set_light(self, radiance: Float32[np.ndarray, "n n 3"]) -> SurroundingLight:
        """Averages the map that is mirrored over cones, and finds its irradiance."""
        self._light.set_map(radiance)
        return self._light

    def project(self, lights: LightSet) -> Float64[np.ndarray, "k 3"]:
        """Projects the light that is the same everywhere onto harmonics."""
        return distant_coefficients(lights, self._settings.order)

    def _upload(self, found: Found) -> None:
        """Uploads new transfer; objects of one asset share it."""
        for gone in set(self._meshes) - set(found):
            self._meshes.pop(gone).release()
        for one in found:
            if one is not None and one not in self._meshes:
                self._meshes[one] = TransferMesh(self._gpu, one)

    def transfer(
        self,
        objects: GeometryState,
        found: Found,
        lights: LightSet,
        distant: Float64[np.ndarray, "k 3"],
        view: CameraView,
    ) -> TransferredLight:
        """Finds the light at the objects' vertices, and draws it as the camera sees them."""
        self._upload(found)
        plain = view.without_antialiasing
        if self._transferred is None:
            self._transferred = TransferredLight(self._gpu, plain.raster[1])
        self._transferred.begin(plain)
        for item, one in zip(objects.objects, found, strict=True):
            if one is not None:
                around = coefficients_around(lights, distant, _middle(item))
                self._transferred.draw(
                    self._meshes[one], item.world_from_asset, _in_asset(around, item), plain
                )
        return self._transferred

    def shade(
        self, scene: Bindings, surface: ObjectSurface, light: SurroundingLight, transferred: TransferredLight
    ) -> moderngl.Texture:
        """Shades the objects by the map and their transfer alone."""
        self._radiance.run(light, transferred.bindings, surface.rectangle, scene)
        return self._radiance.texture

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(*self._meshes.values(), self._transferred, self._light, self._radiance)
        self._meshes = {}


def precomputed_radiance(
    g: Graph, s: FrameResources, settings: Shading, size: tuple[int, int], transfers: ObjectTransfers
) -> Resource[moderngl.Texture]:
    """Declares the stages; returns the objects' radiance, to take the place of a method's own."""
    g.section("precomputed transfer")
    own = TransferShading(g.gpu, size, settings, transfers)
    radiance = g.value("map of light", map_light, s.lights, object_extent(g, s), same=np.array_equal)
    light = g.stage("filtered light", own.set_light, radiance)
    found = g.polled("found transfer", "objects", lambda: own.find(s.objects.value), eq)
    distant = g.value("light coefficients", own.project, s.lights, same=np.array_equal)
    transferred = g.stage("transferred light", own.transfer, s.objects, found, s.lights, distant, s.view)
    return g.stage("precomputed radiance", own.shade, s.geometry, s.object_surface, light, transferred)


def _middle(item: PlacedObject) -> Float64[np.ndarray, "3"]:
    """Middle of the object's box, world, m."""
    matrix = item.world_from_asset
    return np.asarray(matrix[:3, :3] @ bounds_of(item.meshes).mean(axis=0) + matrix[:3, 3])


def _in_asset(coefficients: Float64[np.ndarray, "k 3"], item: PlacedObject) -> Float64[np.ndarray, "k 3"]:
    """Turns light from the world into the asset's frame."""
    linear = item.world_from_asset[:3, :3]
    asset_from_world = linear.T / np.cbrt(np.linalg.det(linear))
    turn = turned_harmonics(asset_from_world, round(len(coefficients) ** 0.5))
    return np.asarray(turn @ coefficients)
