"""What must hold for every picture (docs/method.md 7): bytes are copied, real shadows stay, caches do not show."""

import hashlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import parse_scene
from deltalight.protocol.scene_method import NoneMethod
from deltalight.protocol.scene_objects import ModelGeometry, Pose
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import read_texture, release_all, texture_2d
from deltalight.render_server.passes.composite import FILL_RADIUS, ChangeRatio
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    COARSE,
    HEIGHT,
    WIDTH,
    Stage,
    ambient,
    array_of,
    ball,
    checkered,
    composite,
    cube,
    depth_image,
    directional,
    everyday,
    fields_of,
    floor,
    floor_depth,
    frame,
    look_at,
    noisy,
    plain,
    shifted,
    solve,
    sphere_light,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
ROOT = Path(__file__).parents[2]


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, COARSE)


def test_no_object_gives_the_cameras_bytes(gpu: GpuContext, stage: Stage) -> None:
    document = stage.document([], [ambient(0.2)], floor())
    assert np.array_equal(composite(gpu, document, frame(noisy())), noisy())


def test_invisible_object_gives_the_cameras_bytes(gpu: GpuContext, stage: Stage) -> None:
    document = stage.document([stage.virtual(cube(), visible=False)], [directional(), ambient(0.2)], floor())
    assert np.array_equal(composite(gpu, document, frame(noisy())), noisy())


def test_without_pose_the_cameras_bytes_and_the_status_say_so(gpu: GpuContext, stage: Stage) -> None:
    renderer = SceneRenderer(gpu, everyday(stage))
    result = renderer.render(replace(frame(noisy()), pose=None))
    renderer.release()
    assert result.status == "no_pose"
    assert np.array_equal(result.color, noisy())


@pytest.mark.parametrize("radiance", [1e5, 1e9])
def test_light_beyond_half_floats_shows_as_the_brightest_that_they_hold(
    gpu: GpuContext, stage: Stage, radiance: float
) -> None:
    document = everyday(stage)
    pictures = []
    for strength in (1e3, radiance):
        lights = parse_scene({"lights": {"manual": [ambient(strength)]}}).lights
        renderer = SceneRenderer(gpu, document.replaced(lights=lights))
        result = renderer.render(frame(noisy()))
        renderer.release()
        pictures.append(result.color.astype(int))
        assert np.isfinite(result.lights[-1]["mean_radiance"]).all()
    assert np.abs(pictures[0] - pictures[1]).max() <= 2


def test_the_unit_of_lights_does_not_matter_where_their_registration_is_found(
    gpu: GpuContext, stage: Stage
) -> None:
    """A quarter and four times of camera units, and what a meter might write in lux and cd/m^2 outdoors."""
    document = everyday(stage)
    pictures = []
    for unit in (0.25, 4.0, 40_000.0):
        lights = {"registration": "auto", "manual": [directional(irradiance=2 * unit), ambient(0.3 * unit)]}
        lit = document.replaced(lights=parse_scene({"lights": lights}).lights)
        pictures.append(composite(gpu, lit, frame(noisy())).astype(int))
    assert (pictures[0] != noisy()).any(axis=-1).sum() > 300
    for other in pictures[1:]:
        assert np.abs(pictures[0] - other).max() <= 2


def test_object_behind_the_camera_without_light_changes_nothing(gpu: GpuContext, stage: Stage) -> None:
    """Its volume, too, lies behind the camera, and no lamp throws its shadow into view."""
    document = stage.document([stage.virtual(cube(at=(0.25, -3.0, 0.6)))], [ambient(0.2)], floor(5))
    assert np.array_equal(composite(gpu, document, frame(noisy())), noisy())


def test_same_input_gives_the_same_bytes(gpu: GpuContext, stage: Stage) -> None:
    document = everyday(stage)
    renderer = SceneRenderer(gpu, document)
    first, second = (renderer.render(frame(noisy())).color for _ in range(2))
    renderer.release()
    assert not np.array_equal(first, noisy())
    assert np.array_equal(first, second)
    assert np.array_equal(first, composite(gpu, document, frame(noisy())))


CHILD = """
import hashlib, sys, tempfile, pathlib
from deltalight.render_server.gpu.context import create_context
from tests.render_server.scenes import COARSE, Stage, composite, everyday, frame, noisy
folder = tempfile.TemporaryDirectory()
picture = composite(create_context(), everyday(Stage(pathlib.Path(folder.name), COARSE)), frame(noisy()))
print(hashlib.sha256(picture.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_two_processes_give_the_same_bytes(gpu: GpuContext, stage: Stage) -> None:
    command = [sys.executable, "-c", CHILD]
    child = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert child.returncode == 0, child.stderr
    own = hashlib.sha256(composite(gpu, everyday(stage), frame(noisy())).tobytes()).hexdigest()
    assert child.stdout.strip() == own


@pytest.mark.parametrize("composition", ["ratio", "additive"])
def test_no_negative_pixel(gpu: GpuContext, stage: Stage, composition: str) -> None:
    renderer = SceneRenderer(gpu, everyday(stage, composition=composition), with_linear=True)
    linear = renderer.render(frame(noisy())).linear
    renderer.release()
    assert linear is not None
    assert np.isfinite(linear).all()
    assert linear.min() >= 0.0


def test_no_shadow_where_the_real_scene_is_in_shadow(gpu: GpuContext, stage: Stage) -> None:
    """A wall hides the lamp from a part of the floor; an object inside the wall's shadow darkens nothing there."""
    wall = shifted(cube(1.0), 0.65, 0, 0)  # its face towards the object is the plane x = 0.15
    sun = directional((-1.0, 0.0, -0.5), 2.0)
    objects = [stage.virtual(cube(0.1))]
    open_floor = solve(gpu, stage.document(objects, [sun], floor()))
    walled = stage.document(objects, [sun], wall + floor(), cone_scale=1)
    renderer = SceneRenderer(gpu, walled)
    picture = renderer.render(frame(noisy())).color
    shaded = fields_of(renderer)
    renderer.release()
    would_darken = (open_floor.direct_mu - open_floor.direct_rho).max(axis=-1) > 0.5
    on_floor = (shaded.position[..., 3] > 0) & (np.abs(shaded.position[..., 2]) < 1e-3)
    seen = would_darken & on_floor & (shaded.matte == 0)
    assert np.count_nonzero(seen) > 50
    assert np.abs(shaded.direct_mu[seen]).max() == 0
    assert np.array_equal(shaded.direct_mu, shaded.direct_rho)
    untouched = seen & (shaded.cones_mu == shaded.cones_rho).all(axis=-1)
    assert np.array_equal(picture[untouched], noisy()[untouched])


def test_depth_holes_never_hide_the_object(gpu: GpuContext, stage: Stage) -> None:
    document = stage.document([stage.virtual(ball())], [directional(), ambient(0.2)])
    depth = floor_depth(look_at())
    hole = np.ones((HEIGHT, WIDTH), bool)
    hole[30:90, 50:110] = False
    whole, holed = (solve(gpu, document, frame(depth=depth_image(depth, valid))) for valid in (None, hole))
    assert np.count_nonzero(whole.matte == 1) > 100
    assert np.all(holed.matte[whole.matte == 1] == 1)


def test_real_surface_in_front_hides_the_object_but_not_its_shadow(gpu: GpuContext, stage: Stage) -> None:
    """Depth masks the object only, never its delta."""
    screen = shifted(cube(1.0), 0, -0.68, 0.03)  # hangs 3 cm above the floor, its back at y = -0.18
    document = stage.document([stage.virtual(cube(0.1))], [directional((0.0, -1.0, -0.7))], screen + floor())
    pose = look_at((0.0, -1.3, 0.3), (0.0, 0.0, 0.05))
    assert solve(gpu, document, frame(pose=pose)).matte.max() == 0
    above = look_at((0.0, 0.9, 0.65))
    found = solve(gpu, document, frame(pose=above))
    assert found.matte.max() == 1
    assert (found.direct_mu - found.direct_rho).max() > 0.5


def hand_above(first_column: int) -> ViewFrame:
    """A hand 0.4 m above the floor, 40 pixels wide and high, seen from 1 m above."""
    depth = np.full((HEIGHT, WIDTH), 1.05, np.float32)
    depth[40:80, first_column : first_column + 40] = 0.6
    return frame(plain(), pose=look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)), depth=depth_image(depth))


def test_what_the_depth_camera_sees_casts_its_shadow_on_objects(gpu: GpuContext, stage: Stage) -> None:
    """And the shadow goes with it. The light slants by half its height towards +x: by 0.2 m, 30 pixels.

    Within three pixels: the mesh of the depth is coarse here.
    """
    slab = shifted(trimesh.creation.box((0.9, 0.6, 0.02)), 0, 0, -0.01)
    lights = [directional((0.5, 0.0, -1.0)), ambient(0.05)]
    renderer = SceneRenderer(gpu, stage.document([stage.virtual(slab)], lights), with_linear=True)
    for number, first_column in enumerate((20, 5)):
        view = replace(hand_above(first_column), frame_id=number, timestamp_ns=number * 50_000_000)
        linear = renderer.render(view).linear
        assert linear is not None
        row = linear[HEIGHT // 2, first_column + 42 : 140, 0]  # right of the hand, on the slab
        dark = np.flatnonzero(row < (row.min() + row.max()) / 2) + first_column + 42
        middle = (WIDTH - 1) / 2
        left, right = (np.array([first_column, first_column + 40]) - 0.5 - middle) * 0.6 + 30 + middle
        assert dark.min() == pytest.approx(left, abs=3)
        assert dark.max() == pytest.approx(right, abs=3)
        assert row.min() < 0.25 * row.max()
    renderer.release()


def test_pixels_beyond_every_influence_are_the_cameras(gpu: GpuContext, stage: Stage) -> None:
    document = stage.document([stage.virtual(cube(0.1))], [directional(), ambient(0.2)], floor(5))
    renderer = SceneRenderer(gpu, document)
    picture = renderer.render(frame(noisy())).color
    fields = fields_of(renderer)
    renderer.release()
    away = np.linalg.norm(fields.position[..., :2], axis=-1) > 0.6  # the volume's edge is 0.6 m
    assert 0.3 < away.mean() < 0.99
    assert np.array_equal(picture[away], noisy()[away])
    assert (picture != noisy()).any(axis=-1).sum() > 200


def test_another_picture_of_the_same_scene_is_not_relit_with_the_old_one(
    gpu: GpuContext, stage: Stage
) -> None:
    document = everyday(stage)
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame(plain(90)))
    cached = renderer.render(frame(plain(180))).color
    renderer.release()
    assert np.array_equal(cached, composite(gpu, document, frame(plain(180))))


def test_noise_in_the_picture_passes_through_the_caches(gpu: GpuContext, stage: Stage) -> None:
    """What the tracker takes for noise keeps the voxels, yet the new bytes are what is relit."""
    grain = np.random.default_rng(3).integers(-1, 2, plain().shape)
    grainy = (plain().astype(int) + grain).astype(np.uint8)
    document = everyday(stage)
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame(plain()))
    cached = renderer.render(frame(grainy)).color
    fields = fields_of(renderer)
    assert renderer.graph is not None
    beyond = (read_texture(renderer.graph["change of light"].distant)[..., :3] != 0).any(axis=-1)
    renderer.release()
    fresh = composite(gpu, document, frame(grainy))
    assert np.abs(cached.astype(int) - fresh.astype(int)).max() <= 2
    unchanged = (np.linalg.norm(fields.position[..., :3], axis=-1) > 0.9) & (fields.matte == 0)
    spread = cv2.dilate(beyond.astype(np.uint8), np.ones((3, 3)))  # to texels of which pixels take a part
    unchanged &= cv2.resize(spread, unchanged.shape[::-1], interpolation=cv2.INTER_NEAREST) == 0
    assert 0.05 < unchanged.mean() < 0.9  # 0.094: the objects reach half of what is that far
    assert np.array_equal(cached[unchanged], grainy[unchanged])


def test_moving_there_and_back_leaves_no_trace(gpu: GpuContext, stage: Stage) -> None:
    asset = stage.virtual(cube())
    lights = [sphere_light((0.4, -0.3, 0.9), 2.0, 0.05), ambient(0.2)]
    here = stage.document([asset], lights, floor())
    placed = here.objects[0].model_copy(update={"pose": Pose(translation_m=(0.11, 0.07, 0.0))})
    there = here.model_copy(update={"objects": (placed,)})
    renderer = SceneRenderer(gpu, here)
    first = renderer.render(frame(noisy())).color
    renderer.set_scene(there)
    moved = renderer.render(frame(noisy())).color
    renderer.set_scene(here)
    back = renderer.render(frame(noisy())).color
    renderer.release()
    assert np.array_equal(moved, composite(gpu, there, frame(noisy())))
    assert not np.array_equal(first, moved)
    assert np.array_equal(first, back)


@pytest.mark.slow
def test_light_that_changes_and_changes_back_leaves_no_trace(gpu: GpuContext, stage: Stage) -> None:
    day = everyday(stage)
    night = day.model_copy(update={"lights": stage.document([], [directional((0.5, 0.2, -1.0), 0.4)]).lights})
    renderer = SceneRenderer(gpu, day)
    pictures = []
    for document in (day, night, day):
        renderer.set_scene(document)
        pictures.append(renderer.render(frame()).color)
    renderer.release()
    assert np.array_equal(pictures[1], composite(gpu, night))
    assert np.array_equal(pictures[0], pictures[2])


def test_camera_that_moves_and_returns_leaves_no_trace(gpu: GpuContext, stage: Stage) -> None:
    document = everyday(stage)
    aside = frame(pose=look_at((-0.3, -0.8, 0.6)))
    renderer = SceneRenderer(gpu, document)
    first = renderer.render(frame()).color
    moved = renderer.render(aside).color
    back = renderer.render(frame()).color
    renderer.release()
    assert np.array_equal(moved, composite(gpu, document, aside))
    assert np.array_equal(first, back)


def test_an_object_wider_than_a_bent_lens_sees_is_there(gpu: GpuContext, stage: Stage) -> None:
    """Far beside the picture, barrel distortion would fold its corners back into it."""
    sheet = stage.virtual(shifted(trimesh.creation.box((2, 2, 0.002)), 0, 0, 0.02), (0.8, 0.1, 0.1))
    document = stage.document([sheet], [directional()], floor())
    bent = replace(frame().camera, distortion=np.array([-0.3, 0.0, 0.0, 0.0, 0.0]))
    above = look_at((0, 0, 0.8), (0, 0, 0))
    shown = composite(gpu, document, frame(pose=above, camera=bent))
    assert (shown != plain()).any(axis=-1).all()


def test_lens_distortion_moves_the_object_not_the_picture(gpu: GpuContext, stage: Stage) -> None:
    """The picture is never resampled: where nothing changes, its bytes stay, whatever the lens."""
    document = stage.document([stage.virtual(cube(0.1))], [directional()], floor())
    bent = replace(frame(noisy()).camera, distortion=np.array([-0.3, 0.1, 0.0, 0.0, 0.0]))
    straight = composite(gpu, document, frame(noisy()))
    picture = composite(gpu, document, frame(noisy(), camera=bent))
    changed = (picture != noisy()).any(axis=-1)
    assert 100 < np.count_nonzero(changed) < 0.5 * WIDTH * HEIGHT
    assert not np.array_equal(picture, straight)


def test_textures_are_read_back_whole(gpu: GpuContext) -> None:
    texture = gpu.ctx.texture((5, 3), 2, np.arange(30, dtype=np.float16).tobytes(), dtype="f2", alignment=1)
    assert array_of(texture)[2, 4].tolist() == [28, 29]
    texture.release()


def test_method_none_shows_objects_and_leaves_every_real_pixel_as_it_was(
    gpu: GpuContext, tmp_path: Path
) -> None:
    document = everyday(Stage(tmp_path, COARSE))
    picture = checkered()
    relit = (composite(gpu, document, frame(picture)) != picture).any(axis=-1)
    renderer = SceneRenderer(gpu, document.replaced(method=NoneMethod()))
    drawn = (renderer.render(frame(picture)).color != picture).any(axis=-1)
    renderer.release()
    assert 0.01 < drawn.mean() < 0.3
    assert relit[drawn].all()
    assert relit.sum() > 1.5 * drawn.sum()


@pytest.mark.slow
def test_another_real_model_gives_what_a_fresh_renderer_gives(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path, COARSE)
    document = everyday(stage)
    geometry = document.real.geometry
    assert isinstance(geometry, ModelGeometry)
    lower = geometry.model_copy(update={"pose": Pose(translation_m=(0.0, 0.0, -0.05))})
    changed = document.replaced(real=document.real.model_copy(update={"geometry": lower}))
    renderer = SceneRenderer(gpu, document)
    before = renderer.render(frame(checkered())).color
    renderer.set_scene(changed)
    after = renderer.render(frame(checkered())).color
    renderer.release()
    assert not np.array_equal(before, after)
    assert np.array_equal(after, composite(gpu, changed, frame(checkered())))


def test_under_lamps_alone_the_volumes_border_does_not_show(gpu: GpuContext, stage: Stage) -> None:
    """Cones of the reduced grid reach pixels beyond the border, where the lamp must be known to compare with."""
    lamp = directional((-0.2, 0.1, -1.0))
    document = stage.document([stage.virtual(cube(0.12))], [lamp], floor(), cone_scale=4, volume_edge_m=0.4)
    picture = composite(gpu, document, frame(plain(120))).astype(int)
    assert (picture != 120).any()
    assert picture[solve(gpu, document, frame(plain(120))).matte == 0].max() < 160


def test_only_visible_changes_of_light_are_composed(gpu: GpuContext) -> None:
    """Of 1/1024 of the irradiance an 8-bit picture shows next to nothing; of 1/256 it may show a code."""
    width, unchanged = 40, np.full((1, 40, 4), 1.0, np.float16)
    direct, gathered = unchanged.copy(), unchanged.copy()
    gathered[0, 6, :3] += 2 / 1024  # of 2 in all
    direct[0, 20, 1] -= 2 / 256
    pixels = np.stack([np.arange(width), np.zeros(width), *np.full((2, width), -1)], axis=1).astype(np.int16)
    made = [
        texture_2d(gpu, (width, 1), 4, "f2", data=each.tobytes()) for each in (unchanged, direct, gathered)
    ]
    plain, darker, brighter = made
    seen = texture_2d(gpu, (width, 1), 4, "i2", data=pixels.tobytes())
    change = ChangeRatio(gpu, (width, 1))
    cones: Any = SimpleNamespace(mu=plain, rho=brighter, specular_mu=plain, specular_rho=plain)
    light: Any = SimpleNamespace(light=SimpleNamespace(mu=plain, rho=darker))
    grid: Any = SimpleNamespace(size=(width, 1), pixels=seen, bindings={"sample_pixels": seen, "scale": 1})
    change.run(grid, light, cones, None)
    listed = np.frombuffer(change.texels.read(), np.uint32)
    assert set(listed[1 : 1 + listed[0]]) == set(range(20 - FILL_RADIUS, 21 + FILL_RADIUS))
    release_all(*made, seen, change)
