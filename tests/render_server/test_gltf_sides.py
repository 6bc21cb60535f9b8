"""Surfaces of glTF files from behind: a single-sided one is not seen (as Khronos' TextureSettingsTest has it)."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.benchmarks.gltf_plate import Plate
from deltalight.protocol.scene_objects import Surface
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.gltf_plates import CENTRE, INSIDE, plate, seen_from_above
from tests.render_server.scenes import (
    COARSE,
    ObjectsRenderer,
    Stage,
    ambient,
    array_of,
    depth_image,
    directional,
    floor_depth,
    frame,
    look_at,
    unlit,
)

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


SEEN_IN_MIRROR: dict[str, tuple[dict[str, list[int]], dict[str, object], bool]] = {  # node, material, seen
    "front": (TURNED, {}, True),
    "back": ({}, {}, False),
    "back of two": ({}, {"doubleSided": True}, True),
    "back of glass": ({}, {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 1}}}, True),
}


@pytest.mark.parametrize("case", SEEN_IN_MIRROR)
def test_a_mirror_below_shows_no_more_of_a_plate_than_is_seen_from_there(
    gpu: GpuContext, tmp_path: Path, case: str
) -> None:
    """A floor of silver under a plate that faces up or down. Light leaves bodies of glass by their backs."""
    node, material, is_seen = SEEN_IN_MIRROR[case]
    path = matt(plate(), **material).write(tmp_path / "plate.glb", {**node, "translation": [0, 0, 0.2]})
    document = Stage(tmp_path, COARSE).document([{"asset": str(path), "up_axis": "z"}], [ambient(0.2)])
    plane = {"point_m": [0, 0, 0], "normal": [0, 0, 1], "tolerance_m": 0.02}
    silver = {"region": {"plane": plane}, "metallic": 1.0, "albedo": [0.9] * 3, "roughness": 0.02}
    real = document.real.model_copy(update={"surfaces": (Surface.model_validate(silver),)})
    renderer = SceneRenderer(gpu, document.replaced(real=real))
    renderer.render(frame(depth=depth_image(floor_depth(look_at()).astype(np.float32))))
    assert renderer.graph is not None
    share = array_of(renderer.graph["reflections"])[..., 3]
    renderer.release()
    assert (share > 0).sum() > 100 if is_seen else not share.any()
