"""Where the volumes around the objects lie (docs/method.md 4): one, or several where objects are far apart."""

from collections.abc import Callable, Sequence
from itertools import combinations
from operator import eq

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.quality import BEST, QualityTier
from deltalight.render_server.frame import FrameResources
from deltalight.render_server.geometry_state import GeometryState, ObjectExtent
from deltalight.render_server.gpu.kernel import Binding
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.methods.light_maps import object_extent
from deltalight.render_server.methods.object_groups import group_near, relative_gaps
from deltalight.render_server.passes.volumes import (
    MOST_VOLUMES,
    VolumePlacement,
    keep_placement,
    place_volume,
)

Placements = tuple[VolumePlacement, ...]
SizeOf = Callable[[int], int]
"""Voxels an edge of each of so many volumes, 0 where there is no room for them."""


def only_one(size: int) -> SizeOf:
    """There is room for one volume."""
    return lambda count: size if count == 1 else 0


def volume_placement(
    g: Graph, s: FrameResources, size: int, edge_m: float | None, tier: QualityTier = BEST
) -> Resource[VolumePlacement]:
    """Declares the cube of voxels or cells around the objects; a quick tier moves it only when it must."""
    return g.value("volume cube", _only, volume_placements(g, s, only_one(size), edge_m, tier))


def volume_placements(
    g: Graph, s: FrameResources, size_of: SizeOf, edge_m: float | None, tier: QualityTier = BEST
) -> Resource[Placements]:
    """Declares the cubes of voxels around the objects; a quick tier moves them only when it must."""
    placed: Placements = ()

    def place(extent: ObjectExtent) -> Placements:
        """Places cubes around the objects, snapped to their cells; they stand still while objects turn."""
        nonlocal placed
        groups, wanted = place_volumes(extent, size_of, edge_m)
        if not tier.refresh_tiles or not _may_stay(placed, groups, wanted):
            placed = wanted
        return placed

    placing = g.shared("volume placement", lambda: place)
    return g.value("volume placement", placing, object_extent(g, s), same=eq)


def _only(placements: Placements) -> VolumePlacement:
    """The one volume."""
    return placements[0]


def _may_stay(placed: Placements, groups: Sequence[ObjectExtent], wanted: Placements) -> bool:
    pairs = zip(placed, groups, wanted, strict=False)
    return len(placed) == len(wanted) and all(
        keep_placement(old, *group.bounds, new) for old, group, new in pairs
    )


def object_boxes(objects: GeometryState, placements: Placements) -> dict[str, Binding]:
    """Returns the voxels that hold each volume's own objects (shaders/common/object_box.glsl).

    Each object belongs to one volume, so that none counts twice where volumes overlap.
    """
    boxes = [np.array(objects.bounds)]
    if len(placements) > 1:
        own = own_extents(objects.extents, placements)
        boxes = [_box(each, placement) for each, placement in zip(own, placements, strict=True)]
    lows: list[int] = []
    highs: list[int] = []
    for placement, box in zip(placements, boxes, strict=True):
        bounds = placement.voxel_bounds(box).tolist()
        lows += *bounds[:3], 0
        highs += *(1 - each for each in bounds[3:]), 0
    unused = [0] * (4 * MOST_VOLUMES - len(lows))
    return {"object_lows": (*lows, *unused), "object_highs": (*highs, *unused)}


def own_extents(extents: Sequence[ObjectExtent], placements: Placements) -> list[list[ObjectExtent]]:
    """Returns each volume's own objects: those whose middles lie deeper in it than in others."""
    own: list[list[ObjectExtent]] = [[] for _ in placements]
    for extent in extents:
        middle = np.mean(extent.bounds, axis=0)
        own[int(np.argmin([each.distance_from_middle(middle) for each in placements]))].append(extent)
    return own


def outside_fractions(
    extents: Sequence[ObjectExtent], placements: Placements
) -> Float64[np.ndarray, "count count"]:
    """Returns how much of the box around each volume's own objects (rows) lies outside of each volume (columns).

    0 outside of its own, and for a volume without objects.
    """
    fractions = np.zeros((len(placements), len(placements)))
    for row, group in enumerate(own_extents(extents, placements)):
        for column, placement in enumerate(placements):
            if group and row != column:
                fractions[row, column] = 1 - _inside_fraction(ObjectExtent.around(group), placement)
    return fractions


def _inside_fraction(group: ObjectExtent, placement: VolumePlacement) -> float:
    """Returns how much of the box around a group lies in a volume."""
    low, high = group.bounds
    corners = placement.corners
    edges = np.maximum(high - low, 1e-9)  # of flat things
    within = (np.minimum(high, corners[-1]) - np.maximum(low, corners[0]) + 1e-9) / edges
    return float(np.clip(within, 0, 1).prod())


def _box(own: Sequence[ObjectExtent], placement: VolumePlacement) -> Float64[np.ndarray, "_ 3"]:
    """Returns corners of a box around objects; the volume's middle if there are none."""
    return np.stack(ObjectExtent.around(own).bounds) if own else placement.corners.mean(axis=0)[None]


def place_volumes(
    extent: ObjectExtent, size_of: SizeOf, edge_m: float | None = None
) -> tuple[Sequence[ObjectExtent], Placements]:
    """Returns groups of near objects, and the volume of each.

    It is one around all of them where `edge_m` is given, and where several would have larger voxels.
    """
    whole = extent.volume_edge if edge_m is None else edge_m
    single = [extent], (_placed(extent, size_of(1), whole),)
    parts = extent.extended_parts
    if edge_m is not None or len(parts) < 2:
        return single
    gaps = relative_gaps(parts)
    members = group_near(gaps, max(count for count in range(1, MOST_VOLUMES + 1) if size_of(count)))
    size = size_of(len(members))
    groups = [ObjectExtent.around([parts[each] for each in group]) for group in members]
    edges = _volume_edges(groups, [[gaps[np.ix_(one, other)].min() for other in members] for one in members])
    if len(groups) == 1 or max(edges) * size_of(1) > whole * size:
        return single
    placed = zip(groups, edges, strict=True)
    return groups, tuple(_placed(group, size, edge) for group, edge in placed)


def _placed(group: ObjectExtent, size: int, edge: float) -> VolumePlacement:
    low, high = group.upright
    return place_volume(low, high, size, edge)


def _volume_edges(groups: Sequence[ObjectExtent], gaps: Sequence[Sequence[float]]) -> list[float]:
    """Returns the edge of each group's volume, m.

    As large as one around two groups where they are nearly joined, its own where the gap is as wide as their volumes:
    so voxels do not change at once when objects are moved apart.
    """
    edges = [each.volume_edge for each in groups]
    for one, other in combinations(range(len(groups)), 2):
        weight = max(0.0, 1 - gaps[one][other])
        if weight > 0:
            joint = ObjectExtent.around([groups[one], groups[other]]).volume_edge
            for index in (one, other):
                own = groups[index].volume_edge
                edges[index] = max(edges[index], float(own + weight * (joint - own)))
    return edges
