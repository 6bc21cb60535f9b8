"""The demo's room: corner of a wooden table with a marker board, a book, boxes, a mug and a ball.

World frame, units and light conventions are those of the scene document (docs/formats.md 3): metres, origin at the
board's first marker, +z out of the paper; radiance in camera units (1.0 = sensor white).
"""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from deltalight.benchmarks.ground_truth import benchmark_scene, demo_object
from deltalight.benchmarks.ground_truth.assembly import material
from deltalight.benchmarks.ground_truth.lamps import Ambient, SphereLamp
from deltalight.benchmarks.ground_truth.meshes import mug
from deltalight.benchmarks.ground_truth.parts import (
    Matrix,
    MeshFolder,
    Triple,
    box,
    diffuse,
    looking,
    mesh_shape,
    placed,
    rectangle,
    rgb,
    shape,
    sheet,
    turned,
)
from deltalight.benchmarks.ground_truth.textures import plaster, wood

CAMERA, BOARD, TABLE_Z_M = benchmark_scene.CAMERA, benchmark_scene.BOARD, benchmark_scene.TABLE_Z_M

FRAME_COUNT = 30
FRAME_RATE_HZ = 15
STILL_FRAMES = 20
"""Frames before the camera starts its slow swing out and back."""
SWING_DEG = 6.0

EYE_M = np.array([0.28, -0.62, 0.375])
TARGET_M: Triple = (0.165, 0.0, 0.050)

KEY_LIGHT = SphereLamp((1.10, -0.36, 0.76), intensity=4.9, radius_m=0.06, color_linear=(1.0, 0.93, 0.82))
AMBIENT = Ambient(0.20, (0.88, 0.95, 1.0))

OBJECT_TRANSLATION_M: Triple = (0.290, -0.090, TABLE_Z_M)
FINISH = benchmark_scene.Finish(
    demo_object.BASE_COLOR, demo_object.ROUGHNESS, demo_object.METALLIC, demo_object.SPECULAR
)


def world_from_camera(frame: int) -> Matrix:
    """Returns the pose of one frame.

    On a tripod first, then `SWING_DEG` around the board and back, symmetric in time.
    """
    phase = (frame - STILL_FRAMES + 0.5) / (FRAME_COUNT - STILL_FRAMES)
    angle = np.radians(SWING_DEG) * np.sin(np.pi * phase) ** 2 if frame >= STILL_FRAMES else 0.0
    turn = trimesh.transformations.rotation_matrix(angle, [0, 0, 1], TARGET_M)
    eye = turn[:3, :3] @ (EYE_M - TARGET_M) + TARGET_M
    return looking((float(eye[0]), float(eye[1]), float(eye[2])), TARGET_M)


def scene_document() -> dict[str, Any]:
    """Returns the scene document of the demo (docs/formats.md 3): this room's exact lights and the virtual object."""
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
        "lights": {"mode": "manual", "manual": [KEY_LIGHT.document(), AMBIENT.document()]},
        "method": {"name": "dvct", "operator": "exact"},
        "output": {"antialiasing": True},
    }


def mitsuba_scene(mesh_folder: Path, *, with_object: bool) -> dict[str, Any]:
    """Returns the room as a Mitsuba scene dictionary without sensor; writes meshes as PLY into `mesh_folder`."""
    folder = MeshFolder(mesh_folder)
    lights = {"key": KEY_LIGHT.mitsuba(), "ambient": AMBIENT.mitsuba()}
    scene = {"type": "scene", **lights, **room(folder)}
    if with_object:
        place, mesh = placed(OBJECT_TRANSLATION_M), demo_object.object_mesh()
        scene["object"] = mesh_shape("object", mesh, place, folder, material(FINISH))
    return scene


def room(folder: MeshFolder) -> dict[str, Any]:
    """Returns everything real except the lights."""
    return {**_shell(), **_boxes(), "ball": _ball(), "mug": _mug(folder)}


def _shell() -> dict[str, Any]:
    """Returns table, two walls and the marker sheet, each a two-sided rectangle spanning [-1, 1]^2."""
    table = placed((0.30, -0.28, TABLE_Z_M), scale=(0.80, 0.72, 1.0))
    back = placed((0.30, 0.44, 0.60), turned("x", 90), (0.80, 0.62, 1.0))
    left = placed((-0.30, -0.28, 0.60), turned("z", 90) @ turned("x", 90), (0.72, 0.62, 1.0))
    return {
        "table": rectangle(table, wood(7, 1080, 1200, planks=9)),
        "back_wall": rectangle(back, plaster(3, 480, 620, (0.66, 0.50, 0.33))),
        "left_wall": rectangle(left, plaster(4, 480, 560, (0.28, 0.42, 0.47))),
        "board": sheet(BOARD),
    }


def _boxes() -> dict[str, Any]:
    """Returns a book (cover and pages), a cardboard box and a wooden block on it."""
    return {
        "book": box((0.20, 0.20, 0.115), (0.0800, 0.018, 0.115), -14.0, (0.62, 0.045, 0.035)),
        "pages": box((0.20, 0.20, 0.115), (0.0815, 0.014, 0.111), -14.0, (0.76, 0.72, 0.62)),
        "box": box((-0.09, 0.19, 0.045), (0.065, 0.045, 0.045), 24.0, (0.62, 0.44, 0.27)),
        "block": box((-0.075, 0.185, 0.112), (0.032, 0.022, 0.022), 52.0, (0.10, 0.30, 0.12)),
    }


def _ball() -> dict[str, Any]:
    radius_m = 0.032
    place = placed((0.318, -0.174, TABLE_Z_M + radius_m), scale=(radius_m,) * 3)
    return shape("sphere", place, bsdf=diffuse(rgb((0.80, 0.47, 0.06))))


def _mug(folder: MeshFolder) -> dict[str, Any]:
    ceramic = {
        "type": "roughplastic",
        "diffuse_reflectance": rgb((0.72, 0.69, 0.62)),
        "alpha": 0.18,
        "nonlinear": True,
    }
    return mesh_shape("mug", mug(), placed((0.46, 0.20, TABLE_Z_M), turned("z", -35)), folder, ceramic)
