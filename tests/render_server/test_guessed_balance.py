"""White balance of lights whose map was balanced unlike the picture, without paper (docs/method.md 1.4)."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deltalight.protocol.scene import parse_scene
from deltalight.render_server.estimation.registration import guessed_balance
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import Stage, ball, floor, frame, plain

NEUTRAL = np.ones(3)
WARM = np.array([1.4, 1.0, 0.6])


def room(
    white_fraction: float, light: np.ndarray = NEUTRAL, tint: np.ndarray = NEUTRAL
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Red and white surfaces under `light`: measured, predicted by lights with a tint, bounced."""
    rng = np.random.default_rng(3)
    irradiance, bounce = light * rng.uniform(0.3, 1.0, (4000, 1)), rng.uniform(0, 0.05, (4000, 3))
    is_white = rng.random((4000, 1)) < white_fraction
    albedo = np.where(is_white, 0.9, [0.7, 0.15, 0.1]) * rng.uniform(0.5, 1.0, (4000, 1))
    return albedo / np.pi * (irradiance + bounce), irradiance * tint, bounce


def test_tinted_lights_are_balanced_by_white_things_in_a_balanced_picture() -> None:
    assert guessed_balance(*room(0.3, tint=WARM), NEUTRAL) == pytest.approx(1 / WARM, rel=0.03)


def test_lights_keep_their_warmth_where_the_picture_shows_it_too() -> None:
    assert guessed_balance(*room(0.3, light=WARM), NEUTRAL) == pytest.approx(NEUTRAL, rel=0.03)


def test_red_surfaces_alone_do_not_tint_white_lights() -> None:
    assert guessed_balance(*room(0.0), NEUTRAL) == pytest.approx(NEUTRAL, abs=1e-6)


def test_balance_does_not_depend_on_the_factor_that_is_tried() -> None:
    measured, light, bounce = room(0.3, tint=WARM)
    tried = np.array([0.5, 2.0, 4.0])
    balance = guessed_balance(measured, light, bounce, NEUTRAL)
    again = guessed_balance(measured, light * tried, bounce, 1 / tried)
    assert again * tried / tried[1] == pytest.approx(balance, rel=1e-6)


def test_without_lit_pixels_the_balance_is_the_lights_own() -> None:
    nothing = np.zeros((100, 3))
    balance = guessed_balance(nothing, nothing, nothing, np.array([1.0, 2.0, 4.0]))
    assert balance.tolist() == [0.5, 1, 2]


@pytest.mark.parametrize("mode", ["environment", "manual"])
def test_white_ball_in_a_neutral_picture_is_neutral_unless_the_lights_colour_was_set(
    gpu: GpuContext, tmp_path: Path, mode: str
) -> None:
    lights: dict[str, Any] = {"mode": mode, "registration": "auto"}
    if mode == "environment":
        warm_map = np.tile(WARM[::-1].astype(np.float32), (16, 32, 1))
        cv2.imwrite(str(tmp_path / "warm.hdr"), warm_map)
        lights["environment"] = {"map": str(tmp_path / "warm.hdr")}
    else:
        lights["manual"] = [{"type": "ambient", "radiance": 1.0, "color_linear": WARM.tolist()}]
    stage = Stage(tmp_path)
    document = stage.document([stage.virtual(ball(), (0.8, 0.8, 0.8))], [], floor())
    document = document.replaced(lights=parse_scene({"lights": lights}).lights)
    renderer = SceneRenderer(gpu, document)
    picture = renderer.render(frame(plain())).color.astype(int)
    renderer.release()
    tint = np.abs(picture[..., 0] - picture[..., 2]).max()
    assert tint <= 3 if mode == "environment" else tint > 30
    (warning,) = [sentence for sentence in renderer.notices if "white paper" in sentence]
    assert ("white balance is a guess" in warning) == (mode == "environment")
