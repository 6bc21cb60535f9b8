"""An open coloured Cornell box with a rabbit and a blue box in it, on lit ground.

A reconstruction of the comparison in [D] 5.5, figure 5.19. According to its discussion, box, bunny and blue box are
all virtual: the left wall is reddish, the right one green, the shadow falls behind the box, and the ground is real.
Their geometry, framing and light are not published, so those here are this project's own.
"""

from typing import Any

from deltalight.benchmarks.ground_truth import rooms
from deltalight.benchmarks.ground_truth.benchmark_scene import (
    TABLE_Z_M,
    BenchmarkScene,
    Finish,
    VirtualObject,
)
from deltalight.benchmarks.ground_truth.lamps import Ambient, SphereLamp
from deltalight.benchmarks.ground_truth.meshes import block, rabbit
from deltalight.benchmarks.ground_truth.parts import MeshFolder, Triple, looking
from deltalight.benchmarks.ground_truth.shadow_edges import edge_of_shadow

LAMP = SphereLamp((0.70, -0.60, 0.80), 3.6, 0.07, (1.0, 0.95, 0.88))

CENTRE_M = (0.20, 0.115)
WIDTH_M, DEPTH_M, HEIGHT_M, WALL_M = 0.24, 0.17, 0.17, 0.008


def _real(folder: MeshFolder) -> dict[str, Any]:
    del folder  # no meshes here
    return rooms.plain_table((0.50, 0.48, 0.44)) | rooms.back_wall((0.50, 0.50, 0.50), 0.60)


def _matte(
    name: str, size_m: Triple, x_m: float, y_m: float, color: Triple, *, turn_deg: float = 0
) -> VirtualObject:
    place = rooms.standing(CENTRE_M[0] + x_m, CENTRE_M[1] + y_m, turn_deg=turn_deg)
    return VirtualObject(name, lambda: block(size_m), Finish(color, specular=0.0), (place,))


_SIDE_M: Triple = (WALL_M, DEPTH_M, HEIGHT_M)
_SIDE_X_M = (WIDTH_M - WALL_M) / 2
_BACK_Y_M = (DEPTH_M + WALL_M) / 2
_LEFT_M = CENTRE_M[0] - WIDTH_M / 2

SCENE = BenchmarkScene(
    name="cornell",
    title="Cornell box with a rabbit on lit ground, all virtual",
    world_from_camera=(looking((0.19, -0.39, 0.28), (0.17, 0.045, 0.055)),),
    real=_real,
    objects=(
        _matte("red_wall", _SIDE_M, -_SIDE_X_M, 0.0, (0.60, 0.08, 0.04)),
        _matte("green_wall", _SIDE_M, _SIDE_X_M, 0.0, (0.12, 0.45, 0.08)),
        _matte("white_wall", (WIDTH_M, WALL_M, HEIGHT_M), 0.0, _BACK_Y_M, (0.73, 0.71, 0.68)),
        _matte("blue_box", (0.06, 0.06, 0.07), 0.055, -0.02, (0.08, 0.16, 0.55), turn_deg=17.0),
        VirtualObject(
            "rabbit",
            lambda: rabbit(0.12),
            Finish((0.73, 0.71, 0.68), specular=0.0),
            (rooms.standing(CENTRE_M[0] - 0.045, CENTRE_M[1] - 0.01, turn_deg=20),),
        ),
    ),
    lamps=(LAMP, Ambient(0.18, (0.92, 0.96, 1.0))),
    # The left wall's outer top edge: its shadow falls on free ground.
    shadow_edges=(
        edge_of_shadow(
            LAMP,
            ((_LEFT_M, 0.06, TABLE_Z_M + HEIGHT_M), (_LEFT_M, 0.11, TABLE_Z_M + HEIGHT_M)),
            (_LEFT_M, 0.085, TABLE_Z_M),
        ),
    ),
)
