"""Views of lights around groups of objects far apart: each its own, unless they meet."""

from itertools import pairwise

import numpy as np
import pytest

from deltalight.render_server.lights.light_models import DirectionalLight, Light, SphereLight
from deltalight.render_server.passes.group_views import MOST_GROUP_VIEWS, views_of_groups
from deltalight.render_server.passes.shadow_maps import LightView, light_views

WHITE = np.ones(3, np.float32)


def lamp(x: float, y: float, z: float, radius: float = 0.0) -> Light:
    return SphereLight(np.array((x, y, z), np.float32), WHITE, radius)


def sun(x: float, y: float, z: float, radius_rad: float = 0.0) -> Light:
    direction = np.array((x, y, z)) / np.linalg.norm((x, y, z))
    return DirectionalLight(direction.astype(np.float32), WHITE, radius_rad)


def cube(*middle: float, edge: float = 0.2) -> np.ndarray:
    return np.array(middle) + edge * (np.indices((2, 2, 2)).reshape(3, 8).T - 0.5)


def fitted(lights: list[Light], *groups: np.ndarray) -> list[list[LightView]]:
    points = np.concatenate(groups)
    around_all = [light_views(light, points, points) for light in lights]
    return views_of_groups(lights, groups, points, around_all)


@pytest.mark.parametrize("light", [lamp(0.5, 0.5, 1.5), sun(0.2, 0.1, -1)])
def test_each_group_has_a_view_as_fine_as_alone(light: Light) -> None:
    groups = cube(-1, 0, 0), cube(1, 0, 0), cube(1, 2, 0)
    (views,) = fitted([light], *groups)
    alone = [light_views(light, group, group)[0] for group in groups]
    assert [view.half_extent for view in views] == [view.half_extent for view in alone]


@pytest.mark.parametrize(
    ("light", "far"),
    [(lamp(0, 0, 3), (0, 0, -2)), (sun(1, 0, 0), (3, 0, 0)), (lamp(0, 0, 2, radius=1.5), (1, 0, 0))],
)
def test_groups_before_each_other_share_a_view(light: Light, far: tuple[float, float, float]) -> None:
    """So each view shows all that lights its receivers, and no light counts twice; wide penumbrae meet, too."""
    near = cube(0, 0, 0)
    (views,) = fitted([light], near, cube(*far))
    assert len(views) == 1


def test_groups_aside_keep_views_of_their_own() -> None:
    (views,) = fitted([sun(1, 0, 0)], cube(0, 0, 0), cube(3, 0, 0), cube(0, 9, 0))
    assert len(views) == 2


def test_a_lamp_among_the_objects_keeps_its_views() -> None:
    light, groups = lamp(0, 0, 0.2), (cube(0, 0, 0, edge=0.6), cube(3, 0, 0))
    (views,) = fitted([light], *groups)
    assert len(views) == len(light_views(light, np.concatenate(groups), groups[0]))


def test_many_lights_share_maps_around_all_objects() -> None:
    groups = cube(-1, 0, 0), cube(1, 0, 0)
    counts = [
        sum(map(len, fitted([lamp(0.1 * i, 0, 1.5) for i in range(lights)], *groups)))
        for lights in (MOST_GROUP_VIEWS // 2, MOST_GROUP_VIEWS // 2 + 1)
    ]
    assert counts == [MOST_GROUP_VIEWS, MOST_GROUP_VIEWS // 2 + 1]


def test_views_of_a_light_do_not_meet() -> None:
    """The corners of each lie outside of all others."""
    (views,) = fitted([lamp(0, 0, 2)], *(cube(x, 0, 0) for x in (-3, -1, 1, 3)))
    assert len(views) == 4
    for one, other in pairwise(views):
        ends = np.array([(x, y, 1.0) for x in (-1, 1) for y in (-1, 1)]) * [*[one.half_extent] * 2, 1]
        within = ends @ one.view_from_world[:3, :3] @ other.view_from_world[:3, :3].T
        beyond = np.abs(within[:, :2]).max(axis=1) > other.half_extent * within[:, 2]
        assert (beyond | (within[:, 2] <= 0)).all()
