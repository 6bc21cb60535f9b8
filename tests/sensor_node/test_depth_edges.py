"""Unknown depth along depth edges: the surface whose colour it has, or unknown still."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from jaxtyping import Bool, Float32, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage
from deltalight.protocol.source import open_source
from deltalight.sensor_node.depth import DepthSettings, clean_depth
from deltalight.sensor_node.depth_edges import assign_edges
from deltalight.sensor_node.depth_filter import NoiseModel
from deltalight.sensor_node.view_frames import ViewFrameBuilder

WIDTH, HEIGHT = 160, 120
CAMERA = CameraModel(WIDTH, HEIGHT, np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]]))
NOISE = NoiseModel(0.002, 0.001)
REACH = 8
COLUMNS, ROWS = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
FROM_RIM = np.hypot(COLUMNS - 80, ROWS - 60) - 30
DISC = FROM_RIM < 0
# Slanted both, and apart by 0.8 1/m at the middle: 0.56 m and 1 m away.
NEAR = (1.8 + 0.0008 * (COLUMNS - 80)).astype(np.float32)
FAR = (1.0 + 0.0015 * (ROWS - 60)).astype(np.float32)
TRUTH = np.where(DISC, NEAR, FAR)
ORANGE, GREEN, GREY = (210, 120, 40), (70, 130, 90), (128, 128, 128)


class Result(NamedTuple):
    """Inverse depth and known pixels after assignment, and the pixels that were added."""

    inverse: Float32[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"]
    added: Bool[np.ndarray, "h w"]

    @property
    def wrong(self) -> Bool[np.ndarray, "h w"]:
        """Added pixels that lie nearer to the other surface than to their own."""
        return np.asarray(self.added & (np.abs(self.inverse - TRUTH) > 0.4))


def picture(
    disc: tuple[int, int, int], around: tuple[int, int, int], *, texture: int = 12
) -> UInt8[np.ndarray, "h w 3"]:
    """Disc before a background, streaked and noisy as wood, soft as a lens makes it."""
    rng = np.random.default_rng(5)
    streaks = texture * cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH)), (0, 0), sigmaX=4, sigmaY=1) * 4
    flat = np.where(DISC[..., None], np.array(disc), np.array(around)) + streaks[..., None]
    soft = cv2.GaussianBlur(flat, (0, 0), 0.5) + rng.normal(0, 2, flat.shape)
    return np.asarray(np.clip(np.rint(soft), 0, 255), np.uint8)


def assigned(
    unknown: Bool[np.ndarray, "h w"], color: UInt8[np.ndarray, "h w 3"], reach_px: int = REACH
) -> Result:
    measured = TRUTH + np.random.default_rng(6).normal(0, NOISE.sigma_m, TRUTH.shape).astype(np.float32)
    given = np.where(unknown, 0, measured).astype(np.float32)
    inverse, known = assign_edges(
        given, ~unknown, color, noise=NOISE, sigmas=3.0, contrast=0.05, reach_px=reach_px
    )
    np.testing.assert_array_equal(inverse[~unknown], given[~unknown])
    assert known[~unknown].all()
    assert (inverse[~known] == 0).all()
    return Result(inverse, known, known & unknown)


def ring(inside_px: float, outside_px: float) -> Bool[np.ndarray, "h w"]:
    return (FROM_RIM + inside_px >= 0) & (FROM_RIM - outside_px < 0)


@pytest.mark.parametrize(
    ("inside_px", "outside_px"), [(2.5, 2.5), (5, 0), (0, 5), (3, 10)], ids=["both", "disc", "back", "shadow"]
)
def test_a_ring_along_an_edge_gets_the_surface_of_its_colour(inside_px: float, outside_px: float) -> None:
    hole = ring(inside_px, outside_px)
    result = assigned(hole, picture(ORANGE, GREEN))
    error = np.abs(result.inverse - TRUTH)
    assert (result.added & (error < 0.02))[hole].mean() > 0.9
    assert np.median(error[result.added]) < 2 * NOISE.sigma_m
    # Errors are at the edge itself, where one pixel shows both surfaces.
    assert not result.wrong[np.abs(FROM_RIM) > 1.5].any()


def test_the_shadow_on_one_side_of_a_thing_is_background() -> None:
    hole = ring(2, 2) | (ring(0, 14) & (COLUMNS < 80))
    result = assigned(hole, picture(ORANGE, GREEN))
    rim_of_disc = hole & DISC & (FROM_RIM < -0.7)
    assert (np.abs(result.inverse - NEAR) < 0.02)[rim_of_disc].mean() > 0.95
    assert not (result.inverse > 1.4)[hole & (FROM_RIM > 1.5)].any()


def test_equal_colours_decide_nothing() -> None:
    hole = ring(2.5, 2.5)
    result = assigned(hole, picture(GREY, GREY))
    assert result.added[hole].mean() < 0.02


def test_a_texture_that_both_surfaces_have_decides_nothing() -> None:
    tiles = ((COLUMNS // 4 + ROWS // 4) % 2).astype(bool)
    color = np.where(tiles[..., None], np.uint8(220), np.uint8(30)).repeat(3, axis=2)
    hole = ring(2.5, 2.5)
    result = assigned(hole, color)
    assert result.wrong[hole].mean() < 0.05


def test_a_colour_that_neither_surface_has_stays_unknown() -> None:
    color = picture(ORANGE, GREEN, texture=0)
    foreign = np.hypot(COLUMNS - 115, ROWS - 60) < 3
    color[foreign] = (250, 20, 250)
    result = assigned(ring(2, 8) | foreign, color)
    assert not result.added[np.hypot(COLUMNS - 115, ROWS - 60) < 1.5].any()


LID = (100, 150, 110)  # of neither surface, but much more like the green one


def test_a_strip_of_its_own_colour_stays_unknown_though_it_resembles_one_surface_more() -> None:
    color, hole = picture(ORANGE, GREEN, texture=4), ring(2, 10)
    lid = (FROM_RIM >= 0) & (FROM_RIM < 8) & (ROWS < 60)
    color[lid] = LID
    result = assigned(hole, color)
    inside = (FROM_RIM > 1) & (FROM_RIM < 7)
    assert result.added[inside & (ROWS < 50)].mean() < 0.02
    assert result.added[inside & (ROWS > 70)].mean() > 0.9  # the plain green shadow below
    assert not result.wrong[np.abs(FROM_RIM) > 1.5].any()


def test_a_thin_line_of_mixed_colours_is_no_surface_of_its_own() -> None:
    color, hole = picture(ORANGE, GREEN, texture=4), ring(4, 6)
    line = (FROM_RIM >= 3) & (FROM_RIM < 4.5)
    color[line] = LID
    result = assigned(hole, color)
    assert result.added[line].mean() > 0.9


def test_background_in_the_colour_of_the_thing_is_hidden_no_farther_than_the_reach() -> None:
    color = picture(ORANGE, GREEN)
    color[(np.abs(ROWS - 60) < 6) & (COLUMNS > 105)] = ORANGE
    for reach_px in (4, REACH):
        result = assigned(ring(2, 12), color, reach_px)
        called_near = result.added & (result.inverse > 1.4)
        # Steps of the reach start at the disc's last known pixel, 2 px inside.
        assert (FROM_RIM[called_near] <= reach_px - 1).all()
        assert not (called_near & (np.abs(ROWS - 60) > 8) & (FROM_RIM > 1.5)).any()


def test_a_spot_in_the_colour_of_the_thing_but_apart_from_it_is_not_called_near() -> None:
    color = picture(ORANGE, GREEN)
    color[np.hypot(COLUMNS - 116, ROWS - 60) < 2.5] = ORANGE
    result = assigned(ring(2, 10), color)
    assert not (result.inverse > 1.4)[FROM_RIM > 1.5].any()


def test_the_inside_of_a_large_hole_and_a_hole_in_one_surface_stay() -> None:
    in_one = (np.abs(COLUMNS - 20) < 6) & (np.abs(ROWS - 30) < 6)
    wide = ring(3, 25)
    result = assigned(in_one | wide, picture(ORANGE, GREEN))
    assert not result.added[in_one].any()
    assert not result.added[(FROM_RIM > REACH) & (FROM_RIM < 25 - REACH - 1)].any()


def test_a_whole_picture_comes_back_as_it_was_and_an_empty_one_empty() -> None:
    color = picture(ORANGE, GREEN)
    whole = assigned(np.zeros(TRUTH.shape, bool), color)
    assert whole.known.all()
    empty = assigned(np.ones(TRUTH.shape, bool), color)
    assert not empty.known.any()


def test_the_same_input_gives_the_same_output_and_a_second_pass_changes_little() -> None:
    hole, color = ring(3, 6), picture(ORANGE, GREEN)
    first, again = assigned(hole, color), assigned(hole, color)
    np.testing.assert_array_equal(first.inverse, again.inverse)
    inverse, known = assign_edges(
        first.inverse, first.known, color, noise=NOISE, sigmas=3.0, contrast=0.05, reach_px=REACH
    )
    np.testing.assert_array_equal(inverse[first.known], first.inverse[first.known])
    assert (known & ~first.known).sum() < 0.02 * hole.sum()


def test_the_reach_is_a_setting_of_the_clean_up_and_leaves_known_pixels_alone() -> None:
    hole, color = ring(2.5, 2.5), picture(ORANGE, GREEN)
    depth_m = np.where(hole, 0, 1 / TRUTH).astype(np.float32)
    image = DepthImage(depth_m, depth_m > 0, CAMERA, NOISE.sigma_m)
    off = clean_depth(image, color, DepthSettings(edge_reach_px=0))
    on = clean_depth(image, color, DepthSettings())
    assert not off.valid[hole].any()
    assert on.valid[hole].mean() > 0.9
    np.testing.assert_array_equal(on.depth_m[off.valid], off.depth_m[off.valid])
    with pytest.raises(ValueError, match="edge_reach_px"):
        DepthSettings(edge_reach_px=33)


@pytest.mark.data
def test_the_rim_of_a_real_yellow_dragon_is_yellow(shared_data: Path) -> None:
    source = open_source(shared_data / "rgbd" / "visp_rbt_apriltag")
    off, on = (ViewFrameBuilder(source, DepthSettings(edge_reach_px=reach))(source[0]) for reach in (0, 8))
    assert off.depth is not None
    assert on.depth is not None
    np.testing.assert_array_equal(on.depth.depth_m[off.depth.valid], off.depth.depth_m[off.depth.valid])
    head = np.s_[280:320, 440:535]  # before an orange model and a black cloth; there the known depth is right
    added = (on.depth.valid & ~off.depth.valid)[head]
    _, green, blue = np.moveaxis(off.color[head].astype(int), -1, 0)
    yellow, on_dragon = (green - blue > 60)[added], (on.depth.depth_m[head] < 0.53)[added]
    assert min(on_dragon.sum(), (~on_dragon).sum()) > 50
    assert yellow[on_dragon].mean() > 0.7
    assert yellow[~on_dragon].mean() < 0.1
