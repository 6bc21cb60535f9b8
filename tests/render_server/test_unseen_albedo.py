"""What the camera saw of a room lights objects when it looks elsewhere; registration is averaged over frames."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.estimation.samples import BackoffSchedule
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    HEIGHT,
    WIDTH,
    Stage,
    camera,
    cube,
    directional,
    floor,
    frame,
    look_at,
    plain,
    shifted,
)

FAST: dict[str, object] = {"cone_scale": 4, "cone_count": 8, "shadow_samples": 1}
FRONT = -0.29  # x of the wall's lit side
BESIDE = look_at((-0.33, -0.3, 0.9), (-0.12, 0, 0))  # sees the wall's back and top, not its front


def room(stage: Stage) -> SceneDocument:
    wall = shifted(trimesh.creation.box((0.02, 1.2, 0.5)), FRONT - 0.01, 0, 0.25)
    white = stage.virtual(cube(0.1, (-0.12, 0, 0)), (0.8, 0.8, 0.8))
    document = stage.document(
        [white], [directional((-0.9, 0.1, -0.5))], trimesh.util.concatenate([floor(1.0), wall]), **FAST
    )
    return document.replaced(real=document.real.model_copy(update={"unseen_albedo": None}))


def red_wall(pose: BoardPose) -> np.ndarray:
    """A grey room with a red wall."""
    rays = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))]) @ pose.world_from_camera[:3, :3].T
    eye = pose.world_from_camera[:3, 3]
    place = eye + rays * ((FRONT - eye[0]) / rays[..., :1])
    on_wall = (rays[..., 0] < 0) & (np.abs(place[..., 1]) < 0.6) & (place[..., 2] > 0) & (place[..., 2] < 0.5)
    picture = plain(120)
    picture[on_wall] = (190, 30, 30)
    return picture


def redness(gpu: GpuContext, scene: SceneDocument, frames: list[ViewFrame]) -> float:
    """Red over blue of the object in the last frame's composite, linear, where it differs from the picture."""
    renderer = SceneRenderer(gpu, scene, with_linear=True)
    composites = [renderer.render(view) for view in frames]
    renderer.release()
    linear = composites[-1].linear
    assert linear is not None
    shown = np.abs(composites[-1].color.astype(int) - frames[-1].color).max(axis=-1) > 40
    assert shown.sum() > 150
    red, _, blue = linear[shown].mean(axis=0)
    return float(red / blue)


@pytest.mark.slow
@pytest.mark.usefixtures("clean_gl")
def test_a_wall_out_of_sight_keeps_its_colour(gpu: GpuContext, tmp_path: Path) -> None:
    scene = room(Stage(tmp_path))
    facing = look_at((0.7, -0.2, 0.6), (-0.3, 0, 0.2))
    before = frame(red_wall(facing), pose=facing, timestamp_ns=0)
    now = frame(plain(120), pose=BESIDE, timestamp_ns=2_000_000_000, frame_id=1)
    assert redness(gpu, scene, [now]) == pytest.approx(1, abs=0.02)
    assert redness(gpu, scene, [before, now]) > 1.05
    given = scene.replaced(real=scene.real.model_copy(update={"unseen_albedo": 0.5}))
    assert redness(gpu, given, [before, now]) == pytest.approx(1, abs=0.02)


@pytest.mark.slow
@pytest.mark.usefixtures("clean_gl")
def test_another_room_begins_without_memory(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    first, second = room(stage), room(stage)
    facing = look_at((0.7, -0.2, 0.6), (-0.3, 0, 0.2))
    renderer = SceneRenderer(gpu, first)
    renderer.render(frame(red_wall(facing), pose=facing, timestamp_ns=0))
    renderer.set_scene(second)
    now = frame(plain(120), pose=BESIDE, timestamp_ns=2_000_000_000, frame_id=1)
    after = renderer.render(now).color
    renderer.release()
    fresh = SceneRenderer(gpu, second)
    assert np.array_equal(after, fresh.render(now).color)
    fresh.release()


def test_the_interval_grows_and_survives_a_clock_that_is_set_back() -> None:
    interval = BackoffSchedule()
    due = [second for second in range(200) if interval.is_due(second * 10**9)]
    assert due == [0, 1, 3, 7, 15, 31, 61, 91, 121, 151, 181]
    assert not interval.is_due(5 * 10**9)
    assert interval.is_due(35 * 10**9)


@pytest.mark.slow
@pytest.mark.usefixtures("clean_gl")
def test_registration_is_averaged_over_moved_frames_only(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    document = stage.document(
        [stage.virtual(cube(0.05, (-0.2, 0.15, 0)))], [directional((0, 0, -1), 1.0)], floor(), **FAST
    )
    scene = document.replaced(lights=document.lights.model_copy(update={"registration": "auto"}))
    renderer = SceneRenderer(gpu, scene)

    def factor(code: int, second: int, shift: float) -> float:
        view = frame(plain(code), pose=look_at((shift, -0.9, 0.65)), timestamp_ns=second * 10**9)
        return float(renderer.render(view).lights[0]["irradiance"][0])

    first, still, moved = factor(100, 0, 0.0), factor(101, 5, 0.0), factor(140, 10, 0.2)
    fresh = SceneRenderer(gpu, scene)
    view = frame(plain(140), pose=look_at((0.2, -0.9, 0.65)))
    alone = float(fresh.render(view).lights[0]["irradiance"][0])
    assert still == first
    assert alone > 1.5 * first
    assert moved == pytest.approx((first + alone) / 2, rel=0.02)
    renderer.release()
    fresh.release()
