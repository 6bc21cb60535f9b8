"""The camera's vignetting: found on the board's paper as the camera moves, and put on virtual parts."""

import numpy as np
import pytest

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, ViewFrame, decode_lut
from deltalight.render_server.post_effects.camera_artifacts import CameraArtifacts
from deltalight.render_server.post_effects.camera_vignetting import PaperVignetting, Vignetting, vignetted

WIDTH, HEIGHT = 320, 240
CAMERA = CameraModel(WIDTH, HEIGHT, np.array([[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1.0]]))
BOARD = BoardSpec(
    type="aruco_grid",
    dictionary="DICT_4X4_50",
    marker_length_m=0.04,
    separation_m=0.02,
    rows=2,
    columns=3,
    first_id=0,
    white_albedo=0.8,
)
MIDDLE = np.array([0.08, -0.05])
LUT = decode_lut(None)


def radii() -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return np.hypot(columns - 159.5, rows - 119.5) / np.hypot(160, 120)


def coded(linear: np.ndarray) -> np.ndarray:
    return np.rint(np.interp(linear, LUT[:, 0], np.arange(256))).astype(np.uint8)


def shots(
    falloff: float, count: int = 12, exposure_s: float | None = 0.01, board: BoardSpec | None = BOARD
) -> list[ViewFrame]:
    """The camera looks down on the board, which is lit from one side, and goes round; corners of its pictures lack
    the share `falloff` of their light."""
    rng = np.random.default_rng(3)
    frames = []
    for number in range(count):
        turn = 2 * np.pi * number / count
        pose = np.diag([1.0, -1, -1, 1])
        pose[:3, 3] = *(MIDDLE + 0.09 * np.array([np.cos(turn), 0.8 * np.sin(turn)])), 0.3
        rays = np.dstack([CAMERA.rays(), np.ones((HEIGHT, WIDTH))]) @ pose[:3, :3].T
        place = (pose[:3, 3] - rays * (pose[2, 3] / rays[..., 2:]))[..., :2]
        light = 0.55 * (1 + 3.0 * (place[..., 0] - MIDDLE[0]))
        for quad in BOARD.corner_points().values():
            low, high = quad[:, :2].min(axis=0), quad[:, :2].max(axis=0)
            light[((place >= low) & (place <= high)).all(axis=-1)] = 0.05
        seen = light * (1 - falloff * radii() ** 2) + rng.normal(0, 0.004, light.shape)
        color = coded(np.repeat(seen[..., None], 3, axis=-1))
        frames.append(
            ViewFrame(number, number, color, CAMERA, exposure_s=exposure_s, pose=BoardPose(pose), board=board)
        )
    return frames


def learned(frames: list[ViewFrame]) -> Vignetting | None:
    paper = PaperVignetting()
    for each in frames:
        paper.observe(each)
    return paper.model


@pytest.mark.parametrize("falloff", [0.2, 0.45])
def test_vignetting_is_found_under_uneven_light(falloff: float) -> None:
    found = learned(shots(falloff))
    assert found is not None
    inside = radii() <= found.reach
    true = 1 - falloff * radii()[inside] ** 2
    factors = found.factors(CAMERA)[inside]
    ratio = factors / true
    assert found.reach > 0.7
    assert ratio / np.median(ratio) == pytest.approx(1.0, abs=0.01)
    assert factors.min() < 1 < factors.max()


def test_a_camera_without_has_none() -> None:
    assert learned(shots(0.0)) is None


def test_what_cannot_be_told_is_left_out() -> None:
    """Frames of unknown exposure may differ by that; a board that stays where it is shows nothing."""
    assert learned(shots(0.45, exposure_s=None)) is None
    assert learned(shots(0.45, board=None)) is None
    assert learned([shots(0.45, 1)[0]] * 12) is None


def test_objects_darken_and_nothing_else() -> None:
    rng = np.random.default_rng(4)
    picture = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    coverage = np.zeros((HEIGHT, WIDTH), np.float32)
    coverage[:40, :40], coverage[:40, 40] = 1.0, 0.5
    picture[:40, :41] = coded(np.full(3, 0.5))
    frame = shots(0.0, 1)[0]
    given = Vignetting(np.array([-0.5, 0.0]), 1.0, 0.0)
    dark = vignetted(picture, coverage, given.factors(CAMERA), frame)
    untouched = coverage == 0
    assert np.array_equal(dark[untouched], picture[untouched])
    wanted = 0.5 * np.exp(-0.5 * radii() ** 2)
    assert LUT[dark[:40, :40, 0], 0] == pytest.approx(wanted[:40, :40], abs=0.006)
    assert LUT[dark[:40, 40, 1], 1] == pytest.approx((wanted[:40, 40] + 0.5) / 2, abs=0.006)


def test_artifacts_hold_it_once_the_camera_has_moved() -> None:
    artifacts = CameraArtifacts()
    frames = shots(0.45)
    found = [
        artifacts.observe(each, each.pose.world_from_camera, np.array([*MIDDLE, 0.0]))
        for each in frames
        if each.pose is not None
    ]
    assert found[0].vignetting is None
    assert found[-1].vignetting is not None
    again = artifacts.observe(frames[-1], frames[-1].pose.world_from_camera, np.array([*MIDDLE, 0.0]))  # type: ignore[union-attr]
    assert again.vignetting is found[-1].vignetting
