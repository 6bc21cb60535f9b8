"""Declared surfaces of the real scene (`real.surfaces`), compiled for shaders."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_objects import Region, Surface

MAX_SURFACES = 16
PLANE, BOX, MATERIAL, DIFFUSE_BOX = 0.0, 1.0, 2.0, 3.0
SHEET_TOLERANCE_M = 0.005
# Reflectance of a declared metal without a colour in the document (that of silver and aluminium).
ASSUMED_METAL_F0 = 0.9


@dataclass(frozen=True, eq=False)
class SurfaceTable:
    """Declared surfaces in the document's order; the first row whose region contains a point applies.

    A row of `packed` is five vectors (SurfaceEntry of passes/shaders/common/surfaces.glsl): (F0 R G B, metallic);
    (roughness, 0, 0, 0); (albedo R G B, 1 if declared); and two for the region, whose kind is the last component of
    the first. 0 plane: (point, kind), (unit normal, tolerance); 1 box: (lower corner, kind), (upper corner, 0); 2
    material of the given model: (its index, 0, 0, kind), zeros; 3 box in which everything is diffuse: the marker
    sheet, which comes first.
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

    def lookup(
        self, points: Float[np.ndarray, "k 3"], materials: Int32[np.ndarray, " k"] | None = None
    ) -> Int32[np.ndarray, " k"]:
        """Returns the row of each world point's surface, -1 for diffuse (reference for the shaders).

        `materials` are the material indices of points on a given model.
        """
        entry = np.full(len(points), -1, np.int32)
        for index in reversed(range(len(self.packed))):
            is_diffuse = self.packed[index, 3, 3] == DIFFUSE_BOX
            entry[_inside(self.packed[index], points, materials)] = -1 if is_diffuse else index
        return entry


def _inside(
    row: Float32[np.ndarray, "5 4"],
    points: Float[np.ndarray, "k 3"],
    materials: Int32[np.ndarray, " k"] | None,
) -> Bool[np.ndarray, " k"]:
    first, second = row[3], row[4]
    if first[3] == PLANE:
        inside = np.abs((points - first[:3]) @ second[:3]) <= second[3]
    elif first[3] in (BOX, DIFFUSE_BOX):
        inside = ((points >= first[:3]) & (points <= second[:3])).all(axis=1)
    elif materials is None:
        inside = np.zeros(len(points), bool)
    else:
        inside = (materials == first[0]) & (first[0] >= 0)
    return np.asarray(inside)


def build_surface_table(
    surfaces: Sequence[Surface], board: BoardSpec | None = None, material_names: Sequence[str] = ()
) -> SurfaceTable:
    """Compiles the declared surfaces; `material_names` are those of the given model, by index.

    F0 is 0.08 specular, mixed by `metallic` with the albedo (0.9 where none is given).

    Raises:
        DeltalightError: more than 16 surfaces are declared.
    """
    if len(surfaces) > MAX_SURFACES:
        raise DeltalightError(
            f"real.surfaces has {len(surfaces)} entries; declare at most {MAX_SURFACES}, no diffuse ones."
        )
    rows = [] if board is None else [_sheet_row(board)]
    rows += [_row(surface, material_names) for surface in surfaces]
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


def _sheet_row(board: BoardSpec) -> list[list[float]]:
    """Returns the row of the board's printed sheet, 5 mm thick to either side."""
    outline = board.sheet_outline()
    thickness = np.array([0, 0, SHEET_TOLERANCE_M])
    low, high = outline.min(axis=0) - thickness, outline.max(axis=0) + thickness
    nothing = [0.0] * 4
    return [nothing, [1.0, 0.0, 0.0, 0.0], nothing, [*low.tolist(), DIFFUSE_BOX], [*high.tolist(), 0.0]]
