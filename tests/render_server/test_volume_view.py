"""Debug view `volume` costs frames in other views nothing, and shows what the volume holds when it is looked at."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import watched
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.protected_scenes import Case, frames_of, scene_of
from tests.render_server.scenes import Stage

pytestmark = pytest.mark.usefixtures("clean_gl")

SHOWING = {"dlpv": "lpv_show", "dlpv-paper": "lpv_show", "aroof": "occlusion_show"}
"""Kernels that draw what the view shows, by method."""

NEAR = (0.0, 0.1, 0.05)  # where the ball goes (m)
FAR = (1.5, 0.0, 0.0)  # there, `dlpv` gives it a volume of its own


class Looks:
    """Frames of one scene at rest, each in some views, and how often each drew the cells."""

    def __init__(self, gpu: GpuContext, method: str, folder: Path) -> None:
        case = Case(method, "model", "plain")
        self.gpu, self.kernel, self.frame = gpu, SHOWING[method], frames_of(case)[0]
        self.renderer = SceneRenderer(gpu, scene_of(case, Stage(folder)), checks=True)

    def move(self, place: tuple[float, float, float]) -> None:
        first, *others = self.scene.objects
        moved = first.replaced(pose={"translation_m": place})
        self.renderer.set_scene(self.scene.replaced(objects=[moved, *others]))

    def look(self, view: str, *others: str) -> tuple[list[np.ndarray], int]:
        """Returns the pictures of all views, and how many dispatches drew the cells."""
        if view != self.scene.output.view:  # only a renderer's first scene waits for occlusion fields
            self.renderer.set_scene(self.scene.replaced(output=self.scene.output.replaced(view=view)))
        runs: list[str] = []
        with watched(self.gpu, lambda run: runs.append(run.kernel.split()[0])):
            shown = self.renderer.submit(self.frame, others=others).finish()  # type: ignore[arg-type]
        return [shown.color, *(other.color for other in shown.others)], runs.count(self.kernel)

    @property
    def scene(self) -> SceneDocument:
        return self.renderer.scene


@pytest.mark.parametrize("method", SHOWING)
def test_cells_are_drawn_only_for_their_view_and_only_once(
    gpu: GpuContext, tmp_path: Path, method: str
) -> None:
    looks = Looks(gpu, method, tmp_path)
    _, unseen = looks.look("composite")
    _, seen = looks.look("volume")
    _, again = looks.look("composite", "volume")
    looks.move(NEAR)
    _, moved = looks.look("composite")
    _, both = looks.look("volume", "composite")
    looks.renderer.release()
    objects = len(looks.scene.objects)
    assert (unseen, seen, again, moved, both) == (
        (0, objects, 0, 0, objects) if method == "aroof" else (0, 1, 0, 0, 1)
    )


@pytest.mark.parametrize("place", [NEAR, FAR], ids=["near", "far"])
@pytest.mark.parametrize("method", SHOWING)
def test_objects_that_moved_while_another_view_was_shown_are_in_the_newest_cells(
    gpu: GpuContext, tmp_path: Path, method: str, place: tuple[float, float, float]
) -> None:
    """The same as where the view is looked at all the time, to the bit."""
    looks = Looks(gpu, method, tmp_path)
    looks.look("composite")
    (first,), _ = looks.look("volume")
    looks.move(place)
    looks.look("composite")
    (late,), _ = looks.look("volume")
    assert looks.renderer.graph is not None
    volumes = len(looks.renderer.graph["volume"].placements)
    looks.renderer.release()
    always = Looks(gpu, method, tmp_path)
    always.look("composite")
    always.look("volume")
    always.move(place)
    (there,), _ = always.look("volume")
    _, beside = always.look("composite", "volume")[0]
    always.renderer.release()
    assert volumes == (2 if place == FAR and method != "aroof" else 1)
    assert np.array_equal(late, there)
    assert np.array_equal(beside, there)
    assert (late != first).any()
