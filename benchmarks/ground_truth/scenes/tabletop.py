"""Corner of a wooden table with everyday things, and a matte, a glossy and a metal object among them."""

from typing import Any

from deltalight.benchmarks.ground_truth import rooms
from deltalight.benchmarks.ground_truth.benchmark_scene import BenchmarkScene, Finish, VirtualObject
from deltalight.benchmarks.ground_truth.lamps import Ambient, SphereLamp
from deltalight.benchmarks.ground_truth.meshes import ball, pawn, rabbit
from deltalight.benchmarks.ground_truth.parts import MeshFolder, looking

LAMP = SphereLamp((1.05, -0.30, 0.72), 4.5, 0.06, (1.0, 0.93, 0.82))


def _real(folder: MeshFolder) -> dict[str, Any]:
    things = {
        "box": rooms.standing_box(-0.06, 0.15, (0.130, 0.090, 0.090), 24.0, rooms.CARDBOARD),
        "small_box": rooms.standing_box(
            -0.045, 0.145, (0.064, 0.044, 0.044), 52.0, (0.10, 0.30, 0.12), z_m=0.0895
        ),
        "mug": rooms.mug(folder, rooms.standing(0.36, 0.12, turn_deg=-35)),
    }
    return (
        rooms.wooden_table()
        | rooms.back_wall()
        | rooms.left_wall()
        | rooms.book(0.19, 0.20, -14.0, (0.62, 0.045, 0.035))
        | things
    )


SCENE = BenchmarkScene(
    name="tabletop",
    title="Tabletop: matte, glossy and metal objects",
    world_from_camera=(looking((0.23, -0.38, 0.29), (0.165, -0.02, 0.045)),),
    real=_real,
    objects=(
        VirtualObject(
            "matte",
            lambda: rabbit(0.14),
            Finish((0.62, 0.24, 0.10), specular=0.0),
            (rooms.standing(0.10, 0.095, turn_deg=25),),
        ),
        VirtualObject(
            "glossy", pawn, Finish((0.03, 0.20, 0.50), roughness=0.25), (rooms.standing(0.27, 0.00),)
        ),
        VirtualObject(
            "metal",
            ball,
            Finish((0.93, 0.72, 0.40), roughness=0.3, metallic=1.0),
            (rooms.standing(0.20, -0.115, 0.0),),
        ),
    ),
    lamps=(LAMP, Ambient(0.22, (0.88, 0.95, 1.0))),
)
