"""Surfaces with two sides do not take the voxels that hold both for something before them (docs/method.md 4.5)."""

from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.render_server.gpu.context import GpuContext
from tests.render_server.scenes import Fields, Stage, ambient, ball, cube, floor, frame, look_at, plain, solve

pytestmark = pytest.mark.usefixtures("clean_gl")
AROUND = 0.3  # radiance from everywhere
HEIGHT = 0.1  # m, of the plate
FAR_FLOOR = floor().apply_translation((0, 0, -1))
ABOVE = look_at((0.15, -0.5, 0.5), (0, 0, HEIGHT))
UPRIGHT = trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0))  # +z up to +y up, as in glTF


@pytest.fixture
def stage(tmp_path: Any) -> Stage:  # noqa: ANN401
    return Stage(tmp_path, {"volume_size": 64})


def thing(stage: Stage, mesh: trimesh.Trimesh, *, two_sided: bool = True, **material: Any) -> dict[str, Any]:  # noqa: ANN401
    """An object of a glTF file, matt and of albedo 0.8 unless `material` says otherwise."""
    matt = {"baseColorFactor": (0.8, 0.8, 0.8, 1.0), "metallicFactor": 0.0, "roughnessFactor": 1.0}
    turned = mesh.copy().apply_transform(UPRIGHT)
    turned.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(doubleSided=two_sided, **{**matt, **material})
    )
    stage.count += 1
    path = stage.folder / f"thing{stage.count}.glb"
    turned.export(path)
    return {"asset": str(path)}


def plate(lean: float = 0.0, *, down: bool = False) -> trimesh.Trimesh:
    """A square of 0.3 m that faces up, or down, leaning by an angle (rad)."""
    corners = [(-0.15, -0.15, 0), (0.15, -0.15, 0), (0.15, 0.15, 0), (-0.15, 0.15, 0)]
    square = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    if down:
        square.invert()
    square.apply_transform(trimesh.transformations.rotation_matrix(lean, (1, 0, 0)))
    return square.apply_translation((0, 0, HEIGHT))


def seen(gpu: GpuContext, stage: Stage, objects: list[dict[str, Any]], radiance: float = AROUND) -> Fields:
    """From above, in light from everywhere but below."""
    lights = [ambient(radiance)] if radiance else []
    return solve(gpu, stage.document(objects, lights, FAR_FLOOR), frame(plain(0), pose=ABOVE))


@pytest.mark.parametrize("lean", [0.0, 0.6])
@pytest.mark.parametrize("down", [False, True], ids=["front", "back"])
def test_either_side_of_a_plate_gets_all_the_light(
    gpu: GpuContext, stage: Stage, lean: float, down: bool
) -> None:
    found = seen(gpu, stage, [thing(stage, plate(lean, down=down))])
    share = found.on_object[found.matte == 1] / (np.pi * AROUND)
    print(f"a plate that leans by {lean}: {share.mean():.3f} of the light, least {share.min():.3f}")
    assert share.mean() == pytest.approx(1, abs=0.02)
    assert share.min() > 0.95


@pytest.mark.parametrize("lean", [0.0, 0.6])
def test_a_plate_does_not_light_itself(gpu: GpuContext, stage: Stage, lean: float) -> None:
    """A glowing one in the dark shows its glow alone."""
    found = seen(gpu, stage, [thing(stage, plate(lean), emissiveFactor=(0.4, 0.4, 0.4))], 0.0)
    radiance = found.virtual_radiance[found.matte == 1]
    print(f"a plate of glow 0.4 that leans by {lean}: {radiance.mean():.3f}")
    assert radiance.mean() == pytest.approx(0.4, abs=0.006)


def test_a_smooth_plate_mirrors_the_light_around(gpu: GpuContext, stage: Stage) -> None:
    metal = {"baseColorFactor": (1.0, 1.0, 1.0, 1.0), "metallicFactor": 1.0, "roughnessFactor": 0.2}
    radiances = [
        seen(gpu, stage, [thing(stage, plate(), two_sided=two_sided, **metal)]) for two_sided in (False, True)
    ]
    one, two = (found.virtual_radiance[found.matte == 1].mean() for found in radiances)
    print(f"a metal plate: {two:.4f}, with one side {one:.4f}, around {AROUND}")
    assert two == pytest.approx(one, rel=0.01)


@pytest.mark.parametrize(
    "closed",
    [
        cube(0.16),
        ball(0.08, (0, 0, 0.08)),
        trimesh.creation.cylinder(0.1, 0.06).apply_translation((0, 0, 0.05)),
    ],
    ids=["cube", "ball", "cylinder"],
)
def test_a_closed_body_is_lit_as_one_of_one_sided_faces(
    gpu: GpuContext, stage: Stage, closed: trimesh.Trimesh
) -> None:
    one, two = (seen(gpu, stage, [thing(stage, closed, two_sided=sided)]) for sided in (False, True))
    inside = one.matte == 1
    apart = np.abs(two.on_object - one.on_object)[inside] / (np.pi * AROUND)
    print(f"r.m.s. {np.sqrt(np.mean(apart**2)):.4f} of the light, most {apart.max():.3f}")
    assert np.sqrt(np.mean(apart**2)) < 0.01
    assert apart.max() < 0.05


def test_what_touches_a_plate_still_shades_it(gpu: GpuContext, stage: Stage) -> None:
    """A ball that stands on it takes as much light as from a plate with one side, next to where they touch too."""
    black = stage.virtual(ball(0.06, (0, 0, HEIGHT + 0.06)), (0, 0, 0))
    one, two = (seen(gpu, stage, [thing(stage, plate(), two_sided=sided), black]) for sided in (False, True))
    on_plate = (one.matte == 1) & (one.virtual_radiance[..., 1] > 0)
    apart = np.abs(two.on_object - one.on_object)[on_plate] / (np.pi * AROUND)
    print(f"r.m.s. {np.sqrt(np.mean(apart**2)):.4f} of the light, most {apart.max():.3f}")
    assert apart.max() < 0.06
