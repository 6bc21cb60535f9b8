"""The demo's room: corner of a wooden table with a marker board, a book, boxes, a mug and a ball.

World frame, units and light conventions are those of the scene document (FORMATS 3): metres, origin at the
board's first marker, +z out of the paper; radiance in camera units (1.0 = sensor white).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from benchmarks.ground_truth import demo_object
from benchmarks.ground_truth.board_texture import board_texture
from benchmarks.ground_truth.textures import plaster, wood
from protocol.board import BoardSpec
from protocol.camera_model import CameraModel

FRAME_COUNT = 60
FRAME_RATE_HZ = 30
STILL_FRAMES = 30
"""Frames before the camera starts its slow swing out and back."""
SWING_DEG = 10.0

TABLE_Z_M = -0.0005
"""The sheet has a thickness; its printed side is z = 0."""

BOARD = BoardSpec(
    type="aruco_grid",
    dictionary="DICT_4X4_50",
    marker_length_m=0.04,
    separation_m=0.01,
    rows=3,
    columns=4,
    first_id=0,
    white_albedo=0.8,
)
CAMERA = CameraModel(
    width=640,
    height=480,
    matrix=np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]]),
    distortion_model="plumb_bob",
    distortion=np.zeros(5),
)
EYE_M = np.array([0.28, -0.62, 0.375])
TARGET_M = np.array([0.165, 0.0, 0.050])

Color = tuple[float, float, float]


@dataclass(frozen=True)
class KeyLight:
    """Uniform sphere; `intensity` per steradian in camera units (E = intensity cos / distance^2)."""

    position_m: Color = (1.10, -0.36, 0.76)
    intensity: float = 4.9
    radius_m: float = 0.06
    color_linear: Color = (1.0, 0.93, 0.82)


KEY_LIGHT = KeyLight()
AMBIENT_RADIANCE = 0.20
AMBIENT_COLOR: Color = (0.88, 0.95, 1.0)

OBJECT_TRANSLATION_M: Color = (0.290, -0.090, TABLE_Z_M)


def world_from_camera(frame: int) -> Float[np.ndarray, "4 4"]:
    """Pose of one frame: on a tripod first, then `SWING_DEG` around the board and back, symmetric in time."""
    phase = (frame - STILL_FRAMES + 0.5) / (FRAME_COUNT - STILL_FRAMES)
    angle = np.radians(SWING_DEG) * np.sin(np.pi * phase) ** 2 if frame >= STILL_FRAMES else 0.0
    turn = trimesh.transformations.rotation_matrix(angle, [0, 0, 1], TARGET_M)
    eye = turn[:3, :3] @ (EYE_M - TARGET_M) + TARGET_M
    forward = (TARGET_M - eye) / np.linalg.norm(TARGET_M - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return pose


def scene_document() -> dict[str, Any]:
    """The scene document of the demo (FORMATS 3): this room's exact lights and the virtual object."""
    return {
        "name": "demo",
        "real": {"geometry": "depth"},
        "objects": [
            {
                "id": "knot",
                "asset": "object.glb",
                "pose": {"translation_m": list(OBJECT_TRANSLATION_M)},
            }
        ],
        "lights": {
            "mode": "manual",
            "manual": [
                {
                    "type": "sphere",
                    "position_m": list(KEY_LIGHT.position_m),
                    "intensity": KEY_LIGHT.intensity,
                    "radius_m": KEY_LIGHT.radius_m,
                    "color_linear": list(KEY_LIGHT.color_linear),
                },
                {
                    "type": "ambient",
                    "radiance": AMBIENT_RADIANCE,
                    "color_linear": list(AMBIENT_COLOR),
                },
            ],
        },
        "method": {"name": "dvct", "operator": "exact"},
    }


def mitsuba_scene(mesh_folder: Path, *, with_object: bool) -> dict[str, Any]:
    """The room as a Mitsuba scene dictionary without sensor; meshes are written as PLY into `mesh_folder`."""
    import mitsuba as mi

    world = mi.ScalarTransform4f
    scene: dict[str, Any] = {"type": "scene"}
    scene |= _lights(world) | _shell(mi, world) | _sheet(mi, world) | _things(mi, world, mesh_folder)
    if with_object:
        scene["object"] = _virtual_object(world, mesh_folder)
    return scene


def _lights(world: Any) -> dict[str, Any]:
    area = np.pi * KEY_LIGHT.radius_m**2  # of the disc that the sphere shows: intensity = radiance * area
    radiance = [KEY_LIGHT.intensity / area * float(c) for c in KEY_LIGHT.color_linear]
    return {
        "key": {
            "type": "sphere",
            "to_world": world().translate(list(KEY_LIGHT.position_m)).scale(KEY_LIGHT.radius_m),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
        },
        "ambient": {
            "type": "constant",
            "radiance": {"type": "rgb", "value": [AMBIENT_RADIANCE * c for c in AMBIENT_COLOR]},
        },
    }


def _shell(mi: Any, world: Any) -> dict[str, Any]:
    """Table and two walls, each a rectangle of two sides spanning [-1, 1]^2."""
    table = world().translate([0.30, -0.28, TABLE_Z_M]).scale([0.80, 0.72, 1.0])
    back = world().translate([0.30, 0.44, 0.60]).rotate([1, 0, 0], 90).scale([0.80, 0.62, 1.0])
    left = world().translate([-0.30, -0.28, 0.60]).rotate([0, 0, 1], 90).rotate([1, 0, 0], 90)
    return {
        "table": _rectangle(table, _bitmap(mi, wood(7, 1080, 1200, planks=9))),
        "back_wall": _rectangle(back, _bitmap(mi, plaster(3, 480, 620, (0.66, 0.50, 0.33)))),
        "left_wall": _rectangle(
            left.scale([0.72, 0.62, 1.0]), _bitmap(mi, plaster(4, 480, 560, (0.28, 0.42, 0.47)))
        ),
    }


def _sheet(mi: Any, world: Any) -> dict[str, Any]:
    sheet = board_texture(BOARD)
    center, half = (sheet.min_m + sheet.max_m) / 2, (sheet.max_m - sheet.min_m) / 2
    place = world().translate([*map(float, center), 0.0]).scale([*map(float, half), 1.0])
    return {"board": _rectangle(place, _bitmap(mi, np.repeat(sheet.albedo[..., None], 3, axis=2)))}


def _things(mi: Any, world: Any, mesh_folder: Path) -> dict[str, Any]:
    """The real things on the table."""
    mug = world().translate([0.46, 0.20, TABLE_Z_M])
    ceramic = {
        "type": "roughplastic",
        "diffuse_reflectance": _rgb((0.72, 0.69, 0.62)),
        "alpha": 0.18,
        "nonlinear": True,
    }
    return {
        "book": _box(world, (0.20, 0.20, 0.115), (0.080, 0.018, 0.115), -14.0, (0.62, 0.045, 0.035)),
        "pages": _box(world, (0.20, 0.20, 0.115), (0.0815, 0.014, 0.111), -14.0, (0.76, 0.72, 0.62)),
        "box": _box(world, (-0.09, 0.19, 0.045), (0.065, 0.045, 0.045), 24.0, (0.62, 0.44, 0.27)),
        "block": _box(world, (-0.075, 0.185, 0.112), (0.032, 0.022, 0.022), 52.0, (0.10, 0.30, 0.12)),
        "ball": {
            "type": "sphere",
            "to_world": world().translate([0.318, -0.174, TABLE_Z_M + 0.032]).scale(0.032),
            "bsdf": {"type": "diffuse", "reflectance": _rgb((0.80, 0.47, 0.06))},
        },
        "mug": {
            "type": "ply",
            "filename": _ply(_mug(), mesh_folder / "mug.ply"),
            "to_world": mug.rotate([0, 0, 1], -35),
            "bsdf": {"type": "twosided", "bsdf": ceramic},
        },
    }


def _virtual_object(world: Any, mesh_folder: Path) -> dict[str, Any]:
    return {
        "type": "ply",
        "filename": _ply(demo_object.object_mesh(), mesh_folder / "object.ply"),
        "to_world": world().translate(list(OBJECT_TRANSLATION_M)),
        "bsdf": {
            "type": "principled",
            "base_color": _rgb(demo_object.BASE_COLOR),
            "roughness": demo_object.ROUGHNESS,
            "metallic": demo_object.METALLIC,
            "specular": demo_object.SPECULAR,
        },
    }


def _mug() -> trimesh.Trimesh:
    """A mug on z = 0 with wall, rounded lip and handle (towards +x)."""
    lip = np.linspace(0, np.pi, 7)
    outside = [(0.0, 0.0), (0.032, 0.0), (0.036, 0.002), (0.038, 0.006), (0.038, 0.088)]
    rim = [(0.0365 + 0.0015 * float(np.cos(a)), 0.088 + 0.0015 * float(np.sin(a))) for a in lip[1:-1]]
    inside = [(0.035, 0.088), (0.035, 0.010), (0.032, 0.006), (0.0, 0.005)]
    body = trimesh.creation.revolve(np.array(outside + rim + inside), sections=64)
    handle = trimesh.creation.torus(0.024, 0.005, major_sections=48, minor_sections=16)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    handle.apply_translation([0.039, 0, 0.046])
    handle.update_faces((handle.vertices[handle.faces][..., 0] > 0.0355).all(axis=1))  # none inside the mug
    mug = trimesh.util.concatenate([body, handle])
    assert isinstance(mug, trimesh.Trimesh)
    return mug


def _box(world: Any, center_m: Color, half_m: Color, turn_deg: float, color: Color) -> dict[str, Any]:
    place = world().translate(list(center_m)).rotate([0, 0, 1], turn_deg).scale(list(half_m))
    return {
        "type": "cube",
        "to_world": place,
        "bsdf": {"type": "diffuse", "reflectance": _rgb(color)},
    }


def _rectangle(place: Any, reflectance: dict[str, Any]) -> dict[str, Any]:
    diffuse = {"type": "diffuse", "reflectance": reflectance}
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "twosided", "bsdf": diffuse}}


def _bitmap(mi: Any, albedo: Float[np.ndarray, "h w 3"]) -> dict[str, Any]:
    """Texture of linear albedo; the first row lies at the rectangle's upper edge (v = 1)."""
    picture = mi.Bitmap(np.ascontiguousarray(albedo[::-1], np.float32))
    return {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"}


def _rgb(color: Color) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(c) for c in color]}


def _ply(mesh: trimesh.Trimesh, path: Path) -> str:
    mesh.export(path, vertex_normal=True)
    return str(path)
