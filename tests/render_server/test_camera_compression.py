"""JPEG compression is found in pictures, and put on the virtual part alone."""

import cv2
import numpy as np
import pytest

from deltalight.benchmarks.ground_truth.sensors import ColorSensor, srgb_bytes
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import ViewFrame
from deltalight.render_server.post_effects.camera_artifacts import FrameArtifacts
from deltalight.render_server.post_effects.camera_compression import (
    SAMPLING,
    CameraCompression,
    Compression,
    compressed,
    find_compression,
)
from deltalight.render_server.post_effects.camera_noise import add_noise, estimate_noise

SIZE = (280, 328)  # neither a whole number of blocks, nor of what is examined


def scene(seed: int = 0) -> np.ndarray:
    """A noisy picture with edges and coloured waves."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    waves = np.stack([120 + 60 * np.sin(x / 9 + y / 30), 100 + 50 * np.cos(y / 7), 140 + x / 8], axis=-1)
    waves[60:200, 90:180] *= 0.5
    noise = np.random.default_rng(seed).normal(0, 2.5, waves.shape)
    return np.clip(np.rint(waves + noise), 0, 255).astype(np.uint8)


def from_camera(picture: np.ndarray, quality: int, halved: tuple[bool, bool]) -> np.ndarray:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SAMPLING[halved]]
    _, code = cv2.imencode(".jpg", picture[..., ::-1], options)
    shown = cv2.imdecode(code, cv2.IMREAD_COLOR)
    assert shown is not None
    return shown[..., ::-1]


@pytest.mark.parametrize("halved", SAMPLING)
@pytest.mark.parametrize("quality", [50, 75, 90, 95])
def test_quality_and_sampling_of_chroma_are_found(quality: int, halved: tuple[bool, bool]) -> None:
    assert find_compression(from_camera(scene(), quality, halved)) == Compression(quality, halved)


def test_pictures_that_were_not_compressed_have_none() -> None:
    """Nor has one that was scaled since, or one of a single colour."""
    decoded = from_camera(scene(), 80, (True, True))
    scaled = cv2.resize(decoded, None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA)
    for picture in (scene(), scaled, np.full((*SIZE, 3), 128, np.uint8)):
        assert find_compression(picture) is None


def test_objects_are_as_the_camera_would_have_compressed_them() -> None:
    """Blocks that objects fill are the camera's to the bit; pixels that they do not cover stay the picture's."""
    compression = Compression(60, (True, True))
    plain, object_ = scene(), scene(1)[:, ::-1]
    cover = np.zeros(SIZE, np.float32)
    cover[64:123, 96:200] = 1.0
    cover[64, 96] = 0.3
    covered = cover > 0
    picture = np.where(covered[..., None], object_, from_camera(plain, 60, (True, True)))
    result = compressed(picture, cover, compression)
    assert np.array_equal(result[~covered], picture[~covered])
    truth = from_camera(np.where(covered[..., None], object_, plain), 60, (True, True))
    inside = np.s_[66:110, 98:190]  # whole units of blocks, less a pixel that upsampled chroma reaches over
    assert np.array_equal(result[inside], truth[inside])
    assert not np.array_equal(result[inside], picture[inside])
    assert compressed(picture, np.zeros_like(cover), compression) is picture


def test_all_frames_must_agree_on_the_quality() -> None:
    """Chroma may be too smooth in some of them to tell how it was sampled."""
    camera = CameraModel(SIZE[1], SIZE[0], np.array([[300, 0, 164], [0, 300, 140], [0, 0, 1.0]]))
    grey = scene().mean(axis=2, keepdims=True).astype(np.uint8).repeat(3, axis=2)
    learned = CameraCompression()
    assert learned.model is None
    for number, picture in enumerate((grey, scene())):
        learned.observe(ViewFrame(number, number, from_camera(picture, 75, (True, False)), camera))
    assert learned.model == Compression(75, (True, False))
    learned.observe(ViewFrame(2, 2, scene(), camera))
    assert learned.model is None


@pytest.mark.parametrize("quality", [50, 75, 90])
def test_objects_are_as_far_from_clean_as_the_camera_is(quality: int) -> None:
    """Within 15 % with compression and noise, and nearer than with noise alone. Noise stays as measured."""
    rows, columns = np.mgrid[:240, :320]
    linear = np.linspace(0.03, 0.8, 320)[:, None] * np.array([1, 0.9, 0.7]) * np.ones((240, 1, 1))
    linear *= (1 + 0.25 * np.sin(columns / 3 + rows / 5) * (rows > 120))[..., None]
    linear[..., 2] *= 1 + 0.3 * np.sin(rows / 2.3 + columns / 5) * (rows < 60)
    linear[40:100, 60:200:8] *= 0.5
    linear, rng = linear.astype(np.float32), np.random.default_rng(3)
    sensor, clean = ColorSensor(2e-4, 0.003), srgb_bytes(linear)
    seen = [from_camera(sensor.expose(linear, rng), quality, (True, False)) for _ in range(2)]
    noise, compression = estimate_noise(seen[0], seen[1], None), find_compression(seen[0])
    assert noise is not None
    assert compression is not None
    assert compression.quality == quality
    camera = CameraModel(320, 240, np.array([[300, 0, 160], [0, 300, 120], [0, 0, 1.0]]))
    cover = np.ones((240, 320), np.float32)
    put_on = [
        FrameArtifacts(ViewFrame(number, number, each, camera), noise, None, None, compression).applied(
            clean, cover
        )
        for number, each in enumerate(seen)
    ]
    assert distance(put_on[0], clean) == pytest.approx(distance(seen[0], clean), rel=0.15)
    again = estimate_noise(put_on[0], put_on[1], None)
    assert again is not None
    grey = np.full((1, 3), 0.2)
    np.testing.assert_allclose(again.variance(grey), noise.variance(grey), rtol=0.15)
    alone = distance(add_noise(clean, cover, noise, 0, None), clean)
    truth = distance(seen[0], clean)
    assert abs(distance(put_on[0], clean) - truth) < abs(alone - truth)


def distance(picture: np.ndarray, clean: np.ndarray) -> float:
    """Codes, rms."""
    return float(np.sqrt(np.mean((picture.astype(float) - clean) ** 2)))
