"""Table of brushed steel, almost a mirror."""

from typing import Any

from deltalight.benchmarks.ground_truth import rooms
from deltalight.benchmarks.ground_truth.benchmark_scene import (
    BOARD,
    TABLE_Z_M,
    BenchmarkScene,
    Finish,
    VirtualObject,
)
from deltalight.benchmarks.ground_truth.energy_keeping import energy_keeping
from deltalight.benchmarks.ground_truth.lamps import Ambient, SphereLamp
from deltalight.benchmarks.ground_truth.meshes import rabbit, ring
from deltalight.benchmarks.ground_truth.parts import (
    MeshFolder,
    Triple,
    looking,
    rgb,
    shape,
    sheet,
    sheet_surface,
)

ROUGHNESS = 0.1
STEEL: Triple = (0.62, 0.60, 0.57)
TABLE_BACK_Y_M = 0.19
LAMP = SphereLamp((0.62, -0.20, 0.95), 2.6, 0.20, (1.0, 0.95, 0.88))
"""High above a table that ends before the wall: the table's reflection passes over the visible part of the wall.

Only a path that happens to end in the lamp finds such light, so it would show as noise.
"""


def _real(folder: MeshFolder) -> dict[str, Any]:
    steel = energy_keeping(rgb(STEEL), roughness=ROUGHNESS, metallic=1.0)
    things = {
        "table": shape("rectangle", rooms.table_place(TABLE_BACK_Y_M), bsdf=steel),
        "tin": rooms.standing_box(0.03, 0.14, (0.10, 0.06, 0.13), 25.0, (0.12, 0.30, 0.50)),
        "mug": rooms.mug(folder, rooms.standing(0.36, 0.13, turn_deg=-35), (0.70, 0.30, 0.10)),
    }
    return {"board": sheet(BOARD)} | rooms.back_wall((0.62, 0.58, 0.48), 0.34) | things


SCENE = BenchmarkScene(
    name="mirror_table",
    title="Mirror table: polished steel",
    world_from_camera=(looking((0.215, -0.40, 0.24), (0.165, 0.0, 0.04)),),
    real=_real,
    objects=(
        VirtualObject(
            "rabbit",
            lambda: rabbit(0.14),
            Finish((0.72, 0.70, 0.66), specular=0.0),
            (rooms.standing(0.15, 0.085, turn_deg=-20),),
        ),
        VirtualObject(
            "ring",
            ring,
            Finish((0.06, 0.42, 0.12), roughness=0.35),
            (rooms.standing(0.27, -0.03, turn_deg=35),),
        ),
    ),
    lamps=(LAMP, Ambient(0.24, (0.92, 0.96, 1.0))),
    surfaces=(
        sheet_surface(BOARD),
        {
            "region": {
                "plane": {"point_m": [0.0, 0.0, TABLE_Z_M], "normal": [0.0, 0.0, 1.0], "tolerance_m": 0.003}
            },
            "roughness": ROUGHNESS,
            "metallic": 1.0,
            "albedo": list(STEEL),
        },
    ),
)
