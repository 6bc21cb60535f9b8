"""Energy of shaded surfaces: in even light a white one cannot be told from its surroundings (docs/method.md 4.7)."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float32

from deltalight.protocol.frames import decode_lut
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from tests.render_server.scenes import GREY, Stage, ambient, ball, floor, solve

pytestmark = pytest.mark.usefixtures("clean_gl")
COSINES = np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0])
ROUGHNESSES = np.array([0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.85, 1.0])
WHITE = {"metal": (0.0, 1.0), "plastic": (1.0, 0.04), "glossy": (1.0, 0.08), "matt": (1.0, 0.0)}


def reflected(gpu: GpuContext, diffuse: float, f0: float) -> Float32[np.ndarray, "roughnesses cosines 4"]:
    """Of radiance 1 from everywhere: lights, gathered light, mean over all directions, wide lamps in the lobe."""
    roughness, cosine = np.meshgrid(ROUGHNESSES, COSINES, indexing="ij")
    surfaces = np.zeros((roughness.size, 8), np.float32)
    surfaces[:, :3], surfaces[:, 3] = diffuse, cosine.ravel()
    surfaces[:, 4:7], surfaces[:, 7] = f0, roughness.ravel()
    given, found = gpu.ctx.buffer(surfaces.tobytes()), gpu.ctx.buffer(reserve=16 * len(surfaces))
    kernel = Kernel(gpu, Path(__file__).with_name("furnace"))
    kernel.run((len(surfaces),), Surfaces=given, Found=found, count=len(surfaces))
    values = np.frombuffer(found.read(), np.float32).reshape(*roughness.shape, 4).copy()
    for item in (given, found, kernel):
        item.release()
    return values


@pytest.mark.parametrize("name", WHITE)
def test_white_surfaces_reflect_all_light(gpu: GpuContext, name: str) -> None:
    """From every side and at every roughness, by every path: within 2 %."""
    found = reflected(gpu, *WHITE[name])[..., :3]
    for path, values in zip(("lights", "gathered", "mean"), np.moveaxis(found, -1, 0), strict=True):
        print(f"{name}, {path}: {values.min():.3f} .. {values.max():.3f}")
    assert found == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("f0", [0.3, 0.7])
def test_lights_and_gathered_light_reflect_alike(gpu: GpuContext, f0: float) -> None:
    found = reflected(gpu, 0.0, f0)
    assert found[..., 0] == pytest.approx(found[..., 1], abs=0.02)
    assert found[..., 0].max() < 1.0


def test_lamps_wider_than_the_lobe_keep_its_light(gpu: GpuContext) -> None:
    """A mirror shows lamps of half-angle 0.15 from all sides as one even light, within 5 %."""
    shown = reflected(gpu, 0.0, 1.0)[ROUGHNESSES <= 0.2][..., 3]
    print(f"{shown.min():.3f} .. {shown.max():.3f}")
    assert shown == pytest.approx(1.0, abs=0.05)


def white_ball(gpu: GpuContext, stage: Stage, finish: dict[str, float]) -> float:
    """Mean radiance of a ball over a floor; surroundings and floor have radiance 1 but for what the ball hides."""
    around = float(decode_lut(None)[GREY, 0])
    ball_above = stage.virtual(ball(0.06, (0.0, 0.0, 0.3)), (1.0, 1.0, 1.0), finish)
    found = solve(gpu, stage.document([ball_above], [ambient(around)], floor()))
    seen = found.virtual_radiance[found.matte == 1]
    assert len(seen) > 100
    return float(seen.mean()) / around


def test_white_balls_look_alike_in_even_light(gpu: GpuContext, tmp_path: Path) -> None:
    """Through cones: a metal and a dielectric show the light that a matt ball does."""
    stage = Stage(tmp_path)
    matt = white_ball(gpu, stage, {})
    for finish in ({"metallic": 1.0}, {"specular": 1.0}):
        for roughness in (0.3, 1.0):
            share = white_ball(gpu, stage, {**finish, "roughness": roughness}) / matt
            assert share == pytest.approx(1.0, abs=0.03), (finish, roughness)
