"""Twelve frames: the camera swings around the table while one object slides and rotates and another stands still."""

from typing import Any

import numpy as np

from deltalight.benchmarks.ground_truth import rooms
from deltalight.benchmarks.ground_truth.benchmark_scene import (
    TABLE_Z_M,
    BenchmarkScene,
    Finish,
    VirtualObject,
)
from deltalight.benchmarks.ground_truth.lamps import Ambient, SphereLamp
from deltalight.benchmarks.ground_truth.meshes import block, rabbit
from deltalight.benchmarks.ground_truth.parts import Matrix, MeshFolder, Triple, looking
from deltalight.benchmarks.ground_truth.shadow_edges import edge_of_shadow

FRAMES = 12
STEP_M = 0.004
TURN_DEG = 6.0
SWING_DEG = 0.4
TARGET_M = (0.165, -0.01, 0.045)
DISTANCE_M, HEIGHT_M = 0.40, 0.28
TILE_M: Triple = (0.06, 0.06, 0.10)
TILE_AT_M = (0.30, 0.06)
LAMP = SphereLamp((1.00, -0.35, 0.70), 4.2, 0.06, (1.0, 0.94, 0.84))


def _real(folder: MeshFolder) -> dict[str, Any]:
    things = {
        "tea": rooms.standing_box(-0.005, 0.16, (0.075, 0.075, 0.11), 20.0, (0.15, 0.36, 0.30)),
        "mug": rooms.mug(folder, rooms.standing(0.40, 0.16, turn_deg=-50), (0.72, 0.60, 0.30)),
    }
    return rooms.wooden_table(31) | rooms.back_wall((0.58, 0.54, 0.50)) | things


def _camera(frame: int) -> Matrix:
    """Returns a pose some millimetres further per frame along an arc, rising slowly."""
    angle = np.radians(-90 + SWING_DEG * frame)
    x_m, y_m = TARGET_M[0] + DISTANCE_M * np.cos(angle), TARGET_M[1] + DISTANCE_M * np.sin(angle)
    return looking((float(x_m), float(y_m), HEIGHT_M + 0.001 * frame), TARGET_M)


def _slide(frame: int) -> Matrix:
    return rooms.standing(0.12 + STEP_M * frame, 0.10 - 0.25 * STEP_M * frame, turn_deg=TURN_DEG * frame - 30)


_CORNER_M = (TILE_AT_M[0] - TILE_M[0] / 2, TILE_AT_M[1] - TILE_M[1] / 2)
_TILE_EDGE_M: tuple[Triple, Triple] = ((*_CORNER_M, TABLE_Z_M + 0.02), (*_CORNER_M, TABLE_Z_M + 0.06))

SCENE = BenchmarkScene(
    name="moving",
    title="Moving object, moving camera",
    world_from_camera=tuple(_camera(frame) for frame in range(FRAMES)),
    real=_real,
    objects=(
        VirtualObject(
            "rabbit",
            lambda: rabbit(0.16),
            Finish((0.72, 0.36, 0.22), specular=0.0),
            tuple(_slide(frame) for frame in range(FRAMES)),
        ),
        VirtualObject(
            "tile",
            lambda: block(TILE_M),
            Finish((0.05, 0.12, 0.42), roughness=0.3),
            (rooms.standing(*TILE_AT_M),) * FRAMES,
        ),
    ),
    lamps=(LAMP, Ambient(0.22, (0.90, 0.95, 1.0))),
    shadow_edges=(edge_of_shadow(LAMP, _TILE_EDGE_M, (*TILE_AT_M, TABLE_Z_M + 0.04)),),
)
