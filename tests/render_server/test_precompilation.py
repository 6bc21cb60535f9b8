"""Programs that the next motion will run are compiled while nothing moves; nothing else follows from that."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
import pytest

from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.render_server import live_scene
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings, Dispatch, Program, watched
from deltalight.render_server.gpu.precompile_queue import PrecompileQueue
from deltalight.render_server.gpu.textures import texture_2d
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.protected_scenes import METHODS
from tests.render_server.scenes import Stage, everyday, frame, look_at
from tests.render_server.tiny_kernel import MakeKernel, floats

pytestmark = pytest.mark.usefixtures("clean_gl")
FRAME_NS = 66_000_000
PATIENCE_S = 60.0
AT_REST = 16  # frames, a second: one for each program and some until everything is at rest
BRIGHT = "#pragma switch bool bright\nuniform sampler2D seen;\n"
BRIGHTENS = "values[0] = (bright ? 3.0 : 1.0) * texelFetch(seen, ivec2(0), 0).x;"
LATER = {"bright": False, "bright_later": True}


@pytest.fixture
def compiled(gpu: GpuContext) -> Iterator[list[str]]:
    """Labels of programs that kernels asked for, in order; nothing is to be compiled ahead before."""
    found: list[str] = []

    def watch(label: str, _sources: object) -> None:
        found.append(label)

    gpu.precompile_queue._waiting.clear()
    gpu.compile_watchers.append(watch)
    yield found
    gpu.compile_watchers.remove(watch)


def test_a_switch_that_is_turned_on_later_is_compiled_when_asked_and_not_in_its_run(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, texture: moderngl.Texture, compiled: list[str]
) -> None:
    kernel = make(BRIGHT, BRIGHTENS)
    kernel.run((1,), LATER, Out=out, seen=texture)
    assert compiled == ["tiny"]
    dispatches: list[Dispatch] = []
    with watched(gpu, dispatches.append):
        gpu.precompile_queue.compile_next()
    assert compiled == ["tiny", "tiny bright"]
    assert dispatches == []
    assert floats(out, 1) == [1], "nothing ran"
    gpu.precompile_queue.compile_next()
    kernel.run((1,), LATER, Out=out, seen=texture, bright=True)
    assert floats(out, 1) == [3]
    assert compiled == ["tiny", "tiny bright"]


def test_nothing_is_compiled_for_a_switch_that_nobody_turns_on(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, texture: moderngl.Texture, compiled: list[str]
) -> None:
    for number, later in enumerate(({}, {"bright_later": False})):
        make(BRIGHT, BRIGHTENS, NUMBER=number).run((1,), later, Out=out, seen=texture, bright=False)
        gpu.precompile_queue.compile_next()
    assert compiled == ["tiny NUMBER=0", "tiny NUMBER"]


def test_a_program_that_ran_before_it_was_compiled_ahead_is_not_asked_for_again(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, texture: moderngl.Texture, compiled: list[str]
) -> None:
    kernel, other = make(BRIGHT, BRIGHTENS), make(BRIGHT, BRIGHTENS, OTHER=1)
    for each in (kernel, other):
        each.run((1,), LATER, Out=out, seen=texture)
    kernel.run((1,), LATER, Out=out, seen=texture, bright=True)
    del compiled[:]
    gpu.precompile_queue.compile_next()
    assert compiled == ["tiny OTHER bright"], "the first turn is not wasted"


def test_it_is_compiled_for_what_was_bound_last(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was bound before that may be released by then."""
    kernel, bound = make(BRIGHT, BRIGHTENS), []
    early, late = (texture_2d(gpu, (4, 4), 4, "f2") for _ in range(2))
    for seen in (early, late):
        kernel.run((1,), LATER, Out=out, seen=seen)
    early.release()
    bind = Program.bind

    def noted(program: Program, own: Bindings, known: Bindings) -> None:
        bind(program, own, known)
        bound.append((program.label, known["seen"]))

    monkeypatch.setattr(Program, "bind", noted)
    gpu.precompile_queue.compile_next()
    assert bound == [("tiny bright", late)]
    late.release()


def test_a_program_is_linked_even_if_what_was_bound_is_released(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, compiled: list[str]
) -> None:
    kernel, seen = make(BRIGHT, BRIGHTENS), texture_2d(gpu, (4, 4), 4, "f2")
    kernel.run((1,), LATER, Out=out, seen=seen)
    seen.release()
    gpu.precompile_queue.compile_next()
    assert compiled == ["tiny", "tiny bright"]


def test_the_program_of_a_kernel_that_never_ran_may_be_compiled_ahead(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, texture: moderngl.Texture, compiled: list[str]
) -> None:
    kernel = make(BRIGHT, BRIGHTENS)
    for expected in (["tiny bright"], []):
        kernel.compile_later({"bright": False}, bright=True, Out=out, seen=texture)
        gpu.precompile_queue.compile_next()
        assert compiled == expected
        del compiled[:]


def test_a_kernel_that_is_released_is_forgotten(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, texture: moderngl.Texture, compiled: list[str]
) -> None:
    kernel = make(BRIGHT, BRIGHTENS)
    kernel.run((1,), LATER, Out=out, seen=texture)
    kernel.release()
    gpu.precompile_queue.compile_next()
    assert compiled == ["tiny"]


def test_what_the_driver_refuses_is_told_by_the_run_alone(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer
) -> None:
    kernel = make("#pragma switch BRIGHT\n", "values[0] = 1.0;\n#ifdef BRIGHT\nbrighten();\n#endif\n")
    kernel.run((1,), {"BRIGHT": False, "BRIGHT_later": True}, Out=out)
    gpu.precompile_queue.compile_next()
    kernel.run((1,), Out=out, BRIGHT=False)
    assert floats(out, 1) == [1]


class Viewer:
    """Frames of one scene as a live server renders them, which compiles ahead after each if it `prepares`."""

    def __init__(self, gpu: GpuContext, scene: SceneDocument, *, prepares: bool) -> None:
        own = replace(gpu, precompile_queue=PrecompileQueue())
        self.renderer = SceneRenderer(own, scene, waits=False)
        self.prepares, self._scene, self._count = prepares, scene, 0

    def show(self, aside: float = 0.0) -> np.ndarray:
        self._count += 1
        seen = frame(pose=look_at((0.25 + aside, -0.9, 0.65)), frame_id=self._count)
        picture = self.renderer.render(replace(seen, timestamp_ns=self._count * FRAME_NS)).color
        if self.prepares:
            self.renderer.compile_ahead()
        return picture

    def drag(self, aside: float) -> np.ndarray:
        first, *others = self._scene.objects
        x, y, z = first.pose.translation_m
        moved = first.replaced(pose=first.pose.replaced(translation_m=(x + aside, y, z)))
        self.renderer.set_scene(self._scene.replaced(objects=(moved, *others)))
        return self.show()

    def dim(self, factor: float) -> np.ndarray:
        lamp, *others = self._scene.lights.manual
        dimmed = lamp.replaced(intensity=factor)
        lights = self._scene.lights.replaced(manual=(dimmed, *others))
        self.renderer.set_scene(self._scene.replaced(lights=lights))
        return self.show()

    def play(self) -> Iterator[np.ndarray]:
        """Whatever somebody does first: drags an object, dims a lamp, moves the camera."""
        for aside in (0.01, 0.02, 0.03):
            yield self.drag(aside)
        for factor in (1.5, 1.0):
            yield self.dim(factor)
        for aside in (0.02, 0.04, 0.06):
            yield self.show(aside)


def live(folder: Path, method: str) -> SceneDocument:
    document = everyday(Stage(folder))
    document = document.replaced(output=document.output.replaced(width=80))
    return parse_scene({**document.model_dump(mode="json"), "method": {**METHODS[method], "quality": "live"}})


@pytest.fixture
def viewers(gpu: GpuContext, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[list[Viewer]]:
    """One that compiles ahead and one that does not, of the same scene; the method may be given."""
    scene = live(tmp_path, getattr(request, "param", "exact"))
    found = [Viewer(gpu, scene, prepares=prepares) for prepares in (True, False)]
    yield found
    for each in found:
        each.renderer.release()


@pytest.mark.parametrize(
    "viewers",
    ["exact", *(pytest.param(name, marks=pytest.mark.slow) for name in ("paper", "dlpv"))],
    indirect=True,
)
def test_a_first_drag_or_camera_motion_compiles_nothing_after_a_second_at_rest(
    viewers: list[Viewer], compiled: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the pictures are those of a renderer that compiles nothing ahead."""
    monkeypatch.setattr(live_scene, "REFINE_S", PATIENCE_S)  # in the same frame by both
    for _ in range(AT_REST):
        preparing, plain = (viewer.show() for viewer in viewers)
        np.testing.assert_array_equal(preparing, plain)
    pictures = []
    for viewer in viewers:
        del compiled[:]
        pictures.append([*viewer.play()])
        assert (len(compiled) == 0) == viewer.prepares, compiled
    np.testing.assert_array_equal(pictures[0], pictures[1])


def test_nothing_is_compiled_ahead_while_something_moves_or_when_the_scene_has_changed(
    gpu: GpuContext, tmp_path: Path, compiled: list[str]
) -> None:
    viewer = Viewer(gpu, live(tmp_path, "exact"), prepares=True)
    try:
        for step in range(AT_REST):
            viewer.show(0.01 * step)
        assert not of_drags(compiled)
        viewer.prepares = False
        for _ in range(AT_REST):
            viewer.show(0.01 * AT_REST)
        viewer.renderer.set_scene(viewer.renderer.scene)
        viewer.renderer.compile_ahead()
        assert not of_drags(compiled), "the next frame may show anything"
        viewer.prepares = True
        for _ in range(AT_REST):
            viewer.show(0.01 * AT_REST)
        assert of_drags(compiled)
    finally:
        viewer.renderer.release()


def of_drags(labels: list[str]) -> list[str]:
    """Returns those of programs that reuse light while an object moves."""
    return [label for label in labels if "keeps_unblocked" in label]
