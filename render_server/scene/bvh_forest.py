"""A hierarchy for each part of a mesh, and one over the parts: what rests is not refitted when others move."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from deltalight.render_server.scene.bvh import COUNT_BITS, Bvh, build_bvh
from deltalight.render_server.scene.gpu_mesh import MeshPart

# Refitting costs a fraction of building (8 000 triangles: 1.3 against 34 ms), so rays through a
# hierarchy may become half as expensive again before it is rebuilt.
WORN = 1.5


class LastingBvh:
    """A hierarchy of triangles that move: refitted, as long as that is good enough."""

    def __init__(self) -> None:
        self._built: Bvh | None = None
        self._fresh_cost = 0.0

    def fitted_to(self, corners: Float32[np.ndarray, "m 3 3"]) -> Bvh:
        """Returns the hierarchy of these triangles."""
        if self._built is not None and len(self._built.order) == len(corners):
            bvh = self._built.refitted(corners)
            if bvh.cost <= WORN * self._fresh_cost:
                return bvh
        self._built = build_bvh(corners)
        self._fresh_cost = self._built.cost
        return self._built


@dataclass(frozen=True)
class Tree:
    """The hierarchy of a part, behind `first_node` nodes of others."""

    part: MeshPart
    bvh: Bvh
    first_node: int


@dataclass(frozen=True, eq=False)
class Forest:
    """Trees in one depth-first order of `node_count` nodes, below nodes that hold several trees.

    `above` are those nodes, packed as `Bvh.packed` does, and `above_at` their places; none above a single tree.
    """

    trees: Sequence[Tree]
    above: Float32[np.ndarray, "k 8"]
    above_at: Int64[np.ndarray, " k"]
    node_count: int


class BvhForest:
    """The hierarchies of parts that move."""

    def __init__(self) -> None:
        self._lasting: list[LastingBvh] = []
        self._lasting_above = LastingBvh()
        self._known: dict[MeshPart, Bvh] = {}

    def fitted_to(self, parts: Sequence[MeshPart]) -> Forest:
        """Returns the hierarchy of these parts; those that it knows keep their own."""
        missing = len(parts) - len(self._lasting)
        self._lasting = [*self._lasting, *(LastingBvh() for _ in range(missing))][: len(parts)]
        bvhs = [
            self._known[part] if part in self._known else lasting.fitted_to(part.corners)
            for part, lasting in zip(parts, self._lasting, strict=True)
        ]
        self._known = dict(zip(parts, bvhs, strict=True))
        if len(parts) == 1:
            return lone_tree(parts[0], bvhs[0])
        boxes = np.stack([(each.low[0], each.high[0], each.high[0]) for each in bvhs])
        return _planted(parts, bvhs, self._lasting_above.fitted_to(boxes))


def lone_tree(part: MeshPart, bvh: Bvh) -> Forest:
    """Returns a forest of one part."""
    return Forest([Tree(part, bvh, 0)], np.zeros((0, 8), np.float32), np.zeros(0, np.int64), len(bvh.leaf))


def _planted(parts: Sequence[MeshPart], bvhs: Sequence[Bvh], above: Bvh) -> Forest:
    """Puts the hierarchies of parts behind the leaves of the one `above`, which hold their boxes."""
    sizes = np.array([len(each.leaf) for each in bvhs])
    held = np.where(above.leaf < 0, 0, above.leaf & ((1 << COUNT_BITS) - 1))
    ends = np.cumsum([0, *sizes[above.order]])  # of the trees, side by side
    trees_before = np.cumsum([0, *held])
    at = np.arange(len(held) + 1) + ends[trees_before]
    leaf_of = np.repeat(np.arange(len(held)), held)
    firsts = (leaf_of + 1 + ends[:-1]).tolist()
    trees = [
        Tree(parts[number], bvhs[number], first)
        for number, first in zip(above.order.tolist(), firsts, strict=True)
    ]
    rows = above.packed()
    rows.view(np.int32)[:, 3] = -1  # what a leaf holds lies below it
    rows.view(np.int32)[:, 7] = at[above.skip]
    return Forest(trees, rows, at[:-1], int(at[-1]))
