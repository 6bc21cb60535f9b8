"""`deltalight board`: what is printed has the size, ids and place that board.yaml says."""

from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest
from jaxtyping import Float64, UInt8
from typer.testing import CliRunner, Result

from deltalight.protocol.board import BoardSpec, LampMarker, load_board_yaml
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.poses import rigid_matrix
from deltalight.sensor_node.calibration.targets import MarkerBoard
from deltalight.sensor_node.cameras.synthetic import srgb_codes
from deltalight.sensor_node.markers import BoardDetector
from deltalight.services.board_pdf import PAPERS_MM, choose_page, write_board_pdf
from deltalight.services.cli import app

DPI = 300
MM_PER_PIXEL = 25.4 / DPI
# Between which numbers an option is, typer did not compare with NaN before; the board refuses it.
TAKES_NAN = tuple(map(int, version("typer").split(".")[:2])) < (0, 29)
KINDS = ("aruco_grid", "charuco", "apriltag_grid")


def board_command(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["board", *(str(argument) for argument in arguments)])


def page(pdf: Path, number: int = 0) -> UInt8[np.ndarray, "h w 3"]:
    """A page as printed at 300 dpi, RGB."""
    with pypdfium2.PdfDocument(pdf) as document:
        return np.ascontiguousarray(document[number].render(scale=DPI / 72).to_numpy()[..., ::-1])


def spec(kind: str, **changes: object) -> BoardSpec:
    data = {
        "type": kind,
        "dictionary": "DICT_4X4_50",
        "marker_length_m": 0.03,
        "separation_m": 0.01,
        "rows": 3,
        "columns": 4,
    }
    return BoardSpec.model_validate({**data, **changes})


@pytest.mark.parametrize("kind", KINDS)
def test_printed_marks_are_where_board_yaml_says_within_a_tenth_of_a_millimetre(
    tmp_path: Path, kind: str
) -> None:
    done = board_command("--out", tmp_path / "board.pdf", "--type", kind, "--first-id", 3)
    assert done.exit_code == 0, done.output
    target = MarkerBoard(load_board_yaml(tmp_path / "board.yaml"))
    found = target.find(cv2.cvtColor(page(tmp_path / "board.pdf"), cv2.COLOR_RGB2GRAY))
    assert found is not None
    assert len(found.numbers) == len(target.points)
    printed = found.pixels * MM_PER_PIXEL * (1, -1)
    wanted = 1e3 * target.points[found.numbers][:, :2]
    assert np.abs((printed - printed.mean(axis=0)) - (wanted - wanted.mean(axis=0))).max() < 0.1
    paper = 1e3 * load_board_yaml(tmp_path / "board.yaml").paper_outline()[:, :2]
    height, width = (MM_PER_PIXEL * length for length in page(tmp_path / "board.pdf").shape[:2])
    edges = np.array([(0, 0), (width, 0), (width, -height), (0, -height)])
    np.testing.assert_allclose(paper - wanted.mean(axis=0), edges - printed.mean(axis=0), atol=0.2)


def test_board_yaml_shows_no_digits_below_a_micrometre(tmp_path: Path) -> None:
    done = board_command(
        "--out", tmp_path / "board.pdf", "--paper", "a3", "--marker-mm", 60, "--separation-mm", 15
    )
    assert done.exit_code == 0, done.output
    assert "margins_m: [0.0675, 0.018, 0.0675, 0.069]\n" in (tmp_path / "board.yaml").read_text()


def seen_by(
    camera: CameraModel, sheet: UInt8[np.ndarray, "h w 3"], pose: Float64[np.ndarray, "4 4"]
) -> UInt8[np.ndarray, "h w 3"]:
    """A printed sheet (its middle at the world's origin) as a pinhole camera sees it."""
    height, width = sheet.shape[:2]
    metres = MM_PER_PIXEL / 1e3
    sheet_to_world = np.array(
        [[metres, 0, -metres * (width - 1) / 2], [0, -metres, metres * (height - 1) / 2], [0, 0, 1]]
    )
    camera_from_world = np.linalg.inv(pose)
    projection = camera.matrix @ camera_from_world[:3, [0, 1, 3]] @ sheet_to_world
    # What ink and paper share of a printed pixel is light, and so is what a lens blurs.
    light = cv2.GaussianBlur(sheet.astype(np.float32) / 255, (0, 0), 2.0)
    seen = cv2.warpPerspective(light, projection, (camera.width, camera.height), borderValue=(0.1,) * 3)
    return srgb_codes(0.9 * seen)


@pytest.mark.parametrize("kind", KINDS)
def test_a_camera_that_sees_the_print_finds_ids_pose_and_size(tmp_path: Path, kind: str) -> None:
    """A camera at a known place: what it measures on the sheet is what board.yaml says."""
    assert board_command("--out", tmp_path / "board.pdf", "--type", kind).exit_code == 0
    board, sheet = load_board_yaml(tmp_path / "board.yaml"), page(tmp_path / "board.pdf")
    camera = CameraModel(1600, 1200, np.array([[1800.0, 0, 800], [0, 1800.0, 600], [0, 0, 1]]))
    detector, target, places = BoardDetector(board, camera), MarkerBoard(board), []
    for lean in (-0.4, 0.35):
        turn = cv2.Rodrigues(np.array([0.0, lean, 0.0]))[0] @ np.diag([1.0, -1.0, -1.0])
        pose = rigid_matrix(turn, -0.5 * turn[:, 2])
        picture = seen_by(camera, sheet, pose)
        seen = detector.detect(picture)
        assert seen is not None
        assert seen.reprojection_error_px is not None
        assert seen.reprojection_error_px < 0.3  # pdfium draws edges to whole pixels, 0.3 of the camera's
        places.append(seen.world_from_camera @ np.linalg.inv(pose))
        found = target.find(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
        assert found is not None
        assert len(found.numbers) == len(target.points)
        measured = 1e3 * np.diff(on_sheet(camera, pose, found.pixels), axis=0)
        wanted = 1e3 * np.diff(target.points[found.numbers], axis=0)[:, :2]
        lengths = np.linalg.norm(measured, axis=1) - np.linalg.norm(wanted, axis=1)
        assert np.sqrt(np.mean(lengths**2)) < 0.1
        # pdfium fills every pixel that a rectangle touches, so markers are half a pixel, 0.04 mm, larger.
        assert abs(lengths.mean()) < 0.06
    # board frame from sheet frame: a shift within the paper, the same for both, no turn.
    np.testing.assert_allclose(places[0], places[1], atol=0.004)
    np.testing.assert_allclose(places[0][:3, :3], np.eye(3), atol=0.003)
    assert abs(places[0][2, 3]) < 0.0005


def on_sheet(
    camera: CameraModel, pose: Float64[np.ndarray, "4 4"], pixels: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, "n 2"]:
    """Places (x, y) on the sheet's plane that a camera sees at pixels, metres."""
    rays = np.column_stack([camera.unproject(pixels), np.ones(len(pixels))]) @ pose[:3, :3].T
    return (pose[:3, 3] - rays * (pose[2, 3] / rays[:, 2:]))[:, :2]


def test_the_ruler_is_100_mm_long(tmp_path: Path) -> None:
    write_board_pdf(tmp_path / "board.pdf", spec("aruco_grid"), "a4")
    sheet = page(tmp_path / "board.pdf")[..., 0]
    foot = sheet[-round(28 / MM_PER_PIXEL) :]
    columns = np.flatnonzero((foot < 128).sum(axis=0) > 3.8 / MM_PER_PIXEL)
    assert (columns.max() - columns.min()) * MM_PER_PIXEL == pytest.approx(100, abs=0.3)


def test_squares_and_markers_are_vectors_not_pictures(tmp_path: Path) -> None:
    write_board_pdf(tmp_path / "board.pdf", spec("charuco"), "a4")
    with pypdfium2.PdfDocument(tmp_path / "board.pdf") as document:
        kinds = {found.type for found in document[0].get_objects()}
        text = document[0].get_textpage().get_text_range()
    assert pypdfium2.raw.FPDF_PAGEOBJ_IMAGE not in kinds
    for words in (
        "charuco",
        "DICT_4X4_50",
        "ids 0 to 5",
        "markers 30 mm",
        "gaps 10 mm",
        "Print at 100 %",
        "100 mm",
    ):
        assert words in text


def test_lamp_markers_are_on_pages_of_their_own(tmp_path: Path) -> None:
    lamps = tuple(LampMarker(id=name, marker_length_m=0.05) for name in range(30, 42))
    write_board_pdf(tmp_path / "board.pdf", spec("aruco_grid", lamp_markers=lamps), "a4")
    with pypdfium2.PdfDocument(tmp_path / "board.pdf") as document:
        assert len(document) == 3
    detector = cv2.aruco.ArucoDetector(spec("aruco_grid").opencv_dictionary())
    seen: dict[int, np.ndarray] = {}
    for number in (1, 2):
        quads, ids, _ = detector.detectMarkers(page(tmp_path / "board.pdf", number))
        seen |= {int(name): quad[0] for quad, name in zip(quads, ids.ravel(), strict=True)}
    assert set(seen) == set(range(30, 42))
    for quad in seen.values():
        assert np.ptp(quad[:, 0]) * MM_PER_PIXEL == pytest.approx(50, abs=0.3)
        assert quad[0, 1] < quad[2, 1]  # upright: OpenCV's first corner is the top left


def test_a_lamp_marker_that_is_too_large_is_refused(tmp_path: Path) -> None:
    lamp = LampMarker(id=40, marker_length_m=0.25)
    with pytest.raises(DeltalightError, match="--lamp-marker-mm 139"):
        write_board_pdf(tmp_path / "board.pdf", spec("aruco_grid", lamp_markers=(lamp,)), "a4")


def test_the_paper_is_turned_where_the_board_fits_only_so() -> None:
    assert choose_page(spec("aruco_grid", columns=3), "a4")[:] == PAPERS_MM["a4"]
    assert choose_page(spec("aruco_grid", columns=6), "a4")[:] == PAPERS_MM["a4"][::-1]


def test_a_board_that_does_not_fit_is_refused_with_what_does() -> None:
    large = spec("aruco_grid", columns=7, rows=5, marker_length_m=0.04)
    with pytest.raises(DeltalightError, match="340 x 240 mm") as refusal:
        choose_page(large, "a4")
    assert "--paper a3" in str(refusal.value)
    words = str(refusal.value).split()
    marker, gap = (float(words[words.index(name) + 1]) for name in ("--marker-mm", "--separation-mm"))
    smaller = large.replaced(marker_length_m=marker / 1e3, separation_m=gap / 1e3)
    assert choose_page(smaller, "a4") is not None
    assert marker > 25


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--out", "board.txt"), "is not a PDF file"),
        (("--out", "board.pdf", "--dictionary", "DICT_4X4_60"), "nearest name is DICT_4X4_50"),
        (("--out", "board.pdf", "--rows", "9", "--columns", "9", "--marker-mm", "10"), "ids go from 0 to 49"),
        (("--out", "board.pdf", "--lamp-marker", "3"), "also on the board"),
        (("--out", "board.pdf", "--dictionary", "4X4"), "there is no such dictionary in OpenCV"),
        (("--out", "old.pdf"), "already exists"),
    ],
)
def test_wrong_use_is_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old.yaml").write_text("kept")
    done = board_command(*arguments)
    assert isinstance(done.exception, DeltalightError)
    assert sentence in str(done.exception)
    assert (tmp_path / "old.yaml").read_text() == "kept"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old.yaml"]


@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param(
            ("--marker-mm", "nan"),
            marks=pytest.mark.skipif(TAKES_NAN, reason="typer before 0.29 takes NaN for any number"),
        ),
        ("--separation-mm", "-1"),
        ("--lamp-marker-mm", "1e9"),
    ],
)
def test_a_wrong_size_is_named_as_it_was_given(arguments: tuple[str, str]) -> None:
    done = board_command("--out", "board.pdf", *arguments)
    assert done.exit_code == 2
    assert f"Invalid value for '{arguments[0]}'" in done.output
