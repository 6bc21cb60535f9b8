"""Another method while frames come: every frame is answered, as if the method had always been that one."""

from pathlib import Path

import numpy as np
import pytest

from protocol.scene import SceneDocument
from render_server.gpu.context import GpuContext
from render_server.renderer import SceneRenderer
from tests.render_server.scenes import Stage, composite, everyday, frame, look_at

pytestmark = pytest.mark.usefixtures("clean_gl")
METHODS: list[dict[str, object]] = [
    {"name": "dvct"},
    {"name": "dlpv"},
    {"name": "aroof", "resolution": 12, "rays": 64},
    {"name": "differential"},
    {"name": "none"},
    {"name": "dvct", "operator": "paper"},
]


@pytest.fixture
def document(tmp_path: Path) -> SceneDocument:
    return everyday(Stage(tmp_path))


def test_no_frame_is_lost_and_none_shows_what_was_before(gpu: GpuContext, document: SceneDocument) -> None:
    renderer = SceneRenderer(gpu, document)
    eyes = [(0.25, -0.9, 0.65), (0.3, -0.9, 0.63)]
    waiting = None
    composite(
        gpu, document.replaced(method=METHODS[2]), frame()
    )  # or its field came only while frames are shown
    try:
        for index, method in enumerate([*METHODS, *METHODS]):
            view = frame(pose=look_at(eyes[index % 2]), frame_id=index)
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
                if index < len(METHODS):
                    np.testing.assert_array_equal(shown.color, composite(gpu, changed, view))
    finally:
        renderer.release()


def check(shown: object, frame_id: int) -> None:
    assert (shown.frame_id, shown.status) == (frame_id, "ok")  # type: ignore[attr-defined]
