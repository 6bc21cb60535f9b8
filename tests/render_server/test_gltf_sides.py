"""Surfaces of glTF files from behind: a single-sided one is not seen (as Khronos' TextureSettingsTest has it)."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.benchmarks.gltf_plate import Plate
from tests.render_server.gltf_plates import CENTRE, INSIDE, plate, seen_from_above
from tests.render_server.scenes import ObjectsRenderer, Stage, directional, unlit

pytestmark = pytest.mark.usefixtures("clean_gl")
TURNED = {"rotation": [0, 1, 0, 0]}  # by half a turn about y, so that it faces down
CASES: dict[str, tuple[dict[str, list[int]], bool, bool]] = {  # node, double-sided, seen
    "front": ({}, False, True),
    "back": (TURNED, False, False),
    "back of two": (TURNED, True, True),
    "mirrored front": ({"scale": [-1, 1, 1]}, False, True),
}


def shown(
    objects: ObjectsRenderer, path: Path, *, antialiased: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Picture and coverage of a file's plate from above."""
    document = unlit(Stage(path.parent).document([{"asset": str(path), "up_axis": "z"}], [directional()]))
    output = document.output.model_copy(update={"antialiasing": antialiased})
    color = objects.draw(document.replaced(output=output), seen_from_above()).color
    return color, objects.newest_coverage()


def matt(made: Plate, **material: object) -> Plate:
    made.material |= {"pbrMetallicRoughness": {"metallicFactor": 0}, **material}
    return made


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("mode", ["OPAQUE", "BLEND"])
@pytest.mark.parametrize("case", CASES)
def test_a_single_sided_plate_is_not_seen_from_behind(
    objects: ObjectsRenderer, tmp_path: Path, case: str, mode: str, antialiased: bool
) -> None:
    node, is_double, is_seen = CASES[case]
    made = matt(plate(), doubleSided=is_double, alphaMode=mode)
    color, coverage = shown(objects, made.write(tmp_path / "plate.glb", node), antialiased=antialiased)
    if is_seen:
        assert coverage[INSIDE].min() == 1
    else:
        assert coverage.max() == 0
        assert np.array_equal(color, seen_from_above().color)


def test_what_lies_behind_a_hidden_back_is_seen(objects: ObjectsRenderer, tmp_path: Path) -> None:
    """The back of a red plate hides nothing of the grey one below it; both glow and reflect nothing."""
    things = []
    for name, glow, node in (
        ("grey", [0.5, 0.5, 0.5], {}),
        ("red", [1, 0, 0], {**TURNED, "translation": [0, 0, 0.1]}),
    ):
        made = plate()
        made.material |= {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "emissiveFactor": glow}
        things.append({"asset": str(made.write(tmp_path / f"{name}.glb", node)), "up_axis": "z"})
    both, alone = (
        objects.draw(unlit(Stage(tmp_path).document(some, [])), seen_from_above()).color[CENTRE].astype(int)
        for some in (things, things[:1])
    )
    assert alone.min() > 100
    assert np.abs(both - alone).max() <= 1
