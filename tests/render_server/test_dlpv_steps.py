"""Steps of light propagation volumes: energy, even fields, walls, directions (docs/method.md 5)."""

import moderngl
import numpy as np
import pytest
from jaxtyping import Float32
from scipy.ndimage import uniform_filter

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.passes.lpv import (
    LOBE,
    LightVolume,
    LpvBoxFilter,
    LpvPropagate,
    LpvStart,
    LpvStartChange,
    StepWeights,
    injected_sums,
    lobe_weights,
    medium_bindings,
    moment_weights,
    transmitted_fractions,
)
from deltalight.render_server.passes.lpv_lighting import LpvAddBounce
from deltalight.render_server.passes.lpv_small import HalfSteps, SmallVolume
from tests.render_server.lpv_scenes import INJECTED_STEPS

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
    in_place: bool = False,
    through: Float32[np.ndarray, "n n n 8"] | None = None,
) -> tuple[Float32[np.ndarray, "3 n n n 4"], Float32[np.ndarray, "3 n n n 4"]]:
    """State and total after some steps; `through` of each cell from -x, +x, -y, +y, -z, +z."""
    volume, step = LightVolume(gpu, light.shape[1]), LpvPropagate(gpu, tiled=tiled)
    volume.state.write(light.tobytes())
    volume.total.write(light.tobytes())
    transmitted = None if through is None else transmittances(gpu, through)
    step.run(volume, medium_bindings(volume.cells, weights, transmitted), steps, in_place=in_place)
    found = cells_of(volume, "state").copy(), cells_of(volume, "total").copy()
    for item in (volume, step, *(() if transmitted is None else (transmitted,))):
        item.release()
    return found


def transmittances(gpu: GpuContext, through: Float32[np.ndarray, "n n n 8"]) -> moderngl.Texture3D:
    texture = transmitted_fractions(gpu, len(through))
    texture.write(np.round(255 * through).astype(np.uint8).tobytes())
    return texture


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


@pytest.mark.parametrize("tiled", [False, True], ids=["plain", "tiled"])
@pytest.mark.parametrize("weights", WEIGHTS.values(), ids=WEIGHTS)
def test_half_steps_come_to_whole_steps(gpu: GpuContext, weights: StepWeights, tiled: bool) -> None:
    """Cells of one colour hold the totals of CELLS whole steps, those of the other have one step more."""
    through = np.random.default_rng(1).uniform(0.8, 1, (CELLS, CELLS, CELLS, 8)).astype(np.float32)
    light = np.random.default_rng(2).uniform(-1, 2, (3, CELLS, CELLS, CELLS, 4)).astype(np.float32)
    whole, more = (
        propagated(gpu, light, weights, steps, tiled=True, through=through)[1] for steps in (CELLS, CELLS + 1)
    )
    _, halves = propagated(gpu, light, weights, CELLS, tiled=tiled, in_place=True, through=through)
    is_odd = np.indices((CELLS, CELLS, CELLS)).sum(axis=0) % 2 == 1
    assert halves[:, is_odd] == pytest.approx(whole[:, is_odd], abs=1e-5)
    assert halves[:, ~is_odd] == pytest.approx(more[:, ~is_odd], abs=1e-5)
    assert np.abs(whole - more).max() > 1e-3


def sums_of(gpu: GpuContext, light: Float32[np.ndarray, "3 n n n 4"]) -> moderngl.Buffer:
    """What is injected, in fixed point."""
    sums = injected_sums(gpu, light.shape[1])
    sums.write(np.round(light * INJECTED_STEPS).astype(np.int32).transpose(1, 2, 3, 0, 4).tobytes())
    return sums


class ChangedLight:
    """V_mu after some steps, and V_rho that starts with it and with what objects send and block."""

    def __init__(self, gpu: GpuContext, *, in_place: bool, tiled: bool = False, small: bool = False) -> None:
        self._gpu, self._in_place, self._half_step = gpu, in_place, in_place and tiled
        self._small = SmallVolume(gpu) if small else None
        self.mu, self.rho = LightVolume(gpu, CELLS), LightVolume(gpu, CELLS)
        self._start, self._start_change, self._add, self._steps = (
            LpvStart(gpu),
            LpvStartChange(gpu),
            LpvAddBounce(gpu),
            LpvPropagate(gpu, tiled=tiled),
        )
        self._held: list[moderngl.Buffer | moderngl.Texture3D] = []

    def _sums(self, light: Float32[np.ndarray, "3 n n n 4"]) -> moderngl.Buffer:
        self._held.append(sums := sums_of(self._gpu, light))
        return sums

    def propagate(
        self,
        light: Float32[np.ndarray, "3 n n n 4"],
        change: Float32[np.ndarray, "3 n n n 4"],
        through: tuple[Float32[np.ndarray, "n n n 8"], Float32[np.ndarray, "n n n 8"]],
        steps: tuple[int, int],
    ) -> None:
        """By `steps` without and with objects, `through` what lets light pass without and with them."""
        real, joint = (transmittances(self._gpu, each) for each in through)
        self._held += (real, joint)
        past_real, self._past_all = (
            medium_bindings(CELLS, WEIGHTS["moments"], each) for each in (real, joint)
        )
        injected, changed = self._sums(light), self._sums(change)
        if self._small is not None:
            self._small.start(self.mu, HalfSteps(self._small, past_real, steps[0]), injected, None)
            half_steps = HalfSteps(self._small, self._past_all, steps[1])
            self._small.start_change(self.rho, half_steps, self.mu, changed, real)
            return
        self._start.run(self.mu, past_real, injected, half_step=self._half_step)
        self._steps.run(self.mu, past_real, steps[0], in_place=self._in_place)
        own = {"in_place": self._in_place, "half_step": self._half_step}
        self._start_change.run(self.rho, self.mu, changed, self._past_all, real, **own)
        self._steps.run(self.rho, self._past_all, steps[1], in_place=self._in_place)

    def add(
        self, more: Float32[np.ndarray, "3 n n n 4"], known: Float32[np.ndarray, "3 n n n 4"], steps: int
    ) -> None:
        then = None if self._small is None else HalfSteps(self._small, self._past_all, steps)
        self._add.run(self.rho, self._sums(more), self._sums(known), is_last=False, then=then)
        if then is None:
            self._steps.run(self.rho, self._past_all, steps, in_place=self._in_place)

    def release(self) -> None:
        passes = self._start, self._start_change, self._add, self._steps, self._small
        release_all(self.mu, self.rho, *passes, *self._held)


MANY_STEPS = 160  # nothing is under way any more


def surroundings() -> tuple[Float32[np.ndarray, "3 n n n 4"], Float32[np.ndarray, "n n n 8"]]:
    """Light in all cells, and what lets it pass."""
    rng = np.random.default_rng(5)
    light = rng.uniform(-1, 2, (3, CELLS, CELLS, CELLS, 4)).astype(np.float32)
    return light, rng.uniform(0.8, 1, (CELLS, CELLS, CELLS, 8)).astype(np.float32)


IN_SHARED_MEMORY = "tiled", "small"
STEPS = pytest.mark.parametrize(
    "how",
    [{"in_place": False}, {"in_place": True}, *({"in_place": True, kind: True} for kind in IN_SHARED_MEMORY)],
    ids=["whole", "in place", "tiled in place", "small volume"],
)


@STEPS
def test_objects_that_change_nothing_leave_the_light_as_it_was(gpu: GpuContext, how: dict[str, bool]) -> None:
    """Although V_mu has had few steps and V_rho has further ones."""
    light, through = surroundings()
    changed = ChangedLight(gpu, **how)
    changed.propagate(light, np.zeros_like(light), (through, through), (3, 9))
    mu, rho = cells_of(changed.mu, "total").copy(), cells_of(changed.rho, "total").copy()
    changed.release()
    assert np.abs(mu).max() > 1
    assert rho == pytest.approx(mu, abs=2e-5)


@STEPS
def test_what_objects_send_and_block_comes_to_the_light_with_them(
    gpu: GpuContext, how: dict[str, bool]
) -> None:
    """V_rho that starts with V_mu, and is given more on the way, against all of it propagated at once."""
    light, through = surroundings()
    change, more, known = spot(seed=6), spot(seed=7), spot(seed=8)
    joint = through * np.random.default_rng(9).uniform(0.5, 1, through.shape).astype(np.float32)
    changed = ChangedLight(gpu, **how)
    changed.propagate(light, change, (through, joint), (MANY_STEPS, 5))
    changed.add(more, known, MANY_STEPS)
    rho = cells_of(changed.rho, "total").copy()
    changed.release()
    _, expected = propagated(
        gpu, light + change + more - known, WEIGHTS["moments"], MANY_STEPS, tiled=False, through=joint
    )
    assert rho == pytest.approx(expected, abs=5e-4)


@pytest.mark.parametrize("kind", IN_SHARED_MEMORY)
def test_shared_memory_makes_the_same_half_steps(gpu: GpuContext, kind: str) -> None:
    """Although they begin where the volume is started, and each dispatch makes several, or all."""
    light, through = surroundings()
    joint = through * np.random.default_rng(9).uniform(0.5, 1, through.shape).astype(np.float32)
    found = []
    for how in ({}, {kind: True}):
        changed = ChangedLight(gpu, in_place=True, **how)
        changed.propagate(light, spot(seed=6), (through, joint), (CELLS, 5))
        changed.add(spot(seed=7), spot(seed=8), 3)
        found.append([cells_of(each, "total").copy() for each in (changed.mu, changed.rho)])
        changed.release()
    for one, other in zip(*found, strict=True):
        assert one == pytest.approx(other, abs=1e-5, rel=1e-5)


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
