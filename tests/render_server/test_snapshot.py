"""One frame written in several views and methods: the files, what is refused, and that nothing else changes."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.documents import validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.radiance_files import read_linear
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.camera_frames import CameraFrame
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.server.snapshot import SnapshotRequest, take_snapshot
from tests.render_server.scenes import (
    Stage,
    ambient,
    ball,
    checkered,
    composite,
    cube,
    depth_image,
    directional,
    everyday,
    floor_depth,
    frame,
    look_at,
    noisy,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
NONE = {"name": "none"}
DLPV = {"name": "dlpv", "volume_size": 16, "rsm_size": 256, "query_scale": 2}


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "snapshot"
    made.mkdir()
    return made


def read_png(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    return np.asarray(picture[..., ::-1])


def order(folder: Path, *pictures: Mapping[str, object], exr: bool = False) -> SnapshotRequest:
    data = {"folder": str(folder), "pictures": pictures, "exr": exr}
    return validate(SnapshotRequest, data, "the order")


def with_view(document: SceneDocument, view: str) -> SceneDocument:
    return document.replaced(output=document.output.replaced(view=view))


def with_method(document: SceneDocument, method: Mapping[str, object]) -> SceneDocument:
    return SceneDocument.model_validate({**document.model_dump(), "method": method})


@pytest.mark.slow
def test_each_picture_is_what_that_view_and_method_alone_would_show(
    gpu: GpuContext, stage: Stage, folder: Path
) -> None:
    document = everyday(stage, cone_scale=2, cone_count=8)
    document = document.replaced(output=document.output.replaced(width=80))
    view = frame(checkered())
    pictures: list[dict[str, object]] = [
        {"name": "plain"},
        {"name": "delta", "view": "delta"},
        {"name": "maps", "view": "rsm"},
        {"name": "camera", "view": "camera"},
        {"name": "none", "method": NONE},
        {"name": "dlpv-delta", "view": "delta", "method": DLPV},
    ]
    renderer = SceneRenderer(gpu, with_view(document, "volume"))
    before = renderer.render(view).color
    taken = take_snapshot(
        renderer,
        with_view(document, "volume"),
        CameraFrame.numbered([view]),
        order(folder, *pictures, exr=True),
    )
    after = renderer.render(frame(checkered(), frame_id=1)).color
    renderer.release()
    assert taken.errors == {}
    assert taken.files == [f"{picture['name']}.png" for picture in pictures] + ["composite.exr"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(taken.files)
    np.testing.assert_array_equal(before, after)
    alone = {
        "plain": document,
        "delta": with_view(document, "delta"),
        "maps": with_view(document, "rsm"),
        "none": with_method(document, NONE),
        "dlpv-delta": with_view(with_method(document, DLPV), "delta"),
    }
    for name, scene in alone.items():
        np.testing.assert_array_equal(read_png(folder / f"{name}.png"), composite(gpu, scene, view), name)
    resized = cv2.resize(view.color, (80, 60), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(read_png(folder / "camera.png"), resized)
    lone = SceneRenderer(gpu, document, with_linear=True)
    np.testing.assert_array_equal(read_linear(folder / "composite.exr"), lone.render(view).linear)
    lone.release()


def test_one_that_fails_is_named_and_the_others_are_written(
    gpu: GpuContext, stage: Stage, folder: Path
) -> None:
    document = everyday(stage)
    view = frame()
    too_large = {"volume_size": 512, "memory_budget_mb": 16}
    renderer = SceneRenderer(gpu, document)
    before = renderer.render(view).color
    taken = take_snapshot(
        renderer,
        document,
        CameraFrame.numbered([view]),
        order(
            folder,
            {"name": "huge", "method": too_large},
            {"name": "odd", "view": "upside"},
            {"name": "strange", "method": {"name": "dvvct"}},
            {"name": "good"},
        ),
    )
    assert taken.files == ["good.png"]
    assert set(taken.errors) == {"huge", "odd", "strange"}
    assert "memory_budget_mb" in taken.errors["huge"]
    assert "output.view" in taken.errors["odd"]
    assert "dvct" in taken.errors["strange"]
    np.testing.assert_array_equal(read_png(folder / "good.png"), before)
    assert renderer.scene == document
    renderer.release()


def noisy_view(number: int) -> ViewFrame:
    """A chequered floor and its noisy depth; the camera goes along."""
    pose = look_at((0.25 + 0.005 * number, -0.9, 0.65))
    depth = floor_depth(pose)
    noise = np.random.default_rng(number).normal(0, 0.003, depth.shape).astype(np.float32)
    image = depth_image(np.where(depth > 0, depth + noise * depth**2, 0).astype(np.float32))
    return frame(checkered(), pose=pose, depth=image, frame_id=number, timestamp_ns=number * 10**9)


def learning(stage: Stage) -> SceneDocument:
    """A scene in which all is found from the frames and averaged over them: surface, albedo, factor of the lights."""
    objects = [stage.virtual(ball(), (0.8, 0.2, 0.1)), stage.virtual(cube(0.08, (0.12, 0.08, 0)))]
    document = stage.document(
        objects, [directional(), ambient(0.2)], triangle_budget=2000, cone_scale=4, cone_count=4
    )
    return document.replaced(
        output=document.output.replaced(width=80),
        real=document.real.replaced(geometry="fused", unseen_albedo=None),
        lights=document.lights.replaced(registration="auto"),
    )


@pytest.mark.slow
def test_what_is_averaged_over_frames_is_as_if_there_had_been_no_snapshot(
    gpu: GpuContext, stage: Stage, folder: Path
) -> None:
    document = learning(stage)
    pictures = []
    for with_snapshot in (False, True):
        renderer = SceneRenderer(gpu, document)
        for number in range(4):
            view = noisy_view(number)
            renderer.render(view)
            if with_snapshot and number == 2:
                wanted = order(
                    folder, {"name": "dlpv", "method": DLPV}, {"name": "none", "method": NONE}, exr=True
                )
                assert take_snapshot(renderer, document, CameraFrame.numbered([view]), wanted).errors == {}
        pictures.append(renderer.render(noisy_view(4)).color)
        renderer.release()
    np.testing.assert_array_equal(pictures[0], pictures[1])


@pytest.mark.slow
def test_another_source_begins_as_if_there_had_been_none(gpu: GpuContext, stage: Stage) -> None:
    document = learning(stage)
    pictures = []
    for others in (0, 3):
        renderer = SceneRenderer(gpu, document)
        for number in range(others):
            view = noisy_view(10 + number)
            renderer.render(replace(view, color=255 - view.color))
        if others:
            renderer.forget_frames()
            with pytest.raises(DeltalightError, match="Nothing has been rendered yet"):
                renderer.pick(1, 1)
        pictures.append([renderer.render(noisy_view(number)).color for number in range(2)])
        renderer.release()
    np.testing.assert_array_equal(pictures[0], pictures[1])


def test_a_frame_without_pose_is_the_cameras_picture_linear_too(
    gpu: GpuContext, stage: Stage, folder: Path
) -> None:
    document = everyday(stage)
    view = replace(frame(noisy()), pose=None)
    renderer = SceneRenderer(gpu, document)
    room = CameraFrame.numbered([view])
    assert take_snapshot(renderer, document, room, order(folder, {"name": "a"}, exr=True)).errors == {}
    renderer.release()
    np.testing.assert_array_equal(read_png(folder / "a.png"), view.color)
    linear = read_linear(folder / "composite.exr")
    assert linear[view.color == 255] == pytest.approx(1.0)
    assert linear[view.color == 128] == pytest.approx(0.2158605, rel=1e-4)  # sRGB


def test_orders_that_cannot_be_carried_out_are_sentences(gpu: GpuContext, stage: Stage, folder: Path) -> None:
    for name in ("../up", "a/b", "", ".hidden", "a.png", "x" * 65):
        with pytest.raises(DeltalightError, match=r"pictures\[0\].name"):
            order(folder, {"name": name})
    with pytest.raises(DeltalightError, match="same name"):
        order(folder, {"name": "a"}, {"name": "a", "view": "delta"})
    with pytest.raises(DeltalightError, match="pictures"):
        order(folder, *({"name": f"n{number}"} for number in range(33)))
    document = everyday(stage)
    renderer = SceneRenderer(gpu, document)
    with pytest.raises(DeltalightError, match="There is no folder"):
        take_snapshot(
            renderer, document, CameraFrame.numbered([frame()]), order(folder / "missing", {"name": "a"})
        )
    renderer.release()
