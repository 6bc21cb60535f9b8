"""A benchmark scene for Mitsuba: without objects, with them, and the objects alone as a mask."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32

from deltalight.benchmarks.ground_truth.benchmark_scene import BenchmarkScene, Finish
from deltalight.benchmarks.ground_truth.energy_keeping import energy_keeping
from deltalight.benchmarks.ground_truth.parts import MeshFolder, diffuse, rgb, shape, two_sided
from deltalight.render_server.lights.environment import read_radiance

ENVIRONMENT_FILE = "environment.hdr"
GLASS_IOR = 1.5  # whose reflectance `specular` 0.5 is

WORLD_FROM_MITSUBA_MAP = np.array(
    [[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Axes of environment maps: Mitsuba's has +y up, looks along +z in its centre, with +x a quarter to the left.

Ours has +z, +x and +y in these places.
"""


def material(finish: Finish) -> dict[str, Any]:
    """Returns Mitsuba's material of the scene document's terms; Lambertian or smooth glass if that says so."""
    color = rgb(finish.base_color)
    if finish.transmission:
        return {"type": "dielectric", "int_ior": GLASS_IOR, "ext_ior": 1.0, "specular_transmittance": color}
    if finish.metallic == 0 and finish.specular == 0:
        return diffuse(color)
    return energy_keeping(
        color, roughness=finish.roughness, metallic=finish.metallic, specular=finish.specular
    )


def environment_light(radiance: Float32[np.ndarray, "h w 3"]) -> dict[str, Any]:
    """Returns light from a map in the layout of render_server/lights/environment.py.

    Mitsuba puts the first and the last row at the poles, this project row j at (j + 0.5)/h of the height. A map of 2
    h + 1 rows, with the given ones at the odd rows and their means between, is the same function in its layout.
    """
    import mitsuba as mi

    rows = np.concatenate([radiance[:1], radiance, radiance[-1:]])
    dense = np.empty((2 * len(radiance) + 1, *radiance.shape[1:]), np.float32)
    dense[1::2] = radiance
    dense[::2] = (rows[:-1] + rows[1:]) / 2
    place = mi.ScalarTransform4f(WORLD_FROM_MITSUBA_MAP)
    return {"type": "envmap", "bitmap": mi.Bitmap(dense), "to_world": place}


class Assembly:
    """Mitsuba dictionaries of a scene; constructing it writes the scene's meshes and map into a folder.

    `assets` holds the scene document's assets: a PLY for each object, the environment map.
    """

    def __init__(self, scene: BenchmarkScene, folder: Path) -> None:
        self.scene, self.folder = scene, folder
        self.assets = folder / "assets"
        meshes = folder / "real"
        for path in (self.assets, meshes):
            path.mkdir()
        self._real = {f"real_{name}": part for name, part in scene.real(MeshFolder(meshes)).items()}
        self._lights = self._make_lights()
        self._meshes = [item.mesh() for item in scene.objects]
        self._files = [
            MeshFolder(self.assets).ply(item.id, mesh)
            for item, mesh in zip(scene.objects, self._meshes, strict=True)
        ]

    def without(self) -> dict[str, Any]:
        """Returns the real room and its lights."""
        return {"type": "scene", **self._lights, **self._real}

    def with_objects(self, frame: int) -> dict[str, Any]:
        """Returns the room with the virtual objects in their poses of a frame.

        They come last, so that paths that never meet them draw the same random numbers as without.
        """
        objects = {}
        for index, (item, file) in enumerate(zip(self.scene.objects, self._files, strict=True)):
            place, bsdf = item.world_from_object[frame], material(item.finish)
            if not item.finish.transmission:
                bsdf = two_sided(bsdf)
            glow = {"emitter": _area(item.finish.emission)} if any(item.finish.emission) else {}
            objects[f"object_{index}"] = shape("ply", place, filename=file, bsdf=bsdf, **glow)
        return {**self.without(), **objects}

    def mask(self, frame: int) -> dict[str, Any]:
        """Returns objects that emit radiance 1 among dark real things, for `RoomRenderer.cover`.

        Flat normals: an emitter is dark where its interpolated normal faces away, as along outlines.
        """
        lamps = {name: _dark(lamp) for name, lamp in self._lights.items() if "emitter" in lamp}
        objects = {
            f"object_{index}": shape(
                "ply",
                item.world_from_object[frame],
                filename=file,
                face_normals=True,
                emitter=_area((1.0, 1.0, 1.0)),
            )
            for index, (item, file) in enumerate(zip(self.scene.objects, self._files, strict=True))
        }
        return {"type": "scene", **lamps, **self._real, **objects}

    def base_m(self) -> Float[np.ndarray, "3"]:
        """Returns the middle of the first object's underside in the first frame."""
        low, high = self._meshes[0].bounds
        middle = np.array([*(low[:2] + high[:2]) / 2, low[2], 1.0])
        return np.asarray((self.scene.objects[0].world_from_object[0] @ middle)[:3])

    def _make_lights(self) -> dict[str, Any]:
        if self.scene.environment is None:
            return {f"lamp_{index}": lamp.mitsuba() for index, lamp in enumerate(self.scene.lamps)}
        # The file's rounding (RGBE) is part of the light, for truth and renderer alike.
        path = self.assets / ENVIRONMENT_FILE
        cv2.imwrite(str(path), np.ascontiguousarray(self.scene.environment()[..., ::-1]))
        return {"environment": environment_light(read_radiance(path))}


def _area(radiance: tuple[float, float, float]) -> dict[str, Any]:
    return {"type": "area", "radiance": rgb(radiance)}


def _dark(lamp: dict[str, Any]) -> dict[str, Any]:
    return {name: part for name, part in lamp.items() if name != "emitter"}
