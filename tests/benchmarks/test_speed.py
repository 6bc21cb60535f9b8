"""`bench speed` takes each kind of method: its frames are told into still and moving ones, its passes are named."""

from pathlib import Path

import pytest

from benchmarks.speed import WARM_UP_FRAMES, _measure
from render_server.gpu.context import create_context
from render_server.renderer import SceneRenderer
from services.commands.options import Method
from services.demo import with_method
from tests.render_server.scenes import Stage, everyday, frame, look_at


@pytest.mark.slow
def test_each_kind_of_method_has_still_and_moving_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "cache"))
    gpu = create_context()
    document = everyday(Stage(tmp_path))
    still, moved = frame(), frame(pose=look_at((0.4, -0.8, 0.6)))
    views = [*[still] * WARM_UP_FRAMES, still, moved]
    try:
        for method in (Method.EXACT, Method.DLPV_PAPER, Method.DIFFERENTIAL, Method.AROOF):
            changed = with_method(document, method)
            if method is Method.AROOF:  # precomputes the least that it can
                changed = changed.replaced(
                    method={"name": "aroof", "resolution": 12, "rays": 64, "shells": 2}
                )
            renderer = SceneRenderer(gpu, changed)
            found = _measure(renderer, views)
            renderer.release()
            assert found["still_frame_ms"] is not None, method
            assert found["moving_frame_ms"] is not None, method
            assert {"composite", "direct light"} <= set(found["passes"]), method
            assert found["passes"]["direct light"]["runs"] == 0.5, method
    finally:
        gpu.release()
