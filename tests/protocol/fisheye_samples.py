"""Small fish-eye pictures with everything that a calibration can hold, and comparison to the bit."""

from dataclasses import replace

import numpy as np

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.fisheye_lens import FisheyeCalibration
from deltalight.protocol.frames import FisheyePictures, SensorFrame
from deltalight.protocol.ocam_lens import OcamLens

WIDTH, HEIGHT = 40, 36
BRACKET_S = (0.1, 1 / 3, 0.0125)


def equidistant() -> EquidistantLens:
    matrix = np.array([[11.5, 0, 19.25], [0, 11.75, 17.5], [0, 0, 1]])
    return EquidistantLens(CameraModel(WIDTH, HEIGHT, matrix, "equidistant", np.array([0.01, -0.002, 0, 0])))


def ocam() -> OcamLens:
    description = {
        "width": WIDTH,
        "height": HEIGHT,
        "polynomial": [-12.5, 0.0, 0.012, 0.0001],
        "center": [19.25, 17.5],
        "affine": [1.0, 0.0, 0.0],
        "image_circle": 17.0,
    }
    return OcamLens.from_dict(description)


def calibration() -> FisheyeCalibration:
    table = np.sort(np.random.default_rng(5).random((256, 3), np.float32), axis=0)
    return FisheyeCalibration(equidistant(), table, (-0.05, 0.001))


def coded(timestamp_ns: int, exposures_s: tuple[float | None, ...] = BRACKET_S) -> FisheyePictures:
    """An 8-bit bracket with the full calibration."""
    rng = np.random.default_rng(timestamp_ns % 2**32)
    pictures = tuple(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8) for _ in exposures_s)
    return FisheyePictures(timestamp_ns, pictures, exposures_s, calibration())


def linear(timestamp_ns: int, exposures_s: tuple[float | None, ...] = (None,)) -> FisheyePictures:
    """Linear pictures of an OCam lens without response and vignetting."""
    rng = np.random.default_rng(timestamp_ns % 2**32)
    pictures = tuple(np.exp(rng.normal(0, 5, (HEIGHT, WIDTH, 3))).astype(np.float32) for _ in exposures_s)
    return FisheyePictures(timestamp_ns, pictures, exposures_s, FisheyeCalibration(ocam()))


def uncoded_response(pictures: FisheyePictures) -> FisheyePictures:
    """The same pictures of a camera that codes as sRGB."""
    return replace(pictures, calibration=replace(pictures.calibration, response=None))


def assert_same_pictures(ours: FisheyePictures | None, theirs: FisheyePictures | None) -> None:
    """Every field is the same to the bit."""
    assert (ours is None) == (theirs is None)
    if ours is None or theirs is None:
        return
    assert (ours.timestamp_ns, ours.exposures_s) == (theirs.timestamp_ns, theirs.exposures_s)
    assert ours.calibration == theirs.calibration
    assert len(ours.pictures) == len(theirs.pictures)
    for mine, other in zip(ours.pictures, theirs.pictures, strict=True):
        assert mine.dtype == other.dtype
        assert np.array_equal(mine, other)


def assert_same_frames(ours: SensorFrame, theirs: SensorFrame) -> None:
    """Every field is the same to the bit."""
    for name in (
        "frame_id",
        "timestamp_ns",
        "camera",
        "exposure_s",
        "depth_timestamp_ns",
        "color_jpeg",
        "composite",
    ):
        assert getattr(ours, name) == getattr(theirs, name), name
    for name in ("color", "response", "world_from_camera"):
        mine, other = getattr(ours, name), getattr(theirs, name)
        assert (mine is None) == (other is None), name
        assert mine is None or (mine.dtype == other.dtype and np.array_equal(mine, other)), name
    assert (ours.depth is None) == (theirs.depth is None)
    if ours.depth is not None and theirs.depth is not None:
        assert ours.depth.camera == theirs.depth.camera
        assert ours.depth.noise_sigma_m == theirs.depth.noise_sigma_m
        assert np.array_equal(ours.depth.depth_m, theirs.depth.depth_m)
        assert np.array_equal(ours.depth.valid, theirs.depth.valid)
    assert_same_pictures(ours.fisheye, theirs.fisheye)
