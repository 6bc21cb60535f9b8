"""`import deltalight`: takes, scenes and renderers of a program's own."""

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

import deltalight as dl
from deltalight.protocol.camera_model import save_camera_yaml
from deltalight.protocol.frames import BoardPose
from deltalight.protocol.scene import load_scene
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera
from deltalight.services.demo import RECORDING, SCENE

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "python.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
SMALL = {"name": "dvct", "operator": "paper", "volume_size": 32, "rsm_size": 128, "triangle_budget": 5000}
SIZE = (160, 120)


@pytest.fixture(scope="module")
def take() -> dl.Take:
    opened = dl.open(RECORDING)
    assert isinstance(opened, dl.Take)
    return opened


@pytest.fixture
def scene() -> dl.Scene:
    """The demo's scene, small."""
    found = dl.Scene.load(SCENE)
    output = {"width": SIZE[0], "height": SIZE[1]}
    found.document = found.document.replaced(method=SMALL, output=output)
    return found


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("api") / "cube.glb"
    trimesh.creation.box((0.05, 0.05, 0.05)).export(path)
    return path


def test_importing_it_imports_nothing_else() -> None:
    script = "import sys, deltalight; deltalight.__version__; print(*(n for n in sys.modules if 'deltalight' in n))"
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["deltalight"]


def test_every_public_name_is_there_and_no_other() -> None:
    for name in dl.__all__:
        assert getattr(dl, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'Render'"):
        dl.Render  # noqa: B018


def test_a_take_is_a_sequence_of_frames(take: dl.Take) -> None:
    every_third = take[::3]
    assert isinstance(every_third, dl.Take)
    assert (len(take), len(every_third), len(take[4:6])) == (30, 10, 2)
    assert every_third[1].frame_id == take[3].frame_id
    assert take[-1].frame_id == take[29].frame_id
    assert [frame.frame_id for frame in take[4:6]] == [take[4].frame_id, take[5].frame_id]
    frame = take[0]
    assert frame.pose is not None
    assert frame.depth is not None
    assert take[np.int64(3)].frame_id == take[3].frame_id
    with pytest.raises(IndexError, match="has 30 frames, counted from 0, and none at 30"):
        take[30]
    assert take.scene is not None
    assert take.scene.document.objects[0].id == load_scene(SCENE).objects[0].id


def test_a_camera_is_a_take_that_goes_on() -> None:
    with dl.LiveTake(SyntheticCamera(realtime=False)) as live:
        frames = iter(live)
        first, second = next(frames), next(frames)
    assert second.timestamp_ns > first.timestamp_ns
    assert first.pose is not None
    assert isinstance(dl.open("synthetic"), dl.LiveTake)


@pytest.mark.parametrize("method", [None, "dlpv"])
def test_its_layers_compose_the_picture(
    take: dl.Take, scene: dl.Scene, cube: Path, method: str | None
) -> None:
    scene.add(cube, at=(0.1, 0.1, 0.025))
    with dl.Renderer(method, quality=None if method is None else "live") as renderer:
        picture = renderer.render(take[0], scene)
    assert picture.color.shape == (SIZE[1], SIZE[0], 3)
    camera = picture.linear - picture.delta
    cover = picture.coverage[..., None]
    composed = (1 - cover) * picture.ratio * camera + picture.additive
    assert composed == pytest.approx(picture.linear, abs=1e-5)
    alone = picture.coverage == 0
    assert 0.01 < 1 - alone.mean() < 0.2
    assert picture.ratio[alone].min() < 0.5, "a shadow"
    assert np.abs(picture.additive[alone]).max() < 1e-3, "diffuse surfaces change by their ratio"
    still = alone & (picture.delta == 0).all(axis=-1)
    assert (picture.ratio[still] == 1).all()


def test_depth_is_that_of_the_nearest_surface(take: dl.Take, scene: dl.Scene) -> None:
    with dl.Renderer() as renderer:
        picture = renderer.render(take[0], scene)
    frame = take[0]
    assert frame.depth is not None
    real = cv2.resize(frame.depth.depth_m, SIZE, interpolation=cv2.INTER_NEAREST)
    away = (picture.coverage == 0) & (real > 0) & (picture.depth > 0)
    assert np.median(np.abs(picture.depth[away] - real[away])) < 0.005
    front = (picture.coverage == 1) & (real > 0)
    assert (picture.depth[front] < real[front]).mean() > 0.95, "the knot stands before what the camera saw"


def test_a_frame_without_the_board_stays_as_it_is(take: dl.Take, scene: dl.Scene) -> None:
    camera = SyntheticCamera(realtime=False)
    with dl.LiveTake(camera) as live:
        (lost,) = [next(iter(live))]
    object.__setattr__(lost, "pose", None)
    with dl.Renderer() as renderer:
        picture = renderer.render(lost, scene)
        assert picture.composite.status == "no_pose"
        assert renderer.render(take[0], scene).composite.status == "ok"
    assert (picture.coverage.max(), picture.ratio.min(), np.abs(picture.delta).max()) == (0, 1, 0)


def test_scenes_change_while_a_renderer_lives_and_renderers_live_beside_each_other(
    take: dl.Take, scene: dl.Scene, cube: Path
) -> None:
    with dl.Renderer() as one, dl.Renderer("none", "live") as other:
        before = one.render(take[0], scene)
        name = scene.add(cube, at=(0.1, 0.1, 0.025))
        added = one.render(take[0], scene)
        scene.move(name, to=(0.1, 0.1, 0.125))
        moved = one.render(take[0], scene)
        bare = other.render(take[0], scene)
        scene.remove(name)
        after = one.render(take[0], scene)
        one.forget()
        again = one.render(take[0], scene)
    assert added.coverage.sum() > before.coverage.sum()
    assert moved.depth[added.coverage > 0].mean() != added.depth[added.coverage > 0].mean()
    assert (bare.ratio[bare.coverage == 0] == 1).all(), "method none changes no light"
    assert after.coverage == pytest.approx(before.coverage)
    assert again.color.astype(int) == pytest.approx(before.color.astype(int), abs=2)


def test_cameras_in_one_room_are_relit_together(take: dl.Take, scene: dl.Scene) -> None:
    """The second camera here is the first, a moment later: both pictures are those of one camera, but for noise."""
    with dl.Renderer() as renderer:
        first, second = renderer.render_views([take[0], take[15]], scene)
        renderer.forget()
        alone = renderer.render(take[0], scene)
    assert first.composite.frame_id == take[0].frame_id
    assert second.composite.frame_id == take[15].frame_id
    assert first.coverage == pytest.approx(alone.coverage)
    differs = np.abs(first.color.astype(int) - alone.color) > 4
    assert differs.mean() < 1e-3
    assert second.depth[second.coverage == 1] == pytest.approx(first.depth[second.coverage == 1], abs=0.02)


def test_objects_are_named_changed_and_saved(scene: dl.Scene, cube: Path, tmp_path: Path) -> None:
    assert [scene.add(cube), scene.add(cube), scene.add(cube, name="mine", scale=2)] == [
        "cube",
        "cube 2",
        "mine",
    ]
    scene.move("cube 2", to=np.array([0.1, 0.2, 0.3], np.float32))
    assert scene.document.objects[-2].pose.translation_m == pytest.approx((0.1, 0.2, 0.3))
    scene.change("cube", material=dl.Material(metallic=1.0), visible=False)
    scene.save(tmp_path / "saved.json")
    assert dl.Scene.load(tmp_path / "saved.json").document == scene.document


def test_wrong_input_is_a_sentence(scene: dl.Scene, cube: Path, tmp_path: Path) -> None:
    bag = tmp_path / "desk.bag"
    bag.touch()
    cases: dict[str, Callable[[], object]] = {
        "no object `cup`; it has: ": lambda: scene.move("cup", to=(0, 0, 0)),
        "does not exist; correct the path": lambda: scene.add(tmp_path / "cup.glb"),
        "has an object `knot` already": lambda: scene.add(cube, name="knot"),
        "is not a method; the nearest is dlpv": lambda: dl.Renderer("dlvp"),
        "name of a method is needed and `int` was given": lambda: dl.Renderer(5),  # type: ignore[arg-type]
        "device -1 is not possible; give a number from 0 on, as `deltalight doctor`": lambda: dl.Renderer(
            device=-1
        ),
        "device '0' is not possible": lambda: dl.Renderer(device="0"),  # type: ignore[arg-type]
        "device True is not possible": lambda: dl.Renderer(device=True),
        "no such GPU; name no device, or one that": lambda: dl.Renderer(device=99),
        "is a ROS bag; make a recording of it": lambda: dl.open(bag),
        "'fast' is not a quality; use one of live, balanced, best": lambda: dl.Renderer(quality="fast"),  # type: ignore[arg-type]
        r"the object `cube`: the key `pose.translation_m\[2\]` is missing": lambda: scene.add(
            cube, at=(1, 2)
        ),
        "`pose.scale` is wrong: input should be greater than 0": lambda: scene.add(cube, scale=0),
        "unknown key `colour`": lambda: scene.change("knot", colour="red"),
        "the nearest known key is `volume_size`": lambda: scene.document.replaced(
            method={"name": "dvct", "volume_siz": 32}
        ),
        "the path is empty; name a dataset folder": lambda: dl.open(""),
        "A recording, a dataset folder or a camera is needed and `int` was given": lambda: dl.open(5),  # type: ignore[arg-type]
        "path of a scene document is needed and None was given": lambda: dl.Scene.load(None),  # type: ignore[arg-type]
        "path of a scene document is needed and `dict` was given": lambda: scene.save({}),  # type: ignore[arg-type]
        "path of a mesh is needed and None was given": lambda: scene.add(None),  # type: ignore[arg-type]
        "demo.mcap is not a mesh file; use one of .glb": lambda: scene.add(RECORDING),
        "demo.mcap is not a mesh file": lambda: scene.change("knot", asset=RECORDING),
        "cannot be reached .File name too long": lambda: dl.open("x" * 5000),
        "'/' cannot be written .it names no file": lambda: scene.save("/"),
        "cannot be read|does not exist|no such": lambda: dl.open(tmp_path / "none.mcap"),
        "`pose.translation_m` is wrong: must be a list": lambda: scene.add(cube, at=5),  # type: ignore[arg-type]
        "scene document is needed and `dict` was given; make one with `deltalight.protocol.scene.parse_scene`": (
            lambda: dl.Scene({"name": "desk"})  # type: ignore[arg-type]
        ),
        "is a folder; name a mesh file": lambda: scene.add(tmp_path),
        "cup.glb does not exist; correct": lambda: scene.change("knot", asset="cup.glb"),
        "has its own calibration": lambda: dl.open(RECORDING, calibration=tmp_path),
        "has no calibration; run .* `calibration`": lambda: dl.open("uvc:0"),
        "rgb.yaml": lambda: dl.open("uvc:0", calibration=tmp_path),
    }
    for sentence, call in cases.items():
        with pytest.raises(dl.DeltalightError, match=sentence) as caught:
            call()
        assert "--device" not in str(caught.value)


def test_a_changed_asset_is_found_from_the_working_folder(
    scene: dl.Scene, cube: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A saved scene in another folder must still find it."""
    monkeypatch.chdir(cube.parent)
    scene.change("knot", asset=cube.name)
    scene.save(tmp_path / "saved.json")
    assert dl.Scene.load(tmp_path / "saved.json").document.objects[0].asset == str(cube)


def test_a_live_camera_is_opened_with_its_calibration(tmp_path: Path, take: dl.Take) -> None:
    folder = tmp_path / "calibration"
    folder.mkdir()
    save_camera_yaml(folder / "rgb.yaml", take[0].camera, "rgb")
    assert isinstance(dl.open("uvc:0", calibration=str(tmp_path)), dl.LiveTake)


def test_frames_of_a_programs_own_are_checked(take: dl.Take, scene: dl.Scene) -> None:
    """Arrays that do not fit were read beyond their ends; one exposure of 0 spoilt all later pictures."""
    frame = take[0]
    assert frame.pose is not None
    assert frame.depth is not None
    pose, depth = frame.pose.world_from_camera, frame.depth
    with dl.Renderer() as renderer:
        before = renderer.render(frame, scene)
        cases: dict[str, object] = {
            r"color must be an array of uint8 \(480, 640, 3\), and is float32": replace(
                frame, color=frame.color.astype(np.float32)
            ),
            "frame's camera is None; give a CameraModel": replace(frame, camera=None),  # type: ignore[arg-type]
            r"uint8 \(480, 640, 3\), and is uint8 \(480, 640\)": replace(frame, color=frame.color[..., 0]),
            r"and is uint8 \(100, 100, 3\); convert it": replace(frame, color=frame.color[:100, :100]),
            "the frame's pose is not a rigid transform": replace(frame, pose=BoardPose(pose * np.nan)),
            "the frame's pose must be a 4x4 matrix": replace(frame, pose=BoardPose(pose[:3])),
            r"write `BoardPose\(world_from_camera\)`": replace(frame, pose=pose),  # type: ignore[arg-type]
            "depth is `ndarray`; give a DepthImage": replace(frame, depth=depth.depth_m),  # type: ignore[arg-type]
            r"depth.depth_m must be an array of float32 \(480, 640\)": replace(
                frame, depth=replace(depth, depth_m=depth.depth_m[:100])
            ),
            "depth.valid must be an array of bool": replace(
                frame, depth=replace(depth, valid=depth.valid.astype(np.uint8))
            ),
            "exposure_scale is 0.0; give a number above 0": replace(frame, exposure_scale=0.0),
            "exposure_scale is None; give a number above 0": replace(frame, exposure_scale=None),  # type: ignore[arg-type]
            "timestamp_ns is None; give a whole number": replace(frame, timestamp_ns=None),  # type: ignore[arg-type]
            "frame_id is 1.5; give a whole number": replace(frame, frame_id=1.5),  # type: ignore[arg-type]
            "response holds values that are not finite": replace(
                frame, response=np.full((256, 3), np.nan, np.float32)
            ),
            "response must be an array of float32": replace(frame, response=np.zeros(256, np.float32)),
            "A frame is needed and `ndarray` was given": frame.color,
            "A frame is needed and None was given": None,
        }
        for sentence, wrong in cases.items():
            with pytest.raises(dl.DeltalightError, match=sentence):
                renderer.render(wrong, scene)  # type: ignore[arg-type]
        with pytest.raises(
            dl.DeltalightError, match=r"A list with a frame of each camera .* write `\[frame\]`"
        ):
            renderer.render_views(frame, scene)  # type: ignore[arg-type]
        no_scenes: tuple[Any, ...] = (None, "scene.json", {"objects": []})
        for no_scene in no_scenes:
            with pytest.raises(
                dl.DeltalightError, match=r"A scene is needed and .* load one with `Scene.load`"
            ):
                renderer.render(frame, no_scene)
        (after,) = renderer.render_views((each for each in take[:1]), scene)
    assert (after.color == before.color).all()
    assert repr(frame) == "<ViewFrame 0, 640x480, pose, depth>"


def test_a_closed_renderer_says_so(take: dl.Take, scene: dl.Scene) -> None:
    renderer = dl.Renderer()
    renderer.close()
    renderer.close()
    with pytest.raises(dl.DeltalightError, match="closed"):
        renderer.render(take[0], scene)


@pytest.mark.slow
def test_the_examples_of_the_page_run(tmp_path: Path, cube: Path) -> None:
    """As a reader would run them: one after the other, in a folder with the files that they name."""
    (tmp_path / "desk.mcap").write_bytes(RECORDING.read_bytes())
    (tmp_path / "bunny.glb").write_bytes(cube.read_bytes())
    example = dl.Scene.load(SCENE)
    example.document = example.document.replaced(output={"width": SIZE[0], "height": SIZE[1]})
    example.save(tmp_path / "scene.json")
    script = "\n".join(EXAMPLES)
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert len(EXAMPLES) == 4
    assert len(list(tmp_path.glob("relit_*.png"))) == 3
    assert (tmp_path / "methods.png").is_file()
