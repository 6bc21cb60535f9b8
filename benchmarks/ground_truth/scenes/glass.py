"""Things of glass on a wooden table: a clear ball, and a block of green glass before what it bends."""

from typing import Any

from deltalight.benchmarks.ground_truth import rooms
from deltalight.benchmarks.ground_truth.benchmark_scene import (
    TABLE_Z_M,
    BenchmarkScene,
    Finish,
    VirtualObject,
)
from deltalight.benchmarks.ground_truth.lamps import Ambient, SphereLamp
from deltalight.benchmarks.ground_truth.meshes import ball, block
from deltalight.benchmarks.ground_truth.parts import MeshFolder, looking

MAX_DEPTH = 24
"""Segments. From the camera to the table below the block and on to the lamp light meets up to ten faces."""
GAP_M = 0.0005
"""Of air below the objects: faces that coincide with the table would be hit in either order."""
LAMP = SphereLamp((-0.16, -0.28, 0.47), 1.0, 0.12, (1.0, 0.95, 0.88))
"""Clear of the left wall: a lamp that the wall cuts is not the one that the document tells."""


def _real(folder: MeshFolder) -> dict[str, Any]:
    things = {
        "box": rooms.standing_box(0.10, 0.16, (0.130, 0.090, 0.090), 24.0, rooms.CARDBOARD),
        "mug": rooms.mug(folder, rooms.standing(0.34, 0.12, turn_deg=-35)),
    }
    return rooms.wooden_table() | rooms.back_wall() | rooms.left_wall() | things


SCENE = BenchmarkScene(
    name="glass",
    title="Glass: a clear ball and a green block",
    world_from_camera=(looking((0.23, -0.38, 0.25), (0.19, 0.0, 0.04)),),
    real=_real,
    objects=(
        VirtualObject(
            "ball",
            ball,
            Finish((1.0, 1.0, 1.0), roughness=0.0, transmission=1.0),
            (rooms.standing(0.12, -0.03, TABLE_Z_M + GAP_M),),
        ),
        VirtualObject(
            "block",
            lambda: block((0.06, 0.05, 0.07)),
            Finish((0.72, 0.95, 0.80), roughness=0.0, transmission=1.0),
            (rooms.standing(0.26, 0.0, TABLE_Z_M + GAP_M, turn_deg=28),),
        ),
    ),
    lamps=(LAMP, Ambient(0.22, (0.88, 0.95, 1.0))),
    max_depth=MAX_DEPTH,
)
