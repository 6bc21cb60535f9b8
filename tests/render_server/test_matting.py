"""Soft mattes: hair and fingers that depth does not show, before an object, against mattes that are known.

`pytest -s` prints the errors in the band around the thing, beside those by depth alone and of OpenCV's guided filter.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.matted_things import FAR_M, NEAR_M, PATTERNS, Thing, hairy_head, hand
from tests.render_server.scenes import (
    COARSE,
    HEIGHT,
    WIDTH,
    ObjectsRenderer,
    Stage,
    ambient,
    array_of,
    ball,
    camera,
    cube,
    depth_image,
    directional,
    floor_depth,
    frame,
    look_at,
    noisy,
    plain,
    shifted,
    sphere_light,
    unlit,
)
from tests.render_server.test_antialiasing import ABOVE, GLOW
from tests.render_server.test_edge_unmixing import corrections, glowing, lit_picture

pytestmark = pytest.mark.usefixtures("clean_gl")
REACH_PX = 8


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def matted(document: SceneDocument, reach_px: int = REACH_PX, **output: object) -> SceneDocument:
    return document.replaced(output=document.output.replaced(matting_px=reach_px, **output))


def guided(thing: Thing, radius: int = 32, epsilon: float = 1e-4) -> np.ndarray:
    """The matte by depth after the guided filter of He et al. (2013), at its best of radii 8 to 32, 1e-5 to 1e-3."""
    hard = 255 * thing.by_depth.astype(np.uint8)
    return np.asarray(cv2.ximgproc.guidedFilter(thing.color, hard, radius, epsilon * 255**2) / 255.0)


def before_glow(alpha: np.ndarray, color: np.ndarray) -> np.ndarray:
    return np.asarray(alpha[..., None] * color + (1 - alpha[..., None]) * GLOW)


def coded(linear: np.ndarray) -> np.ndarray:
    return np.searchsorted(decode_lut(None)[:, 0], np.clip(linear, 0, 1)) / 255


def errors(name: str, thing: Thing, alpha: np.ndarray, linear: np.ndarray) -> tuple[float, float]:
    """Of the matte (r.m.s.), and of the coded picture before an object that glows (dB), within the band."""
    band = thing.band(REACH_PX)
    off = (alpha - thing.alpha)[band]
    picture = (coded(linear) - coded(before_glow(thing.alpha, thing.front)))[band]
    rms, psnr = float(np.sqrt(np.mean(off**2))), float(-10 * np.log10(np.mean(picture**2)))
    print(f"{name:16} SAD {np.abs(off).sum():6.1f}  rms {rms:.3f}  {psnr:5.2f} dB")
    return rms, psnr


@pytest.mark.skipif(
    not hasattr(cv2, "ximgproc"), reason="this OpenCV lacks ximgproc, whose filter is compared"
)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_hair_is_nearer_to_the_truth_than_by_depth_or_by_a_guided_filter(
    objects: ObjectsRenderer, stage: Stage, pattern: str
) -> None:
    thing, document = hairy_head(pattern), unlit(glowing(stage))
    linear = decode_lut(None)[thing.color, 0]
    print(f"\n{pattern}, {np.count_nonzero(thing.band(REACH_PX))} pixels")
    hard, smooth = thing.by_depth.astype(float), guided(thing)
    errors("depth", thing, hard, before_glow(hard, linear))
    filtered = errors("guided filter", thing, smooth, before_glow(smooth, linear))
    edges = objects.linear(document, thing.view(pose=ABOVE))
    errors("matting_px: 0", thing, 1 - objects.newest_coverage(), edges)
    found = objects.linear(matted(document), thing.view(pose=ABOVE))
    rms, psnr = errors(f"matting_px: {REACH_PX}", thing, 1 - objects.newest_coverage(), found)
    assert rms < 0.8 * filtered[0]
    assert psnr > filtered[1] + 4


@pytest.mark.parametrize("pattern", PATTERNS)
def test_fingers_that_depth_misses_are_found(objects: ObjectsRenderer, stage: Stage, pattern: str) -> None:
    thing, document = hand(pattern), unlit(glowing(stage))
    print(f"\nhand, {pattern}, {np.count_nonzero(thing.band(REACH_PX))} pixels")
    edges = objects.linear(document, thing.view(pose=ABOVE))
    before = errors("matting_px: 0", thing, 1 - objects.newest_coverage(), edges)
    found = objects.linear(matted(document), thing.view(pose=ABOVE))
    after = errors(f"matting_px: {REACH_PX}", thing, 1 - objects.newest_coverage(), found)
    assert after[0] < 0.4 * before[0]
    assert after[1] > before[1] + 8


@pytest.mark.parametrize(("pattern", "most"), [("plain", 1.12), ("wood", 5.5), ("checks", 1.12)])
def test_noise_changes_pictures_little(
    objects: ObjectsRenderer, stage: Stage, pattern: str, most: float
) -> None:
    """From frame to frame, in the band, as a multiple of the camera's own change; in wood, colours tell less."""
    first, document = hand(pattern), matted(unlit(glowing(stage)))
    things = [first.again(seed) for seed in range(4)]
    band = first.band(REACH_PX)
    pictures = [255 * coded(objects.linear(document, each.view(pose=ABOVE))) for each in things]
    found, cameras = (
        np.sqrt(np.mean(np.diff([each[band] for each in taken], axis=0) ** 2) / 2)
        for taken in (pictures, [each.color.astype(float) for each in things])
    )
    print(f"\n{pattern}: r.m.s. deviation {found:.2f} codes, of the camera's pictures {cameras:.2f}")
    assert found < most * cameras


def moving_beside(thing: Thing, number: int) -> Thing:
    """The thing, and at the left border a card that moves by a pixel from picture to picture."""
    color, depth, valid = thing.color.copy(), thing.depth.depth_m.copy(), thing.depth.valid.copy()
    card = np.s_[2:102, 2 + number : 14 + number]
    color[card], depth[card], valid[card] = (40, 90, 160), NEAR_M, True
    return replace(thing, color=color, depth=replace(thing.depth, depth_m=depth, valid=valid))


def rendered_by(
    gpu: GpuContext, document: SceneDocument, things: list[Thing]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Linear pictures of one camera in a row, and the fractions that the things fill."""
    renderer, found = SceneRenderer(gpu, document, with_linear=True), []
    for number, thing in enumerate(things):
        view = thing.view(pose=ABOVE, frame_id=number, timestamp_ns=33_000_000 * number)
        linear = renderer.render(view).linear
        assert linear is not None
        assert renderer.graph is not None
        covered = array_of(renderer.graph["object surface"].coverage.texture)[..., 0]
        found.append((linear, 1 - covered))
    renderer.release()
    return found


def of_quality(document: SceneDocument, quality: str) -> SceneDocument:
    return document.replaced(method=document.method.replaced(quality=quality))


@pytest.mark.parametrize(("quality", "least", "most"), [("live", 0.0, 2.0), ("best", 4.0, 6.0)])
def test_mattes_of_what_stands_still_settle_while_other_things_move(
    gpu: GpuContext, stage: Stage, quality: str, least: float, most: float
) -> None:
    """Change from frame to frame in a hand's band before wood, by the camera's own; no ray meets the card."""
    first, document = hand("wood", aside_px=45), of_quality(matted(unlit(glowing(stage))), quality)
    things = [moving_beside(first.again(number), number) for number in range(7)]
    band = first.band(REACH_PX)
    pictures = [255 * coded(linear)[band] for linear, _ in rendered_by(gpu, document, things)]
    cameras = [each.color.astype(float)[band] for each in things]
    found, camera = (np.sqrt(np.mean(np.diff(each[-3:], axis=0) ** 2) / 2) for each in (pictures, cameras))
    print(f"\n{quality}: r.m.s. deviation {found:.2f} codes, of the camera's pictures {camera:.2f}")
    assert least * camera <= found < most * camera


@pytest.mark.parametrize("pattern", ["plain", "wood"])
@pytest.mark.parametrize("step_px", [1, 3])
def test_means_over_time_leave_no_trail(gpu: GpuContext, stage: Stage, pattern: str, step_px: int) -> None:
    """Of a slow hand, mattes with history are nowhere farther from the truth than those of single pictures."""
    document = matted(unlit(glowing(stage)))
    things = [hand(pattern, aside_px=step_px * number - 9).again(number) for number in range(5)]
    live, best = (rendered_by(gpu, of_quality(document, quality), things) for quality in ("live", "best"))
    for thing, (_, averaged), (_, alone) in zip(things, live, best, strict=True):
        band = thing.band(REACH_PX)
        rms = [float(np.sqrt(np.mean((each - thing.alpha)[band] ** 2))) for each in (averaged, alone)]
        print(f"{pattern}, {step_px} px: r.m.s. {rms[0]:.4f}, of single pictures {rms[1]:.4f}")
        assert rms[0] <= rms[1]


@pytest.mark.parametrize("distortion", [0.0, -0.3])
def test_through_a_lens_with_antialiasing(objects: ObjectsRenderer, stage: Stage, distortion: float) -> None:
    lens, thing = camera(distortion=(distortion, 0.0, 0.0, 0.0, 0.0)), hairy_head("plain")
    document = matted(unlit(glowing(stage, size=250)), antialiasing=True)
    alpha = 1 - objects.coverage(document, thing.view(pose=ABOVE, camera=lens))
    off = (alpha - thing.alpha)[thing.band(REACH_PX)]
    assert np.sqrt(np.mean(off**2)) < 0.03


def test_hair_is_lit_like_the_thing_and_not_like_the_shaded_background(gpu: GpuContext, stage: Stage) -> None:
    """The object shades all of the background; hair has the light of the thing that depth shows."""
    thing = hairy_head("plain")
    document = matted(glowing(stage, directional((0.0, 0.0, -1.0), 2.0)))
    found = lit_picture(gpu, document, thing.view(pose=ABOVE))
    off = found - before_glow(thing.alpha, thing.front)
    assert np.sqrt(np.mean(off[thing.band(REACH_PX)] ** 2)) < 0.02


def test_equal_colours_leave_the_choice_to_depth(objects: ObjectsRenderer, stage: Stage) -> None:
    document, view = (
        unlit(glowing(stage)),
        frame(plain(), pose=ABOVE, depth=hairy_head("plain").depth),
    )
    by_depth = objects.coverage(document, view)
    assert np.abs(objects.coverage(matted(document), view) - by_depth).max() < 0.2


def test_the_floor_has_no_matte_where_an_object_stands_on_it(objects: ObjectsRenderer, stage: Stage) -> None:
    things = [stage.virtual(cube()), stage.virtual(ball(at=(0.1, 0, 0.03)))]
    document = unlit(stage.document(things, [ambient(0.2)]))
    view = frame(noisy(), depth=depth_image(floor_depth(look_at())))
    by_depth = objects.coverage(document, view)
    assert np.array_equal(objects.coverage(matted(document), view), by_depth)
    assert not corrections(objects).any()


def test_the_cameras_bytes_where_no_object_lies_behind(objects: ObjectsRenderer, stage: Stage) -> None:
    thing = hairy_head("checks")
    result = objects.draw(matted(unlit(glowing(stage, size=60))), thing.view(pose=ABOVE))
    shown = objects.newest_coverage() > 0
    assert 0 < np.count_nonzero(shown) < 60 * 60
    assert np.array_equal(result.color[~shown], thing.color[~shown])


def test_what_ends_at_the_border_of_the_picture(objects: ObjectsRenderer, stage: Stage) -> None:
    """Nothing is read or written beyond it, and nothing is made up where there is no background."""
    near = np.full((HEIGHT, WIDTH), NEAR_M, np.float32)
    near[:, 3:] = FAR_M
    document, view = unlit(glowing(stage)), frame(plain(), pose=ABOVE, depth=depth_image(near))
    found = objects.linear(matted(document, 16), view)
    assert np.isfinite(found).all()
    assert found[:, 20:] == pytest.approx(GLOW, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("quality", ["live", "best"])
def test_a_moving_hand_leaves_nothing_behind(gpu: GpuContext, stage: Stage, quality: str) -> None:
    """Its matte is that of the newest frame, and so is its shadow on an object, with `live` 0.4 s later at most."""
    wall = stage.virtual(shifted(trimesh.creation.box((2.5, 2.0, 0.02)), 0, 0, 0), (0.6, 0.6, 0.6))
    plain_room = stage.document([wall], [sphere_light((0.5, 0.3, 2.9), 3.0, 0.03), ambient(0.3)], **COARSE)
    document = matted(plain_room.replaced(method=plain_room.method.replaced(quality=quality)))
    renderer, off = SceneRenderer(gpu, document), []
    for number in range(4):
        thing = hand("plain", aside_px=6 * number - 9)
        view = thing.view(pose=ABOVE, frame_id=number, timestamp_ns=150_000_000 * number)
        color, alpha = shown(renderer, view)
        alone = SceneRenderer(gpu, document)
        fresh_color, fresh_alpha = shown(alone, view)
        alone.release()
        np.testing.assert_array_equal(alpha, fresh_alpha)
        off.append(np.count_nonzero(color != fresh_color))
    renderer.release()
    assert off[0] == off[3] == 0
    assert quality == "live" or not any(off)


def shown(renderer: SceneRenderer, view: ViewFrame) -> tuple[np.ndarray, np.ndarray]:
    """The picture, and which share of each pixel objects cover."""
    color = renderer.render(view).color
    assert renderer.graph is not None
    return color, array_of(renderer.graph["object surface"].coverage.texture)[..., 0]
