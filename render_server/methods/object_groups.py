"""Groups of objects far apart (docs/method.md 4): each has a volume and light maps of its own."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from deltalight.render_server.geometry_state import ObjectExtent
from deltalight.render_server.passes.volumes import MOST_VOLUMES


def points_of_groups(extent: ObjectExtent) -> list[Float64[np.ndarray, "n 3"]]:
    """Returns the points of each group of objects whose own volumes do not meet those of others; world, m."""
    parts = extent.extended_parts
    if len(parts) < 2:
        return [extent.points]
    return [
        np.concatenate([parts[each].points for each in group]) for group in group_near(relative_gaps(parts))
    ]


def relative_gaps(parts: Sequence[ObjectExtent]) -> Float64[np.ndarray, "n n"]:
    """Returns the gaps between objects' own volumes, by half the sum of two edges; negative: they overlap."""
    middles = np.stack([each.middle for each in parts])
    halves = np.array([each.volume_edge / 2 for each in parts])
    reach = halves[:, None] + halves
    return np.asarray(np.abs(middles[:, None] - middles).max(axis=-1) / reach - 1)


def group_near(gaps: Float64[np.ndarray, "n n"], most: int = MOST_VOLUMES) -> list[list[int]]:
    """Joins objects whose gap is negative, then the nearest until `most` groups are left (single linkage)."""
    groups = {index: [index] for index in range(len(gaps))}
    first, second = np.triu_indices(len(gaps), 1)
    order = np.argsort(gaps[first, second], kind="stable")
    pairs = first[order].tolist(), second[order].tolist(), gaps[first, second][order].tolist()
    for one, other, gap in zip(*pairs, strict=True):
        if gap >= 0 and len({id(group) for group in groups.values()}) <= most:
            break
        if groups[one] is not groups[other]:
            joined = sorted(groups[one] + groups[other])
            groups |= dict.fromkeys(joined, joined)
    return [group for index, group in groups.items() if group[0] == index]
