"""Reflections in the real scene leave the objects themselves alone: what their shading has bound stays its own."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.scene import parse_scene
from deltalight.render_server.gpu.context import GpuContext
from tests.render_server.scenes import Stage, checkered
from tests.render_server.test_history import HERE, fresh, room, seen

pytestmark = pytest.mark.usefixtures("clean_gl")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "without"), [("dvct", "cones"), ("dlpv", "none")])
def test_objects_look_the_same_with_rays_for_the_floors_reflections(
    gpu: GpuContext, tmp_path: Path, name: str, without: str
) -> None:
    content = room(Stage(tmp_path), has_model=True).model_dump(mode="json", exclude={"output"})
    settings = {"name": name, "volume_size": 32, "volume_edge_m": 0.6, "rsm_size": 256}
    plain, rays, other = (
        fresh(gpu, parse_scene({**content, "method": method}), seen(HERE))
        for method in (
            {"name": "none"},
            {**settings, "reflections": "rays"},
            {**settings, "reflections": without},
        )
    )
    shows_object = (plain.color != checkered()).any(axis=-1).astype(np.uint8)
    inner = cv2.erode(shows_object, np.ones((5, 5), np.uint8)) == 1
    assert inner.sum() > 150
    assert (rays.color != other.color).any()
    np.testing.assert_array_equal(rays.color[inner], other.color[inner])
