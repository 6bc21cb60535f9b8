"""Alpha of glTF materials as it is drawn, of textures and vertices: masked and blended, in shadows and rays too."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deltalight.benchmarks.gltf_plate import Plate, even
from deltalight.protocol.scene_objects import Surface
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.gltf_plates import INSIDE, LEFT, RIGHT, WIDE, plate, seen_from_above
from tests.render_server.scenes import (
    WIDTH,
    ObjectsRenderer,
    Stage,
    ambient,
    array_of,
    directional,
    fields_of,
    floor,
    frame,
    solve,
    unlit,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
FLOOR = {"plane": {"point_m": [0, 0, 0], "normal": [0, 0, 1], "tolerance_m": 0.02}}


def masked(mode: str, codes: np.ndarray, **alpha: Any) -> Plate:  # noqa: ANN401
    """A white plate, its alpha from a texture."""
    made = plate()
    made.material |= {
        "alphaMode": mode,
        "pbrMetallicRoughness": {"metallicFactor": 0, "baseColorTexture": made.texture(codes)},
        **alpha,
    }
    return made


def with_alpha(left: int, right: int) -> np.ndarray:
    codes = even(255, 255, 255, left, size=8)
    codes[:, 4:, 3] = right
    return codes


ALPHA: list[tuple[str, dict[str, Any], list[float]]] = [
    ("OPAQUE", {}, [1, 1]),
    ("MASK", {}, [1, 0]),
    ("MASK", {"alphaCutoff": 0.7}, [0, 0]),
    ("MASK", {"alphaCutoff": 0.2}, [1, 1]),
    ("BLEND", {}, [0.6, 0.3]),
]


@pytest.mark.parametrize("case", ALPHA)
@pytest.mark.parametrize("antialiased", [False, True])
def test_alpha_shows_the_cameras_own_picture(
    objects: ObjectsRenderer, tmp_path: Path, case: tuple[str, dict[str, Any], list[float]], antialiased: bool
) -> None:
    """A mask keeps what its cutoff says; what is blended covers pixels by alpha, exactly on average."""
    mode, alpha, expected = case
    path = masked(mode, with_alpha(153, 77), **alpha).write(tmp_path / "plate.glb")
    document = unlit(Stage(tmp_path).document([{"asset": str(path), "up_axis": "z"}], [directional()]))
    output = document.output.model_copy(update={"antialiasing": antialiased})
    view = seen_from_above()
    shown = objects.draw(document.replaced(output=output), view).color
    covered = objects.newest_coverage()
    found = [float(covered[half].mean()) for half in (LEFT, RIGHT)]
    assert found == pytest.approx(expected, abs=0.02)
    open_pixels = covered == 0
    assert np.array_equal(shown[open_pixels], view.color[open_pixels])
    if mode == "BLEND" and antialiased:
        assert covered[LEFT].std() < 0.07, "eight samples a pixel differ by no more than one"


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_alpha_of_vertex_colours_blends(
    objects: ObjectsRenderer, tmp_path: Path, antialiased: bool
) -> None:
    """From 0.2 at the left edge to 1 at the right, times the factor."""
    made = plate()
    made.attributes["COLOR_0"] = made.glb.floats([(1, 1, 1, alpha) for alpha in (0.2, 1, 1, 0.2)])
    made.material |= {"alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.75]}}
    asset = {"asset": str(made.write(tmp_path / "plate.glb")), "up_axis": "z"}
    document = unlit(Stage(tmp_path).document([asset], [directional()]))
    output = document.output.model_copy(update={"antialiasing": antialiased})
    covered = objects.coverage(document.replaced(output=output), seen_from_above())
    for half in (LEFT, RIGHT):
        x = (half[1].start + half[1].stop - 1) / 2 - (WIDTH - 1) / 2
        wanted = 0.75 * (0.2 + 0.8 * (0.5 + x / WIDE))
        assert covered[half].mean() == pytest.approx(wanted, abs=0.02)


VERTEX_MASKS = [
    (0.9, 0.5, None),
    (0.9, 0.3, None),
    (1.0, 0.5, 153),
    (0.6, 0.2, 153),
]  # factor, cutoff, texture


@pytest.mark.parametrize("case", VERTEX_MASKS)
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_alpha_of_vertex_colours_masks(
    objects: ObjectsRenderer, tmp_path: Path, case: tuple[float, float, int | None], antialiased: bool
) -> None:
    """From 0 at the left edge to 1 at the right, times factor and texture: there from the cutoff on."""
    factor, cutoff, texture = case
    made = plate()
    made.attributes["COLOR_0"] = made.glb.floats([(1, 1, 1, alpha) for alpha in (0, 1, 1, 0)])
    pbr: dict[str, Any] = {"baseColorFactor": [1, 1, 1, factor]}
    if texture is not None:
        pbr["baseColorTexture"] = made.texture(even(255, 255, 255, texture))
    made.material |= {"alphaMode": "MASK", "alphaCutoff": cutoff, "pbrMetallicRoughness": pbr}
    asset = {"asset": str(made.write(tmp_path / "plate.glb")), "up_axis": "z"}
    document = unlit(Stage(tmp_path).document([asset], [directional()]))
    output = document.output.model_copy(update={"antialiasing": antialiased})
    covered = objects.coverage(document.replaced(output=output), seen_from_above())[INSIDE]
    x = np.arange(64) + 0.5 - 32
    alpha = factor * (0.5 + x / WIDE) * (1.0 if texture is None else texture / 255)
    sure = np.abs(alpha - cutoff) > 1.5 * factor / WIDE
    expected = np.broadcast_to(alpha >= cutoff, covered.shape)
    assert np.array_equal(covered[:, sure] > 0.5, expected[:, sure])


def cleared(mode: str, edge: float, color: float) -> Plate:
    """Seen from both sides; the alpha of its vertices goes from 1 at the left edge to 0 at the right."""
    made = Plate(edge, edge)
    made.attributes["COLOR_0"] = made.glb.floats([(color, color, color, alpha) for alpha in (1, 0, 0, 1)])
    made.material |= {
        "alphaMode": mode,
        "doubleSided": True,
        "pbrMetallicRoughness": {"metallicFactor": 0},
    }
    return made


def light_below_halves(gpu: GpuContext, folder: Path, made: Plate) -> tuple[list[float], list[float]]:
    """Shares of the lamp's and of the sky's light that a plate above a floor leaves below its left and right half."""
    asset = {
        "asset": str(made.write(folder / "plate.glb")),
        "up_axis": "z",
        "pose": {"translation_m": [0, 0, 0.1]},
    }
    lights = [directional((0, 0, -1), 2.0), ambient(0.3)]
    found = solve(gpu, Stage(folder).document([asset], lights, floor()), frame(depth=None))
    lit, sky = [], []
    for x in (-0.06, 0.06):
        near = np.abs(found.position[..., :3] - (x, 0, 0)).max(axis=-1) < 0.03
        near &= (found.position[..., 3] > 0) & (found.matte == 0)
        lit.append(float(found.direct_rho[near].sum() / found.direct_mu[near].sum()))
        sky.append(float(found.cones_rho[near].sum() / found.cones_mu[near].sum()))
    return lit, sky


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
def test_light_falls_through_vertices_that_a_mask_leaves_out(
    gpu: GpuContext, tmp_path: Path, mode: str
) -> None:
    """Below the clear half the floor is lit as if nothing was there; ambient light comes in through it."""
    lit, sky = light_below_halves(gpu, tmp_path, cleared(mode, 0.24, 0.0))
    assert lit == pytest.approx([0.0, 1.0] if mode == "MASK" else [0.25, 0.75], abs=0.04)
    assert sky[0] < (0.8 if mode == "MASK" else 0.93) * sky[1]


def test_light_falls_through_clear_vertices(gpu: GpuContext, tmp_path: Path) -> None:
    """A blended plate whose vertices have a quarter of alpha casts a quarter of a shadow."""
    made = Plate(0.24, 0.24)
    made.attributes["COLOR_0"] = made.glb.floats([(0, 0, 0, 0.25)] * 4)
    made.material |= {
        "alphaMode": "BLEND",
        "doubleSided": True,
        "pbrMetallicRoughness": {"metallicFactor": 0},
    }
    asset = {"asset": str(made.write(tmp_path / "plate.glb")), "pose": {"translation_m": [0, 0, 0.1]}}
    document = Stage(tmp_path).document([asset | {"up_axis": "z"}], [directional((0, 0, -1), 2.0)], floor())
    found = solve(gpu, document, frame(depth=None))
    near = np.abs(found.position[..., :3]).max(axis=-1) < 0.05
    near &= found.position[..., 3] > 0
    lit = found.direct_rho[near].sum() / found.direct_mu[near].sum()
    assert lit == pytest.approx(0.75, abs=0.04)


def half_open(edge: float, color: float) -> Plate:
    """Seen from both sides; its right half is not there."""
    made = Plate(edge, edge)
    made.material |= {
        "alphaMode": "MASK",
        "doubleSided": True,
        "pbrMetallicRoughness": {
            "baseColorFactor": [color, color, color, 1],
            "metallicFactor": 0,
            "baseColorTexture": made.texture(with_alpha(255, 0)),
        },
    }
    return made


def test_light_falls_through_the_holes_of_a_mask(gpu: GpuContext, tmp_path: Path) -> None:
    """On the floor below the plate only the left half is in its shadow; and ambient light falls through the hole."""
    lit, sky = light_below_halves(gpu, tmp_path, half_open(0.24, 0.0))
    assert lit == pytest.approx([0.0, 1.0], abs=0.02)
    assert sky[0] < 0.8 * sky[1]


@pytest.mark.parametrize("by_vertices", [False, True])
def test_rays_pass_the_holes_of_a_mask(gpu: GpuContext, tmp_path: Path, by_vertices: bool) -> None:
    """A mirror on the floor shows the plate's kept half, and nothing of its open half."""
    made = cleared("MASK", 0.3, 1.0) if by_vertices else half_open(0.3, 1.0)
    stage = Stage(tmp_path)
    stands = {"translation_m": [0, 0.2, 0.15], "rotation_wxyz": [np.sqrt(0.5), np.sqrt(0.5), 0, 0]}
    asset = {"asset": str(made.write(tmp_path / "plate.glb")), "up_axis": "z", "pose": stands}
    document = stage.document([asset], [directional((0, 0.6, -0.8))], floor())
    silver = Surface.model_validate(
        {"region": FLOOR, "metallic": 1.0, "albedo": [0.9] * 3, "roughness": 0.02}
    )
    renderer = SceneRenderer(gpu, document.replaced(real=document.real.replaced(surfaces=(silver,))))
    renderer.render(frame())
    assert renderer.graph is not None
    hidden = array_of(renderer.graph["reflections"])[..., 3]
    position = fields_of(renderer).position
    renderer.release()
    at = [
        (np.abs(position[..., :2] - (x, 0.1)).max(axis=-1) < 0.04) & (position[..., 3] > 0)
        for x in (-0.08, 0.08)
    ]
    kept, removed = (float(hidden[each].mean()) for each in at)
    assert kept > 0.8
    assert removed == 0
