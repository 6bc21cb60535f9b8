"""Neighbouring texels share their cones by a bilateral filter: what a ball hides of even light, at every pixel."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.render_server.gpu.context import GpuContext
from tests.render_server.scenes import Stage, ambient, ball, floor, solve

pytestmark = pytest.mark.usefixtures("clean_gl")
RADIUS_M, HEIGHT_M = 0.05, 0.14


def test_a_ball_hides_its_form_factor_everywhere_below_it(gpu: GpuContext, tmp_path: Path) -> None:
    """A black ball takes (r/d)^2 cos of the floor's even light. The same sixteen cones everywhere miss it or see
    nothing but it, in wedges on the floor: at the median pixel, 0.36 of what it takes was wrong then."""
    stage = Stage(tmp_path)
    black = stage.virtual(ball(RADIUS_M, (0.0, 0.0, HEIGHT_M)), (0.0, 0.0, 0.0))
    settings = {"volume_size": 64, "volume_edge_m": 0.8, "cone_scale": 1, "bounces": 0}
    found = solve(gpu, stage.document([black], [ambient(0.3)], floor(), **settings))
    place = found.position[..., :3]
    factor = RADIUS_M**2 * HEIGHT_M / np.linalg.norm(place - (0.0, 0.0, HEIGHT_M), axis=-1) ** 3
    seen = (found.matte == 0) & (found.fade == 1) & (place[..., 2] > -1e-3) & (factor > 0.02)
    assert seen.sum() > 500
    taken = 1 - found.cones_rho[seen].mean(axis=-1) / found.cones_mu[seen].mean(axis=-1)
    error = np.abs(taken - factor[seen]) / factor[seen]
    total = taken.sum() / factor[seen].sum()
    print(f"the ball takes {total:.3f} of its form factor; error at the median pixel {np.median(error):.3f}")
    assert total == pytest.approx(1.1, abs=0.1)
    assert np.median(error) < 0.2
