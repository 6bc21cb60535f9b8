"""What a change costs: only the stages run again that follow the clock which has ticked."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import watched
from deltalight.render_server.graph import Graph
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.protected_scenes import EYE, METHODS, TARGET, TURNED, Case, scene_of
from tests.render_server.scenes import Stage, ball, checkered, directional, frame, look_at

pytestmark = pytest.mark.usefixtures("clean_gl")

LIGHT = {"environment", "object bvh", "light views"}
MAPS = {"shadow maps real", "shadow maps objects"}
OWN_MAPS = {"volume views", "volume maps real", "volume maps objects"}
VOXELS = {"voxelize real", "voxelize objects"}
CELLS = {"geometry volume real", "geometry volume"}
STANDING = {
    "none": LIGHT | MAPS | VOXELS | {"voxelize far"},
    "exact": LIGHT | MAPS | VOXELS | {"voxelize far"},
    "paper": LIGHT | MAPS | VOXELS | OWN_MAPS,
    "differential": LIGHT | VOXELS | {"shadow maps mu", "shadow maps rho", "voxelize far", "group surfels"},
    "dlpv": LIGHT | MAPS | VOXELS | CELLS,
    "dlpv-paper": LIGHT | MAPS | VOXELS | CELLS,
    "aroof": LIGHT | MAPS | {"occlusion fields"},
}
"""Stages that a camera which moves through a given model leaves alone: all others but values follow `view`."""

FOR_ESTIMATES = {"direct light mu", "cones mu"}
"""Stages that run for estimates of light alone."""

REAL_ALONE = {
    *("declared surfaces", "camera", "real surface", "environment", "shadow maps real", "shadow maps mu"),
    *("volume maps real", "voxelize real", "voxelize far", "real voxel scene", "voxel scene mu"),
    *("light real voxels", "light far voxels", "filter mu", "bounces real", "real albedo"),
    *("inject scene", "inject real", "geometry volume real", "propagate mu"),
}
"""Stages of every method that objects change only by where they make room for the volume and the lights' views."""

MAP_KERNELS = {"reflective_shadow_map"}
GEOMETRY_KERNELS = {"voxelize", "clear_voxels", "geometry_buffer", "real_surface_model", "object_coverage"}
ADDITIVE = ("paper", "dlpv-paper")  # methods whose picture follows from more than a ratio of light


@dataclass(frozen=True)
class Step:
    """What one frame ran: stages by name, and kernels without what they were compiled with."""

    stages: set[str]
    kernels: set[str]


@dataclass
class Walk:
    """Frames of one renderer, each after one change."""

    method: str
    renderer: SceneRenderer
    gpu: GpuContext
    count: int = 0

    @property
    def graph(self) -> Graph:
        assert self.renderer.graph is not None
        return self.renderer.graph

    def step(self, target: Any = TARGET) -> Step:  # noqa: ANN401
        kernels: set[str] = set()
        self.count += 1
        given: dict[str, Any] = {"frame_id": self.count, "timestamp_ns": self.count * 10**7}
        view: ViewFrame = frame(checkered(), pose=look_at(EYE, target), **given)
        with watched(self.gpu, lambda run: kernels.add(run.kernel.split()[0])):
            self.renderer.render(view)
        return Step({stage.name for stage in self.graph.report() if stage.ran}, kernels)

    def change(self, edit: Callable[[SceneDocument], SceneDocument]) -> None:
        self.renderer.set_scene(edit(self.renderer.scene))


@pytest.fixture(scope="module", params=METHODS)
def walk(
    request: pytest.FixtureRequest, gpu: GpuContext, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Walk]:
    """A floor of a given model, two objects, and between them a small one."""
    stage = Stage(tmp_path_factory.mktemp("clocks"))
    scene = scene_of(Case(request.param, "model", "plain"), stage)
    small = stage.virtual(ball(0.02, (0.06, 0, 0.03)), id="small", rigid=True)
    renderer = SceneRenderer(gpu, scene.replaced(objects=[*scene.objects, small]))
    found = Walk(request.param, renderer, gpu)
    found.step()
    yield found
    renderer.release()


def test_first_frame_runs_everything(walk: Walk) -> None:
    walk.graph.invalidate()
    assert walk.step().stages == {stage.name for stage in walk.graph.report()} - FOR_ESTIMATES


def test_camera_that_turns_runs_only_what_follows_the_view(walk: Walk) -> None:
    walk.step()
    step = walk.step(TURNED)
    stages = {stage.name: stage for stage in walk.graph.report()}
    assert all("view" in stages[name].clocks for name in step.stages)
    standing = {stage.name for stage in stages.values() if not (stage.ran or stage.is_value)}
    assert standing - FOR_ESTIMATES == STANDING[walk.method]
    assert {"real surface", "object surface", "cones", "composite"} <= step.stages
    assert not step.kernels & (MAP_KERNELS | {"voxelize", "clear_voxels"})


def test_frame_at_rest_is_composed_and_nothing_else(walk: Walk) -> None:
    walk.step()
    step = walk.step()
    changed = [each.name for each in walk.graph.report_sources() if each.changed]
    if walk.method in ADDITIVE:
        assert step == Step({"relit picture", "composite"}, {"linearize", "composite"})
        assert changed == ["camera image", "linear picture"]
    else:
        assert step == Step({"composite"}, {"recompose"})
        assert changed == ["camera image"]


def test_picture_at_rest_is_the_same_to_the_bit_as_one_composed_in_full(walk: Walk) -> None:
    walk.step()
    color = checkered()
    color[::2, ::3] += 1  # less than motion
    again = frame(color, pose=look_at(EYE, TARGET), timestamp_ns=(walk.count + 1) * 10**7)
    kept = walk.renderer.render(again)
    whole = walk.renderer.render(again, with_linear=True)
    assert np.array_equal(kept.color, whole.color)
    assert not np.array_equal(kept.color, color)


def test_object_that_moves_between_others_leaves_the_real_scene_alone(walk: Walk) -> None:
    def aside(scene: SceneDocument) -> SceneDocument:
        *others, small = scene.objects
        return scene.replaced(objects=[*others, small.replaced(pose={"translation_m": [0, 0.02, 0.01]})])

    walk.step()
    walk.change(aside)
    step = walk.step()
    stages = {stage.name: stage for stage in walk.graph.report()}
    assert all("objects" in stages[name].clocks for name in step.stages)
    assert not step.stages & REAL_ALONE
    assert len(stages.keys() & REAL_ALONE) >= 5
    assert {"object surface", "object bvh", "composite"} <= step.stages


def test_brighter_light_draws_and_voxelizes_nothing(walk: Walk) -> None:
    def brighter(scene: SceneDocument) -> SceneDocument:
        sun, sky = scene.lights.manual
        return scene.replaced(lights=scene.lights.replaced(manual=[sun.replaced(irradiance=2.5), sky]))

    walk.step()
    walk.change(brighter)
    step = walk.step()
    stages = {stage.name: stage for stage in walk.graph.report()}
    assert all("lights" in stages[name].clocks for name in step.stages)
    assert not step.kernels & (GEOMETRY_KERNELS | MAP_KERNELS)
    assert {"environment", "light views", "direct light"} <= step.stages


def test_light_that_moves_draws_its_maps_and_no_geometry(walk: Walk) -> None:
    def moved(scene: SceneDocument) -> SceneDocument:
        _, sky = scene.lights.manual
        sun = directional((0.4, 0.5, -0.8), 1.5, 2.0)
        return scene.replaced(lights=scene.lights.replaced(manual=[sun, sky]))

    walk.step()
    walk.change(moved)
    step = walk.step()
    assert step.kernels >= MAP_KERNELS
    assert not step.kernels & GEOMETRY_KERNELS


def test_values_run_no_kernel(walk: Walk) -> None:
    """What the graph's picture shows as a part of other stages costs the GPU nothing."""
    walk.step()
    walk.graph.invalidate()
    values = [stage for stage in walk.graph.report() if stage.is_value]
    assert {"camera", "geometry", "shading scene"} <= {stage.name for stage in values}
    for stage in values:
        runs: list[object] = []
        walk.graph.run(*(walk.graph.resource(name) for name in stage.inputs))
        with watched(walk.gpu, runs.append):
            walk.graph.run(*(walk.graph.resource(name) for name in stage.outputs))
        assert not runs, stage.name
