"""Table of dark, glossy varnish: it reflects things and the virtual object, blurred."""

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
from deltalight.benchmarks.ground_truth.meshes import pawn, vase
from deltalight.benchmarks.ground_truth.parts import MeshFolder, looking, shape, sheet_surface, texture
from deltalight.benchmarks.ground_truth.textures import wood

ROUGHNESS = 0.25
SPECULAR = 0.5
LAMP = SphereLamp((-0.55, -0.25, 0.75), 2.7, 0.08, (1.0, 0.95, 0.88))


def _real(folder: MeshFolder) -> dict[str, Any]:
    stained = 0.30 * wood(11, 1080, 1200, planks=5)
    varnish = energy_keeping(texture(stained), roughness=ROUGHNESS, specular=SPECULAR)
    things = {
        "table": shape("rectangle", rooms.table_place(), bsdf=varnish),
        "tea": rooms.standing_box(0.05, 0.13, (0.075, 0.075, 0.120), 20.0, (0.70, 0.52, 0.10)),
        "mug": rooms.mug(folder, rooms.standing(0.36, 0.12, turn_deg=-20), (0.20, 0.45, 0.50)),
    }
    return rooms.wooden_table() | rooms.back_wall((0.62, 0.58, 0.50), 0.36) | things


SCENE = BenchmarkScene(
    name="glossy_table",
    title="Glossy table: dark varnish",
    world_from_camera=(looking((0.22, -0.41, 0.22), (0.165, 0.0, 0.045)),),
    real=_real,
    objects=(
        VirtualObject(
            "vase", vase, Finish((0.78, 0.74, 0.66), roughness=0.4), (rooms.standing(0.26, -0.04),)
        ),
        VirtualObject("pawn", pawn, Finish((0.65, 0.06, 0.04), specular=0.0), (rooms.standing(0.15, 0.075),)),
    ),
    lamps=(LAMP, Ambient(0.26, (0.92, 0.96, 1.0))),
    surfaces=(
        sheet_surface(BOARD),
        {
            "region": {
                "plane": {"point_m": [0.0, 0.0, TABLE_Z_M], "normal": [0.0, 0.0, 1.0], "tolerance_m": 0.003}
            },
            "roughness": ROUGHNESS,
            "specular": SPECULAR,
        },
    ),
)
