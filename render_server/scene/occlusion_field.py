"""Occlusion fields of rigid objects ([D] 5.2): what an object hides, seen from points on shells around it.

The paper's shells are spheres; a receiver next to the object lies within all of them. Here they are box grids, each
within the next: the innermost fits the object, so that contact is resolved, the outermost ends where nothing is left
of its shadow.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float16, Float32, Float64
from scipy.ndimage import distance_transform_edt

from render_server.scene.occlusion_rays import ObjectRays
from render_server.scene.spherical_harmonics import harmonics

BLEND_CELLS = 2  # at its border a shell passes over to the next over so many cells; the object lies within

Step = Callable[[float], None]
"""Told how much of the whole has been done (0..1); may raise to end the work."""


@dataclass(frozen=True)
class FieldSettings:
    """Of one field: `order` SH bands, `resolution` samples an edge of each shell, `reach` in enclosing radii."""

    order: int
    shells: int
    resolution: int
    reach: float
    rays: int
    indirect: bool


@dataclass(frozen=True, eq=False)
class ShellGrid:
    """Nested boxes in the asset's frame: `centre`, and half of the edges of each, finest first."""

    centre: Float64[np.ndarray, "3"]
    halves: Float64[np.ndarray, "shells 3"]

    def points(self, shell: int, resolution: int) -> Float32[np.ndarray, "n 3"]:
        """Return the sample points of a shell, x fastest; the outermost lie on its faces."""
        steps = np.linspace(-1, 1, resolution)
        z, y, x = np.meshgrid(steps, steps, steps, indexing="ij")
        unit = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
        return np.asarray(self.centre + unit * self.halves[shell], np.float32)


def place_shells(rays: ObjectRays, settings: FieldSettings) -> ShellGrid:
    """Return grids from just around the object to `reach` times its radius, each axis in even ratios."""
    margin = 1 - 2 * BLEND_CELLS / (settings.resolution - 1)
    cell = 2 * rays.radius / (settings.resolution - 1)
    first = np.maximum(rays.half / margin, rays.half + BLEND_CELLS * cell / 2)
    last = np.full(3, settings.reach * rays.radius)
    share = np.linspace(0, 1, settings.shells)[:, None]
    return ShellGrid(rays.centre, first ** (1 - share) * last**share)


@dataclass(frozen=True, eq=False)
class OcclusionField:
    """SH of what the object hides (1 where a ray meets it), seen from its shells' samples, in the asset's frame.

    `transfer`, if asked for: the radiance that the object sends back there (9 coefficients) for light of unit
    coefficients (9) and, where materials are the asset's own, its colours: [.., seen, light, RGB].
    """

    grid: ShellGrid
    radius: float
    occlusion: Float16[np.ndarray, "shells n n n k"]
    transfer: Float16[np.ndarray, "shells h h h 9 9 3"] | None


def compute_occlusion(
    rays: ObjectRays, grid: ShellGrid, settings: FieldSettings, step: Step
) -> Float16[np.ndarray, "shells n n n k"]:
    """Sample what the object hides on all shells."""
    n, count = settings.resolution, settings.order**2
    found = np.empty((settings.shells, n, n, n, count), np.float16)
    for shell in range(settings.shells):
        points = grid.points(shell, n)

        def done(share: float, shell: int = shell) -> None:
            step((shell + share) / settings.shells)

        values, inside = _hidden(rays, points, settings, done)
        cells = values.reshape(n, n, n, count)
        spacing = 2 * grid.halves[shell][::-1] / (n - 1)
        found[shell] = fill_inside(cells, inside.reshape(n, n, n), spacing)
    return found


def _hidden(
    rays: ObjectRays, points: Float32[np.ndarray, "n 3"], settings: FieldSettings, done: Step
) -> tuple[Float32[np.ndarray, "n k"], Bool[np.ndarray, " n"]]:
    """Coefficients at points, and which of these lie within the object."""
    values = np.zeros((len(points), settings.order**2), np.float32)
    inside, finished = np.zeros(len(points), bool), 0
    for part, chosen, hits in rays.aimed(points, settings.rays):
        basis = (harmonics(chosen.directions, settings.order) * chosen.solid_angle).astype(np.float32)
        met = np.zeros((len(part), len(basis)), np.float32)
        met[hits.point, hits.direction] = 1
        values[part], inside[part] = met @ basis, rays.inside(hits, len(part), chosen)
        finished += len(part)
        done(finished / len(points))
    return values, inside


def fill_inside(
    values: Float32[np.ndarray, "n n n *rest"],
    inside: Bool[np.ndarray, "n n n"],
    spacing: Float64[np.ndarray, "3"],
) -> Float32[np.ndarray, "n n n *rest"]:
    """Give samples within the object the values of the nearest outside: all is hidden within, half at the surface."""
    if not inside.any() or inside.all():
        return values
    nearest = distance_transform_edt(inside, sampling=spacing, return_distances=False, return_indices=True)
    return np.asarray(values[tuple(nearest)])
