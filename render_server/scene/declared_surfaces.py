"""Declared surfaces of the real scene (`real.surfaces`), compiled for shaders."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol import short_axis
from deltalight.protocol.board import BoardSpec
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.protocol.scene_objects import Region, SheetRegion, Surface
from deltalight.render_server.scene.depth_surface import DepthSurface

MAX_SURFACES = 16
MAX_FOUND = 4  # sheets that nobody declared
MAX_ROWS = MAX_SURFACES + 17 + MAX_FOUND  # with the board's paper and its grey cards
PLANE, BOX, MATERIAL, SHEET = 0.0, 1.0, 2.0, 3.0
SHEET_TOLERANCE_M = 0.005
# What leans on a plane by more than 45 degrees is no part of it (a cosine; common/measured_surfaces.glsl).
FLUSH = 0.7071
SAMPLE_STEP, LEAST_SAMPLES = 4, 30
UNBOUNDED_M = 1e6
UNBOUNDED = np.tile(np.array([0.0, UNBOUNDED_M], np.float32), (MAX_ROWS, 1))
UNBOUNDED.flags.writeable = False
# Reflectance of a declared metal without a colour in the document (that of silver and aluminium).
ASSUMED_METAL_F0 = 0.9


@dataclass(frozen=True, eq=False)
class SurfaceTable:
    """Declared surfaces in the document's order; the first row whose region contains a point applies.

    A row of `packed` is five vectors (SurfaceEntry of passes/shaders/common/surfaces.glsl): (F0 R G B, metallic);
    (roughness, 0, 0, 0); (albedo R G B, 1 if declared); and two for the region, whose kind is the last component of
    the first. 0 plane: (point, kind), (unit normal, tolerance); 1 box: (lower corner, kind), (upper corner, 0); 2
    material of the given model: (its index, 0, 0, kind), zeros; 3 diffuse sheet: (centre, kind), (unit direction of
    an edge, half the edge), with (unit normal, half the other edge) and (1, tolerance, 0, 0) in place of the first
    two. The board's paper, its grey cards, declared and found sheets come first.
    """

    packed: Float32[np.ndarray, "n 5 4"]

    def __len__(self) -> int:
        return len(self.packed)

    def equals(self, other: "SurfaceTable") -> bool:
        """Whether it declares the same surfaces."""
        return np.array_equal(self.packed, other.packed)

    @property
    def f0(self) -> Float32[np.ndarray, "n 3"]:
        """Reflectance at normal incidence."""
        return self.packed[:, 0, :3]

    @property
    def roughness(self) -> Float32[np.ndarray, " n"]:
        """Perceptual roughness."""
        return self.packed[:, 1, 0]

    @cached_property
    def is_specular(self) -> bool:
        """Whether any of them reflects, other than sheets."""
        return bool((self.packed[:, 3, 3] < SHEET).any())

    @property
    def sheets(self) -> Float64[np.ndarray, "s 4 3"]:
        """Corners of the sheets, world, m."""
        rows = self.packed[self.packed[:, 3, 3] == SHEET].astype(np.float64)
        normal, edge = rows[:, 0, :3], rows[:, 4, :3]
        one, other = edge * rows[:, 4, 3:], np.cross(normal, edge) * rows[:, 0, 3:]
        middle = rows[:, None, 3, :3]
        return np.asarray(middle + np.stack([-one - other, one - other, one + other, other - one], axis=1))


def build_surface_table(
    surfaces: Sequence[Surface],
    board: BoardSpec | None = None,
    material_names: Sequence[str] = (),
    found: Sequence[Float64[np.ndarray, "4 3"]] = (),
) -> SurfaceTable:
    """Compiles the declared surfaces; `material_names` are those of the given model, by index.

    `found` are outlines (world, m) of at most MAX_FOUND sheets that nobody declared.

    F0 is 0.08 specular, mixed by `metallic` with the albedo (0.9 where none is given).

    Raises:
        DeltalightError: more than 16 surfaces are declared.
    """
    if len(surfaces) > MAX_SURFACES:
        raise DeltalightError(
            f"real.surfaces has {len(surfaces)} entries; declare at most {MAX_SURFACES}, and of "
            "what is diffuse only sheets."
        )
    rows = [] if board is None else [_sheet_row(quad) for quad in _sheets(board)]
    rows += [_sheet_row(_outline(each.region.sheet)) for each in surfaces if each.region.sheet is not None]
    rows += [_sheet_row(outline) for outline in found]
    rows += [_row(surface, material_names) for surface in surfaces if surface.region.sheet is None]
    return SurfaceTable(np.array(rows, np.float32).reshape(-1, 5, 4))


def _row(surface: Surface, material_names: Sequence[str]) -> list[list[float]]:
    albedo = surface.albedo
    metal = np.array(albedo if albedo is not None else (ASSUMED_METAL_F0,) * 3)
    f0 = (1 - surface.metallic) * 0.08 * surface.specular + surface.metallic * metal
    return [
        [*f0.tolist(), surface.metallic],
        [surface.roughness, 0.0, 0.0, 0.0],
        [*(albedo or (0.0, 0.0, 0.0)), float(albedo is not None)],
        *_region(surface.region, material_names),
    ]


def _region(region: Region, material_names: Sequence[str]) -> tuple[list[float], list[float]]:
    if region.plane is not None:
        return [*region.plane.point_m, PLANE], [*region.plane.normal, region.plane.tolerance_m]
    if region.box is not None:
        return [*region.box.min_m, BOX], [*region.box.max_m, 0.0]
    if region.material is None or region.material not in material_names:
        known = (
            f"it has {', '.join(material_names)}" if material_names else "only a given model has materials"
        )
        raise DeltalightError(f"real.surfaces names the material `{region.material}`, but {known}.")
    return [float(list(material_names).index(region.material)), 0.0, 0.0, MATERIAL], [0.0] * 4


def plane_fits(
    table: SurfaceTable,
    depth: DepthImage | None,
    fitted: Callable[[], DepthSurface],
    world_from_camera: Float64[np.ndarray, "4 4"],
    noise_sigma: float,
) -> Float32[np.ndarray, "r 2"]:
    """Returns how depth saw each declared plane: its height over the declared one (m), and the noise at 1 m (m).

    `fitted` fits a surface to `depth`; it is not called where no plane is declared.

    A plane may be declared some millimetres off, and depth errs by more than its noise where its calibration does:
    the height is the median of what lies within the tolerance and faces the plane's way, the noise the larger of
    `noise_sigma` and what the median deviation says. Unbounded where there is no depth, or too little of the plane.
    """
    planes = np.flatnonzero(table.packed[:, 3, 3] == PLANE)
    if depth is None or not len(planes):
        return UNBOUNDED
    fits = UNBOUNDED.copy()
    seen = _sampled(depth, fitted().normals, world_from_camera)
    for index in planes:
        fits[index] = _plane_fit(table.packed[index].astype(float), seen, noise_sigma)
    return fits


@dataclass(frozen=True, eq=False)
class _Seen:
    """Measured points: world position (m), change of it by a metre of depth, unit normal, depth (m)."""

    points: Float64[np.ndarray, "n 3"]
    rays: Float64[np.ndarray, "n 3"]
    normals: Float64[np.ndarray, "n 3"]
    depth_m: Float64[np.ndarray, " n"]


def _sampled(
    depth: DepthImage, normals: Float32[np.ndarray, "h w 3"], world_from_camera: Float64[np.ndarray, "4 4"]
) -> _Seen:
    """Returns the points of every fourth row and column whose normals are known."""
    grid = (slice(None, None, SAMPLE_STEP),) * 2
    z, facing, rays = depth.depth_m[grid], normals[grid], depth.camera.rays()[grid]
    known = depth.valid[grid] & (z > 0) & short_axis.any_of(facing)
    z, rotation = z[known].astype(float), world_from_camera[:3, :3]
    along = np.column_stack([rays[known], np.ones(len(z))]) @ rotation.T
    points = along * z[:, None] + world_from_camera[:3, 3]
    return _Seen(points, along, facing[known] @ rotation.T, z)


def _plane_fit(row: Float64[np.ndarray, "5 4"], seen: _Seen, noise_sigma: float) -> tuple[float, float]:
    point, normal, tolerance_m = row[3, :3], row[4, :3], row[4, 3]
    heights = (seen.points - point) @ normal
    near = (np.abs(heights) <= tolerance_m) & (np.abs(seen.normals @ normal) >= FLUSH)
    if near.sum() < LEAST_SAMPLES:
        return 0.0, UNBOUNDED_M
    level = float(np.median(heights[near]))
    by_depth = np.maximum(np.abs(seen.rays[near] @ normal) * seen.depth_m[near] ** 2, 1e-9)
    deviation = 1.4826 * float(np.median(np.abs(heights[near] - level) / by_depth))
    return level, max(noise_sigma, deviation)


def _sheets(board: BoardSpec) -> list[Float64[np.ndarray, "4 3"]]:
    """Returns the outlines of the board's paper and of the grey cards."""
    return [board.paper_outline(), *(card.outline() for card in board.grey_cards)]


def _outline(sheet: SheetRegion) -> Float64[np.ndarray, "4 3"]:
    """Returns the corners of a declared sheet, world, m."""
    turn = np.radians(sheet.turn_deg)
    edge = np.array([np.cos(turn), np.sin(turn), 0.0]) * sheet.size_m[0] / 2
    other = np.array([-np.sin(turn), np.cos(turn), 0.0]) * sheet.size_m[1] / 2
    middle = np.array([*sheet.middle_m, 0.0])
    return middle + np.stack([-edge - other, edge - other, edge + other, other - edge])


def _sheet_row(outline: Float64[np.ndarray, "4 3"]) -> list[list[float]]:
    """Returns the row of a rectangular sheet of which everything within 5 mm is taken for paper."""
    centre, edge, other = outline.mean(axis=0), outline[1] - outline[0], outline[3] - outline[0]
    length, breadth = float(np.linalg.norm(edge)), float(np.linalg.norm(other))
    normal = np.cross(edge, other) / (length * breadth)
    return [
        [*normal.tolist(), breadth / 2],
        [1.0, SHEET_TOLERANCE_M, 0.0, 0.0],
        [0.0] * 4,
        [*centre.tolist(), SHEET],
        [*(edge / length).tolist(), length / 2],
    ]
