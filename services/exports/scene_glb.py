"""A scene as one .glb file: objects, lights (KHR_lights_punctual), a given model, and points of the room."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_bytes
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_lights import (
    DirectionalLight,
    ManualLight,
    RectangleLight,
    SphereLight,
    SpotLight,
)
from deltalight.protocol.scene_objects import Z_UP_FROM_Y_UP, Material, ModelGeometry
from deltalight.services.exports.nerfstudio import OPTICAL_FROM_GL
from deltalight.services.exports.posed_views import PointCloud, PosedView

if TYPE_CHECKING:
    import trimesh

LIGHTS_EXTENSION = "KHR_lights_punctual"
Y_UP_FROM_Z_UP = np.linalg.inv(Z_UP_FROM_Y_UP)
NEAR_M = 0.01


@dataclass(frozen=True)
class Exported:
    """How many views, objects and lights were written, and sentences about what was not."""

    frames: int
    objects: int
    lights: int
    notes: list[str]


def write_scene_glb(path: Path, document: SceneDocument, views: Iterable[PosedView] = ()) -> Exported:
    """Writes a scene and what `views` show of the room; glTF's y is up, 1 unit is 1 m.

    Strengths of lights are numbers in camera units: a viewer that shows radiance 1 as white shows them alike. The
    camera is that of the first view.

    Raises:
        DeltalightError: an asset is missing or cannot be read, or the file cannot be written.
    """
    import trimesh

    scene = trimesh.Scene()
    shown = [item for item in document.objects if item.visible and item.frame == "world"]
    for item in shown:
        _add(scene, item.id, item.asset, item.world_from_object(), item.material)
    geometry = document.real.geometry
    if isinstance(geometry, ModelGeometry):
        _add(scene, "room", geometry.model, geometry.pose.matrix(), None)
    cloud, camera, frames = PointCloud(), None, 0
    for frames, view in enumerate(views, start=1):  # noqa: B007
        camera = camera or camera_node(view.frame.camera, view.world_from_camera)
        cloud.add(view)
    positions, colors = cloud.arrays()
    if len(positions):
        points = trimesh.PointCloud(positions @ Y_UP_FROM_Z_UP[:3, :3].T, colors)
        scene.add_geometry(points, node_name="room points")
    manual = document.lights.manual if document.lights.mode == "manual" else ()
    lights = [made for made in map(light_node, manual) if made is not None]
    if not (scene.geometry or lights):
        raise DeltalightError(
            "There is nothing to export: the scene has no object, light or model, and no depth."
        )
    data = scene.export(file_type="glb", tree_postprocessor=lambda tree: _add_nodes(tree, lights, camera))
    write_bytes(path, data)
    return Exported(frames, len(shown), len(lights), _notes(document, len(shown), len(lights)))


def _notes(document: SceneDocument, objects: int, lights: int) -> list[str]:
    notes = []
    if objects < len(document.objects):
        notes.append("Objects that are hidden or stand on a marker were left out.")
    if document.lights.mode != "manual":
        notes.append(f"Lights of mode {document.lights.mode} were left out; only lamps by hand are exported.")
    elif lights < len(document.lights.manual):
        notes.append("Ambient light was left out; glTF has no such light.")
    return notes


def _add(
    scene: "trimesh.Scene", name: str, asset: str, matrix: Float64[np.ndarray, "4 4"], material: object
) -> None:
    """Adds a mesh file's nodes; `matrix` leads from its axes to the world."""
    import trimesh

    if not Path(asset).is_file():
        raise DeltalightError(
            f"{name}: {asset} is not a file here; export from the folder that has the scene's assets."
        )
    try:
        loaded = trimesh.load_scene(asset)
    except Exception as error:  # a damaged file can make the loader fail in any way
        raise DeltalightError(f"{asset} cannot be read as a mesh ({error}); export it again.") from error
    for number, node in enumerate(loaded.graph.nodes_geometry):
        own, key = loaded.graph[node]
        geometry = loaded.geometry[key].copy()
        if isinstance(material, Material):
            geometry.visual = _visual(material)
        label = name if number == 0 else f"{name} {number + 1}"
        scene.add_geometry(
            geometry, node_name=label, geom_name=label, transform=Y_UP_FROM_Z_UP @ matrix @ own
        )


def _visual(material: Material) -> Any:  # noqa: ANN401 - trimesh has no types
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    made = PBRMaterial(
        baseColorFactor=[*material.base_color, 1.0],
        metallicFactor=material.metallic,
        roughnessFactor=material.roughness,
        emissiveFactor=np.clip(material.emission, 0, 1).tolist(),
    )
    return TextureVisuals(material=made)


def light_node(light: ManualLight) -> dict[str, Any] | None:
    """Returns a light's node, its definition under `light`; None for ambient light, which glTF does not have.

    A rectangle becomes a spot with the opening of its hemisphere and the intensity that it has along its axis.
    """
    strength: dict[str, Any]
    match light:
        case DirectionalLight():
            strength = {"type": "directional", "intensity": light.irradiance}
            place = _aimed((0.0, 0.0, 0.0), light.direction)
        case SpotLight():
            outer = float(np.radians(light.angle_deg) / 2)
            cone = {"innerConeAngle": outer * (1 - light.blend) * (1 - 1e-6), "outerConeAngle": outer}
            strength = {"type": "spot", "intensity": light.intensity, "spot": cone}
            place = _aimed(light.position_m, light.direction)
        case SphereLight():
            strength = {"type": "point", "intensity": light.intensity}
            place = _aimed(light.position_m, (0.0, 0.0, -1.0))
        case RectangleLight():
            axis = np.cross(light.axis_u_m, light.axis_v_m)
            cone = {"innerConeAngle": 0.0, "outerConeAngle": np.pi / 2}
            intensity = light.radiance * float(np.linalg.norm(axis))
            strength = {"type": "spot", "intensity": intensity, "spot": cone}
            place = _aimed(light.position_m, axis / np.linalg.norm(axis))
        case _:
            return None
    # glTF's colours are at most 1.
    most = max(*light.color_linear, 1e-9)
    strength["intensity"] *= most
    strength["color"] = [value / most for value in light.color_linear]
    return {"name": light.type, "matrix": _columns(place), "light": strength}


def _aimed(position: Iterable[float], direction: Iterable[float]) -> Float64[np.ndarray, "4 4"]:
    """Returns world_from_node of what shines along its own -z."""
    back = -np.asarray(tuple(direction), float)
    side = np.cross((0.0, 0.0, 1.0) if abs(back[2]) < 0.9 else (1.0, 0.0, 0.0), back)
    side /= np.linalg.norm(side)
    node = np.eye(4)
    node[:3, :3] = np.column_stack([side, np.cross(back, side), back])
    node[:3, 3] = tuple(position)
    return node


def camera_node(camera: CameraModel, world_from_camera: Float64[np.ndarray, "4 4"]) -> dict[str, Any]:
    """Returns a camera's node, its definition under `camera`: a pinhole with its axis in the picture's middle."""
    matrix = camera.matrix
    perspective = {
        "yfov": float(2 * np.arctan(camera.height / (2 * matrix[1, 1]))),
        "aspectRatio": float(camera.width / matrix[0, 0] * matrix[1, 1] / camera.height),
        "znear": NEAR_M,
    }
    node = world_from_camera @ OPTICAL_FROM_GL
    return {
        "name": "camera",
        "matrix": _columns(node),
        "camera": {"type": "perspective", "perspective": perspective},
    }


def _columns(world_from_node: Float64[np.ndarray, "4 4"]) -> list[float]:
    """Returns the matrix in glTF's axes, column by column."""
    return [float(value) for value in (Y_UP_FROM_Z_UP @ world_from_node).T.ravel()]


def _add_nodes(tree: dict[str, Any], lights: list[dict[str, Any]], camera: dict[str, Any] | None) -> None:
    """Adds lights and camera to the JSON of a glTF file."""
    nodes, roots = tree.setdefault("nodes", []), tree["scenes"][tree.get("scene", 0)].setdefault("nodes", [])
    if lights:
        tree.setdefault("extensions", {})[LIGHTS_EXTENSION] = {"lights": [light["light"] for light in lights]}
        tree["extensionsUsed"] = [*tree.get("extensionsUsed", []), LIGHTS_EXTENSION]
    made = [
        {"name": light["name"], "matrix": light["matrix"], "extensions": {LIGHTS_EXTENSION: {"light": index}}}
        for index, light in enumerate(lights)
    ]
    if camera is not None:
        tree.setdefault("cameras", []).append(camera["camera"])
        made.append({**camera, "camera": len(tree["cameras"]) - 1})
    roots.extend(range(len(nodes), len(nodes) + len(made)))
    nodes.extend(made)
