import numpy as np
import pytest
from jaxtyping import Bool, Float, Float32, Int32

from deltalight.protocol.board import BoardSpec, GreyCard
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_objects import BoxRegion, PlaneRegion, Region, Surface
from deltalight.render_server.scene.declared_surfaces import (
    BOX,
    PLANE,
    SHEET,
    SurfaceTable,
    build_surface_table,
)

BOARD = BoardSpec(
    type="aruco_grid", dictionary="DICT_4X4_50", marker_length_m=0.06, separation_m=0.02, rows=2, columns=3
)
TABLE = Surface(
    region=Region(plane=PlaneRegion(point_m=(0, 0, 0.5), normal=(0, 0, 2), tolerance_m=0.02)), roughness=0.3
)
METAL_BOX = Surface(
    region=Region(box=BoxRegion(min_m=(0, 0, 0), max_m=(1, 1, 1))), metallic=1.0, albedo=(0.9, 0.6, 0.3)
)


def lookup(
    table: SurfaceTable, points: Float[np.ndarray, "k 3"], materials: Int32[np.ndarray, " k"] | None = None
) -> Int32[np.ndarray, " k"]:
    """Returns the row of each world point's surface, -1 for diffuse, as shaders find it (common/surfaces.glsl).

    `materials` are the material indices of points on a given model.
    """
    entry = np.full(len(points), -1, np.int32)
    for index in reversed(range(len(table))):
        is_diffuse = table.packed[index, 3, 3] == SHEET
        entry[inside(table.packed[index], points, materials)] = -1 if is_diffuse else index
    return entry


def inside(
    row: Float32[np.ndarray, "5 4"],
    points: Float[np.ndarray, "k 3"],
    materials: Int32[np.ndarray, " k"] | None,
) -> Bool[np.ndarray, " k"]:
    first, second = row[3], row[4]
    if first[3] == PLANE:
        found = np.abs((points - first[:3]) @ second[:3]) <= second[3]
    elif first[3] == BOX:
        found = ((points >= first[:3]) & (points <= second[:3])).all(axis=1)
    elif first[3] == SHEET:
        normal, edge = row[0, :3], second[:3]
        along = np.abs((points - first[:3]) @ np.array([edge, np.cross(normal, edge), normal]).T)
        found = (along <= np.array([second[3], row[0, 3], row[1, 1]])).all(axis=1)
    elif materials is None:
        found = np.zeros(len(points), bool)
    else:
        found = (materials == first[0]) & (first[0] >= 0)
    return np.asarray(found)


def test_first_match_wins_and_the_rest_is_diffuse() -> None:
    points = np.array([[0.5, 0.5, 0.51], [0.5, 0.5, 0.9], [5, 5, 0.485], [5, 5, 0.53], [2, 2, 2]])
    assert lookup(build_surface_table([TABLE, METAL_BOX]), points).tolist() == [0, 1, 0, -1, -1]
    assert lookup(build_surface_table([METAL_BOX, TABLE]), points).tolist() == [0, 0, 1, -1, -1]


def test_normal_reflectance_follows_metallic() -> None:
    table = build_surface_table([TABLE, METAL_BOX, Surface(metallic=1.0), Surface(specular=0.0)])
    assert table.f0 == pytest.approx(np.array([[0.04] * 3, [0.9, 0.6, 0.3], [0.9] * 3, [0.0] * 3]))
    assert table.roughness.tolist() == pytest.approx([0.3, 0.5, 0.5, 0.5])
    assert table.packed[:, 2, 3].tolist() == [0, 1, 0, 0]
    assert table.packed[:, 0, 3].tolist() == [0, 1, 1, 0]


def test_the_marker_sheet_always_is_diffuse() -> None:
    everything = Surface(region=Region(box=BoxRegion(min_m=(-9, -9, -9), max_m=(9, 9, 9))))
    table = build_surface_table([everything], BOARD)
    cell = 0.06 / 6  # of a marker: the least margin that it is found with
    points = np.array(
        [[0.1, -0.05, 0.001], [0.1, -0.05, 0.05], [0.1, 0.5, 0.0], [0.1, 0.9 * cell, 0], [0.1, 1.1 * cell, 0]]
    )
    assert lookup(table, points).tolist() == [-1, 1, 1, -1, 1]
    assert len(table) == 2
    known = BOARD.replaced(margins_m=(0.0, 0.03, 0.0, 0.0))
    assert lookup(build_surface_table([everything], known), points).tolist() == [-1, 1, 1, -1, -1]


def test_grey_cards_are_diffuse_where_they_lie() -> None:
    """Turned by 45 degrees: its corner lies on the x axis, half a diagonal from its middle."""
    everything = Surface(region=Region(box=BoxRegion(min_m=(-9, -9, -9), max_m=(9, 9, 9))))
    card = GreyCard(center_m=(1.0, 1.0), size_m=(0.2, 0.2), rotation_deg=45, albedo=0.18)
    table = build_surface_table([everything], BOARD.replaced(grey_cards=(card,)))
    points = np.array([[1.13, 1.0, 0], [1.15, 1.0, 0], [1.09, 1.09, 0], [1.0, 0.87, 0.004]])
    assert lookup(table, points).tolist() == [-1, 2, 2, -1]


def test_materials_of_the_model_are_found_by_name() -> None:
    shiny = Surface(region=Region(material="glass"))
    points = np.zeros((3, 3))
    materials = np.array([0, 1, 2], np.int32)
    assert lookup(build_surface_table([shiny], None, ("wood", "glass")), points, materials).tolist() == [
        -1,
        0,
        -1,
    ]
    with pytest.raises(DeltalightError, match="`glass`, but it has wood"):
        build_surface_table([shiny], None, ("wood",))
    with pytest.raises(DeltalightError, match="only a given model has materials"):
        build_surface_table([shiny])
    assert lookup(build_surface_table([shiny], None, ("glass",)), points).tolist() == [-1] * 3


def test_empty_and_overlong_tables() -> None:
    assert lookup(build_surface_table([]), np.zeros((2, 3))).tolist() == [-1, -1]
    with pytest.raises(DeltalightError, match="at most 16"):
        build_surface_table([TABLE] * 17)
