"""While one object is dragged, nothing of those that rest is made or uploaded again."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from deltalight.benchmarks.speed.instruments import counted
from deltalight.protocol.scene_objects import SceneObject
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.mesh_buffers import CORNERS_ROW
from deltalight.render_server.passes.object_bvh import BVH_WIDTH, ObjectBvh
from deltalight.render_server.virtual_objects import VirtualObjects
from tests.render_server.gltf_samples import bent_bar
from tests.render_server.scenes import Stage, ball

pytestmark = pytest.mark.usefixtures("clean_gl")
CORNERS_ROW_BYTES, BVH_ROW_BYTES = 3 * 16 * CORNERS_ROW, 16 * BVH_WIDTH


def thing(asset: str, number: int, x: float = 0.0, **more: Any) -> SceneObject:  # noqa: ANN401 (of a document)
    pose = {"translation_m": [x, 0.2 * number, 0.1]}
    return SceneObject.model_validate({"id": f"thing{number}", "asset": asset, "pose": pose, **more})


@pytest.fixture
def objects(gpu: GpuContext) -> Iterator[VirtualObjects]:
    made = VirtualObjects(gpu)
    yield made
    made.release()


def updated(objects: VirtualObjects, things: list[SceneObject]) -> GeometryState:
    objects.load(things)
    state = objects.update(things, None, 0)
    assert state is not None
    return state


def bytes_of_a_drag(gpu: GpuContext, objects: VirtualObjects, things: list[SceneObject]) -> int:
    """What a frame uploads of objects of which the first moves."""
    bvh = ObjectBvh(gpu)

    def frame(x: float) -> None:
        state = updated(objects, [thing(things[0].asset, 0, x), *things[1:]])
        bvh.set_triangles(state.drawn.mesh, state.bounds, state.buffers)
        assert state.buffers.corners or not gpu.is_software
        assert bvh.bindings

    for x in (0.0, 0.01):
        frame(x)
    with counted() as counts:
        frame(0.02)
    bvh.release()
    return counts.uploaded_bytes


def test_uploads_of_a_drag_do_not_grow_with_the_objects_that_rest(
    gpu: GpuContext, objects: VirtualObjects, tmp_path: Path
) -> None:
    """Except by what shares rows of texels with the one that moves."""
    asset = Stage(tmp_path).asset(ball(detail=4))
    two, eight = (
        bytes_of_a_drag(gpu, objects, [thing(asset, number) for number in range(count)]) for count in (2, 8)
    )
    assert two > 0
    assert eight <= two + CORNERS_ROW_BYTES + 6 * BVH_ROW_BYTES


@pytest.mark.parametrize("plays", [False, True], ids=["no clip", "a clip that stands"])
def test_what_rests_keeps_its_meshes(objects: VirtualObjects, tmp_path: Path, *, plays: bool) -> None:
    asset = str(bent_bar(tmp_path))
    clip: dict[str, Any] = {"animation": {"speed": 0, "offset_s": 0.3}} if plays else {}
    rests = thing(asset, 1, **clip)
    before, after = (updated(objects, [thing(asset, 0, x), rests]).drawn.mesh for x in (0.0, 0.01))
    assert after.parts[0] is not before.parts[0]
    assert after.parts[1] is before.parts[1]
    assert after.triangles is before.triangles
