"""Objects whose assets play clips: what is rendered of them, and what is kept while they move."""

from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest

from deltalight.benchmarks.glb_builder import GlbBuilder
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.gltf_meshes import load_gltf
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.moved_meshes import turned
from deltalight.render_server.scene.triangle_mesh import TriangleMesh, unit_or
from deltalight.render_server.virtual_objects import VirtualObjects
from tests.render_server.gltf_samples import (
    IDENTITY,
    QUARTER_TURN,
    bent_bar,
    box,
    morphing_box,
    moved_box,
)
from tests.render_server.scenes import (
    COARSE,
    GREY,
    Stage,
    ambient,
    composite,
    cube,
    directional,
    fields_of,
    floor,
    frame,
    noisy,
    pass_times_ms,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
METHODS = ["dvct", "dlpv"]
SECOND = 1_000_000_000


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, COARSE)


def at(time_s: float) -> ViewFrame:
    return frame(timestamp_ns=round(time_s * SECOND))


def placed(asset: Path, animation: dict[str, Any] | None = None, **more: object) -> dict[str, Any]:
    return {"id": "thing", "asset": str(asset), "animation": animation, "material": {"specular": 0}, **more}


def shown(stage: Stage, *objects: dict[str, Any], name: str = "dvct", **method: object) -> SceneDocument:
    lights = [directional((0.3, 0.2, -1.0)), ambient(0.3)]
    document = stage.document(list(objects), lights, floor(), **method)
    if name == "dvct":
        return document
    settings = {"volume_size": 16, "volume_edge_m": 0.6, "query_scale": 1, "rsm_size": 256, **method}
    return document.replaced(method=DlpvMethod.model_validate({"name": name, **settings}))


def sliding_box(folder: Path, edge: float = 0.08) -> Path:
    """Hovers and slides from x = -0.12 m to 0.12 m within a second; y is up in the file."""
    return moved_box(folder, "translation", [[-0.12, 0.08, 0], [0.12, 0.08, 0]], edge=edge)


def baked(folder: Path, asset: Path, time_s: float) -> Path:
    """The asset's pose at a time as a file without clips."""
    gltf = load_gltf(asset)
    glb = GlbBuilder()
    for mesh in gltf.meshes(gltf.pose(gltf.clips[0], time_s)):
        attributes = {"POSITION": glb.floats(mesh.positions), "NORMAL": glb.floats(mesh.normals)}
        part = {"attributes": attributes, "indices": glb.array(mesh.triangles.astype(np.uint32).ravel())}
        glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [part]})})
    return glb.write(folder / "baked.glb")


@pytest.mark.parametrize("method", METHODS)
def test_frames_follow_the_clip_and_depend_on_capture_time_alone(
    gpu: GpuContext, stage: Stage, method: str
) -> None:
    document = shown(stage, placed(sliding_box(stage.folder), {}), name=method)
    renderer = SceneRenderer(gpu, document)
    pictures = [renderer.render(at(time_s)).color for time_s in (0.2, 0.5, 0.8, 1.5)]
    renderer.release()
    assert not np.array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[1], pictures[2])
    assert np.array_equal(pictures[1], pictures[3]), "a second later the clip is where it was"
    assert np.array_equal(pictures[2], composite(gpu, document, at(0.8))), "whatever was rendered before"


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["skin", "morph", "node"])
def test_a_pose_is_the_same_picture_as_the_pose_baked_into_a_still_mesh(
    gpu: GpuContext, stage: Stage, method: str, kind: str
) -> None:
    if kind == "skin":
        asset = bent_bar(stage.folder)
        pose = {"scale": 0.08, "rotation_wxyz": [0.9, 0.1, 0.2, 0.3]}
    elif kind == "morph":
        deltas = [box(0.1).vertices[:, 1:2] * [[1.0, 0, 0]], np.tile([0.0, 0.03, 0], (8, 1))]
        asset, pose = morphing_box(stage.folder, deltas, edge=0.1), {"translation_m": [0, 0, 0.06]}
    else:
        asset = moved_box(stage.folder, "rotation", [IDENTITY, QUARTER_TURN], edge=0.1)
        pose = {"translation_m": [0.02, 0, 0.1]}
    playing = placed(asset, {"speed": 0, "offset_s": 0.6}, pose=pose)
    still = placed(baked(stage.folder, asset, 0.6), pose=pose)
    one, other = (
        composite(gpu, shown(stage, each, name=method), frame(noisy())) for each in (playing, still)
    )
    assert not np.array_equal(one, noisy())
    assert np.array_equal(one, other)


def vertices_of(buffers: MeshBuffers) -> bytes:
    vertices = buffers.storage["Vertices"]
    assert isinstance(vertices, moderngl.Buffer)
    return vertices.read()


def test_what_moved_or_changed_is_as_if_it_had_been_loaded_there(gpu: GpuContext, stage: Stage) -> None:
    """Dragged, turned, of another material, smaller, beside another object, and gone."""
    asset = baked(stage.folder, bent_bar(stage.folder), 0.3)
    other = placed(asset, pose={"translation_m": [0.2, 0.1, 0.3]}, id="other")
    turned = {"translation_m": [0.02, 0, 0.1], "rotation_wxyz": [0.9, 0.1, 0.2, 0.3]}
    scenes = [
        [placed(asset), other],
        [placed(asset, pose={"translation_m": [0.02, 0, 0.1]}), other],
        [placed(asset, pose=turned), other],
        [placed(asset, pose=turned, material={"base_color": [0.1, 0.2, 0.3]}), other],
        [placed(asset, pose={**turned, "scale": 0.5}), {**other, "material": None}],
        [{**other, "material": None}],
        [placed(asset), other],
    ]
    objects = VirtualObjects(gpu)
    for items in scenes:
        fresh = VirtualObjects(gpu)
        scene = shown(stage, *items)
        made = []
        for each in (objects, fresh):
            each.load(scene.objects)
            state = each.update(scene.objects, None, 0)
            assert state is not None
            mesh = state.drawn.mesh
            buffer = vertices_of(state.buffers)[: mesh.vertices.nbytes]
            extent = state.extent.points, state.extent.upright
            made.append((buffer, mesh.vertices, mesh.triangles, mesh.material_table, state.points, *extent))
        for one, expected in zip(*made, strict=True):
            np.testing.assert_array_equal(one, expected)
        fresh.release()
    objects.release()


def test_bounds_of_a_displaced_mesh_are_those_of_its_positions() -> None:
    random = np.random.default_rng(3)
    positions = random.normal(size=(40, 3)).astype(np.float32)
    triangles = random.integers(0, 30, (50, 3)).astype(np.int32)  # some vertices are in no triangle
    mesh = TriangleMesh(positions, unit_or(positions, positions), triangles, None, Material())
    part = turned(mesh, random.normal(size=(3, 3)))
    for place in 10 * random.normal(size=(20, 3)):
        np.testing.assert_array_equal(part.bounds_at(place), part.at(place).bounds())


def test_while_it_plays_triangles_are_those_of_the_baked_pose(gpu: GpuContext, stage: Stage) -> None:
    asset = bent_bar(stage.folder)
    pose = {"scale": 0.1, "rotation_wxyz": [0.9, 0.1, 0.2, 0.3], "translation_m": [0.1, 0.2, 0.3]}
    states = []
    for item in (placed(asset, {}, pose=pose), placed(baked(stage.folder, asset, 0.7), pose=pose)):
        objects = VirtualObjects(gpu)
        scene = shown(stage, item)
        objects.load(scene.objects)
        objects.update(scene.objects, None, round(0.1 * SECOND))
        state = objects.update(scene.objects, None, round(0.7 * SECOND))
        assert state is not None
        states.append((state.corners, state.points, vertices_of(state.buffers)))
        objects.release()
    assert np.array_equal(states[0][0], states[1][0])
    assert np.array_equal(states[0][1], states[1][1])
    assert states[0][2] == states[1][2]


@pytest.mark.parametrize(
    "animation", [{"speed": 0, "offset_s": 0.3}, {"loop": False}, {"loop": False, "speed": -1}]
)
def test_a_clip_that_stands_gives_the_same_bytes_and_keeps_all_caches(
    gpu: GpuContext, stage: Stage, animation: dict[str, Any]
) -> None:
    renderer = SceneRenderer(gpu, shown(stage, placed(sliding_box(stage.folder), animation)))
    first = renderer.render(at(2.0))
    ran_first = pass_times_ms(renderer).keys()
    second = renderer.render(at(3.4))
    ran_second = pass_times_ms(renderer).keys()
    renderer.release()
    assert np.array_equal(first.color, second.color)
    kept = {"voxelize real", "voxelize objects", "shadow maps objects", "cones real"}
    assert kept <= ran_first
    assert not kept & ran_second


@pytest.mark.parametrize("method", METHODS)
def test_while_it_moves_the_real_scene_and_the_volume_stand_still(
    gpu: GpuContext, stage: Stage, method: str
) -> None:
    renderer = SceneRenderer(
        gpu, shown(stage, placed(sliding_box(stage.folder), {}), name=method, volume_edge_m=None)
    )
    renderer.render(at(0.0))
    ran_first = pass_times_ms(renderer).keys()
    graph = renderer.graph
    assert graph is not None
    table = graph["object geometry"].materials
    standing = [graph.resource(name) for name in ("real geometry", "volume placement", "light views real")]
    before = [resource.version for resource in standing]
    renderer.render(at(0.6))
    ran_second = pass_times_ms(renderer).keys()
    assert renderer.graph is graph
    assert [resource.version for resource in standing] == before
    assert graph["object geometry"].materials is table, "materials and textures are not sent again"
    renderer.release()
    assert {"voxelize real", "shadow maps real"} <= ran_first
    assert not {"voxelize real", "shadow maps real"} & ran_second
    assert "shadow maps objects" in ran_second


@pytest.mark.parametrize("method", METHODS)
def test_the_shadow_goes_with_the_object(gpu: GpuContext, stage: Stage, method: str) -> None:
    """A box slides by 0.24 m along x, and so does its shadow: seen on the floor, not on the box."""
    renderer = SceneRenderer(gpu, shown(stage, placed(sliding_box(stage.folder), {}), name=method))
    places = []
    for time_s in (0.0, 0.999):
        color = renderer.render(at(time_s)).color.astype(float).mean(axis=2)
        fields = fields_of(renderer)
        shadow = (color < 0.75 * GREY) & (fields.matte == 0) & (fields.position[..., 3] > 0)
        assert shadow.sum() > 40
        places.append(fields.position[shadow][:, :3].mean(axis=0))
    renderer.release()
    np.testing.assert_allclose(places[1] - places[0], [0.24, 0, 0], atol=0.02)


def test_several_objects_move_each_on_its_own(gpu: GpuContext, stage: Stage) -> None:
    (stage.folder / "other").mkdir()
    turning = moved_box(stage.folder / "other", "rotation", [IDENTITY, QUARTER_TURN], edge=0.1)
    scene = shown(
        stage,
        placed(sliding_box(stage.folder), {}, id="slow"),
        placed(sliding_box(stage.folder), {"speed": 2}, id="fast"),
        stage.virtual(cube(0.1), id="still"),
        placed(turning, None, id="resting"),
        placed(turning, None, id="turning", rigid=False),
    )
    objects = VirtualObjects(gpu)
    objects.load(scene.objects)
    before = objects.update(scene.objects, None, 0)
    after = objects.update(scene.objects, None, SECOND // 4)
    assert before is not None
    assert after is not None
    assert [item.id for item in after.objects if item.moves] == ["slow", "fast", "turning"]
    placed_again = [one is not other for one, other in zip(after.extents, before.extents, strict=True)]
    assert placed_again == [True, True, False, False, True]
    steps = np.split(np.abs(after.corners - before.corners)[..., :3].max(axis=(1, 2)), range(12, 60, 12))
    assert [step.max() for step in steps] == pytest.approx([0.06, 0.12, 0, 0, 0.0229], abs=1e-3)
    assert after is not before
    assert np.array_equal(after.lasting_points, before.lasting_points)
    assert objects.update(scene.objects, None, SECOND // 4) is after
    objects.release()


def test_reflections_of_a_moving_object_are_those_of_one_that_stands_there(
    gpu: GpuContext, stage: Stage
) -> None:
    """The BVH is refitted, not built anew; only rays along edges may find another triangle."""
    item = placed(sliding_box(stage.folder), {})
    document = shown(stage, item)
    mirror = {"region": {"plane": {}}, "roughness": 0.05, "metallic": 1.0, "albedo": [0.9, 0.9, 0.9]}
    data = document.model_dump(mode="json")
    data["real"]["surfaces"] = [mirror]
    document = type(document).model_validate(data)
    renderer = SceneRenderer(gpu, document)
    before = renderer.render(at(0.1)).color
    moved = renderer.render(at(0.8)).color
    renderer.release()
    fresh = composite(gpu, document, at(0.8))
    assert np.abs(before.astype(int) - fresh).max() > 20
    assert np.mean(np.abs(moved.astype(int) - fresh).max(axis=2) > 1) < 0.001


def test_by_default_an_asset_with_clips_rests(gpu: GpuContext, stage: Stage) -> None:
    asset = sliding_box(stage.folder)
    resting, played = (placed(asset, None, rigid=rigid) for rigid in (True, False))
    one, other = (composite(gpu, shown(stage, resting), at(time_s)) for time_s in (0.2, 0.7))
    assert np.array_equal(one, other)
    assert not np.array_equal(composite(gpu, shown(stage, played), at(0.7)), one)


def test_what_has_shrunk_to_a_point_leaves_the_cameras_bytes(gpu: GpuContext, stage: Stage) -> None:
    asset = moved_box(stage.folder, "scale", [[0, 0, 0], [1, 1, 1]], edge=0.1)
    document = shown(stage, placed(asset, {"speed": 0}))
    assert np.array_equal(composite(gpu, document, frame(noisy())), noisy())
    playing = shown(stage, placed(asset, {}))
    assert not np.array_equal(composite(gpu, playing, frame(noisy(), timestamp_ns=SECOND // 2)), noisy())


@pytest.mark.parametrize(
    ("clip", "sentence"),
    [("run", r"object `thing`: .*moved.glb has no clip 'run'; it has `move`"), (3, "has no clip 3")],
)
def test_a_clip_that_the_asset_lacks_is_refused_before_the_first_frame(
    gpu: GpuContext, stage: Stage, clip: str | int, sentence: str
) -> None:
    with pytest.raises(DeltalightError, match=sentence):
        SceneRenderer(gpu, shown(stage, placed(sliding_box(stage.folder), {"clip": clip})))


def test_an_asset_without_clips_cannot_be_animated_but_need_not_be_rigid(
    gpu: GpuContext, stage: Stage
) -> None:
    still = stage.virtual(cube(), id="thing")
    with pytest.raises(DeltalightError, match="has no animation"):
        SceneRenderer(gpu, shown(stage, {**still, "animation": {}}))
    flexible, rigid = (composite(gpu, shown(stage, {**still, "rigid": rigid})) for rigid in (False, True))
    assert np.array_equal(flexible, rigid)
