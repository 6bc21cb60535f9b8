"""A camera's colour mosaic is found in pictures, and put on the virtual part alone."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import Float32

from deltalight.benchmarks.ground_truth.sensors import srgb_bytes
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import ViewFrame
from deltalight.render_server.post_effects.camera_artifacts import CameraArtifacts, FrameArtifacts
from deltalight.render_server.post_effects.camera_blur import (
    NO_MOTION,
    LensBlur,
    blur_kernels,
    blurred,
    measure_blur,
)
from deltalight.render_server.post_effects.camera_compression import SAMPLING
from deltalight.render_server.post_effects.camera_edges import edge_steps
from deltalight.render_server.post_effects.camera_mosaic import (
    GREEN_VARIANCE,
    KERNELS,
    MOSAICS,
    NOISE_KEPT,
    CameraMosaic,
    Mosaic,
    demosaicked,
    find_mosaic,
    mosaicked,
)
from deltalight.render_server.post_effects.camera_noise import estimate_noise
from tests.render_server import test_camera_blur as board
from tests.render_server.test_camera_blur import FINE, PIXEL_VARIANCE, edge_picture, linear, spread_px
from tests.render_server.test_camera_compression import from_camera

NOISE = 0.01


def scene(noise: float = NOISE, seed: int = 0) -> Float32[np.ndarray, "h w 3"]:
    """Coloured waves with noise, as the light at each pixel."""
    rows, columns = np.mgrid[:240, :320]
    waves = np.linspace(0.05, 0.6, 320)[:, None] * np.array([1, 0.9, 0.7]) * np.ones((240, 1, 1))
    waves *= (1 + 0.3 * np.sin(columns / 3 + rows / 5) * (rows > 120))[..., None]
    waves[40:100, 60:200:8] *= 0.6
    return (waves + np.random.default_rng(seed).normal(0, noise, waves.shape)).astype(np.float32)


def through(light: Float32[np.ndarray, "h w 3"], mosaic: Mosaic) -> np.ndarray:
    return srgb_bytes(demosaicked(light, mosaic))


@pytest.mark.parametrize("noise", [NOISE, 0.03])
@pytest.mark.parametrize("mosaic", MOSAICS)
def test_a_mosaic_is_found_with_its_phase(mosaic: Mosaic, noise: float) -> None:
    """A column further it is another one."""
    seen = through(scene(noise), mosaic)
    assert find_mosaic(seen, None) == mosaic
    assert find_mosaic(seen[:, 1:], None) == mosaic[1::-1] + mosaic[:1:-1]


def test_the_usual_cameras_interpolation_is_found() -> None:
    """OpenCV interpolates codes, not light; it names a mosaic by the second row and column."""
    red, green, blue = np.moveaxis(srgb_bytes(scene()), -1, 0)
    raw = green.copy()
    raw[::2, ::2], raw[1::2, 1::2] = red[::2, ::2], blue[1::2, 1::2]
    assert find_mosaic(cv2.cvtColor(raw, cv2.COLOR_BayerBG2RGB), None) == "RGGB"


@pytest.mark.parametrize("noise", [0.0, NOISE, 0.03])
def test_pictures_without_a_mosaic_have_none(noise: float) -> None:
    """Nor have those that were compressed or scaled since, or of a single colour."""
    plain, seen = srgb_bytes(scene(noise)), through(scene(noise), "GRBG")
    others = [plain, np.full_like(plain, 128), *(from_camera(plain, 90, each) for each in SAMPLING)]
    others += [from_camera(seen, 75, each) for each in SAMPLING]
    others += [
        cv2.resize(each, None, fx=scale, fy=scale, interpolation=how)
        for each in (seen, plain)
        for scale in (0.5, 0.8, 2.0)
        for how in (cv2.INTER_AREA, cv2.INTER_LINEAR, cv2.INTER_NEAREST)
    ]
    assert [find_mosaic(each, None) for each in others] == [None] * len(others)


def test_all_frames_must_show_it() -> None:
    camera = CameraModel(320, 240, np.array([[300, 0, 160], [0, 300, 120], [0, 0, 1.0]]))
    learned = CameraMosaic()
    assert learned.model is None
    for number in range(2):
        learned.observe(ViewFrame(number, number, through(scene(seed=number), "BGGR"), camera))
        assert learned.model == "BGGR"
    learned.observe(ViewFrame(2, 2, srgb_bytes(scene()), camera))
    assert learned.model is None


def test_what_interpolation_keeps() -> None:
    """Of noise, and of an edge's sharpness: by the means of the four phases, from the pixels that each is made of."""
    block = [demosaicked(_impulse(row, column), "RGGB") for row in (4, 5) for column in (4, 5)]
    squares = sum((each**2).sum(axis=(0, 1)) for each in block)
    np.testing.assert_allclose(squares / 4, NOISE_KEPT)
    at = np.arange(-1, 2)
    assert (KERNELS[1].sum(axis=0) * at**2).sum() / KERNELS[1].sum() == GREEN_VARIANCE


def _impulse(row: int, column: int) -> Float32[np.ndarray, "h w 3"]:
    light = np.zeros((10, 10, 3), np.float32)
    light[row, column] = 1.0
    return light


def camera_edge(sigma_px: float, mosaic: Mosaic) -> np.ndarray:
    """The scene of `edge_picture` as a camera with a mosaic shows it."""
    columns, rows = np.meshgrid(np.arange(FINE * 96), np.arange(FINE * 64))
    fine = 0.1 + 0.6 * (columns - 48 * FINE > 0.2 * (rows - 32 * FINE)).astype(np.float32)
    soft = cv2.GaussianBlur(fine, (0, 0), FINE * np.sqrt(sigma_px**2 - PIXEL_VARIANCE))
    light = cv2.resize(soft, (96, 64), interpolation=cv2.INTER_AREA)
    return through(np.repeat(light[..., None], 3, axis=2), mosaic)


def fringe(picture: np.ndarray) -> float:
    """Difference between red and blue and green, rms, in linear light."""
    light = linear(picture)[8:-8, 8:-8].astype(float)
    return float(np.sqrt(np.mean((light[..., ::2] - light[..., 1:2]) ** 2)))


@pytest.mark.parametrize("mosaic", MOSAICS)
@pytest.mark.parametrize("sigma_px", [0.6, 0.8, 1.2])
def test_an_objects_edge_is_the_cameras(sigma_px: float, mosaic: Mosaic) -> None:
    """As soft in each colour, and with the same fringes, from the blur that is measured behind the mosaic."""
    picture, coverage = edge_picture()
    truth = camera_edge(sigma_px, mosaic)
    lens = LensBlur(float(np.hypot(sigma_px, np.sqrt(GREEN_VARIANCE)))).without(GREEN_VARIANCE)
    kernels = blur_kernels(lens, NO_MOTION, NO_MOTION)
    soft = (picture, coverage) if kernels is None else blurred(picture, coverage, kernels, None)
    result, covered = mosaicked(*soft, mosaic, None)
    for channel in range(3):
        found, expected = (spread_px(each[..., [channel] * 3]) for each in (result, truth))
        assert found == pytest.approx(expected, rel=0.1)
    assert fringe(soft[0]) == 0
    assert fringe(result) == pytest.approx(fringe(truth), rel=0.15)
    untouched = covered == 0
    assert untouched.sum() > 1000
    assert np.array_equal(result[untouched], picture[untouched])


def test_the_boards_blur_is_told_from_the_mosaics() -> None:
    """Edges measured behind a mosaic, less its share: the lens's own blur, within 10 %."""
    for sigma_px in (0.6, 1.0):
        seen = board.shot(sigma_px)
        seen = replace(seen, color=through(linear(seen.color), "RGGB"))
        found = measure_blur(edge_steps(seen))
        assert found is not None
        assert found.sigma_px > 1.05 * sigma_px
        assert found.without(GREEN_VARIANCE).sigma_px == pytest.approx(sigma_px, rel=0.1)


def test_beside_an_object_only_what_it_reaches_changes() -> None:
    seen = through(scene(), "RGGB")
    cover = np.zeros(seen.shape[:2], np.float32)
    cover[60:101, 81:150] = 1.0
    picture = np.where(cover[..., None] > 0, srgb_bytes(scene(seed=1)[::-1]), seen)
    result, covered = mosaicked(picture, cover, "RGGB", None)
    changed = (result != picture).any(axis=2)
    rows, columns = np.nonzero(changed)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (59, 101, 80, 150)
    assert not changed[covered == 0].any()
    inside = np.s_[62:99, 83:148]
    everywhere, _ = mosaicked(picture, np.ones_like(cover), "RGGB", None)
    assert np.array_equal(result[inside], everywhere[inside])
    assert mosaicked(picture, np.zeros_like(cover), "RGGB", None)[0] is picture


def test_objects_have_the_noise_of_a_mosaic() -> None:
    """Its variance and correlation are the camera's, and its pattern is found in the virtual part alone."""
    light = np.ones((240, 320, 1), np.float32) * np.linspace(0.1, 0.6, 320, dtype=np.float32)[:, None]
    clean, rng = np.repeat(light, 3, axis=2), np.random.default_rng(5)
    camera = CameraModel(320, 240, np.array([[300, 0, 160], [0, 300, 120], [0, 0, 1.0]]))
    frames = [
        ViewFrame(
            number,
            number,
            through((clean + rng.normal(0, NOISE, clean.shape)).astype(np.float32), "GBRG"),
            camera,
        )
        for number in range(2)
    ]
    learned, known = CameraArtifacts(), FrameArtifacts(frames[0], None, None)
    for each in frames:
        known = learned.observe(each, np.eye(4), np.array([0.0, 0.0, 1.0]))
    assert known.mosaic == "GBRG"
    everywhere = np.ones(clean.shape[:2], np.float32)
    put_on = [replace(known, frame=each).applied(srgb_bytes(clean), everywhere) for each in frames]
    assert find_mosaic(put_on[0], None) == "GBRG"
    model, again = known.noise, estimate_noise(put_on[0], put_on[1], None)
    assert model is not None
    assert again is not None
    grey = np.full((1, 3), 0.3)
    np.testing.assert_allclose(again.variance(grey), model.variance(grey), rtol=0.15)
    np.testing.assert_allclose(again.correlation, model.correlation, atol=0.03)
    same = replace(known, frame=frames[1]).applied(srgb_bytes(clean), everywhere)
    assert np.array_equal(same, put_on[1])
