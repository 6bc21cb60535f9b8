"""The real scene as a mesh: where it lies, and which part of the picture is on it."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.room_mesh import EDGE_M, SEEN, UNSEEN, room_mesh
from deltalight.render_server.view import CameraView
from tests.render_server.scenes import COARSE, Stage, depth_image, everyday, floor_depth, frame, look_at

BEHIND_M = np.array([[[0.0, 0, -0.2], [0.05, 0, -0.2], [0, 0.05, -0.2]]], np.float32)  # below the floor


def view_of(taken: object) -> CameraView:
    return CameraView(taken.camera, taken.pose.world_from_camera)  # type: ignore[attr-defined]


def test_each_corner_has_its_place_in_the_picture_and_what_is_hidden_has_none() -> None:
    taken = frame(depth=depth_image(floor_depth(look_at())))
    view = view_of(taken)
    on_floor = np.array([[[0.0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]]], np.float32)
    away = np.array([[[50.0, 0, 0], [50, 0.05, 0], [50.05, 0, 0]]], np.float32)
    room = room_mesh(np.concatenate([on_floor, BEHIND_M, away]), taken, view)
    assert room.is_seen.tolist() == [True, False, False]
    inverse = view.camera_from_world
    pixels = view.camera.project(on_floor[0].astype(float) @ inverse[:3, :3].T + inverse[:3, 3])
    np.testing.assert_allclose(room.places[0] * view.size - 0.5, pixels, atol=1e-6)


def test_the_file_has_the_floor_upright_with_the_picture_on_it(tmp_path: Path) -> None:
    taken = frame(depth=depth_image(floor_depth(look_at())))
    on_floor = np.array([[[0.0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]]], np.float32)
    room = room_mesh(np.concatenate([on_floor, BEHIND_M]), taken, view_of(taken))
    room.write(tmp_path / "room.glb")
    loaded = trimesh.load_scene(tmp_path / "room.glb")
    parts = {part.metadata["name"]: part for part in loaded.dump()}
    assert set(parts) == {SEEN, UNSEEN}
    np.testing.assert_allclose(parts[SEEN].bounds, [[0, 0, -0.05], [0.05, 0, 0]], atol=1e-7)
    np.testing.assert_allclose(parts[UNSEEN].bounds[:, 1], -0.2, atol=1e-7)
    texture = np.asarray(parts[SEEN].visual.material.baseColorTexture)
    np.testing.assert_array_equal(texture[..., :3], taken.color)
    place = np.abs(parts[SEEN].vertices - [0.05, 0, 0]).sum(axis=1).argmin()
    u, v = parts[SEEN].visual.uv[place]
    np.testing.assert_allclose([u, 1 - v], room.places[0, 1], atol=1e-6)


@pytest.mark.usefixtures("clean_gl")
def test_the_renderer_gives_its_own_triangles_or_those_of_depth(gpu: GpuContext, tmp_path: Path) -> None:
    taken = frame(depth=depth_image(floor_depth(look_at())))
    model = everyday(Stage(tmp_path, COARSE))
    sensed = model.replaced(real={"geometry": "depth"})
    for document in (model, sensed, sensed.replaced(objects=())):
        renderer = SceneRenderer(gpu, document)
        with pytest.raises(DeltalightError, match="position is not known"):
            renderer.room()
        renderer.render(taken)
        room = renderer.room()
        renderer.release()
        shown = room.corners[room.is_seen]
        assert len(shown) > 100
        assert (np.abs(shown[..., 2]) < 0.02).mean() > 0.5, "the floor"
        if document is model:
            edges_m = np.linalg.norm(np.roll(room.corners, -1, axis=1) - room.corners, axis=2)
            assert edges_m.max() <= EDGE_M, "divided, so that the picture lies on what it shows"
        else:
            assert room.is_seen.mean() > 0.9
