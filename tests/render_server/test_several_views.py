"""Several cameras in one room: one real scene and its light for all, and a picture for each."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import CompositeFrame, SceneRenderer
from tests.render_server.scenes import (
    HEIGHT,
    WIDTH,
    Stage,
    camera,
    cube,
    depth_image,
    directional,
    floor,
    frame,
    look_at,
    shifted,
)

pytestmark = pytest.mark.usefixtures("clean_gl")

FAST: dict[str, object] = {"cone_scale": 4, "cone_count": 8, "shadow_samples": 1}
FRONT, BACK, TOP, END = -0.29, -0.31, 0.5, 0.6  # of a wall: x of both sides, height, half its length
BESIDE = look_at((-0.33, -0.3, 0.9), (-0.12, 0, 0))  # sees the wall's back and top, not its front
FACING = look_at((0.7, -0.2, 0.6), (-0.3, 0, 0.2))  # sees its front
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


def document(stage: Stage, geometry: str, **method: object) -> SceneDocument:
    """A white cube before the wall, whose front is lit."""
    wall = shifted(trimesh.creation.box((FRONT - BACK, 2 * END, TOP)), (FRONT + BACK) / 2, 0, TOP / 2)
    white = stage.virtual(cube(0.1, (-0.12, 0, 0)), (0.8, 0.8, 0.8))
    model = trimesh.util.concatenate([floor(1.0), wall])
    given = stage.document([white], [directional((-0.9, 0.1, -0.5))], model, **{**FAST, **method})
    if geometry == "model":
        return given
    return given.replaced(real=given.real.model_copy(update={"geometry": geometry}))


@pytest.fixture
def renderers(gpu: GpuContext) -> Iterator[list[SceneRenderer]]:
    made: list[SceneRenderer] = []
    yield made
    for each in made:
        each.release()


def redness(composite: CompositeFrame, view: ViewFrame) -> float:
    """Red over blue of the object in the composite, linear, where it differs from the picture."""
    assert composite.linear is not None
    shown = np.abs(composite.color.astype(int) - view.color).max(axis=-1) > 40
    assert shown.sum() > 150
    red, _, blue = composite.linear[shown].mean(axis=0)
    return float(red / blue)


@pytest.mark.parametrize("geometry", ["model", "depth", "fused"])
def test_what_another_camera_sees_lights_the_object(
    gpu: GpuContext, tmp_path: Path, renderers: list[SceneRenderer], geometry: str
) -> None:
    scene = document(Stage(tmp_path), geometry)
    beside, facing = seen_room(BESIDE), seen_room(FACING)
    renderers += [SceneRenderer(gpu, scene, with_linear=True) for _ in range(2)]
    alone, together = renderers
    assert redness(alone.render(beside), beside) == pytest.approx(1, abs=0.02)
    first, second = together.render_views([beside, facing])
    print(geometry, redness(first, beside), redness(second, facing), redness(alone.render_views([facing])[0], facing))
    import cv2
    cv2.imwrite(f"/tmp/lab/{geometry}.png", cv2.resize(np.hstack([beside.color, first.color, facing.color, second.color])[..., ::-1], None, fx=2, fy=2))
    assert redness(first, beside) > 1.05
