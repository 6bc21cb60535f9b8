"""A scene document as Foxglove shows it in its 3D panel: objects, lights and their names."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.ModelPrimitive_pb2 import ModelPrimitive
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from jaxtyping import Float64

from deltalight.protocol.poses import wxyz_from_rotation
from deltalight.protocol.recording_format import WORLD_FRAME, timestamp_fields
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_lights import (
    AmbientLight,
    DirectionalLight,
    RectangleLight,
    SphereLight,
    SpotLight,
)
from deltalight.protocol.scene_objects import SceneObject

LARGEST_MODEL_BYTES = 16 * 1024 * 1024  # a file beyond it is shown by its name alone
LEAST_RADIUS_M = 0.01  # so that point lights are seen
ARROW_M = 0.2
SHEET_M = 0.002  # thickness of a rectangle's picture
LETTER_M = 0.02

PlacedLight = DirectionalLight | SphereLight | SpotLight | RectangleLight
Vector = Sequence[float] | Float64[np.ndarray, "3"]


def scene_message(scene: SceneDocument, timestamp_ns: int) -> bytes:
    """Returns what Foxglove shows of a scene in place of all that it showed before.

    Objects in the world are shown as their GLB files, at their poses; those of other files by name. Lights are shown
    where the document gives them.
    """
    update = SceneUpdate()
    stamp = timestamp_fields(timestamp_ns)
    update.deletions.append(SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletion.Type.ALL))
    entities = [_object(item) for item in scene.objects if item.visible and item.frame == WORLD_FRAME]
    if scene.lights.mode == "manual":
        lights = [light for light in scene.lights.manual if not isinstance(light, AmbientLight)]
        entities += [_light(light, number) for number, light in enumerate(lights, 1)]
    for entity in entities:
        entity.timestamp.FromNanoseconds(timestamp_ns)
        entity.frame_id = WORLD_FRAME
    update.entities.extend(entities)
    return bytes(update.SerializeToString())


def _object(item: SceneObject) -> SceneEntity:
    pose = item.pose
    entity = SceneEntity(id=f"object {item.id}", texts=[_text(item.id, pose.translation_m)])
    model = _glb(Path(item.asset))
    if model is not None and item.resolved_up_axis == "y":  # as which Foxglove takes every glTF file
        entity.models.append(
            ModelPrimitive(
                pose=_pose(pose.translation_m, pose.rotation_wxyz),
                scale=_vector((pose.scale,) * 3),
                data=model,
                media_type="model/gltf-binary",
            )
        )
    return entity


def _glb(path: Path) -> bytes | None:
    try:
        if path.suffix.lower() != ".glb" or path.stat().st_size > LARGEST_MODEL_BYTES:
            return None
        return path.read_bytes()
    except OSError:
        return None


def _light(light: PlacedLight, number: int) -> SceneEntity:
    name = f"light {number}"
    color = _color(light.color_linear)
    place: Vector = (0.0, 0.0, 0.0) if isinstance(light, DirectionalLight) else light.position_m
    entity = SceneEntity(id=name, texts=[_text(name, place)])
    if isinstance(light, SphereLight | SpotLight):
        size = _vector((2 * max(light.radius_m, LEAST_RADIUS_M),) * 3)
        entity.spheres.append(SpherePrimitive(pose=_pose(place), size=size, color=color))
    if isinstance(light, SpotLight | DirectionalLight):
        entity.arrows.append(_arrow(place, light.direction, color))
    if isinstance(light, RectangleLight):
        entity.cubes.append(_rectangle(light, color))
    return entity


def _arrow(start: Vector, direction: Vector, color: Color) -> ArrowPrimitive:
    x = np.asarray(direction, np.float64)
    aside = np.eye(3)[np.argmin(np.abs(x))]
    return ArrowPrimitive(
        pose=_pose(start, wxyz_from_rotation(_axes(x, aside))),
        shaft_length=0.8 * ARROW_M,
        shaft_diameter=0.05 * ARROW_M,
        head_length=0.2 * ARROW_M,
        head_diameter=0.1 * ARROW_M,
        color=color,
    )


def _rectangle(light: RectangleLight, color: Color) -> CubePrimitive:
    u, v = np.asarray(light.axis_u_m, np.float64), np.asarray(light.axis_v_m, np.float64)
    size = _vector((float(np.linalg.norm(u)), float(np.linalg.norm(v)), SHEET_M))
    return CubePrimitive(
        pose=_pose(light.position_m, wxyz_from_rotation(_axes(u, v))), size=size, color=color
    )


def _axes(x: Float64[np.ndarray, "3"], beside: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Returns a rotation whose first axis is along x, and whose second is in the plane of both."""
    first = x / np.linalg.norm(x)
    third = np.cross(first, beside)
    third /= np.linalg.norm(third)
    return np.column_stack([first, np.cross(third, first), third])


def _pose(place: Vector, wxyz: Sequence[float] = (1.0, 0.0, 0.0, 0.0)) -> Pose:
    w, x, y, z = wxyz
    return Pose(position=_vector(place), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _vector(values: Vector) -> Vector3:
    x, y, z = (float(value) for value in values)
    return Vector3(x=x, y=y, z=z)


def _color(linear: Vector) -> Color:
    """Returns a light's colour at full strength, coded for a screen."""
    values = np.asarray(linear, np.float64)
    r, g, b = (values / max(float(values.max()), 1e-6)) ** (1 / 2.2)
    return Color(r=r, g=g, b=b, a=1.0)


def _text(name: str, place: Vector) -> TextPrimitive:
    white = Color(r=1, g=1, b=1, a=1)
    return TextPrimitive(pose=_pose(place), billboard=True, font_size=LETTER_M, color=white, text=name)
