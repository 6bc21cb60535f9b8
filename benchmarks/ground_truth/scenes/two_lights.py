"""A warm lamp from the left, a cool one from the right: every object has two coloured shadows."""

from typing import Any

from deltalight.benchmarks.ground_truth import rooms
from deltalight.benchmarks.ground_truth.benchmark_scene import (
    TABLE_Z_M,
    BenchmarkScene,
    Finish,
    VirtualObject,
)
from deltalight.benchmarks.ground_truth.lamps import Ambient, SphereLamp
from deltalight.benchmarks.ground_truth.meshes import block, pawn
from deltalight.benchmarks.ground_truth.parts import MeshFolder, Triple, looking
from deltalight.benchmarks.ground_truth.shadow_edges import edge_of_shadow

WARM = SphereLamp((-0.75, -0.30, 0.65), 2.6, 0.05, (1.0, 0.62, 0.28))
COOL = SphereLamp((1.10, -0.25, 0.65), 4.4, 0.05, (0.35, 0.60, 1.0))

SLAB_M: Triple = (0.12, 0.03, 0.13)
SLAB_AT_M = (0.16, 0.07)
_LEFT_X_M, _FRONT_Y_M = SLAB_AT_M[0] - SLAB_M[0] / 2, SLAB_AT_M[1] - SLAB_M[1] / 2
LEFT_EDGE_M: tuple[Triple, Triple] = (
    (_LEFT_X_M, _FRONT_Y_M, TABLE_Z_M + 0.02),
    (_LEFT_X_M, _FRONT_Y_M, TABLE_Z_M + 0.06),
)
"""Of the slab, upright: the part whose shadow falls onto the free table."""


def _real(folder: MeshFolder) -> dict[str, Any]:
    things = {
        "carton": rooms.standing_box(0.02, 0.17, (0.09, 0.06, 0.12), 30.0, (0.55, 0.53, 0.20)),
        "mug": rooms.mug(folder, rooms.standing(0.37, 0.17, turn_deg=-35)),
    }
    return rooms.plain_table((0.52, 0.50, 0.47), 8) | rooms.back_wall((0.55, 0.53, 0.50)) | things


SCENE = BenchmarkScene(
    name="two_lights",
    title="Two lights of different colour",
    world_from_camera=(looking((0.20, -0.40, 0.32), (0.17, 0.01, 0.035)),),
    real=_real,
    objects=(
        VirtualObject(
            "slab",
            lambda: block(SLAB_M),
            Finish((0.70, 0.30, 0.22), specular=0.0),
            (rooms.standing(*SLAB_AT_M),),
        ),
        VirtualObject(
            "pawn", pawn, Finish((0.40, 0.10, 0.32), roughness=0.3), (rooms.standing(0.27, -0.06),)
        ),
    ),
    lamps=(WARM, COOL, Ambient(0.12)),
    shadow_edges=(edge_of_shadow(COOL, LEFT_EDGE_M, (*SLAB_AT_M, TABLE_Z_M + 0.04)),),
)
