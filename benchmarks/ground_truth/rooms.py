"""Common parts of the scenes: a table between two walls and things that stand on it."""

from typing import Any

from deltalight.benchmarks.ground_truth import meshes
from deltalight.benchmarks.ground_truth.benchmark_scene import BOARD, TABLE_Z_M
from deltalight.benchmarks.ground_truth.parts import (
    Matrix,
    MeshFolder,
    Triple,
    diffuse,
    mesh_shape,
    placed,
    rectangle,
    rgb,
    shape,
    sheet,
    texture,
    turned,
)
from deltalight.benchmarks.ground_truth.textures import plaster, wood

OCHRE: Triple = (0.66, 0.50, 0.33)
SLATE: Triple = (0.28, 0.42, 0.47)
CARDBOARD: Triple = (0.62, 0.44, 0.27)
PAGES: Triple = (0.76, 0.72, 0.62)
CERAMIC: Triple = (0.72, 0.69, 0.62)

_TABLE_X_M = (-0.50, 1.10)
_TABLE_FRONT_Y_M = -1.0
_WALL_Y_M = 0.44


def standing(x_m: float, y_m: float, z_m: float = TABLE_Z_M, turn_deg: float = 0.0) -> Matrix:
    """Returns world from an object that stands upright at a position, by default on the table."""
    return placed((x_m, y_m, z_m), turned("z", turn_deg))


def table_place(back_y_m: float = _WALL_Y_M) -> Matrix:
    """Returns world from the unit rectangle of the table's top; its back edge touches the wall or ends before it."""
    (left, right), front = _TABLE_X_M, _TABLE_FRONT_Y_M
    middle = ((left + right) / 2, (front + back_y_m) / 2, TABLE_Z_M)
    return placed(middle, scale=((right - left) / 2, (back_y_m - front) / 2, 1.0))


def wooden_table(seed: int = 7) -> dict[str, Any]:
    """Returns a table of matte boards with the marker sheet on it."""
    return {"table": rectangle(table_place(), wood(seed, 1080, 1200, planks=9)), "board": sheet(BOARD)}


def plain_table(color: Triple, seed: int = 5) -> dict[str, Any]:
    """Returns a matte painted table with the marker sheet on it."""
    return {"table": rectangle(table_place(), plaster(seed, 720, 800, color)), "board": sheet(BOARD)}


def back_wall(color: Triple = OCHRE, y_m: float = _WALL_Y_M) -> dict[str, Any]:
    """Returns a plastered wall behind the table, from below its top to 1.2 m above."""
    place = placed((0.30, y_m, 0.40), turned("x", 90), (0.80, 0.80, 1.0))
    return {"back_wall": rectangle(place, plaster(3, 620, 620, color))}


def left_wall(color: Triple = SLATE) -> dict[str, Any]:
    """Returns a plastered wall at the left end of the table; lamps stand to its right."""
    place = placed((-0.30, -0.28, 0.60), turned("z", 90) @ turned("x", 90), (0.72, 0.62, 1.0))
    return {"left_wall": rectangle(place, plaster(4, 480, 560, color))}


def standing_box(
    x_m: float, y_m: float, size_m: Triple, turn_deg: float, color: Triple, *, z_m: float = TABLE_Z_M
) -> dict[str, Any]:
    """Returns a box of painted or printed card, lightly mottled."""
    half_m = (size_m[0] / 2, size_m[1] / 2, size_m[2] / 2)
    place = placed((x_m, y_m, z_m + half_m[2]), turned("z", turn_deg), half_m)
    return shape("cube", place, bsdf=diffuse(texture(plaster(int(1e4 * size_m[2]), 128, 128, color))))


def book(x_m: float, y_m: float, turn_deg: float, cover: Triple, height_m: float = 0.23) -> dict[str, Any]:
    """Returns an upright book 16 cm wide: cover and, slightly recessed, its pages."""
    return {
        "book": standing_box(x_m, y_m, (0.160, 0.036, height_m), turn_deg, cover),
        "pages": standing_box(x_m, y_m, (0.163, 0.028, height_m - 0.008), turn_deg, PAGES),
    }


def mug(folder: MeshFolder, place: Matrix, color: Triple = CERAMIC) -> dict[str, Any]:
    """Returns a matte ceramic mug."""
    return mesh_shape("mug", meshes.mug(), place, folder, diffuse(rgb(color)))
