"""Exposure brackets: linear light, what is clipped, and the camera's response."""

import numpy as np
import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeCalibration
from deltalight.protocol.frames import FisheyePictures
from deltalight.sensor_node.fisheye import estimate_response
from deltalight.sensor_node.fisheye.exposures import LinearPicture, merge_bracket, reference_exposure
from tests.sensor_node.fisheye_samples import bracket, coded, equidistant

LENS = equidistant(60)
EXPOSURES_S = (1.0, 1 / 32, 1 / 1024)


def smooth_light(darkest: float, brightest: float) -> np.ndarray:
    """Light that rises slowly and evenly in its logarithm, of a slightly different colour in each channel."""
    level = np.linspace(np.log(darkest), np.log(brightest), 3600).reshape(60, 60)
    return np.exp(level)[..., None] * np.array([1.0, 0.8, 0.6])


def merge(pictures: FisheyePictures) -> LinearPicture:
    return merge_bracket(pictures, reference_exposure(pictures.exposures_s))


def test_a_bracket_gives_light_of_any_brightness() -> None:
    light = smooth_light(0.05, 800)
    merged = merge(bracket(light, EXPOSURES_S, LENS))
    assert not merged.clipped.any()
    error = merged.linear / light - 1
    # The last code before 1/32 of white takes over is coarse: 8 bits at 3 % of white have steps of 3 %.
    assert np.abs(error).max() < 0.03
    assert abs(error.mean()) < 0.001


def test_the_order_of_the_exposures_does_not_matter() -> None:
    light = smooth_light(0.05, 800)
    one = merge(bracket(light, EXPOSURES_S, LENS))
    two = merge(bracket(light, (EXPOSURES_S[1], EXPOSURES_S[2], EXPOSURES_S[0]), LENS))
    np.testing.assert_array_equal(one.linear, two.linear)


def test_the_longest_exposure_is_the_reference_unless_another_is_given() -> None:
    assert reference_exposure((0.01, None, 0.2)) == 0.2
    assert reference_exposure((None,)) is None
    light = smooth_light(0.05, 20)
    pictures = bracket(light, (0.1, 0.01), LENS)
    white_at_a_tenth = merge(pictures).linear
    white_at_one = merge_bracket(pictures, 1.0).linear
    assert np.median(white_at_one / light) == pytest.approx(1, abs=0.005)
    assert white_at_one == pytest.approx(10 * white_at_a_tenth, rel=1e-5)


def test_what_the_shortest_exposure_clips_is_a_lower_bound() -> None:
    light = np.full((60, 60, 3), 0.3)
    light[20:24, 30:33] = [500, 500, 40]
    merged = merge(bracket(light, (1.0, 0.01), LENS))
    assert merged.clipped.sum() == 12
    assert merged.clipped[20:24, 30:33].all()
    assert (merged.linear[20:24, 30:33, :2] >= 90).all()
    assert (merged.linear[20:24, 30:33, :2] <= 500).all()
    assert merged.linear[20:24, 30:33, 2] == pytest.approx(40, rel=0.02), "blue is within reach"


def test_a_single_exposure_is_decoded_and_its_clipping_told() -> None:
    light = smooth_light(0.1, 2.0)
    for exposure in (None, 0.5):
        merged = merge(bracket(light, (exposure,), LENS))
        gain = 1.0 if exposure is None else exposure
        unclipped = ~merged.clipped
        assert merged.linear[unclipped] / gain == pytest.approx(light[unclipped], rel=0.02)
        assert np.array_equal(merged.clipped, (coded(light, gain) >= 250).any(axis=-1))
        assert merged.clipped.any()


def test_values_beside_clipped_ones_are_taken_from_a_shorter_exposure() -> None:
    """Half of a pixel clipped and averaged is a code below white that says nothing true."""
    light = np.full((60, 60, 3), 0.1)
    light[30:, :] = 30.0
    pictures = bracket(light, (1.0, 0.02), LENS)
    mixed = pictures.pictures[0].copy()
    mixed[29] = 170  # of white (0.4 linear) where 15 is right
    light[29] = 15.0
    short = coded(light, 0.02)
    merged = merge(FisheyePictures(0, (mixed, short), (1.0, 0.02), pictures.calibration))
    assert merged.linear[29] == pytest.approx(15, rel=0.02)


def test_linear_pictures_are_taken_as_they_are() -> None:
    light = smooth_light(0.01, 300).astype(np.float32)
    calibration = FisheyeCalibration(LENS)
    single = merge(FisheyePictures(0, (light,), (None,), calibration))
    np.testing.assert_array_equal(single.linear, light)
    assert not single.clipped.any(), "a finished picture has values above 1"
    two = tuple(np.minimum(light * exposure, 1).astype(np.float32) for exposure in (1.0, 0.01))
    merged = merge(FisheyePictures(0, two, (1.0, 0.01), calibration))
    assert merged.linear[~merged.clipped] == pytest.approx(light[~merged.clipped], rel=1e-4)
    assert np.array_equal(merged.clipped, light.max(axis=-1) >= 100)


@pytest.mark.parametrize(
    ("shape", "dtype", "exposures_s", "message"),
    [
        ((60, 50, 3), np.uint8, (1.0,), "calibrate at the size that is recorded"),
        ((60, 60, 3), np.uint16, (1.0,), "give uint8 or linear float32"),
        ((60, 60, 3), np.uint8, (1.0, 0.5), "1 pictures has 2 exposures"),
        ((60, 60, 3), np.uint8, (0.0,), "exposure of 0.0 s is impossible"),
    ],
)
def test_pictures_that_do_not_fit_are_refused(
    shape: tuple[int, ...], dtype: type, exposures_s: tuple[float, ...], message: str
) -> None:
    pictures = FisheyePictures(0, (np.zeros(shape, dtype),), exposures_s, FisheyeCalibration(LENS))
    with pytest.raises(DeltalightError, match=message):
        merge_bracket(pictures, 1.0)


def test_values_that_are_not_finite_are_refused() -> None:
    picture = np.zeros((60, 60, 3), np.float32)
    picture[3, 4, 1] = np.inf
    with pytest.raises(DeltalightError, match="not finite"):
        merge(FisheyePictures(0, (picture,), (None,), FisheyeCalibration(LENS)))


@pytest.mark.parametrize("gamma", [1.0, 2.4])
def test_a_response_is_found_from_a_bracket(gamma: float) -> None:
    """Codes of light^(1/gamma) in seven exposures a factor 4 apart; rms within 1.5 % of white."""
    light = smooth_light(0.01, 300)
    exposures_s = [4.0**-step for step in range(7)]
    pictures = [
        np.rint(255 * np.clip(light * exposure, 0, 1) ** (1 / gamma)).astype(np.uint8)
        for exposure in exposures_s
    ]
    response = estimate_response(pictures, exposures_s)
    truth = np.linspace(0, 1, 256)[:, None] ** gamma
    assert np.sqrt(np.mean((response - truth) ** 2)) < 0.015
    assert response[255] == pytest.approx(1)
    assert (np.diff(response, axis=0) >= 0).all()
    assert FisheyeCalibration(LENS, response).response is not None


def test_a_response_needs_two_exposures_of_coded_pictures() -> None:
    picture = np.zeros((9, 9, 3), np.uint8)
    with pytest.raises(DeltalightError, match="at least two different exposures"):
        estimate_response([picture, picture], [0.5, 0.5])
    with pytest.raises(DeltalightError, match="coded 8-bit pictures"):
        estimate_response([picture, picture.astype(np.float32)], [0.5, 0.25])
