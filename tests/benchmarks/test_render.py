"""Mitsuba's pictures agree with `CameraModel` and with the scene's own geometry and light."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from benchmarks.ground_truth import scene_demo
from benchmarks.ground_truth.render import RoomRenderer, choose_variant
from protocol.camera_model import CameraModel
from protocol.errors import DeltalightError

if importlib.util.find_spec("mitsuba") is None:
    pytest.skip("Mitsuba is not installed (dev extra)", allow_module_level=True)

# Off-centre on purpose: the principal point must reach Mitsuba.
CAMERA = CameraModel(
    width=96,
    height=72,
    matrix=np.array([[88.0, 0.0, 40.0], [0.0, 88.0, 39.0], [0.0, 0.0, 1.0]]),
    distortion_model="plumb_bob",
    distortion=np.zeros(5),
)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> RoomRenderer:
    choose_variant()
    return RoomRenderer(scene_demo.mitsuba_scene(tmp_path_factory.mktemp("meshes"), with_object=True), CAMERA)


def test_depth_is_the_distance_of_the_table_along_the_axis(room: RoomRenderer) -> None:
    pose = scene_demo.world_from_camera(0)
    depth_m = room.depth(pose, spp=64, seed=1)
    rays = np.concatenate([CAMERA.rays(), np.ones((72, 96, 1))], axis=2) @ pose[:3, :3].T
    table_m = (scene_demo.TABLE_Z_M - pose[2, 3]) / rays[..., 2]
    nearest_row = 70  # only table there
    assert np.abs(depth_m - table_m)[nearest_row].max() < 0.002
    assert np.all(depth_m > 0.3)


def test_object_stands_where_the_scene_document_says(room: RoomRenderer) -> None:
    pose = scene_demo.world_from_camera(0)
    color = room.color(pose, spp=16, seed=1)
    green = (color[..., 1] > 2 * color[..., 0]) & (color[..., 1] > 0.1)
    rows, columns = np.nonzero(green)
    middle = np.add(scene_demo.OBJECT_TRANSLATION_M, (0, 0, 0.075))
    camera_from_world = np.linalg.inv(pose)
    (u, v) = CAMERA.project((camera_from_world[:3, :3] @ middle + camera_from_world[:3, 3])[None])[0]
    assert green.sum() > 100
    assert (columns.mean(), rows.mean()) == pytest.approx((u, v), abs=4)


def test_lens_distortion_is_refused(room: RoomRenderer, tmp_path: Path) -> None:
    del room  # the variant is set
    bent = CameraModel(
        width=96,
        height=72,
        matrix=CAMERA.matrix,
        distortion_model="plumb_bob",
        distortion=np.array([0.1, 0.0, 0.0, 0.0]),
    )
    renderer = RoomRenderer(scene_demo.mitsuba_scene(tmp_path, with_object=False), bent)
    with pytest.raises(DeltalightError, match="distortion"):
        renderer.color(scene_demo.world_from_camera(0), spp=1, seed=0)
