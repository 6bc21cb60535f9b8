"""Depth images that all cameras of a room took at one moment, and what NumPy computes from them on demand."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.render_server.scene.depth_mesh import BOUND_POINTS, back_faces, bound_points, depth_mesh
from deltalight.render_server.scene.depth_views import DepthViews, PosedSurface
from deltalight.render_server.scene.grazing_depth import grazing_depth_fill
from deltalight.render_server.scene.threads import submit
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.view import PosedFrame

Grazing = Callable[[], Float32[np.ndarray, "h w"]]


class SeenDepth:
    """Frames with depth, one of each camera. `surfaces` fit planes to them, in the same order.

    Surfaces too oblique to measure (`grazing`) are searched for on other threads from the beginning.
    """

    def __init__(self, frames: Sequence[PosedFrame], surfaces: Sequence[Callable[[], PosedSurface]]) -> None:
        self.frames = tuple(frames)
        self._surfaces = tuple(surfaces)
        self.grazing: list[Grazing] = [submit(partial(_grazing_depth, each)).result for each in frames]

    @cached_property
    def views(self) -> DepthViews:
        """What the cameras see; takes time."""
        return DepthViews(tuple(fit() for fit in self._surfaces))

    def begun_bounds(self) -> Callable[[], Float64[np.ndarray, "n 3"]]:
        """Begins to find at most BOUND_POINTS points around everything (world, m); returns what finishes that.

        Those of the first camera are found then: to wait for another thread takes longer.
        """
        most, (first, *others) = BOUND_POINTS // len(self.frames), self.frames
        found = [submit(partial(_bound_points, each, most)) for each in others]
        return lambda: np.concatenate([_bound_points(first, most), *(each.result() for each in found)])

    def meshes(self, triangle_budget: int) -> list[TriangleMesh]:
        """Returns a mesh of each camera's depth, each within the budget; takes time.

        What several cameras see is kept of the one that shows it largest.
        """
        known = zip(self.frames, self.views.frames, self.grazing, strict=True)
        return self.views.without_copies([_mesh(*each, triangle_budget) for each in known], triangle_budget)

    def without_backs_in_sight(
        self, corners: Float32[np.ndarray, "m 3 3"], voxel_edge: float
    ) -> np.ndarray[tuple[int], np.dtype[np.int32]]:
        """Returns the numbers of the triangles whose `back_faces` lie in no space that a camera sees to be empty."""
        middles = back_faces(corners, voxel_edge).mean(axis=1, dtype=np.float64)
        return np.flatnonzero(~self.views.in_free_space(middles)).astype(np.int32)


def _grazing_depth(seen: PosedFrame) -> Float32[np.ndarray, "h w"]:
    assert seen.frame.depth is not None
    return grazing_depth_fill(seen.frame.depth, seen.frame.color, seen.view.camera)


def _bound_points(seen: PosedFrame, most: int) -> Float64[np.ndarray, "n 3"]:
    assert seen.frame.depth is not None
    return bound_points(seen.frame.depth, seen.view.camera, seen.view.world_from_camera, most)


def _mesh(seen: PosedFrame, posed: PosedSurface, grazing: Grazing, triangle_budget: int) -> TriangleMesh:
    view, depth = seen.view, seen.frame.depth
    assert depth is not None
    return depth_mesh(
        depth, view.camera, view.world_from_camera, triangle_budget, posed.surface, grazing=grazing
    )
