"""The bound of shadow cones: where it says that none of a sphere's points has one at the objects, none has."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.lights.light_models import DirectionalLight, Light, SphereLight
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.volumes import PlacedVolume, VolumePlacement

pytestmark = pytest.mark.usefixtures("clean_gl")

SHADER = Path(__file__).with_name("shadow_cone_bounds")
ROUNDS, SPHERES, POINTS = 24, 512, 32
EDGE_M, VOXELS = 1.0, 64  # of the volume, whose middle is the origin
Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def kernel(gpu: GpuContext) -> Iterator[Kernel]:
    made = Kernel(gpu, SHADER, SHADOW_CONES=1, DIRECTIONS=1, POINTS=POINTS)
    yield made
    made.release()


def unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def a_light(kind: str, rng: np.random.Generator) -> Light:
    """Distant, or a lamp: beside the objects as often as far from them, and up to 0.1 m wide."""
    away, white = unit(rng.normal(size=3)), np.ones(3, np.float32)
    if kind == "directional":
        return DirectionalLight(-away.astype(np.float32), white, float(rng.uniform(0, 0.2)))
    place = away * 10 ** rng.uniform(-0.5, 0.5)
    return SphereLight(place.astype(np.float32), white, float(rng.uniform(0, 0.1)))


def samples_of(rng: np.random.Generator) -> tuple[Array, Array]:
    """Spheres (middle and radius, m), and places and normals of points in each.

    A sphere may be a point, or as large as the volume. Most points are on its rim, where a bound that is too small
    misses first.
    """
    radii = 10 ** rng.uniform(-3, 0, (SPHERES, 1)) * EDGE_M
    spheres = np.hstack([rng.uniform(-2, 2, (SPHERES, 3)) * EDGE_M, radii])
    shares = np.minimum(rng.uniform(0, 1.5, (SPHERES, POINTS, 1)), 1)
    away = unit(rng.normal(size=(SPHERES, POINTS, 3)))
    places = spheres[:, None, :3] + spheres[:, None, 3:] * shares * away
    return spheres, np.stack([places, unit(rng.normal(size=places.shape))], axis=2)


def found_in(
    gpu: GpuContext, kernel: Kernel, light: Light, box: Array, samples: tuple[Array, Array]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether the bound says that cones may meet a box of voxels, and whether any of the points' does."""
    spheres, points = samples
    with ExitStack() as stack:
        lights = LightBuffers(gpu, 8, 1)
        stack.callback(lights.release)
        middle = np.zeros((1, 3))
        lights.place([light], middle, middle, middle)
        corner = (-EDGE_M / 2,) * 3
        volume = PlacedVolume(gpu, VolumePlacement(corner, EDGE_M / VOXELS, VOXELS))
        stack.callback(volume.release)
        padded = np.pad(points, ((0, 0), (0, 0), (0, 0), (0, 1)))
        contents = spheres.astype(np.float32), padded.astype(np.float32), np.zeros((SPHERES, 2), np.int32)
        buffers = [gpu.ctx.buffer(content.tobytes()) for content in contents]
        for buffer in buffers:
            stack.callback(buffer.release)
        padding = (0.0,) * 13  # the columns of other volumes
        bounds = {"object_lows": (*box[0], *padding), "object_highs": (*box[1], *padding)}
        named = dict(zip(("Spheres", "Points", "Found"), buffers, strict=True))
        kernel.run((SPHERES,), lights.bindings, volume.bindings, bounds, named, count=SPHERES)
        result = np.frombuffer(buffers[2].read(), np.int32).reshape(SPHERES, 2)
    return result[:, 0] > 0, result[:, 1] > 0


@pytest.mark.parametrize("kind", ["directional", "sphere"])
def test_no_cone_meets_the_objects_from_where_the_bound_says_so(
    gpu: GpuContext, kernel: Kernel, kind: str
) -> None:
    rng = np.random.default_rng(5)
    maybe, does = np.zeros((2, ROUNDS, SPHERES), bool)
    for number in range(ROUNDS):
        low = rng.uniform(0, VOXELS - 2, 3)
        box = np.stack([low, rng.uniform(low + 1, VOXELS)])
        maybe[number], does[number] = found_in(gpu, kernel, a_light(kind, rng), box, samples_of(rng))
    print(
        f"{kind}: cones meet the objects from {does.mean():.1%} of the spheres, may from {maybe.mean():.1%}"
    )
    assert does.any()
    assert not (does & ~maybe).any()
    assert (~maybe).mean() > 0.5 * (~does).mean(), "the bound tells most that are out of reach"
