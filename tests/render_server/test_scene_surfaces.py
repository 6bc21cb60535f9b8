import numpy as np
import pytest

from deltalight.protocol.board import BoardSpec, GreyCard
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_objects import BoxRegion, PlaneRegion, Region, Surface
from deltalight.render_server.scene.declared_surfaces import build_surface_table

BOARD = BoardSpec(
    type="aruco_grid", dictionary="DICT_4X4_50", marker_length_m=0.06, separation_m=0.02, rows=2, columns=3
)
TABLE = Surface(
    region=Region(plane=PlaneRegion(point_m=(0, 0, 0.5), normal=(0, 0, 2), tolerance_m=0.02)), roughness=0.3
)
BOX = Surface(
    region=Region(box=BoxRegion(min_m=(0, 0, 0), max_m=(1, 1, 1))), metallic=1.0, albedo=(0.9, 0.6, 0.3)
)


def test_first_match_wins_and_the_rest_is_diffuse() -> None:
    points = np.array([[0.5, 0.5, 0.51], [0.5, 0.5, 0.9], [5, 5, 0.485], [5, 5, 0.53], [2, 2, 2]])
    assert build_surface_table([TABLE, BOX]).lookup(points).tolist() == [0, 1, 0, -1, -1]
    assert build_surface_table([BOX, TABLE]).lookup(points).tolist() == [0, 0, 1, -1, -1]


def test_normal_reflectance_follows_metallic() -> None:
    table = build_surface_table([TABLE, BOX, Surface(metallic=1.0), Surface(specular=0.0)])
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
    assert table.lookup(points).tolist() == [-1, 1, 1, -1, 1]
    assert len(table) == 2
    known = BOARD.replaced(margins_m=(0.0, 0.03, 0.0, 0.0))
    assert build_surface_table([everything], known).lookup(points).tolist() == [-1, 1, 1, -1, -1]


def test_grey_cards_are_diffuse_where_they_lie() -> None:
    """Turned by 45 degrees: its corner lies on the x axis, half a diagonal from its middle."""
    everything = Surface(region=Region(box=BoxRegion(min_m=(-9, -9, -9), max_m=(9, 9, 9))))
    card = GreyCard(center_m=(1.0, 1.0), size_m=(0.2, 0.2), rotation_deg=45, albedo=0.18)
    table = build_surface_table([everything], BOARD.replaced(grey_cards=(card,)))
    points = np.array([[1.13, 1.0, 0], [1.15, 1.0, 0], [1.09, 1.09, 0], [1.0, 0.87, 0.004]])
    assert table.lookup(points).tolist() == [-1, 2, 2, -1]


def test_materials_of_the_model_are_found_by_name() -> None:
    shiny = Surface(region=Region(material="glass"))
    points = np.zeros((3, 3))
    materials = np.array([0, 1, 2], np.int32)
    assert build_surface_table([shiny], None, ("wood", "glass")).lookup(points, materials).tolist() == [
        -1,
        0,
        -1,
    ]
    with pytest.raises(DeltalightError, match="`glass`, but it has wood"):
        build_surface_table([shiny], None, ("wood",))
    with pytest.raises(DeltalightError, match="only a given model has materials"):
        build_surface_table([shiny])
    assert build_surface_table([shiny], None, ("glass",)).lookup(points).tolist() == [-1] * 3


def test_empty_and_overlong_tables() -> None:
    assert build_surface_table([]).lookup(np.zeros((2, 3))).tolist() == [-1, -1]
    with pytest.raises(DeltalightError, match="at most 16"):
        build_surface_table([TABLE] * 17)
