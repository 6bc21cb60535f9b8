"""`real.geometry: fused` in the renderer: holes filled, noise averaged, things that moved, a scene at rest."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.real_geometry import STILL_FRAMES
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    COARSE,
    HEIGHT,
    WIDTH,
    Stage,
    ambient,
    checkered,
    cube,
    depth_image,
    directional,
    fields_of,
    floor_depth,
    frame,
    look_at,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
NOISE_M = 0.001  # as `depth_image` says
HOLE = np.s_[50:90, 40:80]


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, COARSE)


def document(stage: Stage) -> SceneDocument:
    cast = [stage.virtual(cube(0.1), (0.7, 0.3, 0.2))]
    plain = stage.document(cast, [directional((0.4, 0.2, -1)), ambient(0.2)])
    return plain.replaced(real=plain.real.replaced(geometry="fused"))


def noisy_floor(
    seed: int, pose: BoardPose | None = None, *, hole: bool = False, height: float = 0.0
) -> ViewFrame:
    """The floor as a noisy depth camera sees it; `height` of the part where the hole would be."""
    pose = pose or look_at()
    depth, raised = floor_depth(pose), floor_depth(pose, height)
    depth[HOLE] = raised[HOLE]
    noise = NOISE_M * np.random.default_rng(seed).standard_normal(depth.shape)
    measured = np.where(depth > 0, depth + noise * depth**2, 0).astype(np.float32)
    known = np.ones(depth.shape, bool)
    known[HOLE] = not hole
    return frame(checkered(), pose=pose, depth=depth_image(measured, known))


def height_of(renderer: SceneRenderer) -> np.ndarray:
    """World z of the real surface at each pixel, NaN where it is unknown."""
    position = fields_of(renderer).position
    return np.asarray(np.where(position[..., 3] > 0, position[..., 2], np.nan))


def test_a_hole_shows_what_earlier_frames_saw_there(gpu: GpuContext, stage: Stage) -> None:
    renderer = SceneRenderer(gpu, document(stage))
    renderer.render(noisy_floor(0))
    aside = look_at((0.27, -0.9, 0.65))
    renderer.render(noisy_floor(1, aside, hole=True))
    seen = height_of(renderer)[HOLE]
    renderer.release()
    assert np.isfinite(seen).mean() > 0.99
    assert np.nanmedian(np.abs(seen)) < 0.002


@pytest.mark.slow
def test_noise_is_averaged_over_frames(gpu: GpuContext, stage: Stage) -> None:
    fused = document(stage)
    spread = []
    for scene in (fused.replaced(real=fused.real.replaced(geometry="depth")), fused):
        renderer = SceneRenderer(gpu, scene)
        for number in range(6):
            renderer.render(noisy_floor(number, look_at((0.25 + 0.01 * number, -0.9, 0.65))))
        spread.append(float(np.nanstd(height_of(renderer)[40:100, 30:130])))
        renderer.release()
    assert spread[1] < 0.4 * spread[0]


def test_what_moved_shows_where_it_is_now(gpu: GpuContext, stage: Stage) -> None:
    renderer = SceneRenderer(gpu, document(stage))
    for number in range(3):
        renderer.render(noisy_floor(number, look_at((0.25 + 0.01 * number, -0.9, 0.65))))
    renderer.render(noisy_floor(3, look_at((0.28, -0.9, 0.65)), height=0.08))
    seen = height_of(renderer)[55:85, 45:75]
    renderer.release()
    assert np.nanmedian(seen) == pytest.approx(0.08, abs=0.005)


def test_a_scene_at_rest_becomes_the_same_picture_bit_for_bit(gpu: GpuContext, stage: Stage) -> None:
    renderer = SceneRenderer(gpu, document(stage))
    pictures = [renderer.render(noisy_floor(number)).color for number in range(STILL_FRAMES + 4)]
    assert renderer.graph is not None
    settled = renderer.graph.resource("real geometry").version
    renderer.render(noisy_floor(99))
    assert renderer.graph.resource("real geometry").version == settled
    renderer.release()
    for picture in pictures[STILL_FRAMES + 2 :]:
        np.testing.assert_array_equal(picture, pictures[STILL_FRAMES + 1])
    assert (pictures[-1] != checkered()).any()


def test_frames_without_any_depth_live_on_what_was_fused(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path, {**COARSE, "triangle_budget": 40000})  # the rim of a coarse mesh is ragged
    renderer = SceneRenderer(gpu, document(stage))
    renderer.render(noisy_floor(0))
    nothing = depth_image(np.zeros((HEIGHT, WIDTH), np.float32))
    blind = frame(checkered(), pose=look_at((0.27, -0.9, 0.65)), depth=nothing)
    picture = renderer.render(blind).color
    seen = height_of(renderer)
    renderer.release()
    assert np.isfinite(seen[40:, 10:-10]).mean() > 0.9
    shadow = (picture.astype(int) - blind.color).mean(axis=-1) < -10
    assert shadow.sum() > 50


def test_a_poor_pose_moves_the_fused_surface_with_the_picture(gpu: GpuContext, stage: Stage) -> None:
    """The board says that the camera is 6 mm higher than it is: so is what its depth shows, as without fusion."""
    renderer = SceneRenderer(gpu, document(stage))
    truth, aside = look_at(), look_at((0.27, -0.9, 0.65))
    renderer.render(noisy_floor(0, BoardPose(truth.world_from_camera, 0.5)))
    wrong = aside.world_from_camera.copy()
    wrong[2, 3] += 0.006
    measured = noisy_floor(1, aside, hole=True)
    shifted = frame(measured.color, pose=BoardPose(wrong, 0.5), depth=measured.depth)
    renderer.render(shifted)
    seen = height_of(renderer)
    renderer.release()
    assert np.nanmedian(seen) == pytest.approx(0.006, abs=0.002)
    assert np.nanmedian(seen[HOLE]) == pytest.approx(0.006, abs=0.003)


def test_without_depth_at_all_fused_says_so(gpu: GpuContext, stage: Stage) -> None:
    renderer = SceneRenderer(gpu, document(stage))
    with pytest.raises(Exception, match="no depth"):
        renderer.render(frame(checkered()))
    renderer.release()
