"""The benchmark's scenes, one per file: those of all tables, and those of single materials."""

import difflib

from deltalight.benchmarks.ground_truth.benchmark_scene import BenchmarkScene
from deltalight.benchmarks.ground_truth.scenes import (
    concave_box,
    cornell,
    glass,
    glossy_table,
    hidden_in_shadow,
    mirror_table,
    moving,
    natural_light,
    studio,
    tabletop,
    two_lights,
)
from deltalight.protocol.errors import DeltalightError

SCENES: tuple[BenchmarkScene, ...] = (
    tabletop.SCENE,
    glossy_table.SCENE,
    mirror_table.SCENE,
    natural_light.SCENE,
    cornell.SCENE,
    concave_box.SCENE,
    two_lights.SCENE,
    hidden_in_shadow.SCENE,
    moving.SCENE,
    studio.SCENE,
)
MATERIAL_SCENES: tuple[BenchmarkScene, ...] = (glass.SCENE,)
"""Of materials that SCENES lack; rendered only where they are named."""


def scene_named(name: str) -> BenchmarkScene:
    """Returns a scene.

    Raises:
        DeltalightError: there is none; names the known ones and the nearest.
    """
    known = {scene.name: scene for scene in (*SCENES, *MATERIAL_SCENES)}
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        advice = f"did you mean `{near[0]}`? There are" if near else "use one of"
        raise DeltalightError(f"There is no benchmark scene `{name}`; {advice} {', '.join(known)}.")
    return known[name]
