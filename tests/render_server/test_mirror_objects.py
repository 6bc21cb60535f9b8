"""Virtual objects in smooth real surfaces: where optics says, as bright as they are, and nothing else changes."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_objects import Surface
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.reflections import RAY_ROUGHNESS
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    COARSE,
    HEIGHT,
    WIDTH,
    Stage,
    ambient,
    array_of,
    ball,
    camera,
    composite,
    depth_image,
    floor,
    floor_depth,
    frame,
    look_at,
    noisy,
    plain,
    shifted,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
RADIUS, HEIGHT_M = 0.06, 0.14
EMISSION = 0.6
SILVER = 0.9
AROUND = np.ones((3, 3), np.uint8)
FLOOR = {"plane": {"point_m": [0, 0, 0], "normal": [0, 0, 1], "tolerance_m": 0.02}}


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, COARSE)


def declared(document: SceneDocument, roughness: float, **more: Any) -> SceneDocument:  # noqa: ANN401
    """The document with a floor of polished silver."""
    surface = {"region": FLOOR, "metallic": 1.0, "albedo": [SILVER] * 3, "roughness": roughness, **more}
    real = document.real.model_copy(update={"surfaces": (Surface.model_validate(surface),)})
    return document.replaced(real=real)


def glowing_ball(stage: Stage, real: trimesh.Trimesh | None = None) -> SceneDocument:
    material = {"emission": [EMISSION] * 3}
    at = (0.0, 0.0, HEIGHT_M)
    objects = [stage.virtual(ball(RADIUS, at, detail=4), (0, 0, 0), material)]
    return stage.document(objects, [ambient(0.2)], real)


def over_floor(color: np.ndarray | None = None, noise_m: float = 0.0) -> ViewFrame:
    depth = floor_depth(look_at())
    noise = np.random.default_rng(3).normal(size=depth.shape) * noise_m
    return frame(plain() if color is None else color, depth=depth_image((depth + noise).astype(np.float32)))


def mirrored_ball() -> np.ndarray:
    """Pixels whose centre's ray meets the ball's mirror image below the floor, (h, w)."""
    pose = look_at().world_from_camera
    rays = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))]) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    to = np.array([0.0, 0.0, -HEIGHT_M]) - pose[:3, 3]
    return np.asarray(to @ to - (rays @ to) ** 2 < RADIUS**2)


def reflection(gpu: GpuContext, document: SceneDocument, view: ViewFrame) -> np.ndarray:
    """(h, w, 4): reflected radiance of objects, share of the lobe."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(view)
    assert renderer.graph is not None
    found = array_of(renderer.graph["reflections"])
    renderer.release()
    return found


def object_coverage(gpu: GpuContext, document: SceneDocument, view: ViewFrame) -> np.ndarray:
    renderer = SceneRenderer(gpu, document)
    renderer.render(view)
    assert renderer.graph is not None
    found = array_of(renderer.graph["object surface"].coverage.texture)[..., 0]
    renderer.release()
    return found


@pytest.mark.slow
@pytest.mark.parametrize("noise_m", [0.0, 0.002])
def test_mirror_shows_the_object_where_optics_says(gpu: GpuContext, stage: Stage, noise_m: float) -> None:
    """Silhouette within 1.5 pixels, radiance within 3 %, on a noisy depth image too: the declared plane is flat."""
    view = over_floor(noise_m=noise_m)
    document = declared(glowing_ball(stage), 0.02)
    expected = mirrored_ball().astype(np.uint8)
    beside = object_coverage(gpu, document, view) == 0
    seen = reflection(gpu, document, view)
    shown = (seen[..., 3] > 0.5).astype(np.uint8)
    assert not np.any(shown[beside] > cv2.dilate(expected, AROUND)[beside])
    assert not np.any(cv2.erode(expected, AROUND)[beside] > shown[beside])
    assert abs(float(seen[..., 3].sum()) / expected[beside].sum() - 1) < 0.03
    inner = (cv2.erode(expected, AROUND, iterations=2) > 0) & beside
    assert inner.sum() > 50
    picture = decode_lut(None)[:, 0][composite(gpu, document, view)]
    np.testing.assert_allclose(picture[inner], SILVER * EMISSION, rtol=0.03)


def test_bytes_are_the_cameras_where_the_mirror_shows_no_object(gpu: GpuContext, stage: Stage) -> None:
    color = noisy()
    view = over_floor(color)
    document = declared(glowing_ball(stage), 0.02)
    untouched = (object_coverage(gpu, document, view) == 0) & (reflection(gpu, document, view)[..., 3] == 0)
    assert untouched[cv2.dilate(mirrored_ball().astype(np.uint8), AROUND, iterations=3) == 0].mean() > 0.9
    picture = composite(gpu, document, view)
    np.testing.assert_array_equal(picture[untouched], color[untouched])
    assert (picture != color).any(axis=2)[mirrored_ball()].mean() > 0.9


def test_nothing_is_traced_where_no_smooth_surface_is_declared(gpu: GpuContext, stage: Stage) -> None:
    document = glowing_ball(stage)
    renderer = SceneRenderer(gpu, document)
    renderer.render(over_floor())
    assert renderer.graph is not None
    assert renderer.graph["reflections"] is None
    renderer.release()
    assert not reflection(gpu, declared(document, RAY_ROUGHNESS), over_floor()).any()
    far = {"box": {"min_m": [5, 5, 5], "max_m": [6, 6, 6]}}
    assert not reflection(gpu, declared(document, 0.02, region=far), over_floor()).any()


def test_same_picture_twice_and_after_the_object_was_elsewhere(gpu: GpuContext, stage: Stage) -> None:
    document = declared(glowing_ball(stage), 0.15)
    away = document.objects[0].model_copy(
        update={"pose": document.objects[0].pose.model_copy(update={"translation_m": (0.1, 0.05, 0.02)})}
    )
    renderer = SceneRenderer(gpu, document)
    first = renderer.render(over_floor()).color
    renderer.set_scene(document.replaced(objects=(away,)))
    moved = renderer.render(over_floor()).color
    renderer.set_scene(document)
    again = renderer.render(over_floor()).color
    renderer.release()
    assert (moved != first).any()
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(composite(gpu, document, over_floor()), first)


def test_rough_mirror_blurs_and_keeps_the_energy(gpu: GpuContext, stage: Stage) -> None:
    document = glowing_ball(stage)
    sharp = reflection(gpu, declared(document, 0.02), over_floor())
    rough = reflection(gpu, declared(document, 0.15), over_floor())
    assert abs(rough[..., 0].sum() / sharp[..., 0].sum() - 1) < 0.05
    partly = [np.mean((seen[..., 3] > 0.05) & (seen[..., 3] < 0.95)) for seen in (sharp, rough)]
    assert partly[1] > 2 * partly[0]


def test_real_things_hide_the_object_from_the_mirror(gpu: GpuContext, stage: Stage) -> None:
    """A real board stands in the way from the floor to the ball, not in that from the camera to the floor."""
    board = shifted(trimesh.creation.box((0.5, 0.02, 0.08)), 0, -0.1, 0.08)
    inner = cv2.erode(mirrored_ball().astype(np.uint8), AROUND, iterations=2) > 0
    share = []
    for real in (floor(), trimesh.util.concatenate([floor(), board])):
        document = declared(glowing_ball(stage, real), 0.02)
        seen = reflection(gpu, document, frame())
        share.append(float(seen[inner, 3].mean()))
    assert share[0] > 0.95
    assert share[1] < 0.3 * share[0]


def test_lit_object_is_as_bright_in_the_mirror_as_seen(gpu: GpuContext, stage: Stage) -> None:
    """Ambient light alone: a grey ball high above the floor has about one radiance from all sides but from below."""
    objects = [stage.virtual(ball(RADIUS, (0, 0, 0.3), detail=4))]
    document = declared(stage.document(objects, [ambient(0.4)], volume_edge_m=0.9), 0.02)
    pose = look_at((0.25, -0.9, 0.4), (0.0, 0.0, 0.0))
    view = frame(plain(0), pose=pose, depth=depth_image(floor_depth(pose)))
    seen = reflection(gpu, document, view)
    whole = seen[..., 3] == 1.0
    assert whole.sum() > 100
    assert 0.5 * 0.4 * 0.4 < seen[whole, 0].mean() < 0.5 * 0.4 * 1.05
