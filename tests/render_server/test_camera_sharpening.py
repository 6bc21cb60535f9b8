"""Sharpening of a camera: found at the board's edges, and put on the virtual part of a picture."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Float64, UInt8

from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.source import open_source
from deltalight.render_server.post_effects.camera_artifacts import CameraArtifacts, FrameArtifacts
from deltalight.render_server.post_effects.camera_edges import edge_steps
from deltalight.render_server.post_effects.camera_sharpening import (
    CameraSharpening,
    Sharpening,
    sharpened,
)
from deltalight.sensor_node.view_frames import ViewFrameBuilder
from tests.render_server import test_camera_blur as board
from tests.render_server import test_camera_defocus as lens
from tests.render_server.test_camera_blur import FINE, edge_picture
from tests.render_server.test_camera_compression import from_camera
from tests.render_server.test_camera_mosaic import through

LUMA = (0.299, 0.587, 0.114)


def by_camera(
    color: UInt8[np.ndarray, "h w 3"], amount: float, radius_px: float
) -> UInt8[np.ndarray, "h w 3"]:
    """An unsharp mask of all of a picture's luma."""
    luma = color.astype(np.float64) @ LUMA
    size = 2 * int(np.ceil(3 * radius_px)) + 1
    detail = luma - cv2.GaussianBlur(luma, (size, size), radius_px)
    return np.clip(np.rint(color + amount * detail[..., None]), 0, 255).astype(np.uint8)


def learned(frames: Sequence[ViewFrame]) -> Sharpening | None:
    learner = CameraSharpening()
    for each in frames:
        learner.observe(edge_steps(each), each.response)
    return learner.model


def gain(amount: float, radius_px: float, frequency: float) -> float:
    """By which an unsharp mask raises a frequency (cycles a pixel) along rows."""
    at = np.arange(-8, 9)
    kernel = np.exp(-(at**2) / (2 * radius_px**2))
    return 1 + amount * (1 - float(kernel @ np.cos(2 * np.pi * frequency * at) / kernel.sum()))


@pytest.mark.parametrize("noise", [0.0, 0.004])
@pytest.mark.parametrize(
    ("sigma_px", "amount", "radius_px"),
    [(0.35, 0.5, 0.6), (0.35, 0.6, 1.0), (0.5, 1.0, 0.7), (0.8, 1.0, 1.0)],
)
def test_an_unsharp_mask_is_found(sigma_px: float, amount: float, radius_px: float, noise: float) -> None:
    """What it makes of every frequency within 10 %, and the lens's blur before it within 10 %."""
    seen = board.shot(sigma_px, noise)
    found = learned([replace(seen, color=by_camera(seen.color, amount, radius_px))])
    assert found is not None
    for frequency in (0.1, 0.2, 0.3, 0.5):
        expected = gain(amount, radius_px, frequency)
        assert gain(found.amount, found.radius_px, frequency) == pytest.approx(expected, rel=0.1)
    assert np.sqrt(found.variance) == pytest.approx(sigma_px, rel=0.1)


@pytest.mark.parametrize("aperture_m", [0.0, 0.003, 0.006])
def test_an_unsharp_mask_is_found_though_edges_are_out_of_focus(aperture_m: float) -> None:
    """What it makes of frequencies that such edges still show, within 15 %."""
    seen = lens.shot(lens.oblique(), aperture_m)
    found = learned([replace(seen, color=by_camera(seen.color, 0.8, 0.7))])
    assert found is not None
    for frequency in (0.1, 0.2, 0.3):
        assert gain(found.amount, found.radius_px, frequency) == pytest.approx(
            gain(0.8, 0.7, frequency), rel=0.15
        )


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("sigma_px", [0.35, 0.5, 0.8, 1.2, 1.6])
def test_a_lens_alone_sharpens_nothing(sigma_px: float, noise: float) -> None:
    assert learned([board.shot(sigma_px, noise)]) is None


def test_nor_do_defocus_a_mosaic_and_compression() -> None:
    seen = board.shot(0.6)
    pictures = [through(board.linear(seen.color), "RGGB")]
    pictures += [from_camera(seen.color, quality, (True, False)) for quality in (50, 75, 90)]
    frames = [replace(seen, color=each) for each in pictures]
    frames += [lens.shot(lens.oblique()), lens.shot(lens.oblique(), 0.0, corner_px=1.0)]
    assert [learned([each]) for each in frames] == [None] * len(frames)


def pooled(frame: ViewFrame) -> tuple[Float64[np.ndarray, " b"], Float64[np.ndarray, " b"]]:
    """The mean profile of a frame's edges in linear light, every quarter of a pixel."""
    profiles = [each.profile for each in edge_steps(frame) if each.profile is not None]
    lut, at = decode_lut(frame.response)[:, 1], np.arange(-8, 9) / 4
    light = []
    for each in profiles:
        low, high = each.levels
        codes = low + (high - low) * np.interp(at, each.distance_px, each.code)
        value = np.interp(codes, np.arange(256), lut)
        low, high = np.interp([low, high], np.arange(256), lut)
        light.append((value - low) / (high - low))
    return at, np.median(light, axis=0)


def mtf50(frame: ViewFrame) -> float:
    """Where the transform of the derivative of the profile falls to half, cycles a pixel."""
    at, light = pooled(frame)
    steps, middle = np.diff(light), (at[1:] + at[:-1]) / 2
    frequency = np.arange(0, 1, 0.002)
    response = np.abs(np.exp(-2j * np.pi * np.outer(frequency, middle)) @ steps)
    return float(frequency[np.argmax(response < response[0] / 2)])


def with_virtual_markers(frame: ViewFrame, artifacts: FrameArtifacts) -> ViewFrame:
    """The frame with black squares in place of its markers, as rendered objects with the camera's artifacts."""
    assert frame.board is not None
    assert frame.pose is not None
    from_world = np.linalg.inv(frame.pose.world_from_camera)
    height, width = frame.color.shape[:2]
    ink = np.zeros((FINE * height, FINE * width), np.uint8)
    for quad in frame.board.corner_points().values():
        pixels = frame.camera.project(quad @ from_world[:3, :3].T + from_world[:3, 3])
        cv2.fillConvexPoly(ink, np.rint((FINE * (pixels + 0.5) - 0.5) * 16).astype(np.int32), 1, shift=4)
    coverage = cv2.resize(ink.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    profiles = [each.profile for each in edge_steps(frame) if each.profile is not None]
    low, high = np.interp(
        np.median([each.levels for each in profiles], axis=0), np.arange(256), decode_lut(None)[:, 1]
    )
    picture = board.coded(np.repeat((high + (low - high) * coverage)[..., None], 3, axis=2))
    return replace(frame, color=replace(artifacts, noise=None).applied(picture, coverage))


def observed(frames: Sequence[ViewFrame]) -> FrameArtifacts:
    learner = CameraArtifacts()
    for each in frames:
        assert each.pose is not None
        known = learner.observe(each, each.pose.world_from_camera, np.array([0.07, 0.045, 0.0]))
    return known


SHARPENING = Sharpening(0.8, 0.7, 0.2)


def seen_by_camera(light: Float64[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    return by_camera(
        board.coded(np.repeat(light[..., None], 3, axis=2)), SHARPENING.amount, SHARPENING.radius_px
    )


@pytest.mark.parametrize("slope", [0.0, 0.2, 0.9])
def test_an_object_before_a_plain_wall_is_what_the_camera_makes_of_it(slope: float) -> None:
    picture, coverage = edge_picture(slope)
    result = sharpened(picture, coverage, SHARPENING)
    inner = np.s_[4:-4, 4:-4]
    expected = by_camera(picture, SHARPENING.amount, SHARPENING.radius_px)
    np.testing.assert_allclose(result[inner].astype(int), expected[inner], atol=1)
    assert (result != picture).any(axis=2).sum() > 100


def test_what_the_camera_has_sharpened_is_not_sharpened_again() -> None:
    """A wall with stripes gets the object's halo, of the same strength everywhere, and no more contrast."""
    rows, columns = np.mgrid[:64, :96]
    coverage = ((columns - 48) ** 2 + (rows - 32) ** 2 < 400).astype(np.float32)
    wall = np.where(rows // 2 % 2 > 0, 90, 110)[..., None].repeat(3, 2)
    picture = np.where(coverage[..., None] > 0, 200, wall).astype(np.uint8)
    result = sharpened(picture, coverage, SHARPENING).astype(int)
    near = cv2.dilate(coverage, np.ones((7, 7))) > 0
    assert np.array_equal(result[~near], picture[~near])
    halo = (result - picture)[30:34, 28, 0]  # beside the object, on both kinds of stripes
    assert (halo < -2).all()
    assert np.ptp(halo) <= 3


@pytest.mark.parametrize("inside", [60, 200])
def test_light_is_kept(inside: int) -> None:
    """The codes of a picture keep their sum, while nothing is clipped."""
    picture, coverage = np.full((48, 64, 3), 120, np.uint8), np.zeros((48, 64), np.float32)
    picture[15:30, 20:40], coverage[15:30, 20:40] = inside, 1.0
    result = sharpened(picture, coverage, SHARPENING).astype(int)
    assert result.max() > max(inside, 120)
    assert result.min() < min(inside, 120)
    assert (result - picture).sum() == pytest.approx(0, abs=0.02 * np.abs(result - picture).sum())


def test_colours_keep_their_differences() -> None:
    """Luma alone is sharpened; codes end at black and white."""
    picture, coverage = np.full((32, 32, 3), (40, 90, 60), np.uint8), np.zeros((32, 32), np.float32)
    picture[10:20, 10:20], coverage[10:20, 10:20] = (120, 200, 150), 1.0
    result = sharpened(picture, coverage, SHARPENING).astype(int)
    assert np.array_equal(np.diff(result, axis=2), np.diff(picture.astype(int), axis=2))
    picture[10:20, 10:20] = 250
    assert sharpened(picture, coverage, SHARPENING)[10:20, 10:20].min() == 250
    assert sharpened(picture, np.zeros_like(coverage), SHARPENING) is picture


@pytest.mark.parametrize(
    ("sigma_px", "amount", "radius_px"), [(0.65, 0.8, 0.7), (0.7, 1.0, 0.8), (0.8, 1.0, 1.0)]
)
def test_an_objects_edge_is_the_boards(sigma_px: float, amount: float, radius_px: float) -> None:
    """MTF50 within 10 %, and not so without the sharpening."""
    frames = []
    for number in range(3):
        seen = board.shot(sigma_px, 0.004, frame_id=number, timestamp_ns=number)
        frames.append(replace(seen, color=by_camera(seen.color, amount, radius_px)))
    known = observed(frames)
    assert known.sharpening is not None
    real, virtual = mtf50(frames[0]), mtf50(with_virtual_markers(frames[0], known))
    without = mtf50(with_virtual_markers(frames[0], replace(known, sharpening=None)))
    assert virtual == pytest.approx(real, rel=0.1)
    assert without < 0.85 * real


@pytest.mark.data
def test_edges_of_a_real_camera(shared_data: Path) -> None:
    """A RealSense before it moves: its markers beside virtual ones in their places; MTF50 within 10 %."""
    source = open_source(shared_data / "rgbd" / "visp_rbt_apriltag")
    build = ViewFrameBuilder(source)
    frames = [build(source[number]) for number in range(4)]
    known = observed(frames)
    print(f"\n{known.sharpening}")
    for each in frames:
        artifacts = replace(known, frame=each)
        real, virtual = mtf50(each), mtf50(with_virtual_markers(each, artifacts))
        without = mtf50(with_virtual_markers(each, replace(artifacts, sharpening=None)))
        print(f"MTF50: {real:.3f}; virtual {virtual:.3f}, without sharpening {without:.3f}")
        assert virtual == pytest.approx(real, rel=0.1)
