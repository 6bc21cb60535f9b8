"""The empty table's photograph with a cuboid rendered into it, by the public Python API."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64

from deltalight.benchmarks.quality.metrics import Mask, Picture
from deltalight.benchmarks.real.cuboid import Cuboid
from deltalight.benchmarks.real.light_fit import FoundLights
from deltalight.benchmarks.real.ranges import Plane
from deltalight.protocol.frames import BoardPose, DepthImage, ViewFrame
from deltalight.protocol.scene_lights import AmbientLight, DirectionalLight, Lights
from deltalight.protocol.scene_objects import Material
from deltalight.scene import Scene

Albedo = Float64[np.ndarray, " 3"]
WHITE = 0.8
"""Albedo of the table, as white board and paper have it: it says how bright light is, which cancels in ratios."""
BRIGHTEST = 0.95


def table_frame(number: int, plate: Picture, plane: Plane, table: Mask) -> ViewFrame:
    """Returns the empty table as the renderer takes it: photograph, pose, the plane's depth where the table is."""
    depth_m = np.where(table, plane.depth_m, 0).astype(np.float32)
    depth = DepthImage(depth_m, depth_m > 0, plane.camera)
    pose = BoardPose(plane.world_from_camera)
    return ViewFrame(number, number, plate, plane.camera, pose=pose, depth=depth)


def table_scene(
    things: Sequence[tuple[Cuboid, Albedo]], lights: FoundLights, bare: Albedo, folder: Path
) -> Scene:
    """Returns the scene of cuboids of an albedo on the table; their meshes go into `folder`.

    `bare`: the empty table's radiance, R G B.
    """
    scene = Scene()
    for number, (cuboid, albedo) in enumerate(things):
        asset = folder / f"cuboid{number}.ply"
        trimesh.convex.convex_hull(cuboid.corners).export(asset)
        base_color = _triple(np.clip(albedo, 0, BRIGHTEST))
        scene.add(asset, material=Material(base_color=base_color, specular=0, roughness=1))
    manual = _manual_lights(lights, np.pi * bare / WHITE)
    scene.document = scene.document.replaced(lights=Lights(manual=manual, surroundings="none"))
    return scene


def _manual_lights(
    lights: FoundLights, irradiance: Float64[np.ndarray, " 3"]
) -> tuple[DirectionalLight | AmbientLight, ...]:
    even = AmbientLight(radiance=1, color_linear=_triple(lights.even * irradiance / np.pi))
    discs = [
        DirectionalLight(
            direction=_triple(-light.towards),
            irradiance=1,
            color_linear=_triple(light.fraction * irradiance / light.towards[2]),
            angular_radius_deg=float(np.degrees(light.radius)),
        )
        for light in lights.lights
    ]
    return (*discs, even)


def _triple(values: Float64[np.ndarray, " 3"]) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in values)
    return red, green, blue
