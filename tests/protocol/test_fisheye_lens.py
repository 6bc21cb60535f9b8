"""Fish-eye lenses and their calibration files."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from jaxtyping import Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import (
    FisheyeCalibration,
    FisheyeLens,
    load_fisheye_yaml,
    save_fisheye_yaml,
)
from deltalight.protocol.ocam_lens import OcamLens, load_ocam_results


def equidistant(
    coefficients: tuple[float, ...] = (0.02, -0.01, 0.003, -0.0008),
    circle: float | None = None,
    focal: tuple[float, float] = (84.0, 84.3),
) -> EquidistantLens:
    matrix = np.array([[focal[0], 0, 155.3], [0, focal[1], 148.9], [0, 0, 1]])
    return EquidistantLens(CameraModel(312, 300, matrix, "equidistant", np.array(coefficients)), circle)


def ocam(circle: float | None = None) -> OcamLens:
    """A lens of the size of `equidistant`, with every parameter of its own."""
    return OcamLens(312, 300, (90.0, 0.0, -2.4e-3, 1.1e-6), (156.1, 147.2), (1.001, -0.0003, 0.0008), circle)


LENSES: dict[str, FisheyeLens] = {
    "equidistant": equidistant(),
    "without coefficients": equidistant(()),
    "with circle": equidistant(circle=120.0),
    "ocam": ocam(),
    "ocam with circle": ocam(131.5),
}


def grid(lens: FisheyeLens) -> Float64[np.ndarray, "n 2"]:
    columns, rows = np.meshgrid(np.arange(-0.5, lens.width, 3.7), np.arange(-0.5, lens.height, 3.7))
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def right_of_centre(lens: FisheyeLens, *offsets: float) -> Float64[np.ndarray, "n 2"]:
    x, y = lens.centre
    return np.array([[x + offset, y] for offset in offsets])


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
def test_projection_is_the_inverse_of_the_directions(lens: FisheyeLens) -> None:
    pixels = grid(lens)
    directions = lens.directions(pixels)
    seen = np.isfinite(directions[:, 0])
    assert np.array_equal(seen, lens.has_ray(pixels))
    assert seen.mean() > 0.4
    assert np.linalg.norm(directions[seen], axis=1) == pytest.approx(1, abs=1e-12)
    assert lens.project(3.0 * directions[seen]) == pytest.approx(pixels[seen], abs=1e-6)
    if lens.image_circle is None:
        assert directions[seen][:, 2].min() < -0.05, "beyond 90 degrees from the axis"


def test_axes_are_those_of_the_optical_frame() -> None:
    for lens in LENSES.values():
        x, y = lens.centre
        axis, right, below = lens.directions(np.array([[x, y], [x + 40, y], [x, y + 40]]))
        assert axis == pytest.approx([0, 0, 1], abs=1e-12)
        assert right[0] > 0.3
        assert abs(right[1]) < 0.001
        assert below[1] > 0.3
        assert abs(below[0]) < 0.001


def test_equidistant_agrees_with_opencv_in_front() -> None:
    lens = equidistant()
    rays = np.random.default_rng(2).uniform(-1.2, 1.2, (200, 2))
    points = np.column_stack([rays, np.ones(200)])
    expected = lens.camera.project(points)
    seen = np.isfinite(lens.project(points)[:, 0])
    assert seen.mean() > 0.9
    assert lens.project(points)[seen] == pytest.approx(expected[seen], abs=1e-9)


def test_equidistant_angles_are_right_behind_90_degrees() -> None:
    lens = equidistant((), focal=(40.0, 40.0))  # 180 degrees from the axis lie at 126 pixels
    for degrees in (30, 90, 91, 135, 179):
        direction = lens.directions(right_of_centre(lens, 40.0 * np.radians(degrees)))[0]
        assert np.degrees(np.arctan2(direction[0], direction[2])) == pytest.approx(degrees, abs=1e-9)
    assert np.isnan(lens.directions(right_of_centre(lens, 40.0 * np.radians(181)))).all()


def test_a_lens_ends_where_its_model_turns_back() -> None:
    lens = equidistant((0.0, 0.0, 0.0, -0.01), focal=(60.0, 60.0))
    # d/da (a - 0.01 a^9) = 0 at (1/0.09)^(1/8) = 1.351 rad.
    turn = (1 / 0.09) ** 0.125
    radius = 60.0 * (turn - 0.01 * turn**9)
    inside, outside = lens.directions(right_of_centre(lens, radius - 0.01, radius + 0.01))
    assert np.arccos(inside[2]) == pytest.approx(turn, abs=0.02)
    assert np.isnan(outside).all()
    beyond = np.array([[np.sin(turn + 0.05), 0.0, np.cos(turn + 0.05)]])
    assert np.isnan(lens.project(beyond)).all()


def test_nothing_is_seen_outside_the_circle_and_the_picture() -> None:
    lens = equidistant(circle=120.0)
    x, y = lens.centre
    rays = lens.directions(np.array([[x + 119.9, y], [x, y - 120.1], [-0.6, y], [x, 299.6]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1:]).all()
    edge = equidistant(circle=200.0).directions(np.array([[x, 299.4], [x, 299.6]]))
    assert np.isfinite(edge[0]).all()
    assert np.isnan(lens.project(edge[:1])).all(), "inside the picture but outside the circle"
    assert np.isnan(lens.project(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]))).all()


def test_the_same_lens_in_both_models_has_the_same_directions() -> None:
    """A polynomial z(radius) fitted to a Kannala-Brandt lens (square pixels) within 0.02 degrees up to 95 degrees."""
    first = equidistant(focal=(84.0, 84.0))
    angles = np.radians(np.linspace(0.5, 95, 400))
    radius = 84.0 * first._radius(angles)
    powers = np.array([0, 2, 3, 4, 5, 6, 7, 8])
    share = radius / radius[-1]
    # An error of cot(angle) by 1 is an error of the angle by sin(angle)^2.
    columns = share[:, None] ** powers / radius[:, None] * np.sin(angles)[:, None] ** 2
    fitted = np.linalg.lstsq(columns, np.cos(angles) * np.sin(angles), rcond=None)[0]
    polynomial = np.zeros(9)
    polynomial[powers] = fitted / radius[-1] ** powers
    second = OcamLens(312, 300, tuple(polynomial), first.centre)
    pixels = grid(first)
    one, two = first.directions(pixels), second.directions(pixels)
    both = np.isfinite(one[:, 0]) & np.isfinite(two[:, 0]) & (one[:, 2] > np.cos(np.radians(95)))
    between = np.degrees(np.linalg.norm(np.cross(one[both], two[both]), axis=1))
    assert both.sum() > 3000
    assert between.max() < 0.02


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
@pytest.mark.parametrize("has_more", [False, True])
def test_description_and_file_give_the_same_calibration_again(
    lens: FisheyeLens, has_more: bool, tmp_path: Path
) -> None:
    table = np.linspace(0, 1, 256)[:, None] ** np.array([2.0, 2.2, 2.4])
    calibration = (
        FisheyeCalibration(lens, table.astype(np.float32), (-0.1, 0.01))
        if has_more
        else FisheyeCalibration(lens)
    )
    path = tmp_path / "fisheye.yaml"
    save_fisheye_yaml(path, calibration)
    for again in (FisheyeCalibration.from_dict(calibration.to_dict()), load_fisheye_yaml(path)):
        assert again == calibration
        assert hash(again) == hash(calibration)
        assert type(again.lens) is type(lens)
    assert calibration != FisheyeCalibration(lens, None, (-0.1, 0.02))


def test_vignetting_is_a_polynomial_of_the_squared_angle() -> None:
    calibration = FisheyeCalibration(equidistant(), None, (-0.2, 0.03))
    assert calibration.transmission(np.array([0.0, 0.5])) == pytest.approx(
        [1.0, 1 - 0.2 * 0.25 + 0.03 * 0.0625]
    )
    with pytest.raises(DeltalightError, match="`vignetting` is not positive"):
        FisheyeCalibration(equidistant(), None, (-0.5,))


def test_response_may_stand_in_a_file_beside(tmp_path: Path) -> None:
    table = np.repeat(np.linspace(0, 1, 256)[:, None] ** 2, 3, axis=1).astype(np.float32)
    np.savetxt(tmp_path / "response.txt", table, fmt="%.9g")
    path = tmp_path / "fisheye.yaml"
    save_fisheye_yaml(path, FisheyeCalibration(equidistant()))
    path.write_text(path.read_text() + "response: response.txt\n")
    loaded = load_fisheye_yaml(path)
    assert loaded.response is not None
    np.testing.assert_array_equal(loaded.response, table)


OCAM = "image_width: 312\nimage_height: 300\ndistortion_model: ocam\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image_width: 8\nimage_height: 6\ndistortion_model: plumb_bob\n", "`plumb_bob` is unknown; use"),
        ("image_width: 8\nimage_height: 6\n", "lens model `None` is unknown; use equidistant or ocam"),
        ("image_width: 8\nimage_height: 6\ndistortion_model: equidistant\n", "has no `camera_matrix`"),
        (OCAM, "needs the key `ocam`"),
        (OCAM + "ocam: {polynomial: [90, 0], center: [1]}\n", "ocam lens is malformed"),
        (OCAM + "ocam: {polynomial: [0, 0], center: [1, 2]}\n", "begins above 0"),
        (OCAM + "ocam: {polynomial: [.nan, 0], center: [1, 2]}\n", "not finite"),
        (OCAM + "ocam: {polynomial: [90], center: [1, 2]}\nimage_circle: -3\n", "`image_circle` is -3"),
        (OCAM + "ocam: {polynomial: [90], center: [1, 2]}\nvignetting: [a]\n", "must be a list of numbers"),
        (OCAM + "ocam: {polynomial: [90], center: [1, 2]}\nvignetting: 0.3\n", "must be a list of numbers"),
        (OCAM + "ocam: {polynomial: [90], center: [1, 2]}\nresponse: [[0, 0, 0]]\n", "256 rows"),
        (
            OCAM + "ocam: {polynomial: [90], center: [1, 2]}\nresponse: nowhere.txt\n",
            "nowhere.txt is not a table",
        ),
    ],
)
def test_wrong_files_are_refused_in_one_sentence(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "fisheye.yaml"
    path.write_text(text)
    with pytest.raises(DeltalightError, match=message) as caught:
        load_fisheye_yaml(path)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.filterwarnings("error")
def test_numbers_that_overflow_are_refused() -> None:
    with pytest.raises(DeltalightError, match="goes nowhere"):
        equidistant((1e300, -1e300, 1e308, 1e-300))


def test_an_ocam_results_file_is_read_into_the_optical_frame(tmp_path: Path) -> None:
    path = tmp_path / "calib_results.txt"
    path.write_text(
        "#direct, axis backwards\n\n4 -90.0 0.0 2.4e-3 -1.1e-6\n\n#inverse\n\n2 1.0 2.0\n\n"
        "#center: row and column\n\n147.2 156.1\n\n#affine\n\n1.001 -0.0003 0.0008\n\n#height, width\n\n300 312\n"
    )
    assert FisheyeCalibration(load_ocam_results(path)) == FisheyeCalibration(ocam())
    named = tmp_path / "fisheye.yaml"
    named.write_text("distortion_model: ocam\nocam: calib_results.txt\nimage_circle: 131.5\n")
    assert load_fisheye_yaml(named) == FisheyeCalibration(ocam(131.5))
    # OCamCalib's own cam2world: row, column -> (x down, y right, z backwards).
    row, column = 220.0, 80.0
    x, y = np.linalg.solve([[1.001, -0.0003], [0.0008, 1.0]], [row - 147.2, column - 156.1])
    rho = np.hypot(x, y)
    backwards = -90.0 + 2.4e-3 * rho**2 - 1.1e-6 * rho**3
    expected = np.array([y, x, -backwards]) / np.linalg.norm([x, y, backwards])
    assert load_ocam_results(path).directions(np.array([[column, row]]))[0] == pytest.approx(
        expected, abs=1e-12
    )
    path.write_text("5 1 2\n")
    with pytest.raises(DeltalightError, match="is not a calib_results"):
        load_ocam_results(path)
    with pytest.raises(DeltalightError, match="cannot be read"):
        load_ocam_results(tmp_path / "none.txt")


@pytest.mark.data
def test_the_exact_inverse_agrees_with_ocamcalibs_fitted_one(shared_data: Path) -> None:
    path = shared_data / "fisheye" / "ocam_indoor_apriltags" / "calib_results_0.txt"
    lens = load_ocam_results(path)
    assert np.degrees(lens._largest_model_angle) > 100
    lines = [line.split() for line in path.read_text().splitlines() if line.strip() and line[0] != "#"]
    inverse = np.array(lines[1][1:], float)
    angles = np.radians(np.arange(0, 101, 5.0))
    assert np.abs(np.polyval(inverse[::-1], angles - np.pi / 2) - lens._radius(angles)).max() < 0.01


@pytest.mark.data
def test_april_tags_on_the_floor_are_squares_that_lie_flat(shared_data: Path) -> None:
    """Two tags at 65 to 81 degrees from the axis: their corners fit squares, whose normals agree."""
    folder = shared_data / "fisheye" / "ocam_indoor_apriltags"
    lens = load_ocam_results(folder / "calib_results_0.txt")
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    quads, ids, _ = detector.detectMarkers(cv2.imread(str(folder / "img0.jpg"), cv2.IMREAD_GRAYSCALE))
    assert sorted(ids.ravel()) == [1, 2]
    square = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
    normals = []
    for quad in quads:
        pixels = quad.reshape(4, 2).astype(np.float64)
        rays = lens.directions(pixels)
        # A pinhole turned towards the tag, because at 81 degrees x/z is useless.
        forward = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
        right = np.cross([0.0, 1.0, 0.0], forward)
        turn = np.stack(
            [right / np.linalg.norm(right), np.cross(forward, right / np.linalg.norm(right)), forward]
        )
        seen = rays @ turn.T
        flat = np.ascontiguousarray(seen[:, :2] / seen[:, 2:])
        _, rotations, shifts, _ = cv2.solvePnPGeneric(
            square, flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        rotation = cv2.Rodrigues(rotations[0])[0]
        corners = (square @ rotation.T + shifts[0].ravel()) @ turn
        assert np.abs(lens.project(corners) - pixels).max() < 1.0
        normals.append(turn.T @ rotation[:, 2])
    assert np.degrees(np.arccos(normals[0] @ normals[1])) < 8
    assert normals[0][1] < -0.98, "up, since the camera is level and y is down"


@pytest.mark.data
def test_kannala_brandt_agrees_with_other_models_of_the_same_lens(shared_data: Path) -> None:
    """Enhanced unified and double sphere projections of the same camera; fitted each on its own."""
    folder = shared_data / "fisheye" / "ocam_scaramuzza" / "fisheye_calib_adapter" / "kalibr"
    given = {
        name: yaml.safe_load((folder / f"{name}.yml").read_text())["parameter"]
        for name in ("KB", "EUCM", "DS")
    }
    kb = given["KB"]
    matrix = np.array([[kb["fx"], 0, kb["cx"]], [0, kb["fy"], kb["cy"]], [0, 0, 1]])
    coefficients = np.array([kb[key] for key in ("k1", "k2", "k3", "k4")])
    lens = EquidistantLens(CameraModel(752, 480, matrix, "equidistant", coefficients))
    pixels = np.stack(np.meshgrid(np.arange(0, 752, 25.0), np.arange(0, 480, 25.0)), axis=-1).reshape(-1, 2)
    x, y, z = lens.directions(pixels).T
    across = x * x + y * y
    eucm, ds = given["EUCM"], given["DS"]
    depth = {
        "EUCM": eucm["alpha"] * np.sqrt(eucm["beta"] * across + z * z) + (1 - eucm["alpha"]) * z,
        "DS": ds["alpha"] * np.sqrt(across + (ds["xi"] + z) ** 2) + (1 - ds["alpha"]) * (ds["xi"] + z),
    }
    for name, divisor in depth.items():
        p = given[name]
        other = np.stack([p["fx"] * x / divisor + p["cx"], p["fy"] * y / divisor + p["cy"]], axis=1)
        assert np.linalg.norm(other - pixels, axis=1).max() < 1.5
