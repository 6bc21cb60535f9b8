"""Another method while frames come: every frame is answered, as if the method had always been that one."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import CompositeFrame, SceneRenderer
from tests.render_server.protected_scenes import METHODS
from tests.render_server.scenes import Stage, composite, everyday, frame, look_at, pass_times_ms

pytestmark = pytest.mark.usefixtures("clean_gl")
SWITCHES = [METHODS[name] for name in ("exact", "dlpv", "aroof", "differential", "none", "paper")]
EYES = ((0.25, -0.9, 0.65), (0.3, -0.9, 0.63))


@pytest.fixture
def document(tmp_path: Path) -> SceneDocument:
    document = everyday(Stage(tmp_path))
    return document.replaced(output=document.output.replaced(width=80))


@pytest.mark.slow
def test_no_frame_is_lost_and_none_shows_what_was_before(gpu: GpuContext, document: SceneDocument) -> None:
    # A renderer that is shown another scene does not wait for occlusion fields: here they are on disk before.
    composite(gpu, document.replaced(method=METHODS["aroof"]), frame())
    renderer = SceneRenderer(gpu, document)
    waiting = None
    try:
        for index, method in enumerate([*SWITCHES, *SWITCHES]):
            view = frame(pose=look_at(EYES[index % 2]), frame_id=index)
            changed = document.replaced(method=method)
            renderer.set_scene(changed)
            started = renderer.submit(view)
            if waiting is not None:  # on a GPU the frame before is read only now, after the switch
                check(waiting.finish(), index - 1)
            waiting = started
            if started.immediate:
                shown = started.finish()
                waiting = None
                check(shown, index)
                if index < len(SWITCHES):
                    np.testing.assert_array_equal(shown.color, composite(gpu, changed, view))
    finally:
        renderer.release()


def check(shown: CompositeFrame, frame_id: int) -> None:
    assert (shown.frame_id, shown.status) == (frame_id, "ok")


def test_other_views_of_a_frame_are_what_each_alone_would_show(gpu: GpuContext, tmp_path: Path) -> None:
    document = everyday(Stage(tmp_path), cone_scale=2, cone_count=4)
    document = document.replaced(output=document.output.replaced(width=80))
    renderer = SceneRenderer(gpu, document)
    try:
        alone, _ = (renderer.render(frame(frame_id=index)) for index in range(2))
        several = renderer.submit(frame(frame_id=2), others=("delta", "camera", "rsm")).finish()
        ran = pass_times_ms(renderer)
        again = renderer.render(frame(frame_id=3))
        assert alone.others == again.others == ()
        assert "other views" in ran
        assert "relit picture" not in ran, "its own picture is as cheap as ever"
        for shown in (several, again):
            np.testing.assert_array_equal(shown.color, alone.color)
        views = {each.view: each for each in several.others}
        assert list(views) == ["delta", "camera", "rsm"]
        assert views["rsm"].world_from_camera is None, "not the camera's picture"
        np.testing.assert_array_equal(views["delta"].world_from_camera, alone.world_from_camera)
        np.testing.assert_array_equal(views["camera"].color, renderer.sized(frame()).color)
        assert renderer.pick(40, 30).kind != "nothing", "picking goes on"
        for view in ("delta", "rsm"):
            renderer.set_scene(document.replaced(output=document.output.replaced(view=view)))
            np.testing.assert_array_equal(views[view].color, renderer.render(frame(frame_id=4)).color)
    finally:
        renderer.release()
