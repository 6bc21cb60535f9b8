"""Bloom: light is scattered and none is made, and what it does not reach stays the camera's."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.scene_method import NoneMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.post_effects.bloom import scattered, with_bloom
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import COARSE, Stage, ambient, cube, fields_of, floor, frame

WIDTH, HEIGHT = 320, 240
CAMERA = CameraModel(WIDTH, HEIGHT, np.array([[300, 0, 160], [0, 300, 120], [0, 0, 1.0]]))
LUT = decode_lut(None)


def lamp(radiance: float, code: int = 60) -> tuple[ViewFrame, np.ndarray, np.ndarray, np.ndarray]:
    """A grey picture, and the same with a small virtual lamp: its codes, its radiance and what the lamp covers."""
    frame = ViewFrame(0, 0, np.full((HEIGHT, WIDTH, 3), code, np.uint8), CAMERA, exposure_scale=0.5)
    linear = np.full((HEIGHT, WIDTH, 3), LUT[code, 0] / 0.5, np.float32)
    color, inside = frame.color.copy(), np.s_[118:122, 158:162]
    linear[inside] = radiance
    color[inside] = np.rint(np.interp(radiance * 0.5, LUT[:, 0], np.arange(256)))
    coverage = np.zeros((HEIGHT, WIDTH), np.float32)
    coverage[inside] = 1
    return frame, color, linear, coverage


def test_light_is_spread_and_none_is_made() -> None:
    change = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    change[120, 160] = 5.0, -2.0, 0.0
    found = scattered(change)
    np.testing.assert_allclose(found.sum(axis=(0, 1)), [5.0, -2.0, 0.0], rtol=1e-4, atol=1e-6)
    assert found[120, 160, 0] == found[..., 0].max() < 0.1
    assert np.abs(found[:, 300:]).max() == 0


def test_a_bright_thing_glows_on_what_is_around_it() -> None:
    """And is itself as bright as what it keeps, beyond white or not."""
    frame, color, linear, coverage = lamp(radiance=40.0)
    found = with_bloom(color, linear, coverage, frame, 0.2)
    before, after = LUT[color, 0], LUT[found, 0]
    assert found[120, 160, 0] == 255
    assert after[120, 168, 0] > 1.5 * before[120, 168, 0]
    change = np.where((color != frame.color), linear - LUT[60, 0] / 0.5, 0)
    expected = before + 0.2 * 0.5 * scattered(change.astype(np.float32))
    around = (color == frame.color) & (expected < 0.9)
    np.testing.assert_allclose(after[around], expected[around], rtol=0.02, atol=1e-3)


def aces(x: np.ndarray) -> np.ndarray:
    """As Narkowicz (2015) gives it."""
    return np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)


def test_bloom_under_a_tone_curve_is_that_of_the_light(gpu: GpuContext, tmp_path: Path) -> None:
    """A glowing cube: seen through the curve, its surroundings have the radiance that they have without it."""
    stage = Stage(tmp_path, COARSE)
    glowing = stage.virtual(cube(0.1), (0.0,) * 3, {"emission": (6.0, 2.0, 0.5)})
    document = stage.document([glowing], [ambient(0.2)], floor()).replaced(method=NoneMethod())
    shown = {}
    for tone in ("camera", "aces"):
        for bloom in (0.0, 0.1):
            output = document.output.replaced(tone=tone, bloom=bloom)
            renderer = SceneRenderer(gpu, document.replaced(output=output))
            shown[tone, bloom] = renderer.render(frame()).color
            covered = fields_of(renderer).matte > 0
            renderer.release()
    lut = LUT[:, 0].astype(float)
    curve = np.interp(aces(lut), lut, np.arange(256))  # camera's code -> code shown
    around = ~covered & (shown["camera", 0.1] < 250).all(axis=2)
    reached = around & (shown["camera", 0.1] != shown["camera", 0.0]).any(axis=2)
    assert reached.sum() > 1000
    expected = curve[shown["camera", 0.1]]
    assert np.abs(shown["aces", 0.1] - expected)[around].max() <= 1.5  # roundings of both
    assert np.abs(shown["aces", 0.0] - expected)[reached].max() > 5
    untouched = around & (shown["camera", 0.1] == shown["camera", 0.0]).all(axis=2)
    same = (shown["aces", 0.1] == shown["aces", 0.0]).all(axis=2)
    assert same[untouched].mean() > 0.9  # a curve that is steeper shows half a code's light in some


def test_where_nothing_arrives_the_picture_is_the_cameras() -> None:
    frame, color, linear, coverage = lamp(radiance=1.0)
    found = with_bloom(color, linear, coverage, frame, 0.1)
    assert np.array_equal(found[:, 290:], color[:, 290:])
    assert np.array_equal(found[:30], color[:30])
    assert with_bloom(frame.color, linear, 0 * coverage, frame, 0.1) is frame.color


def test_a_lamp_that_is_hidden_takes_its_glow_along() -> None:
    frame, color, linear, coverage = lamp(radiance=0.0, code=200)
    found = with_bloom(color, linear, coverage, frame, 0.5)
    assert found[120, 166, 0] < 200
    assert found[120, 160, 0] > color[120, 160, 0] == 0
    kept = LUT[found, 0].sum(dtype=float) / LUT[color, 0].sum(dtype=float)
    assert kept == pytest.approx(1.0, abs=1e-3)


def test_what_an_object_hides_does_not_shine_through() -> None:
    """Stripes behind an even object, as bright in the mean: it stays even."""
    frame, _, _, _ = lamp(radiance=1.0)
    frame.color[:, ::8] = 200
    linear = LUT[frame.color, 0] / 0.5
    color, coverage = frame.color.copy(), np.zeros((HEIGHT, WIDTH), np.float32)
    inside = np.s_[60:180, 80:240]
    color[inside], linear[inside], coverage[inside] = 100, LUT[100, 0] / 0.5, 1
    found = with_bloom(color, linear, coverage, frame, 0.3)
    row = found[120, 100:220, 0].astype(int)
    assert np.abs(np.diff(row)).max() <= 1
