"""Light that surfaces reflect once the volume brought it to them: its flux in closed form, and that it dies away."""

from pathlib import Path

import moderngl
import numpy as np
import pytest
import trimesh
from jaxtyping import Float64, Int32

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.lpv import CONSTANT, LOBE, LightVolume, injected_sums
from deltalight.render_server.passes.lpv_lighting import LpvAddBounce, LpvBounce
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import GREY, Stage, ambient, cube, floor, frame, shifted, solve, sphere_light

pytestmark = pytest.mark.usefixtures("clean_gl")
CELLS, EDGE_M = 16, 0.6
FIXED = 2**20  # steps a unit of injected light


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def dlpv(document: SceneDocument, **settings: object) -> SceneDocument:
    method = {"volume_size": CELLS, "volume_edge_m": EDGE_M, "query_scale": 1, "rsm_size": 256, **settings}
    return document.replaced(method=DlpvMethod.model_validate({"name": "dlpv", **method}))


def fill(volume: LightVolume, radiance: float) -> None:
    """Makes light of the volume the same everywhere and from everywhere: E = pi radiance on any surface."""
    even = np.zeros((3, CELLS, CELLS, CELLS, 4), np.float32)
    even[..., 0] = 1.5 * radiance / CONSTANT
    volume.total.write(even.tobytes())


def bounced_flux(
    gpu: GpuContext, document: SceneDocument, radiance_mu: float, radiance_rho: float
) -> tuple[Float64[np.ndarray, "z y x 3"], float]:
    """Flux (W in the picture's units) that surfaces send into each cell under even light of both volumes, and the
    height of the lowest cells' bottom (m)."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame())
    graph = renderer.graph
    assert graph is not None
    (mu,), (rho,) = graph["propagate mu"], graph["bounces"]
    fill(mu, radiance_mu)
    fill(rho, radiance_rho)
    bounce, reflected = LpvBounce(gpu), injected_sums(gpu, CELLS)
    (surfels,), (scene,) = graph["surfels"], graph["inject scene joint"]
    bounce.run(reflected, surfels, (mu, rho), {**scene, **graph["marching"]})
    sums = np.frombuffer(reflected.read(), np.int32).reshape(CELLS, CELLS, CELLS, 3, 4)
    placement = graph["volume"].placement
    bottom_m, edge_m = placement.origin[2], placement.voxel_edge
    for item in (bounce, reflected, renderer):
        item.release()
    return sums[..., 0] / FIXED * np.pi / LOBE[0] * edge_m**2, bottom_m


def test_a_box_reflects_its_albedo_of_all_light_that_the_volume_brings(gpu: GpuContext, stage: Stage) -> None:
    color = (0.8, 0.4, 0.2)
    far = shifted(floor(), 0, 0, -3.0)
    document = stage.document([stage.virtual(cube(0.12), color)], [ambient(0.2)], far)
    flux, _ = bounced_flux(gpu, dlpv(document), 0.1, 0.5)
    expected = np.array(color) * np.pi * 0.5 * 6 * 0.12**2
    assert flux.sum(axis=(0, 1, 2)) == pytest.approx(expected, rel=0.01)


def test_a_floor_reflects_its_albedo_of_what_the_objects_changed(gpu: GpuContext, stage: Stage) -> None:
    """Its albedo is what the picture shows over all the light that the surroundings and V_mu bring."""
    surroundings = 0.4
    document = stage.document([stage.virtual(cube(0.002), (0.0, 0.0, 0.0))], [ambient(surroundings)], floor())
    flux, bottom_m = bounced_flux(gpu, dlpv(document), 0.2, 0.5)
    albedo = decode_lut(None)[GREY] / (surroundings + 0.2)
    edge_m = EDGE_M / CELLS
    above = int((0.5 * edge_m - bottom_m) / edge_m)
    seen = flux[above, 5:11, 5:11]
    assert seen == pytest.approx(np.broadcast_to(albedo * np.pi * 0.3 * edge_m**2, seen.shape), rel=0.01)


def extended(
    gpu: GpuContext, first: Int32[np.ndarray, "z y x 3 4"], second: Int32[np.ndarray, "z y x 3 4"]
) -> Int32[np.ndarray, "z y x 3 4"]:
    """The sums of both bounces and the estimate of all others; a volume gets all of them but the first."""
    before, bounced = injected_sums(gpu, CELLS), injected_sums(gpu, CELLS)
    before.write(first.tobytes())
    bounced.write((first + second).tobytes())
    tail, volume = LpvAddBounce(gpu), LightVolume(gpu, CELLS)
    volume.state.write(bytes(16 * 3 * CELLS**3))
    volume.total.write(np.full((3, CELLS**3, 4), 0.5, np.float32).tobytes())
    tail.measure(before, bounced)
    tail.run(volume, bounced, before, is_last=True)
    found = np.frombuffer(bounced.read(), np.int32).reshape(first.shape)
    added = (np.moveaxis(found - first, 3, 0) / FIXED).astype(np.float32).ravel()
    assert np.frombuffer(volume.state.read(), np.float32) == pytest.approx(added, abs=1e-6)
    assert np.frombuffer(volume.total.read(), np.float32) == pytest.approx(0.5 + added, abs=1e-6)
    for item in (tail, volume, before, bounced):
        item.release()
    return found


def random_sums(scale: float) -> Int32[np.ndarray, "z y x 3 4"]:
    shape = (CELLS, CELLS, CELLS, 3, 4)
    return np.round(scale * FIXED * np.random.default_rng(5).uniform(-1, 1, shape)).astype(np.int32)


@pytest.mark.parametrize("share", [0.0, 0.25, 0.6])
def test_the_tail_of_a_geometric_series_is_its_sum(gpu: GpuContext, share: float) -> None:
    first = random_sums(0.1)
    second = np.round(share * first).astype(np.int32)
    assert extended(gpu, first, second) == pytest.approx(first / (1 - share), abs=4)


def test_the_tail_of_a_series_that_grows_is_bounded(gpu: GpuContext) -> None:
    """Two bounces that cannot be: the tail is that of the brightest albedo."""
    first = random_sums(0.01)
    assert extended(gpu, first, 2 * first) == pytest.approx(first + 2 * first / (1 - 0.95), rel=1e-5, abs=4)


def test_without_light_there_is_no_tail(gpu: GpuContext) -> None:
    nothing = random_sums(0.0)
    assert (extended(gpu, nothing, nothing) == 0).all()


def measure_nothing(add: LpvAddBounce, *_sums: moderngl.Buffer) -> None:
    """Nothing returns, so there are those bounces alone that are propagated."""
    add.parts.write(bytes(add.parts.size))


ALL_STEPS = 128
"""Further ones bring no light, so bounces differ by what is reflected alone."""


def niche(stage: Stage) -> SceneDocument:
    """A dark cube in a box of bright walls under a lamp: what it takes, the walls take from each other again."""
    walls = [shifted(trimesh.creation.box((0.02, 0.4, 0.3)), side * 0.2, 0.1, 0.15) for side in (-1, 1)]
    back = shifted(trimesh.creation.box((0.4, 0.02, 0.3)), 0, 0.3, 0.15)
    room = trimesh.util.concatenate([floor(0.5), back, *walls])
    lights = [sphere_light((0.1, -0.7, 0.8), 1.5, 0.05), ambient(0.05)]
    return stage.document([stage.virtual(cube(0.12), (0.3, 0.3, 0.3))], lights, room)


def test_each_bounce_changes_less_than_the_one_before(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LpvAddBounce, "measure", measure_nothing)
    document = niche(stage)
    solutions = [solve(gpu, dlpv(document, bounces=count, steps=ALL_STEPS)) for count in (0, 1, 2, 3)]
    assert all(np.array_equal(solutions[0].cones_mu, one.cones_mu) for one in solutions[1:])
    seen = (solutions[0].fade == 1) & (solutions[0].matte == 0)
    means = [one.cones_rho[seen].mean() for one in solutions]
    steps = np.abs(np.diff(means))
    assert steps[0] > 1e-3 * means[0]
    assert (steps[1:] < 0.8 * steps[:-1]).all()


def test_two_bounces_come_to_what_more_of_them_do(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four propagated bounces are the reference: without the tail, two leave out most of what is missing."""
    document = niche(stage)

    def change(bounces: int) -> float:
        solution = solve(gpu, dlpv(document, bounces=bounces, steps=ALL_STEPS))
        seen = (solution.fade == 1) & (solution.matte == 0)
        return float((solution.cones_rho - solution.cones_mu)[seen].mean())

    with_tail, many = change(2), change(4)
    monkeypatch.setattr(LpvAddBounce, "measure", measure_nothing)
    without, four = change(2), change(4)
    print(
        f"2 bounces {without:.5f}, with the tail {with_tail:.5f}; 4 bounces {four:.5f}, with the tail {many:.5f}"
    )
    assert abs(with_tail - many) < 0.3 * abs(without - many)
    assert abs(many - four) < 0.5 * abs(many - without)


def test_the_papers_operator_refuses_bounces() -> None:
    with pytest.raises(DeltalightError, match="operator difference"):
        parse_scene({"method": {"name": "dlpv", "operator": "paper", "bounces": 1}})
