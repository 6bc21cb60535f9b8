"""What a pixel of the newest picture shows, against where things were put."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.picking import Pick
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.bvh import first_hit
from tests.render_server.scenes import (
    COARSE,
    HEIGHT,
    WIDTH,
    Stage,
    ambient,
    ball,
    camera,
    cube,
    depth_image,
    directional,
    everyday,
    floor,
    floor_depth,
    frame,
    look_at,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
BALL_AT, BALL_RADIUS = np.array([0.0, 0.0, 0.06]), 0.06
BOX_TOP = np.array([0.12, 0.08, 0.08])
FREE_FLOOR = np.array([0.15, -0.2, 0.0])
BENT = (-0.2, 0.05, 0.001, 0.001, 0.0)


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, COARSE)


def pixel_of(view: ViewFrame, point: np.ndarray, scale: float = 1.0) -> tuple[float, float]:
    """Where a world point appears in a composite `scale` times as large as the frame."""
    assert view.pose is not None
    inverse = np.linalg.inv(view.pose.world_from_camera)
    x, y = view.camera.project((inverse[:3, :3] @ point + inverse[:3, 3])[None])[0]
    return scale * (x + 0.5) - 0.5, scale * (y + 0.5) - 0.5


def picked(gpu: GpuContext, document: SceneDocument, view: ViewFrame, *points: np.ndarray) -> list[Pick]:
    """What is picked where world points appear in the rendered frame."""
    renderer = SceneRenderer(gpu, document)
    composite = renderer.render(view)
    scale = composite.color.shape[1] / view.color.shape[1]
    found = [renderer.pick(*pixel_of(view, point, scale)) for point in points]
    renderer.release()
    return found


def place_of(pick: Pick) -> tuple[np.ndarray, np.ndarray]:
    """Position and normal of what a pixel shows."""
    assert pick.point_m is not None
    assert pick.normal is not None
    return pick.point_m, pick.normal


def with_output(document: SceneDocument, **changes: object) -> SceneDocument:
    return document.replaced(output=document.output.replaced(**changes))


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes", [{}, {"antialiasing": True}, {"width": 320}, {"height": 60, "antialiasing": True}]
)
@pytest.mark.parametrize("distortion", [(0.0,) * 5, BENT], ids=["pinhole", "bent"])
def test_objects_and_the_real_scene_are_where_they_were_put(
    gpu: GpuContext, stage: Stage, distortion: tuple[float, ...], changes: dict[str, object]
) -> None:
    view = frame(camera=camera(distortion=distortion), frame_id=7)
    assert view.pose is not None
    eye = view.pose.world_from_camera[:3, 3]
    scene = with_output(everyday(stage), **changes)
    on_ball, on_box, on_floor = picked(gpu, scene, view, BALL_AT, BOX_TOP, FREE_FLOOR)
    pixel_m = 0.012 if changes.get("height") else 0.008  # what a pixel spans here, along the floor
    assert (on_ball.kind, on_ball.object_id, on_ball.frame_id) == ("object", "ball", 7)
    met, normal = place_of(on_ball)
    outward = (met - BALL_AT) / np.linalg.norm(met - BALL_AT)
    assert np.linalg.norm(met - BALL_AT) == pytest.approx(BALL_RADIUS, abs=0.002)
    assert normal @ outward > 0.99
    for pick, named, where in ((on_box, ("object", "box"), BOX_TOP), (on_floor, ("real", None), FREE_FLOOR)):
        assert (pick.kind, pick.object_id) == named
        met, normal = place_of(pick)
        np.testing.assert_allclose(met, where, atol=pixel_m)
        np.testing.assert_allclose(normal, (0, 0, 1), atol=1e-2)
    assert on_floor.distance_m == pytest.approx(np.linalg.norm(place_of(on_floor)[0] - eye))


def test_an_object_behind_a_real_thing_is_not_picked(gpu: GpuContext, stage: Stage) -> None:
    depth = floor_depth(look_at())
    x, y = (round(value) for value in pixel_of(frame(), BALL_AT))
    depth[y - 15 : y + 16, x - 15 : x + 16] = 0.5  # something stands before the ball
    document = stage.document([stage.virtual(ball(), id="ball")], [directional(), ambient(0.2)])
    (hidden,) = picked(gpu, document, frame(depth=depth_image(depth)), BALL_AT)
    assert (hidden.kind, hidden.object_id) == ("real", None)
    inverse = np.linalg.inv(look_at().world_from_camera)
    assert (inverse[:3, :3] @ hidden.point_m + inverse[:3, 3])[2] == pytest.approx(0.5, abs=1e-3)


def test_an_object_that_is_dragged_is_looked_through(gpu: GpuContext, stage: Stage) -> None:
    view = frame()
    renderer = SceneRenderer(gpu, everyday(stage))
    renderer.render(view)
    at = pixel_of(view, BALL_AT)
    behind, other = renderer.pick(*at, ignore="ball"), renderer.pick(*at, ignore="box")
    renderer.release()
    assert (behind.kind, behind.object_id) == ("real", None)
    assert abs(place_of(behind)[0][2]) < 0.008, "the floor behind it"
    assert (other.kind, other.object_id) == ("object", "ball")


def two_materials(folder: Path) -> str:
    """A GLB of two meshes: a red cube left and a blue cube right of the middle."""
    scene = trimesh.Scene()
    for name, x, color in (("left", -0.06, (255, 0, 0, 255)), ("right", 0.06, (0, 0, 255, 255))):
        mesh = cube(0.06, (x, 0, 0))
        mesh.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(name=name, baseColorFactor=color)
        )
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    path = folder / "two.glb"
    scene.export(path)
    return str(path)


def test_every_mesh_of_an_object_belongs_to_it(gpu: GpuContext, stage: Stage, tmp_path: Path) -> None:
    two = two_materials(tmp_path)
    objects: list[dict[str, Any]] = [
        {"id": "pair", "asset": two, "up_axis": "z"},
        {"id": "hidden", "asset": two, "up_axis": "z", "visible": False},
        stage.virtual(cube(0.06, (0.2, 0, 0)), id="single"),
        {"id": "second pair", "asset": two, "up_axis": "z", "pose": {"translation_m": (0, 0.2, 0)}},
    ]
    document = stage.document(objects, [ambient(0.5)], floor())
    places = [(-0.06, 0, 0.06), (0.06, 0, 0.06), (0.2, 0, 0.06), (-0.06, 0.2, 0.06), (0.06, 0.2, 0.06)]
    found = picked(gpu, document, frame(), *map(np.array, places))
    assert [pick.object_id for pick in found] == ["pair", "pair", "single", "second pair", "second pair"]


@pytest.mark.parametrize("has_model", [True, False], ids=["model", "depth"])
def test_a_scene_without_objects_has_places_too(gpu: GpuContext, stage: Stage, has_model: bool) -> None:
    document = stage.document([], [ambient(0.5)], floor() if has_model else None)
    depth = floor_depth(look_at())
    view = frame(depth=None if has_model else depth_image(depth))
    (found,) = picked(gpu, document, view, FREE_FLOOR)
    assert found.kind == "real"
    met, normal = place_of(found)
    np.testing.assert_allclose(met, FREE_FLOOR, atol=0.008)
    np.testing.assert_allclose(normal, (0, 0, 1), atol=0.02)


@pytest.mark.parametrize("has_object", [True, False])
def test_unknown_depth_is_nothing(gpu: GpuContext, stage: Stage, has_object: bool) -> None:
    x, y = (round(value) for value in pixel_of(frame(), FREE_FLOOR))
    depth = floor_depth(look_at())
    depth[y - 4 : y + 5, x - 4 : x + 5] = 0
    objects = [stage.virtual(cube(0.06), id="cube")] if has_object else []
    document = stage.document(objects, [ambient(0.5)])
    (found,) = picked(gpu, document, frame(depth=depth_image(depth)), FREE_FLOOR)
    assert found.as_dict() == {
        "frame_id": 0,
        "kind": "nothing",
        "object": None,
        "point_m": None,
        "normal": None,
        "distance_m": None,
    }


def test_what_cannot_be_picked_is_a_sentence(gpu: GpuContext, stage: Stage) -> None:
    document = everyday(stage)
    renderer = SceneRenderer(gpu, document)
    with pytest.raises(DeltalightError, match="Nothing has been rendered yet"):
        renderer.pick(1, 1)
    renderer.render(frame())
    assert renderer.pick(-0.5, HEIGHT - 0.51).kind in ("real", "nothing")
    for x, y in ((-0.51, 5), (5, -1), (WIDTH - 0.5, 5), (5, HEIGHT)):
        with pytest.raises(DeltalightError, match=f"outside of the picture of {WIDTH}x{HEIGHT}"):
            renderer.pick(x, y)
    renderer.render(replace(frame(), pose=None))
    with pytest.raises(DeltalightError, match="no place in the world"):
        renderer.pick(5, 5)
    renderer.set_scene(with_output(document, view="rsm"))
    assert renderer.render(frame()).world_from_camera is None
    with pytest.raises(DeltalightError, match="another view"):
        renderer.pick(5, 5)
    renderer.set_scene(
        with_output(document, view="lights")
    )  # without a fish-eye they are drawn on the camera's
    assert renderer.render(frame()).world_from_camera is not None
    assert renderer.pick(*pixel_of(frame(), BALL_AT)).object_id == "ball"
    renderer.release()


def test_while_nothing_moves_picture_and_picks_keep_their_pose(gpu: GpuContext, stage: Stage) -> None:
    renderer = SceneRenderer(gpu, everyday(stage))
    first = renderer.render(frame())
    shaken = look_at((0.2501, -0.9, 0.65))
    second = renderer.render(frame(pose=shaken, frame_id=1))
    on_floor = renderer.pick(*pixel_of(frame(), FREE_FLOOR))
    renderer.release()
    assert not np.array_equal(shaken.world_from_camera, look_at().world_from_camera)
    assert first.world_from_camera is not None
    np.testing.assert_array_equal(second.world_from_camera, look_at().world_from_camera)
    np.testing.assert_array_equal(first.world_from_camera, look_at().world_from_camera)
    assert on_floor.frame_id == 1
    assert second.camera == camera()


def test_a_ray_meets_the_nearest_triangle_before_it() -> None:
    triangles = np.array([[[-1, -1, z], [1, -1, z], [0, 2, z]] for z in (3, 2, -1)], np.float32)
    hit = first_hit(triangles, np.zeros(3), np.array([0.0, 0.0, 2.0]))
    assert hit is not None
    assert hit[0] == pytest.approx(1.0)
    np.testing.assert_allclose(hit[1], (0, 0, -1))
    assert first_hit(triangles, np.zeros(3), np.array([1.0, 0.0, 0.0])) is None
    assert first_hit(triangles[2:], np.zeros(3), np.array([0.0, 0.0, 1.0])) is None
