"""What reaches a floor at the foot of glass, against rays in numpy: wide lamps, and light from all around."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from jaxtyping import Bool, Float64

from deltalight.protocol.frames import decode_lut
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.methods.dvct import ExactCones
from deltalight.render_server.passes.cones import ConeFields
from tests.render_server.scenes import COARSE, GREY, Fields, Stage, ambient, ball, floor, plain, sphere_light
from tests.render_server.test_transparent_objects import IOR, fresnel, glass, pane, rendered

pytestmark = pytest.mark.usefixtures("clean_gl")
RADIUS, GAP = 0.06, 0.0005
CENTRE = np.array([0.0, 0.0, RADIUS + GAP])
Points = Float64[np.ndarray, "n 3"]


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, {**COARSE, "cone_scale": 1, "cone_count": 16})


def clear_ball(stage: Stage) -> dict[str, Any]:
    return glass(stage, ball(RADIUS, tuple(CENTRE), 5))


def beside_foot(found: Fields, low_m: float, high_m: float) -> Bool[np.ndarray, "h w"]:
    """Pixels that show the floor between two distances from the ball's foot."""
    away = np.hypot(found.position[..., 0], found.position[..., 1])
    on_floor = (found.position[..., 3] > 0) & (np.abs(found.position[..., 2]) < 1e-3) & (found.matte == 0)
    return np.asarray(on_floor & (away > low_m) & (away < high_m))


def to_sphere(start: Points, d: Points) -> tuple[Float64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Distances at which rays from outside meet the ball, and whether they do."""
    along, beyond = d @ CENTRE - (start * d).sum(axis=-1), ((start - CENTRE) ** 2).sum(axis=-1) - RADIUS**2
    square = along**2 - beyond
    return along - np.sqrt(np.maximum(square, 0)), (square > 0) & (along > 0)


def towards_lamp(points: Points, at: np.ndarray, radius: float) -> Float64[np.ndarray, "n 400 3"]:
    """Directions from points to places all over a lamp's disc."""
    facing = np.linalg.svd((at - points.mean(axis=0))[None])[2][1:]
    index = np.arange(400) + 0.5
    turn = index * np.pi * (3 - np.sqrt(5))
    disc = radius * np.sqrt(index / 400)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    d = at + disc @ facing - points[:, None]
    return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))


def test_wide_lamps_leave_the_foot_of_a_ball_dark(gpu: GpuContext, stage: Stage) -> None:
    """Next to where a ball stands it hides all of a lamp, though each point of its upper side hides only a part."""
    at, radius = np.array([-0.2, -0.2, 0.45]), 0.12
    lamp = sphere_light(tuple(at), radius=radius)
    _, found, beams = rendered(gpu, stage.document([clear_ball(stage)], [lamp], floor()))
    chosen = beside_foot(found, 0.02, 0.1)
    points = found.position[chosen][:, :3].astype(float)
    rays = towards_lamp(points, at, radius)
    hidden = to_sphere(points[:, None], rays)[1].mean(axis=1)
    kept = ((found.direct_rho - beams)[chosen] / found.direct_mu[chosen])[:, 1]
    dark = hidden > 0.99
    print(
        f"{dark.sum()} points are dark, {kept[dark].max():.3f}; off by {np.abs(kept - 1 + hidden).max():.3f}"
    )
    assert dark.sum() > 30
    assert kept[dark].max() < 0.02
    np.testing.assert_allclose(kept, 1 - hidden, atol=0.06)


def refract(d: Points, n: Points, eta: float) -> tuple[Points, Float64[np.ndarray, " n"]]:
    """Directions behind a surface with normals against `d`, and what it reflects."""
    cosine = -(d * n).sum(axis=1)
    square = 1 - eta**2 * (1 - cosine**2)
    bent = eta * d + (eta * cosine - np.sqrt(np.maximum(square, 0)))[:, None] * n
    return bent, np.where(square > 0, fresnel(np.clip(cosine, 1e-6, 1), eta), 1.0)


def kept_by_rays(at: np.ndarray, ground: float, rng: np.random.Generator) -> float:
    """Fraction of a sky's light of radiance 1 that a point of the floor has with the ball there, by random paths."""
    u, turn = rng.random(20000), 2 * np.pi * rng.random(20000)
    d = np.stack([np.sqrt(u) * np.cos(turn), np.sqrt(u) * np.sin(turn), np.sqrt(1 - u)], axis=1)
    t, inside = to_sphere(at, d)
    place, eta = at + t[:, None] * d, 1 / IOR
    for _ in range(20):
        n = (place - CENTRE) / RADIUS * (1 if eta < 1 else -1)
        bent, reflected = refract(d, n, eta)
        back = rng.random(len(d)) < reflected
        turned = np.where(back[:, None], d - 2 * (d * n).sum(axis=1)[:, None] * n, bent)
        d = np.where(inside[:, None], turned, d)
        inside &= back == (eta > 1)
        place, eta = place - 2 * (d * (place - CENTRE)).sum(axis=1)[:, None] * d, IOR
    return float(np.where(d[:, 2] > 0, 1.0, ground).mean())


def test_a_ball_bends_light_from_all_around(gpu: GpuContext, stage: Stage) -> None:
    """Below a bright sky, a clear ball shows places beside its foot the dark floor, and those farther off less."""
    ground, rng = float(decode_lut(None)[60, 0]), np.random.default_rng(1)
    _, found, _ = rendered(gpu, stage.document([clear_ball(stage)], [ambient(1.0)], floor()), plain(60))
    away = np.hypot(found.position[..., 0], found.position[..., 1])
    for place in (0.035, 0.045, 0.055, 0.07, 0.09):
        ring = beside_foot(found, place - 0.004, place + 0.004)
        kept = (found.cones_rho[ring] / found.cones_mu[ring]).mean()
        expected = kept_by_rays(np.array([away[ring].mean(), 0.0, 0.0]), ground, rng)
        print(f"{place} m: {kept:.3f}, by rays {expected:.3f}, {ring.sum()} pixels")
        assert kept == pytest.approx(expected, abs=0.01)


def test_cones_that_are_bent_again_are_the_same(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stage leaves what the cones traced as it was: if it alone runs again, nothing adds up."""
    document = stage.document([clear_ball(stage)], [ambient(1.0)], floor())
    _, once, _ = rendered(gpu, document, plain(60))
    refract = ExactCones.refract

    def twice(self: ExactCones, *inputs: Any) -> ConeFields:  # noqa: ANN401
        refract(self, *inputs)
        return refract(self, *inputs)

    monkeypatch.setattr(ExactCones, "refract", twice)
    _, again, _ = rendered(gpu, document, plain(60))
    assert np.array_equal(once.cones_rho, again.cones_rho)
    assert not np.array_equal(once.cones_rho, once.cones_mu)


@pytest.mark.parametrize(
    "mesh", [ball(RADIUS, tuple(CENTRE), 4), pane(0.03, 0.1, 0.016)], ids=["ball", "slab"]
)
def test_even_light_stays_even_below_clear_things(
    gpu: GpuContext, stage: Stage, mesh: trimesh.Trimesh
) -> None:
    """Where sky and floor have one radiance, what refracts and reflects it changes nothing (radiance invariance)."""
    around = float(decode_lut(None)[GREY, 0])
    _, found, _ = rendered(gpu, stage.document([glass(stage, mesh)], [ambient(around)], floor()))
    near = (found.position[..., 3] > 0) & (np.hypot(found.position[..., 0], found.position[..., 1]) < 0.12)
    kept = found.cones_rho[near] / found.cones_mu[near]
    print(f"{near.sum()} pixels, {kept.min():.3f} .. {kept.max():.3f}, mean {kept.mean():.4f}")
    assert kept.mean() == pytest.approx(1.0, abs=0.01)
    assert kept.min() > 0.95
