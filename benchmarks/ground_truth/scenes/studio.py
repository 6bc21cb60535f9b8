"""Product photograph: a large panel to the left, a spot from the right."""

from typing import Any

from deltalight.benchmarks.ground_truth import rooms
from deltalight.benchmarks.ground_truth.benchmark_scene import (
    TABLE_Z_M,
    BenchmarkScene,
    Finish,
    VirtualObject,
)
from deltalight.benchmarks.ground_truth.lamps import Ambient, Panel, Spot
from deltalight.benchmarks.ground_truth.meshes import vase
from deltalight.benchmarks.ground_truth.parts import MeshFolder, looking

PANEL = Panel((-0.45, -0.35, 0.60), (0.0, 0.5, 0.0), (0.282, 0.0, 0.282), 9.0, (0.94, 0.97, 1.0))
"""Half a metre by 40 cm; leans over the table at 45 degrees."""
SPOT = Spot((0.95, -0.60, 0.75), (-0.72, 0.62, -0.72), 3.2, 26.0, 0.5, (1.0, 0.86, 0.66))


def _real(folder: MeshFolder) -> dict[str, Any]:
    things = {
        "plinth": rooms.standing_box(0.03, 0.14, (0.10, 0.10, 0.04), 15.0, (0.60, 0.60, 0.62)),
        "mug": rooms.mug(folder, rooms.standing(0.03, 0.14, TABLE_Z_M + 0.04, -35), (0.62, 0.20, 0.12)),
    }
    return rooms.plain_table((0.60, 0.58, 0.56), 13) | rooms.back_wall((0.62, 0.60, 0.58)) | things


SCENE = BenchmarkScene(
    name="studio",
    title="Studio: panel and spot",
    world_from_camera=(looking((0.215, -0.37, 0.29), (0.165, 0.01, 0.055)),),
    real=_real,
    objects=(
        VirtualObject(
            "vase",
            vase,
            Finish((0.06, 0.30, 0.28), roughness=0.3),
            (rooms.standing(0.225, 0.065),),
        ),
    ),
    lamps=(PANEL, SPOT, Ambient(0.08)),
)
