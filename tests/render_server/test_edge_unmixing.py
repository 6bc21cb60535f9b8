"""Edges of real things before objects: unmixed from the old background by colour; nothing else changes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_objects import Pose
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    HEIGHT,
    WIDTH,
    ObjectsRenderer,
    Stage,
    ambient,
    array_of,
    ball,
    camera,
    composite,
    cube,
    depth_image,
    directional,
    floor_depth,
    frame,
    look_at,
    noisy,
    plain,
    unlit,
)
from tests.render_server.test_antialiasing import ABOVE, GLOW, antialiased, area_shares, sheet

pytestmark = pytest.mark.usefixtures("clean_gl")
NEAR_M, FAR_M = 0.5, 3.0  # the real things before and behind an object at 1 m
FRONT, BACK = np.array([0.45, 0.30, 0.10]), np.array([0.03, 0.12, 0.35])
INSIDE = np.s_[10:-10, 10:-10]  # pixels that see enough of both


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def glowing(stage: Stage, *lights: dict[str, Any], size: float = 400) -> SceneDocument:
    """A sheet of one radiance, `size` pixels wide."""
    material = {"base_color": (0, 0, 0), "specular": 0, "emission": (GLOW, GLOW, GLOW)}
    sheets = [{"asset": stage.asset(sheet(size, size)), "material": material}]
    return stage.document(sheets, [*lights, ambient(0.2)])


def coded(linear: np.ndarray) -> np.ndarray:
    """Camera codes whose linear values are nearest."""
    lut = decode_lut(None)[:, 0]
    return np.asarray(np.searchsorted((lut[1:] + lut[:-1]) / 2, linear), np.uint8)


def shares(turn_deg: float, shift: float = 0.3) -> np.ndarray:
    """Of each pixel, what lies on the near side of an inclined line through the picture's middle."""
    angle = np.radians(turn_deg)
    return area_shares(np.array([np.cos(angle), np.sin(angle)]), shift)


def mixed(a: np.ndarray, front: np.ndarray = FRONT, back: np.ndarray = BACK) -> np.ndarray:
    return np.asarray(a[..., None] * front + (1 - a[..., None]) * back)


def seen(a: np.ndarray, color: np.ndarray, least: float = 0.5, model: CameraModel | None = None) -> ViewFrame:
    """A near thing that fills shares `a`; depth gives it the pixels of which it fills more than `least`."""
    depth = depth_image(np.where(a > least, NEAR_M, FAR_M).astype(np.float32))
    return frame(color, pose=ABOVE, depth=depth, **({} if model is None else {"camera": model}))


def lit_picture(gpu: GpuContext, document: SceneDocument, view: ViewFrame) -> np.ndarray:
    renderer = SceneRenderer(gpu, document, with_linear=True)
    linear = renderer.render(view).linear
    renderer.release()
    assert linear is not None
    return linear


@pytest.mark.parametrize(
    ("turn_deg", "least", "smooth"),
    [(0.0, 0.5, False), (23.0, 0.02, False), (45.0, 0.98, False), (90.0, 0.98, True), (23.0, 0.5, True)],
)
def test_edge_shows_the_thing_and_the_object_only(
    objects: ObjectsRenderer, stage: Stage, turn_deg: float, least: float, smooth: bool
) -> None:
    """Whichever surface depth gives the mixed pixels to."""
    a = shares(turn_deg)
    found = objects.linear(antialiased(unlit(glowing(stage)), smooth), seen(a, coded(mixed(a)), least))
    expected = mixed(a, back=np.full(3, GLOW))
    assert np.abs(found - expected)[INSIDE].max() < 0.03


@pytest.mark.parametrize("distortion", [-0.3, 0.2])
def test_through_a_lens(objects: ObjectsRenderer, stage: Stage, distortion: float) -> None:
    lens = camera(distortion=(distortion, 0.0, 0.0, 0.0, 0.0))
    a = shares(23.0)
    found = objects.linear(unlit(glowing(stage, size=250)), seen(a, coded(mixed(a)), model=lens))
    assert np.abs(found - mixed(a, back=np.full(3, GLOW)))[INSIDE].max() < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(("back", "tolerance"), [(BACK, 0.02), (0.6 * FRONT, 0.05)])
def test_in_noise(objects: ObjectsRenderer, stage: Stage, back: np.ndarray, tolerance: float) -> None:
    """A tenth of the contrast or less of the colours: the whole edge is right within `tolerance`, r.m.s."""
    a = shares(23.0)
    noise = 0.015 * np.random.default_rng(0).standard_normal((HEIGHT, WIDTH, 3))
    color = coded(np.clip(mixed(a, back=back) + noise, 0, 1))
    found = objects.linear(unlit(glowing(stage)), seen(a, color, least=0.98))
    error = (found - mixed(a, back=np.full(3, GLOW)))[INSIDE]
    edge = ((a > 0.01) & (a < 0.99))[INSIDE]
    assert np.sqrt(np.mean(error[edge] ** 2)) < tolerance


@pytest.mark.slow
@pytest.mark.parametrize("off_px", [-1, 1])
def test_depth_that_is_off_by_a_pixel(objects: ObjectsRenderer, stage: Stage, off_px: int) -> None:
    a = shares(0.0)
    view = seen(a, coded(mixed(a)))
    depth = np.roll(view.depth.depth_m, off_px, axis=1)  # type: ignore[union-attr]
    found = objects.linear(unlit(glowing(stage)), replace(view, depth=depth_image(depth)))
    assert np.abs(found - mixed(a, back=np.full(3, GLOW)))[INSIDE].max() < 0.03


def test_edge_is_lit_like_the_thing_and_not_like_the_shaded_background(gpu: GpuContext, stage: Stage) -> None:
    """The object shades all of the background, and depth gives the edge's pixels to that."""
    a = shares(0.0)
    document = glowing(stage, directional((0.0, 0.0, -1.0), 2.0))
    found = lit_picture(gpu, document, seen(a, coded(mixed(a)), least=0.98))
    assert np.abs(found - mixed(a, back=np.full(3, GLOW)))[INSIDE].max() < 0.03


def test_equal_colours_leave_the_choice_to_depth(objects: ObjectsRenderer, stage: Stage) -> None:
    a = shares(0.0, 0.0)
    found = objects.linear(unlit(glowing(stage)), seen(a, plain()))
    assert np.isfinite(found).all()
    thing = float(decode_lut(None)[plain()[0, 0, 0], 0])
    middle = found[INSIDE][:, :, 0]
    assert np.all(np.diff(middle, axis=1) > -1e-3)
    assert middle[:, 0] == pytest.approx(thing, abs=1e-3)
    assert middle[:, -1] == pytest.approx(GLOW, abs=1e-3)
    assert np.count_nonzero((middle[50] > thing + 0.01) & (middle[50] < GLOW - 0.01)) <= 4


@pytest.mark.parametrize("smooth", [False, True])
def test_no_negative_pixel_and_the_cameras_bytes_where_no_object_lies_behind(
    objects: ObjectsRenderer, stage: Stage, smooth: bool
) -> None:
    """The edge goes on beyond the object."""
    document = antialiased(unlit(glowing(stage, size=60)), smooth)
    view = seen(shares(23.0), noisy())
    result, matte = objects.draw(document, view), objects.newest_coverage()
    drawn = (
        np.abs(np.indices((HEIGHT, WIDTH)) - np.reshape([HEIGHT / 2, WIDTH / 2], (2, 1, 1))).max(axis=0) < 33
    )
    assert result.linear is not None
    assert np.isfinite(result.linear).all()
    assert result.linear.min() >= 0
    assert np.array_equal(result.color[~drawn], noisy()[~drawn])
    assert np.array_equal(result.color[matte == 0], noisy()[matte == 0])


def test_a_third_colour_along_the_edge_belongs_to_the_thing_as_depth_says(
    objects: ObjectsRenderer, stage: Stage
) -> None:
    """A green line that is neither the thing's red nor the background's blue."""
    column = np.arange(WIDTH) - WIDTH // 2
    a = np.broadcast_to((column < 0).astype(float), (HEIGHT, WIDTH))
    color = mixed(a)
    color[:, (column < 0) & (column >= -2)] = (0.10, 0.60, 0.15)
    found = objects.linear(unlit(glowing(stage)), seen(a, coded(color)))
    expected = np.where(a[..., None] > 0.5, color, GLOW)
    assert np.abs(found - expected)[INSIDE].max() < 0.05


def corrections(objects: ObjectsRenderer) -> np.ndarray:
    """Of the picture that was drawn last."""
    graph = objects.renderer.graph
    assert graph is not None
    return array_of(graph["object surface"].coverage.edge_correction)


def test_the_floor_is_not_unmixed_where_an_object_stands_on_it(
    objects: ObjectsRenderer, stage: Stage
) -> None:
    document = unlit(
        stage.document([stage.virtual(cube()), stage.virtual(ball(at=(0.1, 0, 0.03)))], [ambient(0.2)])
    )
    view = frame(noisy(), depth=depth_image(floor_depth(look_at())))
    objects.draw(document, view)
    assert not corrections(objects).any()


def test_what_is_too_thin_to_tell_its_colour_keeps_the_share_by_depth(
    objects: ObjectsRenderer, stage: Stage
) -> None:
    bar = np.abs(np.arange(WIDTH) - WIDTH // 2) < 2
    a = np.broadcast_to(bar.astype(float), (HEIGHT, WIDTH))
    found = objects.linear(unlit(glowing(stage)), seen(a, coded(mixed(a))))
    assert not corrections(objects).any()
    assert np.abs(found - mixed(a, back=np.full(3, GLOW)))[INSIDE].max() < 0.03


def test_an_object_that_moves_away_takes_its_corrections_along(gpu: GpuContext, stage: Stage) -> None:
    a = shares(23.0)
    view = seen(a, coded(mixed(a)))
    here = unlit(glowing(stage, size=60))
    placed = here.objects[0].model_copy(update={"pose": Pose(translation_m=(0.0, 0.3, 0.0))})
    there = here.model_copy(update={"objects": (placed,)})
    renderer = SceneRenderer(gpu, here)
    renderer.render(view)
    renderer.set_scene(there)
    moved = renderer.render(view).color
    renderer.release()
    assert np.array_equal(moved, composite(gpu, there, view))
