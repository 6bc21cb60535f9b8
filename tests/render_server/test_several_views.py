"""Several cameras in one room: one real scene and its light for all, and a picture for each."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.camera_frames import CameraFrame
from deltalight.render_server.gpu.context import GpuContext, count_gl_objects
from deltalight.render_server.gpu.kernel import watched
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.depth_mesh import depth_mesh
from deltalight.render_server.scene.depth_surface import depth_surface
from deltalight.render_server.scene.depth_views import DepthViews, PosedSurface
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.view import CameraView, resized_frame
from tests.render_server.scenes import (
    HEIGHT,
    WIDTH,
    Stage,
    camera,
    cube,
    depth_image,
    directional,
    floor,
    floor_depth,
    frame,
    look_at,
    psnr_db,
    shifted,
)

pytestmark = pytest.mark.usefixtures("clean_gl")

FAST: dict[str, object] = {"cone_scale": 4, "cone_count": 8, "shadow_samples": 1}
METHODS: dict[str, dict[str, object]] = {
    "exact": {},
    "paper": {"operator": "paper"},
    "dlpv": {"name": "dlpv", "volume_size": 16, "rsm_size": 128, "query_scale": 2},
}
WORLD_KERNELS = "voxelize", "reflective_shadow_map", "light_voxels", "filter_voxels", "gather_voxels"
FRONT, BACK, TOP, END = -0.29, -0.31, 0.2, 0.6  # of a wall: x of both sides, height, half its length
BEHIND = look_at((-0.75, -0.3, 0.9), (-0.12, 0, 0.05))  # looks over the wall, at its back
FACING = look_at((0.7, -0.2, 0.6), (-0.3, 0, 0.2))  # sees its front
EVERY_PIXEL = 160_000  # triangles: a node of the mesh for each, whoever shares the budget
GREY, RED = (120, 120, 120), (190, 30, 30)


def rays(pose: BoardPose) -> tuple[np.ndarray, np.ndarray]:
    """Eye, and direction of each pixel, one metre along the optical axis."""
    own = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))])
    return pose.world_from_camera[:3, 3], own @ pose.world_from_camera[:3, :3].T


def seen_room(pose: BoardPose, number: int = 0, **changes: Any) -> ViewFrame:  # noqa: ANN401
    """A grey floor and a wall whose front is red, with depth."""
    eye, along = rays(pose)
    nearest, picture = np.full((HEIGHT, WIDTH), 20.0), np.full((HEIGHT, WIDTH, 3), GREY, np.uint8)
    for axis, at, color in ((2, 0.0, GREY), (2, TOP, GREY), (0, BACK, GREY), (0, FRONT, RED)):
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (at - eye[axis]) / along[..., axis]
        x, y, z = np.moveaxis(eye + along * depth[..., None], -1, 0)
        on_wall = (x > BACK - 1e-6) & (x < FRONT + 1e-6) & (np.abs(y) < END) & (z > -1e-6) & (z < TOP + 1e-6)
        on_floor = (np.abs(x) < 1) & (np.abs(y) < 1)
        hit = (depth > 0) & (depth < nearest) & (on_floor if (axis, at) == (2, 0.0) else on_wall)
        nearest[hit], picture[hit] = depth[hit], color
    known = np.where(nearest < 20, nearest, 0).astype(np.float32)
    given = {"frame_id": number, "timestamp_ns": number * 10**9, "depth": depth_image(known)}
    return frame(picture, pose=pose, **{**given, **changes})


def off_voxel_borders(view: ViewFrame) -> ViewFrame:
    """The same room a little aside: planes through the world's axes lie where voxels meet, and rounding, which the
    GPU's triangles have in other bits than numpy's, would decide which ones they fill.
    """
    assert view.pose is not None
    aside = view.pose.world_from_camera.copy()
    aside[:3, 3] += 1e-4
    return replace(view, pose=replace(view.pose, world_from_camera=aside))


def document(
    stage: Stage, geometry: str, material: dict[str, float] | None = None, **method: object
) -> SceneDocument:
    """A white cube before the wall, whose front is lit."""
    wall = shifted(trimesh.creation.box((FRONT - BACK, 2 * END, TOP)), (FRONT + BACK) / 2, 0, TOP / 2)
    white = stage.virtual(cube(0.1, (-0.12, 0, 0)), (0.8, 0.8, 0.8), material or {})
    model = trimesh.util.concatenate([floor(1.0), wall])
    own = {} if "name" in method else method
    given = stage.document([white], [directional((-0.9, 0.1, -0.5))], model, **{**FAST, **own})
    given = given.replaced(method=method) if "name" in method else given
    if geometry == "model":
        return given
    return given.replaced(real=given.real.model_copy(update={"geometry": geometry}))


@pytest.fixture
def made(gpu: GpuContext, tmp_path: Path) -> Iterator[Callable[..., SceneRenderer]]:
    """Makes renderers of the room."""
    renderers: list[SceneRenderer] = []

    def make(geometry: str, material: dict[str, float] | None = None, **method: object) -> SceneRenderer:
        scene = document(Stage(tmp_path), geometry, material, **method)
        renderers.append(SceneRenderer(gpu, scene, with_linear=True))
        return renderers[-1]

    yield make
    for each in renderers:
        each.release()


def redness(renderer: SceneRenderer, camera: int = 0) -> float:
    """Red over blue of the object in a camera's newest picture."""
    layers = renderer.layers(camera)
    shown = layers.coverage == 1
    assert shown.sum() > 100
    red, _, blue = layers.radiance[shown].mean(axis=0)
    return float(red / blue)


@pytest.mark.parametrize("geometry", ["model", "depth", "fused"])
def test_what_another_camera_sees_lights_the_object(
    made: Callable[..., SceneRenderer], geometry: str
) -> None:
    alone, together = made(geometry), made(geometry)
    alone.render(seen_room(BEHIND))
    assert redness(alone) == pytest.approx(1, abs=0.02)
    together.render_views([seen_room(BEHIND), seen_room(FACING)])
    assert redness(together) > 1.3
    alone.forget_frames()
    alone.render(seen_room(FACING))
    assert redness(together, 1) == pytest.approx(redness(alone), rel=0.02)


@pytest.mark.parametrize("method", METHODS)
def test_a_frame_that_comes_twice_counts_once(
    gpu: GpuContext, made: Callable[..., SceneRenderer], method: str
) -> None:
    """Two cameras at one place know what one knows: light and obstacles must not add up.

    A GPU makes the triangles of one camera itself, with other last bits than numpy those of two.
    """
    settings, geometry = METHODS[method], "fused" if method == "dlpv" else "depth"
    view = off_voxel_borders(seen_room(FACING))
    one = made(geometry, **settings, triangle_budget=EVERY_PIXEL).render(view)
    pair = made(geometry, **settings, triangle_budget=EVERY_PIXEL).render_views(
        [view, replace(view, frame_id=1)]
    )
    assert np.abs(one.color.astype(int) - view.color).max() > 40
    for each in pair:
        apart = np.abs(each.color.astype(int) - one.color).max(axis=2)
        assert (apart > 1).mean() <= (0 if gpu.is_software else 2e-4)
        assert (each.color != one.color).mean() < (0.01 if gpu.is_software else 0.02)


def test_cameras_that_know_the_same_show_the_same_as_each_alone(made: Callable[..., SceneRenderer]) -> None:
    views = [seen_room(FACING), seen_room(look_at((0.6, -0.4, 0.6), (-0.3, 0, 0.2)))]
    pair = made("model").render_views(views)
    for each, view in zip(pair, views, strict=True):
        assert psnr_db(each.color, made("model").render(view).color) > 45


def test_the_world_is_made_once_and_each_view_by_itself(
    made: Callable[..., SceneRenderer], gpu: GpuContext
) -> None:
    small = resized_frame(seen_room(BEHIND), 80, 60)

    def counted(*frames: ViewFrame) -> Counter[str]:
        kernels: Counter[str] = Counter()
        with watched(gpu, lambda run: kernels.update([run.kernel.split()[0]])):
            pictures = renderer.render_views(frames)
        assert [each.color.shape for each in pictures] == [each.color.shape for each in frames]
        return kernels

    renderer = made("model")
    one = counted(seen_room(FACING))
    renderer.forget_frames()
    two = counted(seen_room(FACING), small)
    for kernel in WORLD_KERNELS:
        assert two[kernel] == one[kernel] > 0, kernel
    for kernel in ("trace_cones", "direct_light", "composite", "object_coverage"):
        assert two[kernel] == 2 * one[kernel] > 0, kernel
    assert renderer.graph is not None
    doubled = {stage.name for stage in renderer.graph.report() if stage.name.endswith("(view 2)")}
    assert {"cones (view 2)", "real surface (view 2)"} <= doubled
    of_world = "voxelize real", "shadow maps real", "bounces joint", "object bvh"
    assert not {f"{name} (view 2)" for name in of_world} & doubled
    again = counted(seen_room(FACING), small)
    assert set(again) == {"composite", "linearize"}, "nothing moved"


def test_beams_of_smooth_objects_are_traced_once_and_end_in_each_view(
    made: Callable[..., SceneRenderer], gpu: GpuContext
) -> None:
    kernels: Counter[str] = Counter()
    renderer = made("model", material={"metallic": 1.0, "roughness": 0.3})
    with watched(gpu, lambda run: kernels.update([run.kernel])):
        renderer.render_views([seen_room(FACING), seen_room(BEHIND)])
    assert [
        kernels[name] for name in ("caustic_beams RAY_COUNT=4 WIDE", "caustic_ends", "caustic_bounds")
    ] == [1, 2, 2]
    assert not kernels["caustic_beams RAY_COUNT=4"], "nothing mirrors so sharply"


def test_several_cameras_share_the_budget_of_triangles(made: Callable[..., SceneRenderer]) -> None:
    renderer = made("depth", triangle_budget=2000)
    views = [seen_room(FACING), seen_room(BEHIND)]
    renderer.render_views(views)
    assert 1000 < len(renderer.room().corners) <= 2000


def test_a_camera_without_its_pose_leaves_to_the_room_what_it_saw(made: Callable[..., SceneRenderer]) -> None:
    renderer, facing = made("depth"), seen_room(FACING)
    renderer.render_views([seen_room(BEHIND), facing])
    known = redness(renderer)
    lost = replace(facing, frame_id=1, pose=None)
    first, second = renderer.render_views([seen_room(BEHIND, 1), lost])
    assert redness(renderer) == pytest.approx(known, rel=0.01)
    assert (first.status, second.status) == ("ok", "no_pose")
    assert np.array_equal(second.color, lost.color)
    with pytest.raises(DeltalightError, match="give one of each camera"):
        renderer.render_views([])


def test_each_camera_reuses_its_own_light(made: Callable[..., SceneRenderer]) -> None:
    """Quality `live` keeps light from frame to frame; what another camera saw in between must not show."""
    turned = [look_at((0.7, -0.2 + 0.01 * step, 0.6), (-0.3, 0, 0.2)) for step in range(4)]
    alone, together = made("model", quality="live"), made("model", quality="live")
    for step, pose in enumerate(turned):
        view = replace(seen_room(pose), timestamp_ns=step * 30_000_000, frame_id=step)
        one = alone.render(view)
        pair = together.render_views([view, seen_room(FACING, step, timestamp_ns=view.timestamp_ns)])
    assert psnr_db(pair[0].color, one.color) > 45


def test_surfaces_that_two_cameras_see_are_kept_once() -> None:
    """Of a floor that both see, triangles cover about its area, and leave no hole."""
    eyes = [(0.3, -0.9, 0.7), (-0.4, -0.8, 0.9)]
    frames, meshes = [], []
    for eye in eyes:
        pose = look_at(eye, (0, 0, 0))
        depth = depth_image(floor_depth(pose))
        view = CameraView(camera(), pose.world_from_camera)
        surface = depth_surface(depth, view.camera)
        frames.append(PosedSurface(surface, view, 0.001))
        meshes.append(depth_mesh(depth, view.camera, view.world_from_camera, 5000, surface))
    kept = DepthViews(tuple(frames)).without_copies(meshes, 5000)
    inside = np.random.default_rng(0).uniform(-0.25, 0.25, (300, 2))
    before, after = (np.sum([covering(mesh, inside) for mesh in each], axis=0) for each in (meshes, kept))
    assert before.min() == 2
    assert after.min() == 1
    assert after.mean() < 1.15
    free = DepthViews(tuple(frames)).in_free_space(np.array([(0, 0, 0.2), (0, 0, 0.001), (0, 0, -0.1)]))
    assert free.tolist() == [True, False, False]


def covering(mesh: TriangleMesh, points: np.ndarray) -> np.ndarray:
    """How many triangles of a floor's mesh lie over each point (x, y)."""
    a, b, c = np.moveaxis(mesh.positions[mesh.triangles][..., :2].astype(float), 1, 0)[:, None]
    at = points[:, None]
    edges = [(end - start, at - start) for start, end in ((a, b), (b, c), (c, a))]
    sides = [along[..., 0] * to[..., 1] > along[..., 1] * to[..., 0] for along, to in edges]
    return np.asarray((np.sum(sides, axis=0) % 3 == 0).sum(axis=1))


def pictures(renderer: SceneRenderer, *taken: CameraFrame) -> list[np.ndarray]:
    return [each.finish().color for each in renderer.submit_cameras(taken)]


def test_a_frame_that_is_not_shown_lights_the_room_and_one_left_out_does_not(
    made: Callable[..., SceneRenderer],
) -> None:
    behind, facing = seen_room(BEHIND), seen_room(FACING)
    alone = made("depth").render(behind).color
    together = [each.color for each in made("depth").render_views([behind, facing])]
    renderer = made("depth")
    (first,) = pictures(renderer, CameraFrame("a", behind), CameraFrame("b", facing, is_shown=False))
    assert psnr_db(first, together[0]) > 50
    assert psnr_db(first, alone) < 45
    middle = (WIDTH / 2, HEIGHT / 2)
    picks = [renderer.pick(*middle, camera=name).distance_m for name in ("a", "b", None)]
    assert picks[0] == picks[2] != picks[1]
    (second,) = pictures(renderer, CameraFrame("b", facing))
    assert renderer.pick(*middle).distance_m == picks[1]
    with pytest.raises(DeltalightError, match="Nothing has been rendered"):
        renderer.pick(*middle, camera="a")
    assert psnr_db(second, facing.color) < 45, "the object is in it"
    again = pictures(renderer, CameraFrame("a", behind), CameraFrame("b", facing))
    assert all(psnr_db(one, other) > 50 for one, other in zip(again, together, strict=True))


def test_the_gpu_holds_what_the_cameras_of_the_newest_frame_need(made: Callable[..., SceneRenderer]) -> None:
    """But for timer queries, of which those of the longest frames stay for the next ones.

    The first round is not counted: the first frames of a process hold less.
    """
    renderer, held = made("depth"), []
    for poses in ((BEHIND, FACING), (BEHIND,)) * 3:
        for number in range(2):
            renderer.render_views([seen_room(pose, number) for pose in poses])
        held.append(sum(number for kind, number in count_gl_objects().items() if kind != "Query"))
    held = held[2:]
    assert held[1] < held[0]
    assert held[2:] == held[:2], "nothing is kept for cameras that left"
