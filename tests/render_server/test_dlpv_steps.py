"""Steps of light propagation volumes: energy, even fields, walls, directions (docs/method.md 5)."""

import numpy as np
import pytest
from jaxtyping import Float32
from scipy.ndimage import uniform_filter

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.lpv import (
    LOBE,
    LightVolume,
    LpvBoxFilter,
    LpvPropagate,
    StepWeights,
    lobe_weights,
    moment_weights,
    transmitted_fractions,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
CELLS = 16
WEIGHTS = {"lobes": lobe_weights(), "moments": moment_weights(CELLS)}


def cells_of(volume: LightVolume, name: str) -> Float32[np.ndarray, "3 n n n 4"]:
    """Channel, z, y, x, coefficient."""
    data = np.frombuffer(getattr(volume, name).read(), np.float32)
    return data.reshape(3, volume.cells, volume.cells, volume.cells, 4)


def propagated(
    gpu: GpuContext,
    light: Float32[np.ndarray, "3 n n n 4"],
    weights: StepWeights,
    steps: int,
    *,
    tiled: bool | None = None,
    through: Float32[np.ndarray, "n n n 8"] | None = None,
) -> tuple[Float32[np.ndarray, "3 n n n 4"], Float32[np.ndarray, "3 n n n 4"]]:
    """State and total after some steps; `through` of each cell from -x, +x, -y, +y, -z, +z."""
    volume, step = LightVolume(gpu, light.shape[1]), LpvPropagate(gpu, tiled=tiled)
    volume.state.write(light.tobytes())
    volume.total.write(light.tobytes())
    transmitted = None
    if through is not None:
        transmitted = transmitted_fractions(gpu, volume.cells)
        transmitted.write(np.round(255 * through).astype(np.uint8).tobytes())
    step.run(volume, weights, steps, transmitted)
    found = cells_of(volume, "state").copy(), cells_of(volume, "total").copy()
    for item in (volume, step, *(() if transmitted is None else (transmitted,))):
        item.release()
    return found


def spot(cells: int = CELLS, seed: int = 0) -> Float32[np.ndarray, "3 n n n 4"]:
    """Light of any direction in the middle of an empty volume."""
    light = np.zeros((3, cells, cells, cells, 4), np.float32)
    middle = slice(cells // 2 - 1, cells // 2 + 1)
    light[:, middle, middle, middle] = np.random.default_rng(seed).uniform(-1, 2, (3, 2, 2, 2, 4))
    return light


@pytest.mark.parametrize("weights", WEIGHTS.values(), ids=WEIGHTS)
@pytest.mark.parametrize("tiled", [False, True], ids=["plain", "tiled"])
@pytest.mark.parametrize("steps", [1, 3])
def test_a_step_in_free_space_keeps_the_energy(
    gpu: GpuContext, weights: StepWeights, tiled: bool, steps: int
) -> None:
    light = spot()
    state, _ = propagated(gpu, light, weights, steps, tiled=tiled)
    before, after = light[..., 0].sum(axis=(1, 2, 3)), state[..., 0].sum(axis=(1, 2, 3))
    assert after == pytest.approx(before, rel=1e-3)


@pytest.mark.parametrize("weights", WEIGHTS.values(), ids=WEIGHTS)
def test_tiles_in_shared_memory_make_the_same_steps(gpu: GpuContext, weights: StepWeights) -> None:
    through = np.random.default_rng(1).uniform(0, 1, (CELLS, CELLS, CELLS, 8)).astype(np.float32)
    light = np.random.default_rng(2).uniform(-1, 2, (3, CELLS, CELLS, CELLS, 4)).astype(np.float32)
    plain, tiles = (
        propagated(gpu, light, weights, 5, tiled=tiled, through=through) for tiled in (False, True)
    )
    for one, other in zip(plain, tiles, strict=True):
        assert one == pytest.approx(other, abs=1e-5)


@pytest.mark.parametrize("weights", WEIGHTS.values(), ids=WEIGHTS)
def test_half_steps_come_to_whole_steps(gpu: GpuContext, weights: StepWeights) -> None:
    """Cells of one colour hold the totals of CELLS whole steps, those of the other have one step more."""
    through = np.random.default_rng(1).uniform(0.8, 1, (CELLS, CELLS, CELLS, 8)).astype(np.float32)
    light = np.random.default_rng(2).uniform(-1, 2, (3, CELLS, CELLS, CELLS, 4)).astype(np.float32)
    whole, more = (
        propagated(gpu, light, weights, steps, tiled=True, through=through)[1] for steps in (CELLS, CELLS + 1)
    )
    _, halves = propagated(gpu, light, weights, CELLS, tiled=False, through=through)
    is_odd = np.indices((CELLS, CELLS, CELLS)).sum(axis=0) % 2 == 1
    assert halves[:, is_odd] == pytest.approx(whole[:, is_odd], abs=1e-5)
    assert halves[:, ~is_odd] == pytest.approx(more[:, ~is_odd], abs=1e-5)
    assert np.abs(whole - more).max() > 1e-3


@pytest.mark.parametrize("weights", WEIGHTS.values(), ids=WEIGHTS)
def test_an_even_field_stays_even(gpu: GpuContext, weights: StepWeights) -> None:
    light = np.zeros((3, CELLS, CELLS, CELLS, 4), np.float32)
    light[..., 0] = 1.0
    state, _ = propagated(gpu, light, weights, 2)
    inside = state[:, 2:-2, 2:-2, 2:-2]
    assert inside[..., 0] == pytest.approx(1.0, rel=1e-3)
    assert np.abs(inside[..., 1:]).max() < 1e-5


def test_light_does_not_pass_a_wall(gpu: GpuContext) -> None:
    through = np.ones((CELLS, CELLS, CELLS, 8), np.float32)
    through[10, ..., 4] = 0.0  # into z = 10 from below
    light = spot()
    _, total = propagated(gpu, light, WEIGHTS["moments"], CELLS, through=through)
    _, free = propagated(gpu, light, WEIGHTS["moments"], CELLS)
    assert np.abs(total[:, 10:]).max() == 0
    assert np.abs(free[:, 10:]).max() > 0.1


def test_directions_are_kept_where_lobes_lose_them(gpu: GpuContext) -> None:
    """A square emitter lights what faces it; with kept directions it does not light itself."""
    light = np.zeros((3, 32, 32, 32, 4), np.float32)
    light[:, 8, 12:20, 12:20] = np.array([LOBE[0], 0, 0, LOBE[1]]) / np.pi
    through = np.ones((32, 32, 32, 8), np.float32)
    through[7, 12:20, 12:20, 5] = 0.0  # from above into the cells behind it
    own = {}
    for name, weights in {"lobes": lobe_weights(), "moments": moment_weights(32)}.items():
        _, total = propagated(gpu, light, weights, 32, through=through)
        up = total[0, 8, 12:20, 12:20] @ np.array([LOBE[0], 0, 0, -LOBE[1]])
        own[name] = 2 / 3 * up.mean()
    assert abs(own["moments"]) < 0.1
    assert own["lobes"] > 0.4


@pytest.mark.parametrize("radius", [1, 2])
def test_box_filter_is_the_mean_over_cubes(gpu: GpuContext, radius: int) -> None:
    """It keeps the light of what lies inside; nothing comes from beyond the border."""
    light = np.random.default_rng(3).uniform(-1, 2, (3, CELLS, CELLS, CELLS, 4)).astype(np.float32)
    volume, box = LightVolume(gpu, CELLS), LpvBoxFilter(gpu)
    volume.total.write(light.tobytes())
    box.run(volume, radius)
    found = cells_of(volume, "total").copy()
    for item in (volume, box):
        item.release()
    expected = uniform_filter(light.astype(float), 2 * radius + 1, mode="constant", axes=(1, 2, 3))
    assert found == pytest.approx(expected, abs=1e-5)
