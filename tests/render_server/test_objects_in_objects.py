"""Mirror-like objects show the others by rays, and lamps as they are: where optics says, and as bright."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from jaxtyping import Bool, Float64

from deltalight.protocol.frames import decode_lut
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.reflections import RAY_ROUGHNESS
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    COARSE,
    GREY,
    HEIGHT,
    WIDTH,
    Fields,
    Stage,
    ambient,
    array_of,
    ball,
    camera,
    cube,
    fields_of,
    floor,
    frame,
    look_at,
    plain,
    shifted,
    sphere_light,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
GLOW = (0.6, 0.2, 0.1)
SILVER: dict[str, Any] = {"metallic": 1.0, "roughness": 0.0}
WHITE = (1.0, 1.0, 1.0)
AROUND = np.ones((3, 3), np.uint8)
RADIUS, CENTRE = 0.15, np.array([-0.06, 0.05, 0.15])
EDGE, BESIDE = 0.15, np.array([0.15, -0.1, 0.0])


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, COARSE)


def silver_ball(stage: Stage, roughness: float = 0.0) -> dict[str, Any]:
    mesh = ball(RADIUS, (CENTRE[0], CENTRE[1], CENTRE[2]), detail=5)
    return stage.virtual(mesh, WHITE, {**SILVER, "roughness": roughness})


def glowing_cube(stage: Stage) -> dict[str, Any]:
    return stage.virtual(cube(EDGE, (BESIDE[0], BESIDE[1], BESIDE[2])), (0, 0, 0), {"emission": GLOW})


def shown(gpu: GpuContext, document: SceneDocument) -> tuple[np.ndarray | None, Fields]:
    """What rays saw of objects in objects (h, w, 4), if any were traced; and the fields."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame(plain()))
    assert renderer.graph is not None
    mirrored = renderer.graph["mirrored objects"]
    found, fields = None if mirrored is None else array_of(mirrored), fields_of(renderer)
    renderer.release()
    return found, fields


def camera_ways() -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "h w 3"]]:
    """Where the camera is, and the unit directions of its pixels."""
    pose = look_at().world_from_camera
    ways = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))]) @ pose[:3, :3].T
    return pose[:3, 3], ways / np.linalg.norm(ways, axis=2, keepdims=True)


def ball_mirror() -> tuple[
    Bool[np.ndarray, "h w"], Float64[np.ndarray, "h w 3"], Float64[np.ndarray, "h w 3"]
]:
    """Pixels that show the ball, where they meet it, and the mirrored directions there."""
    eye, ways = camera_ways()
    along = (CENTRE - eye) @ np.moveaxis(ways, 2, 1)
    left = along**2 - ((CENTRE - eye) @ (CENTRE - eye) - RADIUS**2)
    met = left > 0
    place = eye + (along - np.sqrt(np.maximum(left, 0)))[..., None] * ways
    normal = (place - CENTRE) / RADIUS
    return met, place, ways - 2 * np.sum(ways * normal, axis=2, keepdims=True) * normal


def meets_cube(place: np.ndarray, ways: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Which rays meet the cube (slabs)."""
    low = BESIDE + np.array([-EDGE / 2, -EDGE / 2, 0.0])
    a, b = (low - place) / ways, (low + EDGE - place) / ways
    enter, leave = np.minimum(a, b).max(axis=2), np.maximum(a, b).min(axis=2)
    return np.asarray((enter < leave) & (leave > 0))


def centroid(mask: np.ndarray) -> Float64[np.ndarray, "2"]:
    return np.asarray(np.argwhere(mask).mean(axis=0))


def test_ball_shows_the_cube_where_optics_says(gpu: GpuContext, stage: Stage) -> None:
    """Image of a cube in a mirror ball beside it: its outline within a pixel, its radiance within 3 %."""
    document = stage.document([silver_ball(stage), glowing_cube(stage)], [ambient(0.2)], floor())
    found, fields = shown(gpu, document)
    assert found is not None
    on_ball, place, back = ball_mirror()
    expected = on_ball & meets_cube(place, back)
    in_front = cv2.dilate(meets_cube(*camera_ways()).astype(np.uint8), AROUND) > 0
    whole = cv2.erode(on_ball.astype(np.uint8), AROUND, iterations=2).astype(bool) & ~in_front
    expected &= whole
    image = whole & (found[..., 3] > 0.5)
    assert expected.sum() > 60
    assert np.abs(centroid(image) - centroid(expected)).max() < 0.5
    grown, shrunk = (f(expected.astype(np.uint8), AROUND) > 0 for f in (cv2.dilate, cv2.erode))
    assert not np.any(image & ~grown)
    assert not np.any(shrunk & ~image)
    inner = shrunk & whole
    assert fields.virtual_radiance[inner] == pytest.approx(np.broadcast_to(GLOW, (inner.sum(), 3)), rel=0.03)


def test_rough_and_lonely_objects_show_none(gpu: GpuContext, stage: Stage) -> None:
    """From the roughness of voxels' cones on nothing is traced; a convex object does not see itself."""
    rough = stage.document([silver_ball(stage, RAY_ROUGHNESS), glowing_cube(stage)], [ambient(0.2)], floor())
    assert shown(gpu, rough)[0] is None
    lonely, _ = shown(gpu, stage.document([silver_ball(stage)], [ambient(0.2)], floor()))
    assert lonely is not None
    assert not lonely.any()


def test_rough_mirror_blurs_and_keeps_the_light(gpu: GpuContext, stage: Stage) -> None:
    """The cube's image in a brushed ball is wider than in a polished one, and as bright in sum, within 10 %."""
    sums, partly = [], []
    for roughness in (0.0, 0.2):
        objects = [silver_ball(stage, roughness), glowing_cube(stage)]
        found, _ = shown(gpu, stage.document(objects, [ambient(0.2)], floor()))
        assert found is not None
        sums.append(found[..., 0].sum())
        partly.append(np.mean((found[..., 3] > 0.05) & (found[..., 3] < 0.95)))
    assert sums[1] == pytest.approx(sums[0], rel=0.1)
    assert partly[1] > 1.5 * partly[0]


def test_parallel_mirrors_make_no_light(gpu: GpuContext, stage: Stage) -> None:
    """Two silver plates face each other in even light: neither shows more than that, and little less."""
    around = float(decode_lut(None)[GREY, 0])
    plates = [
        stage.virtual(shifted(trimesh.creation.box((0.3, 0.01, 0.2)), 0, y, 0.15), WHITE, SILVER)
        for y in (-0.12, 0.12)
    ]
    document = stage.document(plates, [ambient(around)], floor())
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame(plain(), pose=look_at((0.5, -0.45, 0.45), (0.0, 0.1, 0.15))))
    assert renderer.graph is not None
    mirrored, fields = array_of(renderer.graph["mirrored objects"]), fields_of(renderer)
    renderer.release()
    facing = (fields.matte == 1) & (mirrored[..., 3] > 0.99)
    assert facing.sum() > 100
    share = fields.virtual_radiance[facing] / around
    assert share.max() < 1.02
    assert share.mean() > 0.95


def test_smooth_ball_shows_the_lamp_itself(gpu: GpuContext, stage: Stage) -> None:
    """A lamp in a mirror ball: as bright as it is, where mirrored rays meet it, within a pixel."""
    position, intensity, radius = np.array([0.3, -0.6, 0.8]), 0.8, 0.35
    lamp = sphere_light((position[0], position[1], position[2]), intensity, radius)
    _, fields = shown(gpu, stage.document([silver_ball(stage)], [lamp], floor()))
    on_ball, place, back = ball_mirror()
    to = position - place
    along = np.sum(to * back, axis=2)
    meets = on_ball & (along > 0) & (np.sum(to * to, axis=2) - along**2 < radius**2)
    radiance = intensity / (np.pi * radius**2)
    grown, shrunk = (f(meets.astype(np.uint8), AROUND) > 0 for f in (cv2.dilate, cv2.erode))
    seen = fields.virtual_radiance[..., 1]
    assert shrunk.sum() > 8
    assert seen[shrunk] == pytest.approx(radiance, rel=0.05)
    outside = cv2.erode(on_ball.astype(np.uint8), AROUND, iterations=2).astype(bool) & ~grown
    assert seen[outside].max() < 0.5 * radiance
