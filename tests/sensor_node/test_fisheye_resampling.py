"""The map of the hemisphere has the energy of the picture, in the right places."""

import re

import cv2
import numpy as np
import pytest
from jaxtyping import Float32, Float64

from deltalight.protocol.fisheye_lens import FisheyeCalibration, FisheyeLens
from deltalight.protocol.frames import FisheyePictures, RadianceMap
from deltalight.protocol.hemisphere import texel_directions, texel_solid_angles
from deltalight.sensor_node.fisheye import light_warnings, radiance_map
from tests.sensor_node.fisheye_samples import equidistant, even, ocam, pixel_solid_angles

LENSES: dict[str, FisheyeLens] = {
    "coarser than the map": equidistant(120),
    "as fine": equidistant(250),
    "finer": equidistant(700, 185.0),
    "ocam": ocam(400),
}
SIZE = 128


def mapped(
    picture: Float32[np.ndarray, "h w 3"],
    lens: FisheyeLens,
    vignetting: tuple[float, ...] = (),
    size: int = SIZE,
) -> RadianceMap:
    calibration = FisheyeCalibration(lens, None, vignetting)
    return radiance_map(FisheyePictures(0, (picture,), (None,), calibration), np.eye(4), size)


def flux_and_irradiance(radiance: Float32[np.ndarray, "n n 3"]) -> Float64[np.ndarray, "2"]:
    size = len(radiance)
    solid = texel_solid_angles(size).astype(np.float64)
    flux = radiance.mean(axis=-1) * solid
    return np.array([flux.sum(), (flux * texel_directions(size)[..., 2]).sum()])


def direct(picture: Float32[np.ndarray, "h w 3"], lens: FisheyeLens) -> Float64[np.ndarray, "2"]:
    """The same two by direct integration over the pixels."""
    solid, cosine = pixel_solid_angles(lens)
    flux = picture.mean(axis=-1) * solid
    return np.array([flux.sum(), (flux * cosine).sum()])


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
@pytest.mark.parametrize("size", [SIZE, 256])
def test_an_uneven_sky_keeps_its_energy_within_half_a_percent(lens: FisheyeLens, size: int) -> None:
    light = np.random.default_rng(3).gamma(0.3, 1.0, (lens.height, lens.width, 1)) * [1.0, 0.7, 0.4]
    picture = light.astype(np.float32)
    assert flux_and_irradiance(mapped(picture, lens, size=size).radiance) == pytest.approx(
        direct(picture, lens), rel=0.005
    )


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
def test_lamps_of_few_pixels_keep_their_energy(lens: FisheyeLens) -> None:
    """Flux within 1 %; irradiance within 2 %, as far as a texel's width (0.7 degrees) lets it at 45 degrees.

    OpenCV 4 rounds the places at which it resamples to 1/32 of a pixel.
    """
    rng = np.random.default_rng(4)
    solid, cosine = pixel_solid_angles(lens)
    worst = np.zeros(2)
    for _ in range(10):
        angle, around, extent = rng.uniform(0, np.pi / 4), rng.uniform(0, 2 * np.pi), rng.integers(2, 4)
        ray = [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)]
        x, y = np.rint(lens.project(np.array([ray]))[0]).astype(int)
        picture = np.zeros((lens.height, lens.width, 3), np.float32)
        picture[y : y + extent, x : x + 2] = 1000
        flux = 1000 * solid[y : y + extent, x : x + 2]
        expected = np.array([flux.sum(), (flux * cosine[y : y + extent, x : x + 2]).sum()])
        error = np.abs(flux_and_irradiance(mapped(picture, lens).radiance) / expected - 1)
        worst = np.maximum(worst, error)
    assert worst[0] < (0.015 if cv2.__version__.startswith("4.") else 0.01)
    assert worst[1] < 0.02


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
def test_an_even_sky_stays_even(lens: FisheyeLens) -> None:
    radiance = mapped(even(lens), lens).radiance
    assert radiance.std() < 0.01
    assert np.abs(radiance - 1).max() < 0.06


def test_lamps_come_out_where_they_are() -> None:
    lens = equidistant(500)
    for ray in ([0.5, 0.1, 0.9], [-0.3, 0.8, 0.4], [0.0, -0.6, 0.7]):
        x, y = lens.project(np.array([ray]))[0]
        rows, columns = np.mgrid[: lens.height, : lens.width]
        lamp = np.hypot(columns - x, rows - y) < 5
        picture = np.repeat(lamp[..., None], 3, axis=-1).astype(np.float32)
        radiance = mapped(picture, lens).radiance[..., :1]
        centroid = (radiance * texel_solid_angles(SIZE)[..., None] * texel_directions(SIZE)).sum(axis=(0, 1))
        cosine = centroid @ np.array(ray) / np.linalg.norm(centroid) / np.linalg.norm(ray)
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.1


def test_vignetting_is_taken_out() -> None:
    lens, vignetting = equidistant(300), (-0.12, 0.01)
    columns, rows = np.meshgrid(np.arange(300.0), np.arange(300.0))
    directions = lens.directions(np.stack([columns.ravel(), rows.ravel()], axis=1))
    angle = np.arccos(np.clip(directions[:, 2], -1, 1)).reshape(300, 300)
    shares = np.nan_to_num(FisheyeCalibration(lens, None, vignetting).transmission(angle))
    picture = (even(lens) * shares[..., None]).astype(np.float32)
    radiance = mapped(picture, lens, vignetting).radiance
    assert abs(radiance.mean() - 1) < 0.002
    assert radiance.std() < 0.01
    assert mapped(picture, lens).radiance.min() < 0.8


def test_vignetting_needs_to_hold_only_where_the_lens_sees() -> None:
    """A polynomial that is negative from 82 degrees on, of a lens that sees 70: nothing of it shows."""
    lens = equidistant(300, 190.0, circle=300 / 190 * 70)
    result = mapped(even(lens), lens, (-0.49,))
    assert np.isfinite(result.radiance).all()
    assert result.radiance.min() >= 0
    # A texel on the rim is a mean over 1.5 degrees.
    assert result.radiance.max() == pytest.approx(1 / (1 - 0.49 * np.radians(70) ** 2), rel=0.06)


def test_only_what_the_lens_sees_is_seen() -> None:
    lens = equidistant(300, 190.0, circle=300 / 190 * 70)
    result = mapped(even(lens), lens)
    z = texel_directions(SIZE)[..., 2]
    assert result.seen[z > np.cos(np.radians(69))].all()
    assert not result.seen[z < np.cos(np.radians(71))].any()
    assert (result.radiance[~result.seen] == 0).all()
    inside = result.radiance[result.seen]
    assert inside.min() > 0.95
    sentences = light_warnings(result)
    assert len(sentences) == 1
    # The cap of 70 degrees has 1 - cos(70) = 66 % of the hemisphere, less the texels on its rim.
    assert re.search("sees 6[56] % of the hemisphere", sentences[0])


def test_what_lies_outside_the_circle_or_behind_does_not_count() -> None:
    lens = equidistant(300, 200.0, circle=300 / 200 * 95)
    solid, _ = pixel_solid_angles(lens)
    clean = mapped(even(lens), lens).radiance
    picture = even(lens)
    columns, rows = np.meshgrid(np.arange(300.0), np.arange(300.0))
    seen = lens.has_ray(np.stack([columns.ravel(), rows.ravel()], axis=1)).reshape(300, 300)
    picture[~seen] = 1e6
    np.testing.assert_array_equal(mapped(picture, lens).radiance, clean)
    assert (~seen & (solid == 0)).any()


def test_the_clipped_share_is_of_the_seen_solid_angle() -> None:
    lens = equidistant(300)
    solid, _ = pixel_solid_angles(lens)
    picture = np.full((300, 300, 3), 90, np.uint8)
    picture[100:130, 160:200] = 255
    expected = solid[100:130, 160:200].sum() / solid.sum()
    result = radiance_map(FisheyePictures(7, (picture,), (0.1,), FisheyeCalibration(lens)), np.eye(4), SIZE)
    assert result.clipped_share == pytest.approx(expected, rel=0.01)
    assert result.timestamp_ns == 7
    assert "overexposed" in light_warnings(result)[0]
    assert f"{100 * expected:.2g} %" in light_warnings(result)[0]
    assert light_warnings(mapped(even(lens), lens)) == []


def test_the_shown_picture_is_the_exposure_nearest_to_middle_grey() -> None:
    lens = equidistant(64)
    pictures = tuple(np.full((64, 64, 3), code, np.uint8) for code in (250, 140, 30))
    calibration = FisheyeCalibration(lens)
    result = radiance_map(FisheyePictures(0, pictures, (1.0, 0.2, 0.01), calibration), np.eye(4), 32)
    assert result.picture is pictures[1]
    linear = mapped(7.0 * even(lens), lens, size=32).picture
    assert linear.dtype == np.uint8
    assert abs(int(linear[32, 32, 0]) - 118) <= 1
