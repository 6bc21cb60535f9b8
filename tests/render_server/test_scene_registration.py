import numpy as np
import pytest

from deltalight.protocol.board import BoardSpec, GreyCard
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose
from deltalight.render_server.estimation.registration import (
    Registration,
    RegistrationAverage,
    registration_from_albedo_percentile,
    registration_from_patch,
)
from deltalight.render_server.scene.albedo import known_albedo, paper_pixels, unclipped

FACTOR = np.array([2.0, 1.5, 0.75])
BOARD = BoardSpec(
    type="aruco_grid", dictionary="DICT_4X4_50", marker_length_m=0.06, separation_m=0.02, rows=2, columns=3
)


def patch(count: int, albedo: float = 0.8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    light = rng.uniform(0.2, 1.0, (count, 3))
    bounce = rng.uniform(0.0, 0.2, (count, 3))
    return albedo / np.pi * (FACTOR * light + bounce), light, bounce


def test_patch_gives_the_factor_that_was_put_in() -> None:
    registration = registration_from_patch(*patch(500), 0.8)
    assert registration is not None
    assert registration.source == "patch"
    assert registration.factor == pytest.approx(FACTOR, rel=1e-5)
    assert registration.residual == pytest.approx(0, abs=1e-6)


def test_shadows_and_stains_are_left_out() -> None:
    measured, light, bounce = patch(500)
    noisy = measured * np.random.default_rng(1).normal(1, 0.02, measured.shape)
    noisy[:120] *= 0.4
    noisy[480:, 2] = np.nan
    registration = registration_from_patch(noisy, light, bounce, 0.8)
    assert registration is not None
    assert registration.factor == pytest.approx(FACTOR, rel=0.01)
    assert registration.residual is not None
    assert 0.005 < registration.residual < 0.05


def test_a_patch_that_tells_nothing_gives_none() -> None:
    measured, light, bounce = patch(500)
    assert registration_from_patch(*patch(10), 0.8) is None
    assert registration_from_patch(measured, np.zeros_like(light), bounce, 0.8) is None
    assert registration_from_patch(np.zeros_like(measured), light, bounce, 0.8) is None


def test_fallback_puts_the_percentile_of_albedo_at_its_place() -> None:
    rng = np.random.default_rng(9)
    light, bounce = rng.uniform(0.2, 1, (5000, 3)), rng.uniform(0, 0.3, (5000, 3))
    true_albedo = np.repeat(rng.uniform(0.05, 0.9, (5000, 1)), 3, axis=1)
    measured = true_albedo / np.pi * (1.7 * light + bounce)
    registration = registration_from_albedo_percentile(measured, light, bounce)
    assert registration.source == "percentile"
    assert registration.warning is not None
    factor = registration.factor
    assert factor[0] == factor[1] == factor[2]
    weights = np.array([0.2126, 0.7152, 0.0722])
    albedo = np.pi * (measured @ weights) / ((factor * light + bounce) @ weights)
    assert np.percentile(albedo, 99) == pytest.approx(0.95, abs=1e-3)


def test_nothing_lit_leaves_lights_as_they_are() -> None:
    registration = registration_from_albedo_percentile(*np.zeros((3, 100, 3)))
    assert registration.source == "given"
    assert registration.factor.tolist() == [1, 1, 1]
    assert registration.warning is not None


def test_clipped_and_black_pixels_tell_nothing() -> None:
    color = np.array([[[100, 100, 100], [255, 10, 10], [100, 253, 100], [1, 1, 0]]], np.uint8)
    linear = (color / 255.0) ** 2.2
    assert unclipped(color, linear).tolist() == [[True, False, False, False]]


def look_at_board(distance: float) -> tuple[CameraModel, BoardPose]:
    """A camera straight above the board's middle; its picture's y runs down the sheet."""
    camera = CameraModel(
        320,
        240,
        np.array([[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]]),
        "plumb_bob",
        np.array([-0.1, 0, 0, 0, 0]),
    )
    pose = np.diag([1.0, -1, -1, 1])
    pose[:3, 3] = [*BOARD.sheet_outline().mean(axis=0)[:2], distance]
    return camera, BoardPose(pose)


def test_paper_pixels_lie_inside_the_gaps_of_the_board() -> None:
    camera, pose = look_at_board(0.4)
    mask = paper_pixels(BOARD, camera, pose)
    assert mask.sum() > 500
    rows, columns = np.nonzero(mask)
    rays = camera.rays()[rows, columns]
    world = np.column_stack([rays * 0.4, np.full(len(rays), 0.4)]) @ pose.world_from_camera[:3, :3].T
    points = (world + pose.world_from_camera[:3, 3])[:, :2]
    for corners in BOARD.corner_points().values():
        low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
        distance = np.maximum(np.maximum(low - points, points - high), 0).max(axis=1)
        assert distance.min() > 0.002
    low, high = BOARD.sheet_outline().min(axis=0)[:2], BOARD.sheet_outline().max(axis=0)[:2]
    assert ((points > low) & (points < high)).all()


def test_a_board_behind_or_out_of_sight_has_no_paper() -> None:
    camera, _ = look_at_board(0.4)
    assert not paper_pixels(BOARD, camera, BoardPose(np.diag([1.0, 1, 1, 1]))).any()
    away = np.diag([1.0, -1, -1, 1])
    away[:3, 3] = [5, 5, 0.4]
    assert not paper_pixels(BOARD, camera, BoardPose(away)).any()


def test_a_grey_card_is_known_and_an_assumed_paper_then_is_not() -> None:
    camera, pose = look_at_board(0.4)
    card = GreyCard(center_m=(0.07, -0.03), size_m=(0.04, 0.03), rotation_deg=30, albedo=0.18)
    only_card = known_albedo(BOARD.model_copy(update={"grey_cards": (card,)}), camera, pose)
    assert np.unique(only_card).tolist() == pytest.approx([0, 0.18])
    area = np.count_nonzero(only_card) / (400 / 0.4) ** 2
    assert 0.035 * 0.025 < area < 0.0365 * 0.0265  # 2 pixels of 1 mm inside its edges

    both = BOARD.model_copy(update={"grey_cards": (card,), "white_albedo": 0.7})
    albedo = known_albedo(both, camera, pose)
    assert np.unique(albedo).tolist() == pytest.approx([0, 0.18, 0.7])
    assert np.count_nonzero(albedo == np.float32(0.7)) < paper_pixels(BOARD, camera, pose).sum()

    away = BOARD.model_copy(
        update={"grey_cards": (GreyCard(center_m=(9, 9), size_m=(0.1, 0.1), albedo=0.2),)}
    )
    assert np.unique(known_albedo(away, camera, pose)).tolist() == pytest.approx([0, 0.8])


def test_paper_and_card_are_fitted_together() -> None:
    paper, card = patch(300, 0.8), patch(200, 0.18)
    measured, light, bounce = (np.concatenate(pair) for pair in zip(paper, card, strict=True))
    registration = registration_from_patch(measured, light, bounce, np.repeat([0.8, 0.18], [300, 200]))
    assert registration is not None
    assert registration.factor == pytest.approx(FACTOR, rel=1e-5)


def test_a_poor_fit_warns_and_a_good_one_does_not() -> None:
    measured, light, bounce = patch(500)
    good = registration_from_patch(measured, light, bounce, 0.8)
    sloped = measured * np.linspace(0.6, 1.4, 500)[:, None]
    poor = registration_from_patch(sloped, light, bounce, 0.8)
    assert good is not None
    assert poor is not None
    assert good.warning is None
    assert poor.warning is not None
    assert poor.residual is not None
    assert f"within {100 * poor.residual:.0f} %" in poor.warning


def test_factors_are_averaged_and_known_surfaces_replace_guesses() -> None:
    rng = np.random.default_rng(2)
    average = RegistrationAverage()
    guess = Registration(np.full(3, 9, np.float32), "percentile")
    assert average.add(guess).tolist() == [9, 9, 9]
    for _ in range(30):
        factor = average.add(Registration((FACTOR * rng.normal(1, 0.1, 3)).astype(np.float32), "patch"))
    assert factor == pytest.approx(FACTOR, rel=0.06)
    assert np.array_equal(average.add(guess), factor)


def test_the_average_follows_a_lasting_change() -> None:
    average = RegistrationAverage()
    for value in (1.0, 2.0):
        for _ in range(100):
            factor = average.add(Registration(np.full(3, value, np.float32), "patch"))
    assert factor == pytest.approx([2, 2, 2], rel=0.05)
