"""Views of lights around groups of objects far apart: in one around all, texels would grow with the distance."""

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float64

from deltalight.render_server.lights.light_models import Light
from deltalight.render_server.passes.shadow_maps import LightView, light_views

MOST_GROUP_VIEWS = 8  # of all lights together: each is a map, and maps take memory

Points = Float64[np.ndarray, "n 3"]


def views_of_groups(
    lights: Sequence[Light], groups: Sequence[Points], occluders: Points, around_all: list[list[LightView]]
) -> list[list[LightView]]:
    """Returns each light's views: one around each group (world points), or those `around_all`.

    The views of a light do not meet, nor do the penumbrae of what they show: groups behind each other share one. It
    is those around all of them if a single one is left, if a group needs several, or if maps became too many.
    """
    if len(groups) < 2:
        return around_all
    found = [
        _apart(light, list(groups), occluders) or views
        for light, views in zip(lights, around_all, strict=True)
    ]
    return found if sum(map(len, found)) <= MOST_GROUP_VIEWS else around_all


def _apart(light: Light, groups: list[Points], occluders: Points) -> list[LightView]:
    """Returns a view of each group, after groups whose views meet were joined; none if one or no group is left."""
    while len(groups) > 1:
        fitted = [light_views(light, group, occluders) for group in groups]
        if any(len(views) != 1 for views in fitted):
            return []
        views = [view for (view,) in fitted]
        meeting = next(
            (pair for pair in combinations(range(len(views)), 2) if _meet(light, views, *pair)), None
        )
        if meeting is None:
            return views
        one, other = meeting
        groups[one] = np.concatenate([groups[one], groups.pop(other)])
    return []


def _meet(light: Light, views: Sequence[LightView], one: int, other: int) -> bool:
    """Whether two views of a light meet, or the penumbrae of what they show."""
    a, b = views[one], views[other]
    if not a.orthographic:
        between = math.acos(float(np.clip(a.view_from_world[2, :3] @ b.view_from_world[2, :3], -1, 1)))
        return between <= sum(_half_angle(light, view) for view in (a, b))
    centres = [view.view_from_world[:2, :3].T @ view.view_from_world[:2, 3] for view in (a, b)]
    apart = np.abs(a.view_from_world[:2, :3] @ (centres[0] - centres[1])).max()
    return bool(apart <= sum(view.half_extent + _extent(light) * (view.far - view.near) for view in (a, b)))


def _half_angle(light: Light, view: LightView) -> float:
    """Half the angle of a cone around a view and the penumbrae of what it shows, rad."""
    return math.atan(math.sqrt(2) * view.half_extent) + math.atan(_extent(light) / view.near)


def _extent(light: Light) -> float:
    """Radius of a ball around a lamp, m; tangent of a directional light's."""
    record = light.record()
    return record.shape[0] + float(np.linalg.norm(record.axis_u) + np.linalg.norm(record.axis_v))
