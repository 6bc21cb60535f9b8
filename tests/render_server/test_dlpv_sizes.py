"""Light propagation volumes of any size: the same light, memory as stated, refusals; texels as large as cells."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float32

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import gpu_objects, sizes_bytes
from deltalight.render_server.graph import Graph
from deltalight.render_server.methods.lpv import DifferenceVolumes, PrintedVolumes, ShownCells
from deltalight.render_server.methods.lpv_cells import LpvCells
from deltalight.render_server.methods.lpv_memory import (
    PrintedSizes,
    affordable_count,
    state_memory,
    volumes_bytes,
)
from deltalight.render_server.methods.method import SOFTWARE_DEFAULTS
from deltalight.render_server.methods.per_volume import PerVolume
from deltalight.render_server.passes.lpv import (
    CONSTANT,
    LightVolume,
    LpvJoin,
    LpvPropagate,
    injected_sums,
    medium_bindings,
    moment_weights,
)
from deltalight.render_server.passes.voxels import LEAST_SURFELS
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.lpv_scenes import dlpv, graph_of, injected_flux
from tests.render_server.scenes import (
    Stage,
    array_of,
    ball,
    cube,
    directional,
    everyday,
    floor,
    frame,
    solve,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
LARGEST = 128


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def settings_of(**settings: object) -> DlpvMethod:
    return DlpvMethod.model_validate({"name": "dlpv", **settings})


def rendered(gpu: GpuContext, document: SceneDocument) -> tuple[SceneRenderer, Graph]:
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame())
    return renderer, graph_of(renderer)


@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (0.4, 0.25, -1.0)])
def test_texels_as_large_as_cells_fill_them_evenly(
    gpu: GpuContext, stage: Stage, direction: tuple[float, float, float]
) -> None:
    """Each column of cells over an evenly lit floor gets albedo times the irradiance of its area; the map has 128
    texels for 64 cells in a part of it."""
    document = stage.document([stage.virtual(ball(0.05))], [directional(direction, 2.0)], floor(0.4))
    settings = {"volume_size": 64, "rsm_size": 128, "ambient": "open", "steps": 1, "bounces": 0}
    renderer, graph = rendered(gpu, dlpv(document, **settings))
    columns = injected_flux(graph, "inject real").sum(axis=0)[12:-12, 12:-12, 1]
    area, linear = graph["volume"].placement.voxel_edge ** 2, array_of(graph["camera image"].linear)[0, 0, 1]
    renderer.release()
    assert columns.mean() == pytest.approx(np.pi * linear * area, rel=0.02)
    assert columns.std() / columns.mean() < 0.05
    assert columns.min() > 0.85 * columns.mean()


def test_the_largest_volume_holds_the_flux_that_a_box_reflects(gpu: GpuContext, stage: Stage) -> None:
    color = (0.8, 0.4, 0.2)
    document = stage.document([stage.virtual(cube(0.12), color)], [directional(irradiance=2.0)], floor())
    settings = {"volume_size": LARGEST, "operator": "paper", "volume_edge_m": 0.5, "steps": 1}
    renderer, graph = rendered(gpu, dlpv(document, **settings))
    change, direct = (injected_flux(graph, name) for name in ("inject change", "inject direct"))
    renderer.release()
    gained = np.clip(change, 0, None).sum(axis=(0, 1, 2))
    assert gained == pytest.approx(np.array(color) * 2.0 * 0.12**2, rel=0.03)
    for sign in (1, -1):  # what now meets the box, and what the floor lost
        one_sided = np.clip(sign * direct, 0, None).sum(axis=(0, 1, 2))
        assert one_sided == pytest.approx(np.full(3, 2.0 * 0.12**2), rel=0.03)


def test_a_query_in_the_largest_volume_is_exact(gpu: GpuContext, stage: Stage) -> None:
    """Radiance 0.1 k from everywhere, k = 1, 2, 3 in red, green, blue, gives the object E = 0.1 k pi."""
    document = stage.document([stage.virtual(ball())], [directional()], floor())
    renderer, graph = rendered(gpu, dlpv(document, volume_size=LARGEST, steps=1))
    even = np.zeros((3, LARGEST, LARGEST, LARGEST, 4), np.float32)
    radiance = np.array((0.1, 0.2, 0.3))
    even[..., 0] = (1.5 / CONSTANT * radiance)[:, None, None, None]
    light = graph.resource("bounces")
    light.value[0].total.write(even.tobytes())
    light.write(light.value)
    graph.run()
    field = array_of(graph["cones"].virtual)
    renderer.release()
    seen = field[field[..., 3] > 0][:, :3]
    assert len(seen) > 100
    assert seen == pytest.approx(np.pi * np.broadcast_to(radiance, seen.shape), rel=2e-3)


@pytest.mark.parametrize("tiled", [False, True], ids=["plain", "tiled"])
def test_steps_in_the_last_corner_are_those_of_a_small_volume(gpu: GpuContext, tiled: bool) -> None:
    corner = np.random.default_rng(4).uniform(-1, 2, (3, 4, 4, 4, 4)).astype(np.float32)

    def after(cells: int) -> Float32[np.ndarray, "3 8 8 8 4"]:
        light = np.zeros((3, cells, cells, cells, 4), np.float32)
        light[:, -4:, -4:, -4:] = corner
        volume, propagate = LightVolume(gpu, cells), LpvPropagate(gpu, tiled=tiled)
        for texture in (volume.state, volume.total):
            texture.write(light.tobytes())
        propagate.run(volume, medium_bindings(cells, moment_weights(16), None), 3)
        total = np.frombuffer(volume.total.read(), np.float32).reshape(light.shape)
        assert not total[:, :-8, :-8, :-8].any()
        for item in (volume, propagate):
            item.release()
        return total[:, -8:, -8:, -8:].copy()

    small = after(16)
    assert np.abs(small[2, 0]).max() == 0 < np.abs(small[2, 1]).max()
    assert np.array_equal(after(LARGEST), small)


@pytest.mark.slow
def test_light_converges_with_resolution(gpu: GpuContext, stage: Stage) -> None:
    """To 128 cells an edge: twice the cells halve the error of E_mu at least, and keep the mean of all fields."""
    document = everyday(stage)
    coarse, middle, fine = (
        solve(gpu, dlpv(document, volume_size=cells, bounces=0)) for cells in (32, 64, LARGEST)
    )
    real = np.all([(each.fade == 1) & (each.matte == 0) for each in (coarse, middle, fine)], axis=0)
    errors = [
        float(np.sqrt(np.mean((one.cones_mu - other.cones_mu)[real] ** 2)))
        for one, other in ((coarse, middle), (middle, fine))
    ]
    shares = {
        "without objects": middle.cones_mu[real].mean() / fine.cones_mu[real].mean(),
        "with objects": middle.cones_rho[real].mean() / fine.cones_rho[real].mean(),
        "objects": middle.on_object[fine.matte == 1].mean() / fine.on_object[fine.matte == 1].mean(),
    }
    print(
        f"E_mu of 32 against 64 and of 64 against 128 cells, r.m.s.: {errors}; means of 64 to 128: {shares}"
    )
    assert errors[1] < 0.5 * errors[0] < 0.5 * 0.02 * coarse.cones_mu[real].mean()
    for name, share in shares.items():
        assert share == pytest.approx(1.0, abs=0.02), name


SIZES: list[dict[str, object]] = [
    {},
    {"bounces": 0},
    {"operator": "paper"},
    {"operator": "paper", "shadow": "map"},
    {"operator": "paper", "objects_volume_size": 16, "direct_volume_size": 64},
]


def readers(gpu: GpuContext, method: DlpvMethod, count: int) -> list[Any]:
    """What all of `count` volumes share: cells that are shown, and light that surfaces read."""
    sizes = PrintedSizes.of(method)
    shown = ShownCells(gpu, sizes.indirect)
    injected = injected_sums(gpu, sizes.indirect)
    assert shown.show(PerVolume([injected] * count)).texture.width == count * sizes.indirect
    read = [sizes.objects, sizes.indirect] + ([sizes.direct] if method.resolved_shadow == "lobe" else [])
    joins = [LpvJoin(gpu) for _ in read]
    for join, cells in zip(joins, read, strict=True):
        light = LightVolume(gpu, cells)
        join.run([light] * count)
        light.release()
    injected.release()
    return [shown, *joins]


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("settings", SIZES, ids=str)
def test_the_stated_memory_is_what_is_allocated(
    gpu: GpuContext, settings: dict[str, object], count: int
) -> None:
    """But for surfels, of which there are none yet, and uniform blocks and the like."""
    method = settings_of(volume_size=32, **settings)
    sizes = PrintedSizes.of(method)
    cells = [LpvCells(gpu, method, size) for size in sizes.counts for _ in range(count)]
    volumes: list[Any] = [
        DifferenceVolumes(gpu, method, sizes.indirect)
        if method.operator == "difference"
        else PrintedVolumes(gpu, method, sizes)
        for _ in range(count)
    ]
    items = [*cells, *volumes, *readers(gpu, method, count)]
    held = sizes_bytes([list(gpu_objects(items))])[0]
    surfels = 2 * len(cells) * LEAST_SURFELS * 400  # bytes a surfel, with its slot
    assert 0 <= held - volumes_bytes(method, count) < surfels
    for item in items:
        item.release()


def test_the_budget_limits_how_many_volumes_there_are() -> None:
    two_mb = -(-volumes_bytes(settings_of(), 2) // 1_000_000)
    assert affordable_count(settings_of(memory_budget_mb=two_mb)) == 2
    assert affordable_count(settings_of(memory_budget_mb=two_mb - 1)) == 1
    assert affordable_count(settings_of()) == 4


@pytest.mark.parametrize(
    ("settings", "name"),
    [({}, "volume_size"), ({"operator": "paper", "direct_volume_size": LARGEST}, "direct_volume_size")],
)
def test_volumes_beyond_the_budget_are_refused(
    gpu: GpuContext, stage: Stage, settings: dict[str, object], name: str
) -> None:
    """And the scene before stays."""
    document = stage.document([stage.virtual(cube())], [directional()], floor())
    renderer = SceneRenderer(gpu, dlpv(document, volume_size=16))
    before = renderer.render(frame()).color
    large = {"volume_size": LARGEST if name == "volume_size" else 16, "memory_budget_mb": 256, **settings}
    needed = -(-volumes_bytes(settings_of(**large)) // 1_000_000)
    with pytest.raises(
        DeltalightError, match=rf"128\^3 cells takes {needed} MB.*256 MB: lower method\.{name} "
    ):
        renderer.set_scene(dlpv(document, **large))
    assert np.array_equal(renderer.render(frame()).color, before)
    renderer.release()
    enough = settings_of(**{**large, "memory_budget_mb": needed})
    assert f"{needed} MB of a budget of {needed} MB" in state_memory(enough, SOFTWARE_DEFAULTS)


def test_a_device_whose_shaders_reach_too_little_is_told_in_a_sentence(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenGL guarantees 16 MB of a buffer: enough for 64 cells an edge, not for 128."""
    monkeypatch.setitem(gpu.ctx.info, "GL_MAX_SHADER_STORAGE_BLOCK_SIZE", 2**24)
    document = stage.document([stage.virtual(cube())], [directional()], floor())
    renderer = SceneRenderer(gpu, dlpv(document, volume_size=64, steps=1))
    renderer.render(frame())
    words = r"^A buffer of 101 MB is needed.* 17 MB of one: lower method\.volume_size"
    renderer.set_scene(dlpv(document, volume_size=LARGEST))
    with pytest.raises(DeltalightError, match=words):
        renderer.render(frame())
    renderer.release()


@pytest.mark.parametrize("name", ["volume_size", "objects_volume_size", "direct_volume_size"])
def test_more_cells_than_the_largest_volume_has_are_refused(name: str) -> None:
    with pytest.raises(DeltalightError, match=rf"{name}.*128"):
        parse_scene({"method": {"name": "dlpv", "operator": "paper", name: LARGEST + 8}})
