"""Light that objects take and add beyond their volumes, against closed forms (docs/method.md 4.5)."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float64

from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import read_texture
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import Stage, ambient, ball, floor, frame, look_at, plain

pytestmark = pytest.mark.usefixtures("clean_gl")

RADIUS, HEIGHT = 0.06, 0.1
EDGE_M = 0.24  # of the volume: the floor changes by 5 % at its border
FADE_M = 4 * EDGE_M / 64
TOO_LARGE = 0.2  # test_furnace: cones see distant things 1.05 to 1.17 times too large
VIEW = look_at((0.0, -0.6, 0.9), (0.0, 0.0, 0.0))


def below_black_ball(stage: Stage, **method: object) -> SceneDocument:
    black = stage.virtual(ball(RADIUS, (0.0, 0.0, HEIGHT)), (0.0,) * 3, {"specular": 0})
    settings = {"volume_size": 64, "volume_edge_m": EDGE_M, "cone_scale": 1, **method}
    return stage.document([black], [ambient(0.5)], floor(), **settings)


def changes(gpu: GpuContext, document: SceneDocument) -> tuple[Float64[np.ndarray, " k"], ...]:
    """Of each texel that shows the floor: distance from the ball's axis, relative change, greatest coordinate (m)."""
    renderer = SceneRenderer(gpu, document)
    try:
        renderer.render(frame(plain(), pose=VIEW))
        graph = renderer.graph
        assert graph is not None
        ratio = read_texture(graph["change of light"].ratio).astype(float)
        pixels = np.frombuffer(graph["low res grid"].pixels.read(), np.int16).reshape(ratio.shape)
        position = read_texture(graph["shading scene"]["real_surface_position"]).astype(float)
    finally:
        renderer.release()
    shows = (ratio[..., 3] > 0) & (pixels[..., 0] >= 0)
    at = position[pixels[shows][:, 1], pixels[shows][:, 0]]
    return np.hypot(at[:, 0], at[:, 1]), ratio[shows][:, 1] - 1, np.abs(at[:, :2]).max(axis=1)


def form_factor(away: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, " k"]:
    """Of a ball above a floor's point that sees all of it: (r / d)^2 cos."""
    return np.asarray(RADIUS**2 * HEIGHT / np.hypot(away, HEIGHT) ** 3)


def test_a_black_ball_takes_its_form_factor_of_even_light_beyond_its_volume(
    gpu: GpuContext, tmp_path: Path
) -> None:
    away, change, border = changes(gpu, below_black_ball(Stage(tmp_path)))
    share = form_factor(away)
    beyond = (border > EDGE_M / 2) & (share > 0.01)
    error = -change[beyond] / share[beyond] - 1
    print(f"{beyond.sum()} texels: median {np.median(error):+.3f}, worst {np.abs(error).max():.3f}")
    assert beyond.sum() > 1000
    assert -0.05 < np.median(error) < TOO_LARGE
    assert np.quantile(np.abs(error), 0.95) < 0.5


def test_the_change_goes_on_across_the_border_of_the_volume(gpu: GpuContext, tmp_path: Path) -> None:
    away, change, border = changes(gpu, below_black_ball(Stage(tmp_path)))
    share = form_factor(away)
    within, fades, beyond = (
        -change[each].mean() / share[each].mean()
        for each in (
            (border > EDGE_M / 2 - 2 * FADE_M) & (border < EDGE_M / 2 - FADE_M),
            (border > EDGE_M / 2 - FADE_M) & (border < EDGE_M / 2),
            (border > EDGE_M / 2) & (border < EDGE_M / 2 + FADE_M),
        )
    )
    print(f"of the form factor: {within:.3f} before the border, {fades:.3f} at it, {beyond:.3f} behind it")
    assert (fades, beyond) == pytest.approx((within, within), abs=0.1)


@pytest.mark.parametrize("quality", ["balanced", "live"])
def test_quicker_tiers_leave_what_is_beyond_as_it_is(gpu: GpuContext, tmp_path: Path, quality: str) -> None:
    _, change, border = changes(gpu, below_black_ball(Stage(tmp_path), quality=quality))
    beyond = change[border > EDGE_M / 2 + FADE_M]
    assert beyond.size > 1000
    assert (beyond == 0).all()
