"""Marker boards: geometry as OpenCV prints them, in a world whose y is up and whose z leaves the paper."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deltalight.protocol.board import BoardSpec, CustomDictionary, load_board_yaml, save_board_yaml
from deltalight.protocol.errors import DeltalightError

PIXELS_PER_M = 4000


def grid(**changes: object) -> BoardSpec:
    values = {
        "type": "aruco_grid",
        "dictionary": "DICT_4X4_50",
        "marker_length_m": 0.04,
        "separation_m": 0.01,
        "rows": 3,
        "columns": 4,
        "first_id": 7,
    }
    return BoardSpec.model_validate({**values, **changes})


def charuco(rows: int = 5, columns: int = 4) -> BoardSpec:
    return grid(type="charuco", marker_length_m=0.03, rows=rows, columns=columns, first_id=None)


def opencv_board(spec: BoardSpec) -> Any:  # noqa: ANN401 - cv2 has no types
    dictionary, size = spec.opencv_dictionary(), (spec.columns, spec.rows)
    ids = np.array(spec.marker_ids)
    if spec.type == "charuco":
        square = spec.marker_length_m + spec.separation_m
        return cv2.aruco.CharucoBoard(size, square, spec.marker_length_m, dictionary, ids)
    return cv2.aruco.GridBoard(size, spec.marker_length_m, spec.separation_m, dictionary, ids)


@pytest.mark.parametrize("spec", [grid(), charuco(), charuco(4, 4)], ids=["grid", "charuco", "charuco 4x4"])
def test_corners_are_opencvs_with_y_and_z_turned(spec: BoardSpec) -> None:
    board = opencv_board(spec)
    theirs = np.array(board.getObjPoints())
    origin = theirs[0, 0]
    ours = spec.corner_points()
    assert list(ours) == board.getIds().ravel().tolist()
    turned = (theirs - origin) * [1, -1, -1]
    assert np.array(list(ours.values())) == pytest.approx(turned, abs=1e-7)
    assert ours[spec.marker_ids[0]][0] == pytest.approx([0, 0, 0])
    if spec.type == "charuco":
        inner = (board.getChessboardCorners() - origin) * [1, -1, -1]
        assert spec.chessboard_corners() == pytest.approx(inner, abs=1e-7)


def test_the_paper_reaches_beyond_the_print_by_its_margins_or_by_what_markers_need() -> None:
    """A cell of a 4x4 marker with its border is a sixth of its edge; a chessboard needs no margin."""
    left, top, right, bottom = 0.01, 0.02, 0.03, 0.04
    known = grid(margins_m=(left, top, right, bottom))
    beyond = known.paper_outline() - known.sheet_outline()
    assert beyond[0] == pytest.approx([-left, top, 0])
    assert beyond[2] == pytest.approx([right, -bottom, 0])
    assert (grid().paper_outline() - grid().sheet_outline())[1] == pytest.approx([0.04 / 6, 0.04 / 6, 0])
    assert np.array_equal(charuco().paper_outline(), charuco().sheet_outline())
    assert "margins_m" not in grid().model_dump(mode="json")
    assert BoardSpec.model_validate(known.model_dump(mode="json")) == known


def test_rows_lie_below_the_first_and_ids_go_row_by_row() -> None:
    corners = grid().corner_points()
    assert corners[8][0] == pytest.approx([0.05, 0, 0])
    assert corners[11][0] == pytest.approx([0, -0.05, 0])
    listed = grid(first_id=None, ids=list(range(20, 8, -1)))
    assert listed.marker_ids[0] == 20
    assert listed.corner_points()[19][0] == pytest.approx([0.05, 0, 0])


def printed(spec: BoardSpec) -> tuple[np.ndarray, np.ndarray]:
    """Draws the board and returns the picture and the outline's top-left corner in it."""
    outline = spec.sheet_outline()
    size = (outline[2] - outline[0])[:2] * [1, -1] * PIXELS_PER_M
    margin = 40
    picture = opencv_board(spec).generateImage(tuple(np.rint(size).astype(int) + 2 * margin), None, margin, 1)
    return picture, outline[0, :2]


@pytest.mark.parametrize("spec", [grid(), charuco()], ids=["grid", "charuco"])
def test_markers_are_detected_where_the_geometry_says(spec: BoardSpec) -> None:
    picture, corner = printed(spec)
    found, ids, _ = cv2.aruco.ArucoDetector(spec.opencv_dictionary()).detectMarkers(picture)
    assert sorted(ids.ravel()) == sorted(spec.marker_ids)
    for pixels, number in zip(found, ids.ravel(), strict=True):
        expected = (spec.corner_points()[int(number)][:, :2] - corner) * [1, -1] * PIXELS_PER_M + 40
        assert np.abs(pixels[0] - expected).max() < 2.5


@pytest.mark.parametrize("spec", [grid(), charuco()], ids=["grid", "charuco"])
def test_paper_patches_are_white_on_the_printed_board(spec: BoardSpec) -> None:
    picture, corner = printed(spec)
    patches = spec.paper_patches()
    assert len(patches) > 10
    for quad in patches:
        pixels = (quad[:, :2] - corner) * [1, -1] * PIXELS_PER_M + 40
        (left, top), (right, bottom) = np.ceil(pixels[0]).astype(int), np.floor(pixels[2]).astype(int)
        assert right > left
        assert bottom > top
        assert (picture[top:bottom, left:right] == 255).all()


def test_patches_of_a_single_marker_are_its_margin() -> None:
    spec = grid(type="single", rows=1, columns=1)
    patches = spec.paper_patches()
    assert patches.shape == (4, 4, 3)
    inside = (
        (patches[..., 0] > 0) & (patches[..., 0] < 0.04) & (patches[..., 1] < 0) & (patches[..., 1] > -0.04)
    )
    assert not inside.any()
    assert grid(type="single", rows=1, columns=1, separation_m=0).paper_patches().shape == (0, 4, 3)


def test_albedo_of_the_paper_is_assumed_when_unknown() -> None:
    assert grid().white_albedo is None
    assert grid().paper_albedo == 0.8
    assert grid(white_albedo=0.9).paper_albedo == 0.9


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ("dictionary: DICT_4X4_51", "DICT_4X4_50"),
        ("dictionary: APRILTAG_36h11", "DICT_APRILTAG_36h11"),
        ("ids: [1, 2]", "12 different markers"),
        ("first_id: 45", "0 to 49"),
        ("marker_length_m: -1", "marker_length_m"),
        ("colums: 4", "nearest known key is `columns`"),
        ("type: sheet", "type"),
        ("rows: 0", "rows"),
        ("type: single", "one row"),
        ("first_id: 1\nids: [1]", "not both"),
        ("dictionary: {marker_size: 4, bits: '0101'}", "16 cells"),
        ("type: charuco\nseparation_m: 0", "above 0"),
    ],
)
def test_wrong_descriptions_are_told_in_one_sentence(tmp_path: Path, changes: str, message: str) -> None:
    text = "type: aruco_grid\ndictionary: DICT_4X4_50\nmarker_length_m: 0.04\nrows: 3\ncolumns: 4\n"
    kept = [line for line in text.splitlines() if line.split(":")[0] not in changes]
    path = tmp_path / "board.yaml"
    path.write_text("\n".join([*kept, changes]))
    with pytest.raises(DeltalightError, match=message) as caught:
        load_board_yaml(path)
    assert "\n" not in str(caught.value)
    assert "board.yaml" in str(caught.value)


def test_a_board_file_gives_the_same_board_again(tmp_path: Path) -> None:
    path = tmp_path / "board.yaml"
    cells = CustomDictionary(marker_size=4, border_bits=2, bits="0111001011110000")
    for spec in (grid(), charuco(), grid(type="single", rows=1, columns=1, first_id=None, dictionary=cells)):
        save_board_yaml(path, spec)
        assert load_board_yaml(path) == spec


def test_a_marker_picture_becomes_a_dictionary_that_finds_it(tmp_path: Path) -> None:
    code = np.array([[0, 1, 1, 0], [1, 0, 1, 1], [1, 1, 0, 0], [0, 1, 0, 1]], np.uint8)
    marker = np.kron(np.pad(code, 2), np.full((20, 20), 255, np.uint8))
    cv2.imwrite(str(tmp_path / "marker.png"), marker)
    (tmp_path / "board.yaml").write_text(
        "type: single\nmarker_length_m: 0.1\n"
        "dictionary: {marker_size: 4, border_bits: 2, image: marker.png}\n"
    )
    spec = load_board_yaml(tmp_path / "board.yaml")
    assert isinstance(spec.dictionary, CustomDictionary)
    assert np.array_equal(spec.dictionary.cells(), code)
    assert detect_single(np.pad(marker, 60, constant_values=255), spec)[0] == pytest.approx([60, 60], abs=2)


def detect_single(picture: np.ndarray, spec: BoardSpec) -> np.ndarray:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = spec.border_bits
    found, ids, _ = cv2.aruco.ArucoDetector(spec.opencv_dictionary(), parameters).detectMarkers(picture)
    assert ids.ravel().tolist() == [0]
    return np.asarray(found[0][0])


def test_a_marker_picture_without_its_border_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "marker.png"), np.full((80, 80), 255, np.uint8))
    text = "type: single\ndictionary: {marker_size: 6, border_bits: 1, image: NAME}\nmarker_length_m: 0.1\n"
    (tmp_path / "board.yaml").write_text(text.replace("NAME", "marker.png"))
    with pytest.raises(DeltalightError, match="no black border of 1 cells"):
        load_board_yaml(tmp_path / "board.yaml")
    (tmp_path / "board.yaml").write_text(text.replace("NAME", "absent.png"))
    with pytest.raises(DeltalightError, match=r"absent\.png cannot be read"):
        load_board_yaml(tmp_path / "board.yaml")


@pytest.mark.data
def test_the_papers_marker_is_found_in_their_photograph(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "paper_scene_dirtchamber" / "data"
    (tmp_path / "marker.png").write_bytes((folder / "marker.png").read_bytes())
    (tmp_path / "board.yaml").write_text(
        "type: single\nmarker_length_m: 0.1\n"
        "dictionary: {marker_size: 6, border_bits: 3, image: marker.png}\n"
    )
    spec = load_board_yaml(tmp_path / "board.yaml")
    corners = detect_single(
        np.asarray(cv2.imread(str(folder / "real_static_scene.png"), cv2.IMREAD_GRAYSCALE)), spec
    )
    assert corners.min(axis=0) == pytest.approx([220, 311], abs=3)
    assert corners.max(axis=0) == pytest.approx([317, 373], abs=3)
