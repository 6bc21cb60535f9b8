"""Deep box of bright walls, open to the front, with an object inside: light bounces many times."""

from typing import Any

from deltalight.benchmarks.ground_truth import rooms
from deltalight.benchmarks.ground_truth.benchmark_scene import (
    TABLE_Z_M,
    BenchmarkScene,
    Finish,
    VirtualObject,
)
from deltalight.benchmarks.ground_truth.lamps import Ambient, SphereLamp
from deltalight.benchmarks.ground_truth.meshes import ball, rabbit
from deltalight.benchmarks.ground_truth.parts import MeshFolder, Triple, looking

WHITE: Triple = (0.80, 0.79, 0.77)
RED: Triple = (0.80, 0.10, 0.05)
FRONT_Y_M, DEPTH_M, WIDTH_M, HEIGHT_M, BOARD_M = 0.03, 0.28, 0.32, 0.20, 0.012
CENTRE_X_M = 0.11
FLOOR_Z_M = TABLE_Z_M + BOARD_M
LAMP = SphereLamp((0.25, -0.75, 0.60), 2.4, 0.06, (1.0, 0.95, 0.88))


def _real(folder: MeshFolder) -> dict[str, Any]:
    del folder  # no meshes here
    middle_y_m = FRONT_Y_M + DEPTH_M / 2
    side_m, side_x_m = (BOARD_M, DEPTH_M, HEIGHT_M), (WIDTH_M + BOARD_M) / 2
    lid_m = (WIDTH_M + 2 * BOARD_M, DEPTH_M, BOARD_M)
    inside = {
        "floor": rooms.standing_box(CENTRE_X_M, middle_y_m, (WIDTH_M, DEPTH_M, BOARD_M), 0.0, WHITE),
        "left": rooms.standing_box(CENTRE_X_M - side_x_m, middle_y_m, side_m, 0.0, RED),
        "right": rooms.standing_box(CENTRE_X_M + side_x_m, middle_y_m, side_m, 0.0, WHITE),
        "back": rooms.standing_box(
            CENTRE_X_M, FRONT_Y_M + DEPTH_M + BOARD_M / 2, (lid_m[0], BOARD_M, HEIGHT_M), 0.0, WHITE
        ),
        "lid": rooms.standing_box(CENTRE_X_M, middle_y_m, lid_m, 0.0, WHITE, z_m=TABLE_Z_M + HEIGHT_M),
    }
    return rooms.wooden_table() | rooms.back_wall(rooms.SLATE, 0.50) | inside


SCENE = BenchmarkScene(
    name="concave_box",
    title="Concave box: strong second bounce",
    world_from_camera=(looking((0.13, -0.42, 0.26), (0.11, 0.06, 0.06)),),
    real=_real,
    objects=(
        VirtualObject(
            "rabbit",
            lambda: rabbit(0.13),
            Finish((0.10, 0.32, 0.55), specular=0.0),
            (rooms.standing(0.07, 0.14, FLOOR_Z_M, 20),),
        ),
        VirtualObject(
            "ball",
            lambda: ball(0.045),
            Finish((0.78, 0.76, 0.70), roughness=0.4),
            (rooms.standing(0.19, 0.12, FLOOR_Z_M),),
        ),
    ),
    lamps=(LAMP, Ambient(0.12, (0.92, 0.96, 1.0))),
)
