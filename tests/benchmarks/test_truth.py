"""Truth of benchmark scenes: complete or absent, repeatable, and readable as the dataset folder that it is."""

import importlib.util
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from rich.progress import Progress

from deltalight.benchmarks.ground_truth import fisheye
from deltalight.benchmarks.ground_truth.assembly import Assembly
from deltalight.benchmarks.ground_truth.benchmark_scene import (
    BOARD,
    CAMERA,
    BenchmarkScene,
    Finish,
    VirtualObject,
)
from deltalight.benchmarks.ground_truth.lamps import Ambient, SphereLamp
from deltalight.benchmarks.ground_truth.parts import MeshFolder, box, looking, placed, rectangle, sheet
from deltalight.benchmarks.ground_truth.point_lamps import point_lamps, with_point_lamps
from deltalight.benchmarks.ground_truth.render import RoomRenderer, choose_variant
from deltalight.benchmarks.ground_truth.scenes import scene_named
from deltalight.benchmarks.ground_truth.truth import CACHE, Truth, ensure_truth
from deltalight.benchmarks.ground_truth.truth_pictures import world_from_fisheye
from deltalight.benchmarks.ground_truth.truth_writer import is_whole
from deltalight.protocol.cached_files import cache_folder
from deltalight.protocol.camera_model import load_camera_yaml
from deltalight.protocol.dataset import open_dataset
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeCalibration
from deltalight.protocol.frames import FisheyePictures
from deltalight.protocol.hemisphere import texel_solid_angles
from deltalight.protocol.pictures import decode_rgb
from deltalight.protocol.scene_method import DvctMethod
from deltalight.protocol.source import open_source
from deltalight.sensor_node.fisheye import radiance_map

if importlib.util.find_spec("mitsuba") is None:
    pytest.skip("Mitsuba is not installed (dev extra)", allow_module_level=True)

pytestmark = pytest.mark.slow
SIZE = (64, 48)
SPP = 8
LAMP = SphereLamp((0.5, -0.4, 0.8), intensity=0.7, radius_m=0.05)


def real(folder: MeshFolder) -> dict[str, Any]:
    del folder
    table = placed((0.1, 0.0, -0.0005), scale=(0.35, 0.35, 1.0))
    return {
        "table": rectangle(table, (0.4, 0.3, 0.2)),
        "board": sheet(BOARD),
        "block": box((-0.1, 0.15, 0.05), (0.05, 0.05, 0.05), 0.0, (0.2, 0.5, 0.2)),
    }


def cube() -> trimesh.Trimesh:
    return trimesh.creation.box((0.06, 0.06, 0.08), placed((0.0, 0.0, 0.04)))


SCENE = BenchmarkScene(
    name="small",
    title="A cube on a table under the sky",
    world_from_camera=(looking((0.1, -0.7, 0.25), (0.1, 0.0, 0.12)),),
    real=real,
    objects=(VirtualObject("cube", cube, Finish((0.7, 0.1, 0.1)), (placed((0.25, -0.1, 0.0)),)),),
    lamps=(LAMP, Ambient(0.3)),
    settings={"volume_edge_m": 0.4},
)


def make(scene: BenchmarkScene, cache: Path, spp: int = SPP) -> Truth:
    return ensure_truth(scene, size=SIZE, spp=spp, progress=Progress(disable=True), cache=cache)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    return make(SCENE, tmp_path_factory.mktemp("cache"))


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_truth_is_rendered_once(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RoomRenderer, "_render", None)
    again = make(SCENE, truth.folder.parent)
    assert again.folder == truth.folder
    assert list(truth.folder.parent.iterdir()) == [truth.folder]


def test_damaged_truth_is_rendered_again(
    truth: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if choose_variant() != "llvm_ad_rgb":  # asked here, since each worker would ask while it collects tests
        pytest.skip("only Mitsuba's LLVM variant repeats a seed exactly")
    folder = tmp_path / truth.folder.name
    shutil.copytree(truth.folder, folder)
    assert is_whole(folder)
    picture = folder / "rgb" / "000000.png"
    picture.write_bytes(picture.read_bytes()[:-1])
    assert not is_whole(folder)
    write_again = partial(shutil.copytree, truth.folder)
    monkeypatch.setattr(
        "deltalight.benchmarks.ground_truth.truth.write_truth", lambda made, *_: write_again(made)
    )
    assert make(truth.scene, tmp_path).folder == folder
    assert is_whole(folder)


def test_truth_is_the_same_wherever_it_is_rendered(truth: Truth, tmp_path: Path) -> None:
    again = make(SCENE, tmp_path)
    assert again.folder.name == truth.folder.name
    assert content(again.folder) == content(truth.folder)


@pytest.mark.parametrize(
    "change",
    [
        {"lamps": (replace(LAMP, intensity=0.70001), Ambient(0.3))},
        {"objects": (replace(SCENE.objects[0], finish=Finish((0.7, 0.1, 0.1), roughness=0.4)),)},
        {"objects": (replace(SCENE.objects[0], mesh=lambda: cube().subdivide()),)},
        {"settings": {}},
    ],
    ids=["lamp", "finish", "mesh", "settings"],
)
def test_another_scene_has_another_folder(
    change: dict[str, Any], truth: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names: list[str] = []
    monkeypatch.setattr(
        "deltalight.benchmarks.ground_truth.truth._render", lambda truth, *_: names.append(truth.folder.name)
    )
    make(replace(SCENE, **change), tmp_path)
    make(SCENE, tmp_path)
    assert names[0] != names[1] == truth.folder.name


@pytest.mark.parametrize("error", [KeyboardInterrupt, DeltalightError])
def test_interrupted_rendering_leaves_nothing(
    error: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(RoomRenderer, "cover", interrupted)
    with pytest.raises(error):
        make(SCENE, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_cover_is_the_objects_share_of_each_pixel(truth: Truth) -> None:
    cover = truth.frame(0).cover
    corners = truth.document(0).objects[0].world_from_object() @ np.c_[cube().vertices, np.ones(8)].T
    camera = CAMERA.resized(*SIZE)
    pixels = camera.project((np.linalg.inv(SCENE.world_from_camera[0]) @ corners)[:3].T)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    rows, columns = np.nonzero(cover)
    assert cover.min() == 0
    assert cover.max() == 1
    assert np.all((columns > low[0] - 3) & (columns < high[0] + 3))
    assert np.all((rows > low[1] - 3) & (rows < high[1] + 3))
    middle = np.rint(pixels.mean(axis=0)).astype(int)
    assert cover[middle[1], middle[0]] == 1
    assert np.any((cover > 0.1) & (cover < 0.9))


def test_without_and_with_share_their_random_numbers(truth: Truth) -> None:
    frame = truth.frame(0)
    unchanged = (frame.without == frame.with_objects).all(axis=2)
    lit = frame.without.min(axis=2) > 0
    assert np.mean(unchanged & lit) > 0.25
    far_table = np.s_[-6:, :12]  # lit by chance, hardly by the cube: alike by the same draw only
    change = np.abs(frame.with_objects - frame.without)[far_table].mean()
    noise = np.abs(np.diff(frame.without[far_table], axis=1)).mean()
    assert change < 0.3 * noise


def test_sensor_pictures_differ_where_truth_does(truth: Truth) -> None:
    frame = truth.frame(0)
    same = (frame.without == frame.with_objects).all(axis=2)
    assert np.array_equal(frame.sensor_without[same], frame.sensor_with[same])
    assert np.any(frame.sensor_without[frame.cover == 1] != frame.sensor_with[frame.cover == 1])


def test_halves_agree_better_with_more_samples(truth: Truth, tmp_path: Path) -> None:
    progress = Progress(disable=True)
    better = ensure_truth(SCENE, size=SIZE, spp=32, progress=progress, cache=tmp_path).frame(0).halves_psnr_db
    assert progress.finished
    assert better > truth.frame(0).halves_psnr_db + 3


def test_folder_is_a_dataset_of_the_room_without_objects(truth: Truth) -> None:
    source = open_source(truth.folder)
    frame = source[0]
    assert (len(source), source.notes, source.board) == (1, [], BOARD)
    assert frame.camera == CAMERA.resized(*SIZE)
    assert np.array_equal(frame.color, truth.frame(0).sensor_without)
    assert frame.world_from_camera == pytest.approx(SCENE.world_from_camera[0])
    assert frame.depth is not None
    rays = (
        np.concatenate([frame.camera.rays(), np.ones((48, 64, 1))], axis=2)
        @ SCENE.world_from_camera[0][2, :3]
    )
    table_m = (-0.0005 - SCENE.world_from_camera[0][2, 3]) / rays[46]
    error = (frame.depth.depth_m[46] - table_m)[frame.depth.valid[46]]
    assert error.size > 30
    assert np.abs(error).max() < 0.01


def test_fisheye_bracket_shows_the_lamp_where_it_is(truth: Truth) -> None:
    dataset = open_dataset(truth.folder)
    (bracket,) = dataset.fisheye
    pose = dataset.extrinsics.world_from_fisheye
    assert pose is not None
    assert pose[:3, 3] == pytest.approx([0.25, -0.1, 0.05])
    assert load_camera_yaml(truth.folder / "calibration" / "fisheye.yaml") == fisheye.CAMERA
    assert bracket.exposures_s == fisheye.EXPOSURES_S
    darkest = decode_rgb(bracket.paths[-1].read_bytes(), "fish-eye")
    rows, columns = np.nonzero(darkest.min(axis=2) > 60)
    direction = np.array(LAMP.position_m) - pose[:3, 3]
    (expected,) = fisheye.CAMERA.project((pose[:3, :3].T @ direction)[None])
    assert (columns.mean(), rows.mean()) == pytest.approx(tuple(expected), abs=0.6)
    assert np.all(darkest[rows, columns] < 255)  # not clipped: its radiance can be read
    brightest = decode_rgb(bracket.paths[0].read_bytes(), "fish-eye")
    assert brightest[rows, columns].min() == 255


def test_document_says_where_and_what_the_objects_are(truth: Truth) -> None:
    document = truth.document(0)
    (item,) = document.objects
    assert Path(item.asset) == truth.folder / "cube.ply"
    assert item.world_from_object() == pytest.approx(SCENE.objects[0].world_from_object[0])
    assert [light.type for light in document.lights.manual] == ["sphere", "ambient"]
    assert document.lights.resolved_registration == (1.0, 1.0, 1.0)
    assert isinstance(document.method, DvctMethod)
    assert document.method.volume_edge_m == 0.4


def test_moving_object_has_a_document_a_frame_and_a_still_room(tmp_path: Path) -> None:
    places = (placed((0.25, -0.1, 0.0)), placed((0.15, -0.2, 0.0)))
    moving = replace(SCENE.objects[0], world_from_object=places)
    truth = make(replace(SCENE, world_from_camera=SCENE.world_from_camera * 2, objects=(moving,)), tmp_path)
    frames = [truth.frame(index) for index in range(truth.frame_count)]
    poses = [truth.document(index).objects[0].world_from_object() for index in range(2)]
    assert np.allclose(poses, places)
    assert Path(truth.document(1).objects[0].asset) == truth.folder / "cube.ply"
    assert np.array_equal(frames[0].without, frames[1].without)
    assert not np.array_equal(frames[0].sensor_without, frames[1].sensor_without)
    assert not np.array_equal(frames[0].cover, frames[1].cover)
    assert len(open_source(truth.folder)) == 2


def test_map_lights_truth_and_document(tmp_path: Path) -> None:
    sky = np.full((8, 16, 3), (0.2, 0.3, 0.5), np.float32)
    scene = replace(SCENE, lamps=(), environment=lambda: sky)
    truth = make(scene, tmp_path)
    document, frame = truth.document(0), truth.frame(0)
    assert document.lights.mode == "environment"
    assert document.lights.resolved_registration == (1.0, 1.0, 1.0)
    assert Path(str(document.lights.environment.map)).is_file()
    assert frame.without[0, 0] == pytest.approx((0.2, 0.3, 0.5), rel=0.02)  # RGBE has 8 bits


@pytest.mark.parametrize("spp", [0, 6, 12])
def test_samples_that_cannot_be_halved_are_refused(spp: int, tmp_path: Path) -> None:
    with pytest.raises(DeltalightError, match="multiple of 8"):
        make(SCENE, tmp_path, spp=spp)


def test_cache_is_where_the_environment_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("DELTALIGHT_CACHE", raising=False)
    assert cache_folder(CACHE) == tmp_path / "xdg" / "deltalight" / "ground-truth"
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "own"))
    assert cache_folder(CACHE) == tmp_path / "own" / "ground-truth"


def test_cache_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DeltalightError, match="DELTALIGHT_CACHE"):
        make(SCENE, tmp_path / "file")


def test_a_lamp_without_extent_is_a_blur_of_its_irradiance_in_the_fish_eye_picture(tmp_path: Path) -> None:
    choose_variant()
    scene = scene_named("studio")
    assembly = Assembly(scene, tmp_path)
    room, lens = RoomRenderer(assembly.without(), fisheye.CAMERA), EquidistantLens(fisheye.CAMERA)
    pose = world_from_fisheye(assembly)
    black = np.zeros((lens.height, lens.width, 3), np.float32)
    seen = with_point_lamps(black, scene.lamps, room, lens, pose)

    (spot,) = point_lamps(scene.lamps)
    calibration = FisheyeCalibration(lens, None, ())
    sky = radiance_map(FisheyePictures(0, (seen,), (None,), calibration), pose)
    found = np.tensordot(texel_solid_angles(len(sky.radiance)), sky.radiance, axes=2)
    assert found == pytest.approx(spot.irradiance(pose[:3, 3]), rel=0.02)
    row, column = np.unravel_index(int(seen[..., 0].argmax()), seen.shape[:2])
    toward = pose[:3, :3] @ lens.directions(np.array([[column, row]], float))[0]
    way = np.array(spot.position_m) - pose[:3, 3]
    assert toward @ way / np.linalg.norm(way) > np.cos(np.radians(1))

    below = pose.copy()
    below[2, 3] -= 0.5  # under the table's top
    assert not with_point_lamps(black, scene.lamps, room, lens, below).any()
