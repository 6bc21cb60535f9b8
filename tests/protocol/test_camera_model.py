"""Camera models: rays and projection are inverse, sizes and files are right."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel, load_camera_yaml, save_camera_yaml
from deltalight.protocol.errors import DeltalightError


def camera(model: str = "plumb_bob", coefficients: tuple[float, ...] = ()) -> CameraModel:
    matrix = np.array([[517.306408, 0, 318.64304], [0, 516.469215, 255.313989], [0, 0, 1]])
    return CameraModel(640, 480, matrix, model, np.array(coefficients))  # type: ignore[arg-type]


FREIBURG1 = (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
LENSES = {
    "pinhole": camera(),
    "zeros": camera("plumb_bob", (0.0,) * 5),
    "plumb_bob 4": camera("plumb_bob", (-0.2, 0.05, 0.001, -0.002)),
    "plumb_bob 5": camera("plumb_bob", FREIBURG1),
    "rational 8": camera("plumb_bob", (0.5, -0.3, 0.0005, -0.0002, 0.05, 0.8, -0.2, 0.01)),
    "equidistant": camera("equidistant", (-0.01, 0.02, -0.01, 0.002)),
    "equidistant without coefficients": camera("equidistant"),
}


@pytest.mark.parametrize("model", LENSES.values(), ids=LENSES.keys())
def test_projection_is_the_inverse_of_the_rays(model: CameraModel) -> None:
    rays = model.rays()
    assert rays.shape == (480, 640, 2)
    assert rays.dtype == np.float32
    for depth in (0.3, 4.0):
        points = np.dstack([rays, np.ones((480, 640))]).reshape(-1, 3).astype(np.float64) * depth
        rows, columns = np.mgrid[:480, :640]
        expected = np.stack([columns.ravel(), rows.ravel()], axis=1)
        assert np.abs(model.project(points) - expected).max() < 2e-3


def test_rays_of_a_pinhole_are_exact_at_integer_pixel_centres() -> None:
    model = camera()
    ray = model.rays()[100, 200]
    assert ray == pytest.approx([(200 - 318.64304) / 517.306408, (100 - 255.313989) / 516.469215], rel=1e-6)


def test_distortion_and_fisheye_change_the_rays() -> None:
    straight = camera().rays()
    assert np.abs(LENSES["plumb_bob 5"].rays() - straight).max() > 0.01
    assert not LENSES["zeros"].has_distortion
    assert np.array_equal(LENSES["zeros"].rays(), straight)
    # theta = r for an ideal equidistant lens, so rays bend outwards: tan(theta) > theta.
    assert LENSES["equidistant without coefficients"].has_distortion
    assert (np.abs(LENSES["equidistant without coefficients"].rays()[0, 0]) > np.abs(straight[0, 0])).all()


def test_rays_are_computed_once_and_read_only() -> None:
    model = camera("plumb_bob", FREIBURG1)
    assert model.rays() is model.rays()
    with pytest.raises(ValueError, match="read-only"):
        model.rays()[0, 0] = 0


@pytest.mark.parametrize("name", LENSES)
def test_equal_cameras_share_their_rays(name: str) -> None:
    model = LENSES[name]
    same = CameraModel.from_dict(model.to_dict())
    assert same == model
    assert hash(same) == hash(model)
    assert same.rays() is model.rays()
    longer = model.matrix + np.diag([1.0, 0, 0])
    other = CameraModel(model.width, model.height, longer, model.distortion_model, model.distortion)
    assert other != model
    assert not np.array_equal(other.rays(), model.rays())


def test_points_behind_the_camera_have_no_pixel() -> None:
    pixels = camera("plumb_bob", FREIBURG1).project(np.array([[0, 0, -1.0], [0, 0, 0], [0, 0, 1.0]]))
    assert np.isnan(pixels[:2]).all()
    assert pixels[2] == pytest.approx([318.64304, 255.313989])


def test_a_lens_that_folds_inside_the_picture_is_refused() -> None:
    with pytest.raises(DeltalightError, match="no ray for"):
        camera("plumb_bob", (-2.0, 0.0, 0.0, 0.0)).rays()


@pytest.mark.parametrize("name", ["pinhole", "plumb_bob 5", "equidistant"])
def test_resized_keeps_the_rays_of_the_picture_borders(name: str) -> None:
    model = LENSES[name]
    half = model.resized(320, 160)
    assert (half.width, half.height) == (320, 160)
    borders = np.array([[-0.5, -0.5], [639.5, 479.5]])
    smaller = np.array([[-0.5, -0.5], [319.5, 159.5]])
    assert model.unproject(borders) == pytest.approx(half.unproject(smaller), abs=1e-9)


def test_description_and_file_give_the_same_camera_again(tmp_path: Path) -> None:
    for number, model in enumerate(LENSES.values()):
        assert CameraModel.from_dict(model.to_dict()) == model
        path = tmp_path / f"{number}.yaml"
        save_camera_yaml(path, model, "rgb", {"depth_scale": 0.001})
        again = load_camera_yaml(path)
        assert again == model
        assert hash(again) == hash(model)
    assert LENSES["pinhole"] != LENSES["plumb_bob 5"]


def test_ros_file_may_hold_plain_lists(tmp_path: Path) -> None:
    path = tmp_path / "rgb.yaml"
    path.write_text(
        "image_width: 8\nimage_height: 6\ncamera_matrix: [[5, 0, 4], [0, 5, 3], [0, 0, 1]]\n"
        "distortion_model: equidistant\ndistortion_coefficients: [0.1, 0, 0, 0]\n"
    )
    model = load_camera_yaml(path)
    assert model.matrix[0, 2] == 4
    assert model.distortion_model == "equidistant"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image_width: 8\nimage_height: 6\n", "has no `camera_matrix`"),
        ("image_width: 8\nimage_height: 6\ncamera_matrix: [1, 2]\n", "not a ROS camera_info"),
        ("image_width: 8\nimage_height: 0\ncamera_matrix: [5, 0, 4, 0, 5, 3, 0, 0, 1]\n", "8x0"),
        ("image_width: 8\nimage_height: 6\ncamera_matrix: [-5, 0, 4, 0, 5, 3, 0, 0, 1]\n", "positive"),
        ("image_width: 8\nimage_height: 6\ncamera_matrix: [.nan, 0, 4, 0, 5, 3, 0, 0, 1]\n", "finite"),
        ("image_width: 8\nimage_height: 6\ncamera_matrix: [5, 1, 4, 0, 5, 3, 0, 0, 1]\n", "0 fy cy"),
        (
            "image_width: 8\nimage_height: 6\ncamera_matrix: [5, 0, 4, 0, 5, 3, 0, 0, 1]\n"
            "distortion_model: brown\n",
            "`brown` is unknown",
        ),
        (
            "image_width: 8\nimage_height: 6\ncamera_matrix: [5, 0, 4, 0, 5, 3, 0, 0, 1]\n"
            "distortion_model: equidistant\ndistortion_coefficients: [1, 2, 3]\n",
            "3 coefficients",
        ),
        ("- 1\n", "keys and values"),
        ("a: [\n", "not valid YAML"),
    ],
)
def test_wrong_files_are_told_in_one_sentence(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "rgb.yaml"
    path.write_text(text)
    with pytest.raises(DeltalightError, match=message) as caught:
        load_camera_yaml(path)
    assert "rgb.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DeltalightError, match=r"absent\.yaml cannot be read"):
        load_camera_yaml(tmp_path / "absent.yaml")
