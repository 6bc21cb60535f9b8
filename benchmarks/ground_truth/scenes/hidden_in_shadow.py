"""Objects half behind a real book's corner and half in the shadow of a real box."""

from typing import Any

from deltalight.benchmarks.ground_truth import rooms
from deltalight.benchmarks.ground_truth.benchmark_scene import BenchmarkScene, Finish, VirtualObject
from deltalight.benchmarks.ground_truth.lamps import Ambient, SphereLamp
from deltalight.benchmarks.ground_truth.meshes import pawn, rabbit
from deltalight.benchmarks.ground_truth.parts import MeshFolder, looking

LAMP = SphereLamp((1.00, 0.02, 0.57), 3.5, 0.05, (1.0, 0.94, 0.84))


def _real(folder: MeshFolder) -> dict[str, Any]:
    things = {
        "screen": rooms.standing_box(0.33, 0.05, (0.05, 0.12, 0.11), 10.0, (0.16, 0.34, 0.40)),
        "front": rooms.standing_box(0.075, 0.058, (0.10, 0.045, 0.115), 12.0, rooms.CARDBOARD),
        "mug": rooms.mug(folder, rooms.standing(0.005, 0.21, turn_deg=-35)),
    }
    return (
        rooms.wooden_table(15)
        | rooms.back_wall((0.60, 0.58, 0.52))
        | rooms.left_wall((0.46, 0.30, 0.22))
        | things
    )


SCENE = BenchmarkScene(
    name="hidden_in_shadow",
    title="Half hidden, half in a real shadow",
    world_from_camera=(looking((0.15, -0.38, 0.29), (0.155, 0.015, 0.05)),),
    real=_real,
    objects=(
        VirtualObject(
            "rabbit",
            rabbit,
            Finish((0.70, 0.62, 0.20), specular=0.0),
            (rooms.standing(0.125, 0.16, turn_deg=15),),
        ),
        VirtualObject(
            "pawn", pawn, Finish((0.55, 0.06, 0.05), roughness=0.3), (rooms.standing(0.24, 0.045),)
        ),
    ),
    lamps=(LAMP, Ambient(0.22, (0.90, 0.95, 1.0))),
)
