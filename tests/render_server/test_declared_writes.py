"""Stages write what they declare, and nothing that another stage made: the graph checks it, kernel by kernel."""

from pathlib import Path

import pytest

from render_server.gpu.context import GpuContext
from tests.render_server.protected_scenes import METHODS, Case, pictures_of

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("clean_gl")]
CHANGES = {  # between the frames: what the camera sees of the real scene, the objects, the light
    "mirror": "depth",
    "animated": "model",
    "estimated": "depth",
}


def cases() -> list[Case]:
    """`aroof` refuses objects that change their shape."""
    found = [Case(method, geometry, kind) for method in METHODS for kind, geometry in CHANGES.items()]
    return [case for case in found if (case.method, case.kind) != ("aroof", "animated")]


@pytest.mark.parametrize("case", cases(), ids=str)
def test_no_stage_writes_what_it_did_not_declare(
    gpu: GpuContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: Case
) -> None:
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "cache"))
    _, dispatches = pictures_of(gpu, case, tmp_path, checks=True)
    assert any(run.written for run in dispatches[1])
