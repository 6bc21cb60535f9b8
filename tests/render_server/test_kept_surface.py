"""A kept world under poses that err: the board of a later frame may place a floor below the kept one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.protected_scenes import EYE, Case, scene_of
from tests.render_server.scenes import GREY, Stage, depth_image, floor_depth, frame, look_at, psnr_db

pytestmark = pytest.mark.usefixtures("clean_gl")
LATER_NS = 50_000_000  # sooner than a kept world is rebuilt


def seen(number: int, *, lifted_m: float = 0.0, aside_m: float = 0.0) -> ViewFrame:
    """A grey floor; the pose says that the camera, and so the floor, is so much higher than it is."""
    pose = look_at(EYE, (aside_m, 0.0, 0.06))
    depth = floor_depth(pose)
    color = np.full((*depth.shape, 3), GREY, np.uint8)
    erring = np.array(pose.world_from_camera)
    erring[2, 3] += lifted_m
    taken = frame(color, depth=depth_image(depth), frame_id=number, timestamp_ns=number * LATER_NS)
    return replace(taken, pose=BoardPose(erring))


def live(tmp_path: Path, method: str) -> SceneDocument:
    scene = scene_of(Case(method, "depth", "plain"), Stage(tmp_path))
    size = scene.output.replaced(
        width=320, height=240
    )  # in small ones, light of the frame before serves for longer
    return scene.replaced(method=scene.method.replaced(quality="live"), output=size)


def shown(gpu: GpuContext, scene: SceneDocument, *frames: ViewFrame) -> np.ndarray:
    """The last picture of a sequence."""
    renderer = SceneRenderer(gpu, scene)
    pictures = [renderer.render(each).color.astype(float) for each in frames]
    renderer.release()
    return pictures[-1]


@pytest.mark.parametrize("method", ["exact", "paper", "dlpv", "aroof"])
def test_a_floor_below_the_kept_one_is_not_in_its_shadow(
    gpu: GpuContext, tmp_path: Path, method: str
) -> None:
    scene = live(tmp_path, method)
    first, second = seen(0), seen(1, lifted_m=-0.02, aside_m=0.016)
    kept, alone = shown(gpu, scene, first, second), shown(gpu, scene, second)
    changed = np.abs(alone - GREY).max(axis=-1) > 2
    assert changed.mean() > 0.05
    assert psnr_db(kept[changed], alone[changed]) > 38
