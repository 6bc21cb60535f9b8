"""Objects that turn: volumes and real shadow maps stand still, and with them the light on the floor."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.volumes import VolumePlacement, place_volume
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.virtual_objects import VirtualObjects
from tests.render_server.scenes import (
    Stage,
    ambient,
    array_of,
    ball,
    cube,
    directional,
    fields_of,
    floor,
    frame,
    shifted,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
EDGE_M = 0.12
METHODS: dict[str, dict[str, Any]] = {
    "exact": {"volume_size": 32},
    "paper": {"volume_size": 32, "operator": "paper"},
    "dlpv": {"volume_size": 16, "query_scale": 1, "rsm_size": 256},
}


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def centred_cube(edge: float = EDGE_M) -> Any:  # noqa: ANN401 - a mesh of trimesh, which has no types
    return shifted(cube(edge), 0, 0, -edge / 2)


def turned(document: SceneDocument, degrees: float, axis: tuple[float, float, float]) -> SceneDocument:
    """The first object turned about its own middle, which is where its pose puts the origin."""
    half, unit = np.radians(degrees) / 2, np.array(axis) / np.linalg.norm(axis)
    first, *others = document.objects
    rotation = (float(np.cos(half)), *(float(v) for v in np.sin(half) * unit))
    pose = first.pose.replaced(rotation_wxyz=rotation)
    return document.replaced(objects=(first.replaced(pose=pose), *others))


def around(gpu: GpuContext, document: SceneDocument) -> tuple[VolumePlacement, np.ndarray]:
    """The volume around the objects, and the share of its edge that they keep from its border (low and high)."""
    objects = VirtualObjects(gpu)
    objects.load(document.objects)
    state = objects.update(document.objects, None, 0)
    assert state is not None
    extent = state.extent
    placed = place_volume(extent.upright[0], extent.upright[1], 64, extent.volume_edge)
    edge, origin = 64 * placed.voxel_edge, np.array(placed.origin)
    low, high = extent.bounds
    objects.release()
    return placed, np.array([low - origin, origin + edge - high]) / edge


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 2.0, 3.0)])
def test_the_volume_stands_still_while_an_object_turns_and_encloses_it(
    gpu: GpuContext, stage: Stage, axis: tuple[float, float, float]
) -> None:
    """Twice the cube's edge, whatever its turn; a second object makes the volume larger but no less still."""
    pose = {"translation_m": [0.02, 0.0, 0.1]}
    first = stage.virtual(centred_cube(), pose=pose)
    other = stage.virtual(ball(0.05, (0.2, 0.05, 0.05)))
    for objects, edge in (([first], 2 * EDGE_M), ([first, other], 2 * (0.25 - 0.02 + EDGE_M / 2))):
        document = stage.document(objects, [ambient(0.2)])
        volumes = [around(gpu, turned(document, degrees, axis)) for degrees in range(0, 180, 17)]
        assert 64 * volumes[0][0].voxel_edge == pytest.approx(edge, rel=1e-3)
        for placed, clearance in volumes:
            assert np.allclose(placed.origin, volumes[0][0].origin, atol=1e-9)
            assert placed.voxel_edge == pytest.approx(volumes[0][0].voxel_edge, rel=1e-12)
            assert clearance.min() > 0.06


def test_the_volume_grows_where_several_objects_turn_out_of_it(gpu: GpuContext, stage: Stage) -> None:
    """A rod along x beside a ball, turned to point away from it: it keeps a single object's clearance to a voxel."""
    rod = shifted(cube(1.0), 0, 0, -0.5)
    rod.apply_scale((0.5, 0.02, 0.02))
    objects = [stage.virtual(rod), stage.virtual(ball(0.02, (0.0, -0.45, 0.0)))]
    for degrees in (0.0, 90.0):
        _, clearance = around(gpu, turned(stage.document(objects, [ambient(0.2)]), degrees, (0, 0, 1)))
        assert clearance.min() > 0.06 - 1 / 64


@pytest.mark.parametrize("name", METHODS)
def test_a_cube_that_turns_by_a_degree_changes_the_floors_light_by_less_than_half_a_percent(
    gpu: GpuContext, stage: Stage, name: str
) -> None:
    """99 of 100 pixels of the floor, from frame to frame. Light of the real scene alone stays the same to the bit.

    But for pixels beside the object, which share cones with it.
    """
    thing = stage.virtual(centred_cube(), (0.7, 0.3, 0.2), pose={"translation_m": [0.0, 0.0, 0.07]})
    lights = [directional((0.3, 0.2, -1.0), 2.0, 2.0), ambient(0.3)]
    settings = {**METHODS[name], "volume_edge_m": None}
    document = stage.document([thing], lights, floor(), **({} if name == "dlpv" else settings))
    if name == "dlpv":
        document = document.replaced(method=DlpvMethod.model_validate({"name": name, **settings}))
    renderer = SceneRenderer(gpu, document)
    seen = []
    for degrees in (1.0, 2.0, 3.0):
        renderer.set_scene(turned(document, degrees, (0, 0, 1)))
        renderer.render(frame())
        fields = fields_of(renderer)
        seen.append((fields.cones_mu, fields.cones_rho, (fields.normal[..., 2] > 0.9) & (fields.matte == 0)))
    renderer.release()
    for (mu, rho, on_floor), (next_mu, next_rho, next_on_floor) in pairwise(seen):
        floor_pixels = on_floor & next_on_floor
        change = np.abs(next_rho - rho)[floor_pixels].mean(axis=1) / rho[floor_pixels].mean(axis=1)
        assert np.percentile(change, 99) < 0.005
        assert change.max() > 0
        assert np.mean(next_mu[floor_pixels] == mu[floor_pixels]) > 0.999


def test_the_real_scenes_shadow_maps_stand_still_while_an_object_turns(gpu: GpuContext, stage: Stage) -> None:
    thing = stage.virtual(centred_cube(), pose={"translation_m": [0.0, 0.0, 0.07]})
    document = stage.document([thing], [directional((0.3, 0.2, -1.0))], floor(), volume_size=32)
    renderer = SceneRenderer(gpu, document)
    maps = []
    for degrees in (0.0, 30.0):
        renderer.set_scene(turned(document, degrees, (0, 0, 1)))
        renderer.render(frame())
        assert renderer.graph is not None
        lit = renderer.graph["shadow maps real"]
        maps.append((lit.real_records, array_of(lit.real_atlas.depth)))
    renderer.release()
    assert maps[0][0] == maps[1][0]
    np.testing.assert_array_equal(maps[0][1], maps[1][1])
