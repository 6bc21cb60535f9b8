"""The demo's room: corner of a wooden table with a marker board, a book, boxes, a mug and a ball.

World frame, units and light conventions are those of the scene document (FORMATS 3): metres, origin at the
board's first marker, +z out of the paper; radiance in camera units (1.0 = sensor white).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float

from benchmarks.ground_truth import demo_object
from benchmarks.ground_truth.board_texture import board_texture
from benchmarks.ground_truth.textures import plaster, wood
from protocol.board import BoardSpec
from protocol.camera_model import CameraModel

FRAME_COUNT = 30
FRAME_RATE_HZ = 15
STILL_FRAMES = 20
"""Frames before the camera starts its slow swing out and back."""
SWING_DEG = 6.0

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

Triple = tuple[float, float, float]
Matrix = Float[np.ndarray, "4 4"]
IDENTITY: Matrix = np.eye(4)


@dataclass(frozen=True)
class KeyLight:
    """Uniform sphere; `intensity` per steradian in camera units (E = intensity cos / distance^2)."""

    position_m: Triple = (1.10, -0.36, 0.76)
    intensity: float = 4.9
    radius_m: float = 0.06
    color_linear: Triple = (1.0, 0.93, 0.82)


KEY_LIGHT = KeyLight()
AMBIENT_RADIANCE = 0.20
AMBIENT_COLOR: Triple = (0.88, 0.95, 1.0)

OBJECT_TRANSLATION_M: Triple = (0.290, -0.090, TABLE_Z_M)


def world_from_camera(frame: int) -> Matrix:
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
    scene: dict[str, Any] = {"type": "scene"}
    scene |= _lights() | _shell() | _boxes() | {"ball": _ball(), "mug": _mug(mesh_folder)}
    if with_object:
        scene["object"] = _virtual_object(mesh_folder)
    return scene


def _lights() -> dict[str, Any]:
    area = np.pi * KEY_LIGHT.radius_m**2  # of the disc that the sphere shows: intensity = radiance * area
    radiance = np.array(KEY_LIGHT.color_linear) * KEY_LIGHT.intensity / area
    ambient = np.array(AMBIENT_COLOR) * AMBIENT_RADIANCE
    place = _place(KEY_LIGHT.position_m, scale=(KEY_LIGHT.radius_m,) * 3)
    return {
        "key": _shape("sphere", place, emitter={"type": "area", "radiance": _rgb(radiance)}),
        "ambient": {"type": "constant", "radiance": _rgb(ambient)},
    }


def _shell() -> dict[str, Any]:
    """Table, two walls and the marker sheet, each a rectangle of two sides spanning [-1, 1]^2."""
    table = _place((0.30, -0.28, TABLE_Z_M), scale=(0.80, 0.72, 1.0))
    back = _place((0.30, 0.44, 0.60), _turn("x", 90), (0.80, 0.62, 1.0))
    left = _place((-0.30, -0.28, 0.60), _turn("z", 90) @ _turn("x", 90), (0.72, 0.62, 1.0))
    paper = board_texture(BOARD)
    center, half = (paper.min_m + paper.max_m) / 2, (paper.max_m - paper.min_m) / 2
    sheet = _place((center[0], center[1], 0.0), scale=(half[0], half[1], 1.0))
    return {
        "table": _rectangle(table, wood(7, 1080, 1200, planks=9)),
        "back_wall": _rectangle(back, plaster(3, 480, 620, (0.66, 0.50, 0.33))),
        "left_wall": _rectangle(left, plaster(4, 480, 560, (0.28, 0.42, 0.47))),
        "board": _rectangle(sheet, np.repeat(paper.albedo[..., None], 3, axis=2)),
    }


def _boxes() -> dict[str, Any]:
    """A book (cover and pages), a cardboard box and a wooden block on it."""
    return {
        "book": _box((0.20, 0.20, 0.115), (0.0800, 0.018, 0.115), -14.0, (0.62, 0.045, 0.035)),
        "pages": _box((0.20, 0.20, 0.115), (0.0815, 0.014, 0.111), -14.0, (0.76, 0.72, 0.62)),
        "box": _box((-0.09, 0.19, 0.045), (0.065, 0.045, 0.045), 24.0, (0.62, 0.44, 0.27)),
        "block": _box((-0.075, 0.185, 0.112), (0.032, 0.022, 0.022), 52.0, (0.10, 0.30, 0.12)),
    }


def _ball() -> dict[str, Any]:
    radius_m = 0.032
    place = _place((0.318, -0.174, TABLE_Z_M + radius_m), scale=(radius_m,) * 3)
    return _shape("sphere", place, bsdf=_diffuse(_rgb((0.80, 0.47, 0.06))))


def _mug(mesh_folder: Path) -> dict[str, Any]:
    ceramic = {
        "type": "roughplastic",
        "diffuse_reflectance": _rgb((0.72, 0.69, 0.62)),
        "alpha": 0.18,
        "nonlinear": True,
    }
    return _shape(
        "ply",
        _place((0.46, 0.20, TABLE_Z_M), _turn("z", -35)),
        filename=_ply(_mug_mesh(), mesh_folder / "mug.ply"),
        bsdf={"type": "twosided", "bsdf": ceramic},
    )


def _virtual_object(mesh_folder: Path) -> dict[str, Any]:
    glaze = {
        "type": "principled",
        "base_color": _rgb(demo_object.BASE_COLOR),
        "roughness": demo_object.ROUGHNESS,
        "metallic": demo_object.METALLIC,
        "specular": demo_object.SPECULAR,
    }
    return _shape(
        "ply",
        _place(OBJECT_TRANSLATION_M),
        filename=_ply(demo_object.object_mesh(), mesh_folder / "object.ply"),
        bsdf=glaze,
    )


def _mug_mesh() -> trimesh.Trimesh:
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


def _box(center_m: Triple, half_m: Triple, turn_deg: float, color: Triple) -> dict[str, Any]:
    return _shape("cube", _place(center_m, _turn("z", turn_deg), half_m), bsdf=_diffuse(_rgb(color)))


def _rectangle(place: Matrix, albedo: Float[np.ndarray, "h w 3"]) -> dict[str, Any]:
    """Rectangle under a texture of linear albedo, whose first row lies at its upper edge (v = 1)."""
    import mitsuba as mi

    picture = mi.Bitmap(np.ascontiguousarray(albedo[::-1], np.float32))
    texture = {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"}
    return _shape("rectangle", place, bsdf={"type": "twosided", "bsdf": _diffuse(texture)})


def _shape(kind: str, place: Matrix, **parts: object) -> dict[str, Any]:
    import mitsuba as mi

    return {"type": kind, "to_world": mi.ScalarTransform4f(place), **parts}


def _place(translation_m: Triple, turn: Matrix = IDENTITY, scale: Triple = (1.0, 1.0, 1.0)) -> Matrix:
    translation = trimesh.transformations.translation_matrix(translation_m)
    return np.asarray(translation @ turn @ np.diag([*scale, 1.0]))


def _turn(axis: Literal["x", "z"], angle_deg: float) -> Matrix:
    direction = [float(axis == name) for name in "xyz"]
    return np.asarray(trimesh.transformations.rotation_matrix(np.radians(angle_deg), direction))


def _diffuse(reflectance: dict[str, Any]) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": reflectance}


def _rgb(color: Triple | Float[np.ndarray, "3"]) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(c) for c in color]}


def _ply(mesh: trimesh.Trimesh, path: Path) -> str:
    mesh.export(path, vertex_normal=True)
    return str(path)
