"""What holds for every method alike: no object, no change; the same frame, the same bytes (docs/method.md 7)."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.scene import parse_scene
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import Stage, cube, everyday, frame, look_at, noisy

pytestmark = pytest.mark.usefixtures("clean_gl")
VOXELS = {"volume_size": 32, "volume_edge_m": 0.6, "rsm_size": 256}
CELLS = {"volume_size": 16, "volume_edge_m": 0.6, "rsm_size": 256}
METHODS: dict[str, dict[str, object]] = {
    "none": {"name": "none"},
    "exact": {"name": "dvct", **VOXELS},
    "paper": {"name": "dvct", "operator": "paper", **VOXELS},
    "differential": {"name": "differential", **VOXELS},
    "dlpv": {"name": "dlpv", **CELLS},
    "dlpv-paper": {"name": "dlpv", "operator": "paper", **CELLS},
    "aroof": {"name": "aroof", "resolution": 12, "rays": 64, "rsm_size": 256},
}


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_frames_are_repeated_to_the_bit_and_without_objects_the_cameras(
    gpu: GpuContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: dict[str, object]
) -> None:
    """Still, and after the camera was elsewhere, so that everything is computed anew; then with no object, with one
    that is invisible, and with one that is there, three metres behind the camera."""
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "cache"))
    stage = Stage(tmp_path)
    document = parse_scene({**everyday(stage).model_dump(mode="json"), "method": method})
    view, aside = frame(noisy()), frame(noisy(1), pose=look_at((0.4, -0.8, 0.6)))
    renderer = SceneRenderer(gpu, document)
    first, still, away, back = (renderer.render(one).color for one in (view, view, aside, view))
    assert (first != noisy()).any(axis=-1).sum() > 300
    assert (away != noisy(1)).any(axis=-1).sum() > 300
    assert np.array_equal(first, still)
    assert np.array_equal(first, back)
    hidden = document.objects[0].replaced(visible=False)
    far = parse_scene({"objects": [stage.virtual(cube(at=(0.25, -4.0, 0.6)))]}).objects
    for objects in ((), (hidden,), far):
        renderer.set_scene(document.replaced(objects=objects))
        assert np.array_equal(renderer.render(view).color, noisy())
    renderer.release()
