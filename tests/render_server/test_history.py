"""What a picture shows does not depend on the frames before it, bit for bit."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_objects import Pose, Surface
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.volumes import VolumePlacement
from deltalight.render_server.renderer import CompositeFrame, SceneRenderer
from tests.render_server.scenes import (
    Stage,
    Vector,
    ambient,
    ball,
    checkered,
    cube,
    depth_image,
    floor,
    floor_depth,
    frame,
    look_at,
    shifted,
    sphere_light,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
HERE, ASIDE = (0.25, -0.9, 0.65), (0.3, -0.9, 0.63)
FLOOR = {"plane": {"point_m": [0, 0, 0], "normal": [0, 0, 1], "tolerance_m": 0.02}}
LEFT_OF_FLOOR = {"box": {"min_m": [-3, -3, -0.02], "max_m": [-0.02, 3, 0.02]}}


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def seen(eye: Vector) -> ViewFrame:
    pose = look_at(eye)
    return frame(checkered(), pose=pose, depth=depth_image(floor_depth(pose)))


def room(stage: Stage, *, has_model: bool, **method: object) -> SceneDocument:
    """Two objects on a floor, half of it glossy and half a mirror, with antialiasing.

    In the model, a wall and an object throw soft shadows on a face that the camera does not see. Shadows of the low
    lamp cross the border of the volume.
    """
    wall = shifted(trimesh.creation.box((0.6, 0.01, 0.05)), 0, -0.085, 0.025)
    behind = cube(0.1, (-0.05, -0.16, 0))
    objects = [
        stage.virtual(ball(), (0.8, 0.2, 0.1), {"roughness": 0.4, "specular": 0.5}),
        stage.virtual(cube(0.08, (0.12, 0.08, 0)), (0.2, 0.7, 0.2)),
    ]
    lamps = [
        sphere_light((0.6, -0.4, 0.25), 1.0, 0.02),
        sphere_light((0.5, -0.4, 0.9), 1.0, 0.05),
        sphere_light((-0.1, 0.9, 0.5), 4.0, 0.1),
    ]
    real = trimesh.util.concatenate([floor(), wall, behind]) if has_model else None
    method = {"volume_edge_m": None, "cone_scale": 2, "cone_count": 8, "shadow_samples": 4, **method}
    document = stage.document(objects, [*lamps, ambient(0.15)], real, **method)
    return document.replaced(
        real=document.real.model_copy(
            update={"surfaces": (glossy(LEFT_OF_FLOOR, 0.45), glossy(FLOOR, 0.05))}
        ),
        output=document.output.model_copy(update={"antialiasing": True, "width": 80}),
    )


def glossy(region: dict[str, Any], roughness: float) -> Surface:
    return Surface.model_validate({"region": region, "albedo": [0.4] * 3, "roughness": roughness})


def moved(document: SceneDocument, by: Vector) -> SceneDocument:
    """The same with all objects moved by so much."""
    pose = Pose(translation_m=by)
    return document.replaced(objects=tuple(one.model_copy(update={"pose": pose}) for one in document.objects))


def fresh(gpu: GpuContext, document: SceneDocument, view: ViewFrame) -> CompositeFrame:
    renderer = SceneRenderer(gpu, document, with_linear=True)
    found = renderer.render(view)
    renderer.release()
    return found


def placement_of(renderer: SceneRenderer) -> VolumePlacement:
    assert renderer.graph is not None
    (placement,) = renderer.graph["volume placement"]
    assert isinstance(placement, VolumePlacement)
    return placement


def differing_pixels(one: CompositeFrame, other: CompositeFrame) -> int:
    assert one.linear is not None
    assert other.linear is not None
    differs = (one.color != other.color) | (one.linear != other.linear)
    return int(np.count_nonzero(differs.any(axis=-1)))


@pytest.mark.slow(seconds=20)
@pytest.mark.parametrize("has_model", [True, False], ids=["model", "depth"])
@pytest.mark.parametrize("operator", ["exact", "paper"])
def test_a_camera_that_steps_aside_and_back(
    gpu: GpuContext, stage: Stage, operator: str, has_model: bool
) -> None:
    document = room(stage, has_model=has_model, operator=operator)
    renderer = SceneRenderer(gpu, document, with_linear=True)
    first, aside, back = (renderer.render(seen(eye)) for eye in (HERE, ASIDE, HERE))
    renderer.release()
    assert differing_pixels(first, aside) > 250
    assert differing_pixels(first, back) == 0
    assert differing_pixels(aside, fresh(gpu, document, seen(ASIDE))) == 0


@pytest.mark.slow
@pytest.mark.parametrize("by", [(-0.06, 0.0, 0.0), (-0.07, 0.0, 0.0), (0.15, -0.1, 0.0)])
def test_an_object_that_moves_leaves_nothing(gpu: GpuContext, stage: Stage, by: Vector) -> None:
    start = room(stage, has_model=False, operator="exact", volume_edge_m=0.5)
    end = moved(start, by)
    renderer = SceneRenderer(gpu, start, with_linear=True)
    renderer.render(seen(HERE))
    renderer.set_scene(end)
    found = renderer.render(seen(HERE))
    renderer.release()
    assert differing_pixels(found, fresh(gpu, end, seen(HERE))) == 0


@pytest.mark.parametrize("operator", [pytest.param("exact", marks=pytest.mark.slow), "paper"])
def test_an_object_that_moves_less_than_a_voxel(gpu: GpuContext, stage: Stage, operator: str) -> None:
    """The volume stays where it is, but not what may receive the objects' shadows, nor the light maps around it."""
    start = room(stage, has_model=True, operator=operator, volume_edge_m=0.5)
    end = moved(start, (-0.002, -0.003, 0.0))
    renderer = SceneRenderer(gpu, start, with_linear=True)
    placements = []
    for document in (start, end):
        renderer.set_scene(document)
        found = renderer.render(seen(HERE))
        placements.append(placement_of(renderer))
    renderer.release()
    assert placements[0] == placements[1]
    assert differing_pixels(found, fresh(gpu, end, seen(HERE))) == 0


def test_depth_that_begins_empty_is_taken_when_it_comes(gpu: GpuContext, stage: Stage) -> None:
    """A depth camera that starts shows no surface at first, while nothing in the room moves."""
    document = room(stage, has_model=False, operator="paper", volume_edge_m=0.5)
    good = seen(HERE)
    blind = frame(
        checkered(), pose=look_at(HERE), depth=depth_image(np.zeros_like(floor_depth(look_at(HERE))))
    )
    renderer = SceneRenderer(gpu, document)
    for _ in range(2):
        assert np.array_equal(renderer.render(blind).color, renderer.sized(blind).color)
    found = renderer.render(good)
    renderer.release()
    assert np.array_equal(found.color, fresh(gpu, document, good).color)
