"""Transparent objects of many triangles: no loop that traces their rays may be cut off (gpu/list_groups.py)."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import trimesh
from jaxtyping import Bool, Float64

from deltalight.protocol.quality import QualityTier
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.methods import surface_shading
from deltalight.render_server.passes.reflections import TransmittedLight
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    COARSE,
    Stage,
    array_of,
    ball,
    checkered,
    fields_of,
    floor,
    frame,
    plain,
    sphere_light,
)
from tests.render_server.test_transparent_objects import glass

pytestmark = [pytest.mark.slow(seconds=20), pytest.mark.usefixtures("clean_gl")]
LAMP = (-0.5, 0.2, 0.7)
HEAP = (-0.1, -0.1, 0.03), (0.1, 0.1, 0.23)


def heap_of_balls() -> trimesh.Trimesh:
    """Balls beside and above each other: each ray meets many surfaces, and searches many boxes for the next one."""
    places = np.stack(np.meshgrid(*(np.arange(-2, 3),) * 3), axis=-1).reshape(-1, 3)
    return trimesh.util.concatenate(
        [ball(0.024, (0.05 * x, 0.05 * y, 0.05 * z + 0.13), 3) for x, y, z in places]
    )


@pytest.fixture
def renderer(gpu: GpuContext, tmp_path: Path) -> Iterator[SceneRenderer]:
    """A heap of glass on a floor, under wide lamps."""
    stage = Stage(tmp_path, COARSE)
    lamps = [sphere_light(LAMP, radius=0.1)] * 4
    renderer = SceneRenderer(gpu, stage.document([glass(stage, heap_of_balls())], lamps, floor()))
    renderer.render(frame(plain()))
    yield renderer
    renderer.release()


def behind_heap(points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether the middles of the outer balls' box are between these points and the lamp's centre."""
    to_lamp = np.subtract(LAMP, points)
    ends = np.stack([(np.array(corner) - points) / to_lamp for corner in HEAP])
    return np.asarray(ends.min(axis=0).max(axis=-1) < ends.max(axis=0).min(axis=-1))


def test_every_pixel_of_glass_and_of_its_shadow_is_computed(renderer: SceneRenderer) -> None:
    graph = renderer.graph
    assert graph is not None
    shown = array_of(graph["object radiance"])[..., 3] > 0
    assert np.count_nonzero(shown) > 1000
    np.testing.assert_array_equal(array_of(graph["transmitted light"])[..., 3] > 0, shown)
    found, light = fields_of(renderer), graph["direct light"].light
    floor_pixels = (found.position[..., 3] > 0) & ~shown
    shadow = floor_pixels & behind_heap(found.position[..., :3].reshape(-1, 3)).reshape(shown.shape)
    assert np.count_nonzero(shadow) > 300
    without, with_glass = array_of(light.mu)[shadow][:, 0], array_of(light.rho)[shadow][:, 0]
    assert (without > 0).all()
    assert np.mean(with_glass < 0.9 * without) > 0.5


def bumpy_ball() -> trimesh.Trimesh:
    """Bumps of a few pixels, each of many triangles: neighbouring rays leave it in all directions."""
    mesh = ball(0.12, (0.0, 0.0, 0.0), 5)
    directions = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    bumps = np.sin(30 * directions).prod(axis=1, keepdims=True)
    place = (0.12 + 0.004 * bumps) * directions + (0.0, 0.0, 0.15)
    return trimesh.Trimesh(place, mesh.faces, process=False)


class ManyRays(TransmittedLight):
    """As many rays a pixel as a workgroup has threads: nearly converged."""

    def __init__(self, gpu: GpuContext, grid: Any, march: Any, tier: QualityTier) -> None:  # noqa: ANN401
        super().__init__(gpu, grid, march, replace(tier, reflection_cones=cast("Any", 64)))


def shown_through(gpu: GpuContext, document: SceneDocument) -> Float64[np.ndarray, "h w 3"]:
    """What the glass shows, as a sensor would clip it."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame(checkered()))
    assert renderer.graph is not None
    radiance = array_of(renderer.graph["transmitted light"])
    renderer.release()
    return np.where(radiance[..., 3:] > 0, radiance[..., :3].clip(0, 1), np.nan)


def test_few_rays_through_dense_glass_come_near_to_many(
    gpu: GpuContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lamp that rays meet by chance does not glitter: each ray stands for the cone that its surfaces spread."""
    stage = Stage(tmp_path, COARSE)
    lamp = sphere_light((-0.5, 0.9, 0.9), intensity=1.0, radius=0.03)
    document = stage.document([glass(stage, bumpy_ball())], [lamp], floor())
    few = shown_through(gpu, document)
    monkeypatch.setattr(surface_shading, "TransmittedLight", ManyRays)
    off = few - shown_through(gpu, document)
    off = off[np.isfinite(off)]
    print(f"off by {np.sqrt(np.mean(off**2)):.4f} r.m.s. on {len(off) // 3} pixels")
    assert len(off) > 2000
    assert np.sqrt(np.mean(off**2)) < 0.05
