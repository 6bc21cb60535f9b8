"""Light of the unseen environment, found on the board's paper."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.estimation.registration import unseen_radiance_from_patch
from deltalight.render_server.frame_graph import EvaluatedLight, FrameGraph
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Dispatch
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.passes.cones import ConeFields
from deltalight.render_server.passes.shading import DirectLight
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    COARSE,
    Stage,
    ambient,
    array_of,
    cube,
    directional,
    floor,
    frame,
    look_at,
    plain,
)

ALBEDO = 0.7
KNOWN, OUT_OF_SIGHT, SUN = 0.05, 0.12, 0.9
BOARD = BoardSpec(
    type="aruco_grid",
    dictionary="DICT_4X4_50",
    marker_length_m=0.12,
    separation_m=0.15,
    rows=2,
    columns=3,
    first_id=0,
    white_albedo=ALBEDO,
)


def picture(irradiance: float) -> np.ndarray:
    """All of it paper under this irradiance, to the nearest code."""
    radiance = ALBEDO / np.pi * irradiance
    return plain(int(np.abs(decode_lut(None)[:, 0] - radiance).argmin()))


def document(stage: Stage, surroundings: str = "auto") -> SceneDocument:
    made = stage.document(
        [stage.virtual(cube(0.05, (-0.2, 0.15, 0)))], [directional((0, 0, -1), SUN), ambient(KNOWN)], floor()
    )
    return made.replaced(lights=made.lights.model_copy(update={"surroundings": surroundings}))


def sky_light(gpu: GpuContext, scene: SceneDocument, view: ViewFrame) -> np.ndarray:
    """Radiance above the horizon that the renderer uses after its first frame; below, it has that of the paper."""
    renderer = SceneRenderer(gpu, scene)
    lights = renderer.render(view).lights
    renderer.release()
    ground = decode_lut(None)[view.color[0, 0], np.arange(3)]
    return 2 * np.array(lights[-1]["mean_radiance"]) - ground


@pytest.mark.slow
@pytest.mark.usefixtures("clean_gl")
def test_what_lights_do_not_explain_comes_from_above(gpu: GpuContext, tmp_path: Path) -> None:
    color = picture(SUN + np.pi * (KNOWN + OUT_OF_SIGHT))
    found = sky_light(gpu, document(Stage(tmp_path, COARSE)), frame(color, board=BOARD))
    assert found == pytest.approx(KNOWN + OUT_OF_SIGHT, rel=0.03)  # one code is 1 % of the paper's radiance


@pytest.mark.slow
@pytest.mark.usefixtures("clean_gl")
@pytest.mark.parametrize("case", ["paper unknown", "darker than the lights"])
def test_given_sky_stays_where_nothing_can_be_found(gpu: GpuContext, tmp_path: Path, case: str) -> None:
    board = BOARD.model_copy(update={"white_albedo": None}) if case == "paper unknown" else BOARD
    color = picture(0.8 * SUN if case == "darker than the lights" else SUN + np.pi * (KNOWN + OUT_OF_SIGHT))
    found = sky_light(gpu, document(Stage(tmp_path, COARSE)), frame(color, board=board))
    assert found == pytest.approx(KNOWN, abs=0.002)


@pytest.mark.usefixtures("clean_gl")
def test_without_surroundings_only_the_lights_shine(gpu: GpuContext, tmp_path: Path) -> None:
    renderer = SceneRenderer(gpu, document(Stage(tmp_path, COARSE), "none"))
    view = frame(picture(SUN + np.pi * (KNOWN + OUT_OF_SIGHT)), board=BOARD)
    found = renderer.render(view).lights[-1]["mean_radiance"]
    renderer.release()
    assert found == pytest.approx([KNOWN] * 3, rel=1e-3)


@pytest.mark.usefixtures("clean_gl")
def test_while_lamps_change_live_pictures_assume_what_was_found(gpu: GpuContext, tmp_path: Path) -> None:
    """The search takes longer than pictures do; it is made once all is at rest."""
    made = document(Stage(tmp_path, COARSE))
    live = made.replaced(method=made.method.replaced(quality="live"))
    dimmed = live.replaced(
        lights=live.lights.replaced(manual=[directional((0, 0, -1), 0.5 * SUN), *live.lights.manual[1:]])
    )
    color = picture(SUN + np.pi * (KNOWN + OUT_OF_SIGHT))
    renderer, fresh = SceneRenderer(gpu, live), SceneRenderer(gpu, dimmed)

    def sky_at(time_ms: int, shown: SceneRenderer = renderer) -> float:
        view = frame(color, board=BOARD, frame_id=time_ms, timestamp_ns=time_ms * 1_000_000)
        return float(shown.render(view).lights[-1]["mean_radiance"][0])

    found = sky_at(100)
    renderer.set_scene(dimmed)
    assumed, rested, wanted = [sky_at(200), sky_at(300)], sky_at(2500), sky_at(100, fresh)
    renderer.release()
    fresh.release()
    assert assumed == pytest.approx([found] * 2, rel=1e-6)
    assert rested == pytest.approx(wanted, rel=1e-3)
    assert rested > 1.2 * found


@pytest.mark.usefixtures("clean_gl")
@pytest.mark.parametrize("moves", ["nothing", "object", "camera"])
def test_what_is_kept_while_lamps_change_follows_what_moves(
    gpu: GpuContext, tmp_path: Path, moves: str
) -> None:
    """With another lamp, lights are those that a fresh renderer finds in the same frame."""
    color = np.random.default_rng(1).integers(40, 200, plain().shape, np.uint8)
    stage = Stage(tmp_path, COARSE)
    made = document(stage)
    before = made.replaced(real=made.real.replaced(unseen_albedo=0.5))
    dim = before.lights.replaced(manual=[directional((0, 0, -1), SUN / 2), ambient(KNOWN)])
    after, view = before.replaced(lights=dim), frame(color, board=BOARD)
    if moves == "object":
        after = after.replaced(objects=[stage.virtual(cube(0.08, (0.1, 0.0, 0)))])
    if moves == "camera":
        view = frame(color, board=BOARD, pose=look_at((0.1, -0.7, 0.5), (0.0, 0.1, 0.0)))
    renderer, fresh = SceneRenderer(gpu, before), SceneRenderer(gpu, after)
    renderer.render(frame(color, board=BOARD))
    renderer.set_scene(after)
    found, expected = (each.render(view).lights for each in (renderer, fresh))
    assert found == expected
    assert found[-1]["mean_radiance"] != [KNOWN] * 3
    renderer.release()
    fresh.release()


def test_shadows_and_stains_on_the_paper_do_not_count() -> None:
    rng = np.random.default_rng(1)
    irradiance, per_radiance = rng.uniform(1, 2, (400, 3)), rng.uniform(2, np.pi, (400, 3))
    wanted = np.array([0.3, 0.2, 0.1])
    measured = ALBEDO / np.pi * (irradiance + wanted * per_radiance)
    measured[:120] *= 0.2
    found = unseen_radiance_from_patch(measured, irradiance, per_radiance, ALBEDO)
    assert found is not None
    assert found[0] == pytest.approx(wanted[0], abs=0.01)
    assert unseen_radiance_from_patch(measured[:20], irradiance[:20], per_radiance[:20], ALBEDO) is None


@pytest.mark.usefixtures("clean_gl")
def test_a_servers_first_picture_does_not_wait_for_the_search(gpu: GpuContext, tmp_path: Path) -> None:
    """The second has what the first one of a renderer that waits has; so have the first ones of later scenes."""
    scene = document(Stage(tmp_path, COARSE))
    view = frame(picture(SUN + np.pi * (KNOWN + OUT_OF_SIGHT)), board=BOARD)
    waiting, server = SceneRenderer(gpu, scene), SceneRenderer(gpu, scene, waits=False)
    expected = waiting.render(view)
    first, second = server.render(view), server.render(replace(view, frame_id=1, timestamp_ns=10**9))
    mean = [each.lights[-1]["mean_radiance"][0] for each in (expected, first, second)]
    assert mean[1] < 0.9 * mean[0]
    assert second.lights == expected.lights
    assert np.array_equal(second.color, expected.color)
    other_order = scene.lights.model_copy(update={"manual": scene.lights.manual[::-1]})
    server.set_scene(scene.replaced(lights=other_order, revision=2))
    assert server.render(replace(view, frame_id=2, timestamp_ns=2 * 10**9)).lights == expected.lights
    waiting.release()
    server.release()


def both_mu(cones: ConeFields, direct: DirectLight) -> tuple[np.ndarray, np.ndarray]:
    return array_of(cones.mu), array_of(direct.light.mu)


@pytest.mark.usefixtures("clean_gl")
@pytest.mark.parametrize("quality", ["best", "live"])
def test_the_search_lights_no_objects(
    gpu: GpuContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quality: str
) -> None:
    """It evaluates the light without objects alone, which is to the bit that of the whole method."""
    evaluate, ran = FrameGraph.evaluate, list[Dispatch]()
    found, expected = list[np.ndarray](), list[np.ndarray]()

    def watched(graph: FrameGraph, lights: LightSet) -> EvaluatedLight:
        gpu.watchers.append(ran.append)
        fields = evaluate(graph, lights)
        gpu.watchers.pop()
        found.extend(both_mu(fields.cones, fields.direct))
        expected.extend(graph.kept(both_mu, graph.layers.cones, graph.layers.direct))
        return fields

    monkeypatch.setattr(FrameGraph, "evaluate", watched)
    made = document(Stage(tmp_path, COARSE))
    renderer = SceneRenderer(gpu, made.replaced(method=made.method.replaced(quality=quality)))
    view = frame(picture(SUN + np.pi * (KNOWN + OUT_OF_SIGHT)), board=BOARD)
    renderer.render(view)
    reused = renderer.render(replace(view, frame_id=1, timestamp_ns=10**7)).reused_pass_times_ms
    renderer.release()
    assert "cones real" in reused
    assert not {"cones mu", "direct light mu"} & reused.keys()
    names = {each.kernel for each in ran}
    assert any(name.startswith("light_voxels REAL ") for name in names)
    assert not any("VIRTUAL" in name or "REAL_DELTA" in name for name in names)
    assert all(each.any() for each in found)
    assert [np.array_equal(*pair) for pair in zip(found, expected, strict=True)] == [True, True]
