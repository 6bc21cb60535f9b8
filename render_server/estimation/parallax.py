"""The parallax between the fish-eye camera, whose map lights the objects from infinity, and the objects.

Near things, such as a book beside the board, lie in other directions as seen from the objects, and the renderer shows
them itself where they are. Of what the camera's depth shows, both directions are known (docs/method.md 2).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from deltalight.protocol.hemisphere_map import WorldSky
from deltalight.protocol.octahedral import octahedral_grid, octahedral_texels, sample_at, texel_coordinates
from deltalight.render_server.estimation.samples import seen_surface
from deltalight.render_server.frame_graph import FrameGraph

MOST_POINTS = 60_000  # some 50 in each texel that the camera sees
STILL_M = 0.01  # more than the pose by a board trembles
SAME_DISTANCE = 0.1  # relative: what is so much farther than what the fish-eye sees there is hidden from it


@dataclass(frozen=True, eq=False)
class EnvironmentParallax:
    """Where the map of a fish-eye camera shows what lies in the directions of a map as seen from the objects.

    `fisheye` is the camera's place (world, m). `coordinates` are those of `sample_at`. `is_shown`: whether the map
    shows the same there; what moved leaves directions of which nothing is known.
    """

    fisheye: Float64[np.ndarray, "3"]
    coordinates: Float32[np.ndarray, "n n 2"]
    is_shown: Bool[np.ndarray, "n n 1"]

    @classmethod
    def between(
        cls,
        fisheye: Float64[np.ndarray, "3"],
        objects: Float64[np.ndarray, "3"],
        points: Float64[np.ndarray, "k 3"],
        size: int,
    ) -> "EnvironmentParallax":
        """Finds the parallax of octahedral maps with `size`^2 texels.

        `fisheye` and `objects` are positions and `points` lie on real surfaces (world, m). Where there are none,
        everything is infinitely far away.
        """
        from_fisheye, from_objects = (_nearest(points - origin, size) for origin in (fisheye, objects))
        towards, is_near = octahedral_grid(size).copy(), np.isfinite(from_objects)
        towards[is_near] = objects + from_objects[is_near, None] * towards[is_near] - fisheye
        away = np.where(is_near, np.linalg.norm(towards, axis=-1), np.inf)
        column, row = np.moveaxis(octahedral_texels(towards, size), -1, 0)
        met = from_fisheye[row, column]
        is_shown = np.where(is_near, away <= (1 + SAME_DISTANCE) * met, np.isinf(met))
        return cls(fisheye, texel_coordinates(towards, size), is_shown[..., None])

    def holds_for(self, fisheye: Float64[np.ndarray, "3"]) -> bool:
        """Whether a fish-eye camera is still where it was."""
        return bool(np.linalg.norm(fisheye - self.fisheye) <= STILL_M)

    def applied(self, radiance: Float32[np.ndarray, "n n 3"]) -> Float32[np.ndarray, "n n 3"]:
        """Returns a map of the fish-eye as seen from the objects; unknown directions hold what is beside them."""
        seen = self.is_shown.astype(np.float32)
        return WorldSky(sample_at(radiance, self.coordinates) * seen, seen).filled()


def find_parallax(graph: FrameGraph, fisheye: Float64[np.ndarray, "3"], size: int) -> EnvironmentParallax:
    """Returns the parallax between a fish-eye camera (world, m) and the middle of the objects."""
    position = seen_surface(graph).position
    points = position[position[:, 3] > 0, :3].astype(np.float64)
    some = points[:: 1 + len(points) // MOST_POINTS]
    low, high = graph.inputs.objects.bounds
    return EnvironmentParallax.between(fisheye, (low + high) / 2, some, size)


def _nearest(away: Float64[np.ndarray, "k 3"], size: int) -> Float64[np.ndarray, "n n"]:
    """Returns the distance of the nearest point in each texel; infinite where there is none."""
    column, row = octahedral_texels(away, size).T
    found = np.full((size, size), np.inf)
    np.minimum.at(found, (row, column), np.linalg.norm(away, axis=-1))
    return found
