"""Smooth objects reflect the picture: a flat mirror shows a known pattern where optics says, as bright as it is."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_lights import Lights
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.reflections import ROUGHEST
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    FOCAL,
    HEIGHT,
    WIDTH,
    Stage,
    array_of,
    ball,
    camera,
    checkered,
    composite,
    directional,
    fields_of,
    floor,
    frame,
    look_at,
    pass_times_ms,
    shifted,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
FACE_Y = 0.1  # of the mirror, which looks along -y
METHODS: dict[str, dict[str, object]] = {
    "dvct": {"volume_size": 32, "cone_scale": 1, "caustics": False},
    "dlpv": {"query_scale": 1, "caustics": False},
}


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def standing_mirror(
    stage: Stage, name: str = "dvct", roughness: float = 0.0, *, screen_space: bool = True
) -> SceneDocument:
    """A silver plate on the checkered floor. The sun from straight above is so strong that the plate, which takes
    nothing of it from what it shows, changes the floor's light by less than a percent."""
    plate = shifted(trimesh.creation.box((0.5, 0.01, 0.3)), 0, FACE_Y + 0.005, 0.15)
    material = {"metallic": 1.0, "roughness": roughness}
    mirror = stage.virtual(plate, (1.0, 1.0, 1.0), material)
    document = stage.document([mirror], [directional(irradiance=100.0)], floor())
    settings = {"name": name, "rsm_size": 256, "screen_space": screen_space, **METHODS[name]}
    return document.replaced(method=settings)


def reflected(gpu: GpuContext, document: SceneDocument) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the pass wrote (radiance times share, share), which pixels the mirror fills, the picture's radiance."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame(checkered()))
    assert renderer.graph is not None
    found = array_of(renderer.graph["screen cones"])
    linear = array_of(renderer.graph["camera image"].linear)[..., :3]
    shown = fields_of(renderer).matte == 1
    renderer.release()
    return found, shown, linear


def mirrored_pixels() -> tuple[np.ndarray, np.ndarray]:
    """Where in the picture the floor lies that each pixel's ray meets after the mirror's face (h, w, 2), in pixels
    with centres at whole numbers; and which rays meet that face."""
    pose = look_at().world_from_camera
    ways = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))]) @ pose[:3, :3].T
    face = pose[:3, 3] + ways * ((FACE_Y - pose[1, 3]) / ways[..., 1:2])
    on_face = (np.abs(face[..., 0]) < 0.24) & (face[..., 2] > 0.01) & (face[..., 2] < 0.29)
    back = ways * (1, -1, 1)
    place = face - back * (face[..., 2:] / back[..., 2:])
    seen = (place - pose[:3, 3]) @ pose[:3, :3]
    centre = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    return FOCAL * seen[..., :2] / seen[..., 2:] + centre, on_face & (back[..., 2] < 0) & (seen[..., 2] > 0)


@pytest.mark.parametrize("name", METHODS)
def test_a_flat_mirror_shows_the_patterns_radiance(gpu: GpuContext, stage: Stage, name: str) -> None:
    """Within 2 % in the mean, where the pattern is even around what the mirror shows.

    Beyond the picture DVCT asks its voxels; DLPV leaves the lobe to others.
    """
    document = standing_mirror(stage, name=name)
    found, shown, linear = reflected(gpu, document)
    pixels, meets = mirrored_pixels()
    inside = ((pixels > 6) & (pixels < (WIDTH - 7, HEIGHT - 7))).all(axis=-1)
    x, y = (pixels[..., axis].astype(np.float32) for axis in (0, 1))
    expected = cv2.remap(linear.astype(np.float32), x, y, cv2.INTER_LINEAR)
    kernel = np.ones((7, 7), np.uint8)
    low, high = (
        cv2.remap(change(linear[..., 1].astype(np.float32), kernel), x, y, cv2.INTER_NEAREST)
        for change in (cv2.erode, cv2.dilate)
    )
    even = shown & meets & inside & (high < 1.15 * low)
    light, dark = even & (expected[..., 1] > 0.2), even & (expected[..., 1] < 0.12)
    assert min(light.sum(), dark.sum()) > 50
    assert found[..., 3][even] == pytest.approx(1.0, abs=0.02)
    for part in (light, dark):
        assert found[part][:, :3] == pytest.approx(expected[part], rel=0.05)
        assert found[part][:, :3].mean() == pytest.approx(expected[part].mean(), rel=0.02)
    beyond = shown & meets & ((pixels < -2) | (pixels > (WIDTH + 1, HEIGHT + 1))).any(axis=-1)
    if name == "dlpv":
        assert (found[beyond][:, 3] < 0.05).all()
    else:
        assert (found[beyond][:, 3] == 1).all()  # the voxels answer


def test_the_composite_shows_the_pattern_in_the_mirror(gpu: GpuContext, stage: Stage) -> None:
    """Without the pass the voxels' blur is left of it."""
    pixels, meets = mirrored_pixels()
    inside = meets & ((pixels > 6) & (pixels < (WIDTH - 7, HEIGHT - 7))).all(axis=-1)
    x, y = (pixels[..., axis].astype(np.float32) for axis in (0, 1))
    expected = cv2.remap(checkered(), x, y, cv2.INTER_LINEAR)[inside].astype(float)
    off = []
    for screen_space in (True, False):
        shown = composite(gpu, standing_mirror(stage, screen_space=screen_space), frame(checkered()))
        off.append(np.median(np.abs(shown[inside] - expected)))
    assert off[0] < 4
    assert off[1] > 3 * off[0]


def test_what_the_picture_does_not_show_is_as_sharp(gpu: GpuContext, stage: Stage) -> None:
    """A ball before two halves of sky, dark and light, shows their border no wider than its lobe, although the other
    cones of the picture are traced at every fourth pixel, which here is a turn of the reflection by 30 degrees."""
    sky = np.full((64, 128, 3), 80, np.uint8)
    sky[:, 64:] = 200  # -y in the world
    cv2.imwrite(str(stage.folder / "sky.png"), sky)
    silver = {"metallic": 1.0, "roughness": 0.2}
    shining = stage.virtual(ball(0.1, (0, 0, 0.4), detail=5), (1.0, 1.0, 1.0), silver)
    document = stage.document([shining], [], shifted(floor(), 0, 0, -1), cone_scale=4)
    environment = {
        "mode": "environment",
        "environment": {"map": str(stage.folder / "sky.png")},
        "registration": (1, 1, 1),
    }
    document = document.replaced(lights=Lights.model_validate(environment))
    renderer = SceneRenderer(gpu, document)
    color = renderer.render(frame()).color
    shown = fields_of(renderer).matte == 1
    assert renderer.graph is not None
    surface = array_of(renderer.graph["object surface"].buffer.position)
    renderer.release()
    points = surface[..., :3]
    normal = (points - (0, 0, 0.4)) / 0.1
    way = points - look_at().world_from_camera[:3, 3]
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    mirrored = way - 2 * (way * normal).sum(axis=-1, keepdims=True) * normal
    upward = shown & (mirrored[..., 2] > 0.3)
    off = np.degrees(np.arcsin(mirrored[..., 1].clip(-1, 1)))
    for side, code in ((off > 15, 80), (off < -15, 200)):
        assert (upward & side).sum() > 30
        # The lobe's albedo is a little below 1.
        assert color[upward & side].astype(float) == pytest.approx(0.97 * code, abs=6)


def test_rough_objects_are_left_to_the_cones(gpu: GpuContext, stage: Stage) -> None:
    renderer = SceneRenderer(gpu, standing_mirror(stage, roughness=ROUGHEST + 0.05))
    renderer.render(frame(checkered()))
    assert "direct light" in pass_times_ms(renderer)
    assert renderer.graph is not None
    assert renderer.graph["screen cones"] is None
    renderer.release()
