"""Light out of real fish-eye pictures (skipped where they are absent)."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from jaxtyping import Float32, Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.fisheye_lens import FisheyeCalibration
from deltalight.protocol.frames import FisheyePictures, RadianceMap
from deltalight.protocol.hemisphere import hemisphere_uv, texel_directions, texel_solid_angles
from deltalight.protocol.ocam_lens import load_ocam_results
from deltalight.protocol.pictures import decode_rgb
from deltalight.sensor_node.fisheye import estimate_response, light_warnings, radiance_map

SIZE = 256
EFFICACY = 179.0 * np.array([0.265, 0.670, 0.065])
"""Lumen a watt of Radiance's R G B, in which the finished picture of the office is written."""
MEASURED_LX = 897.9
"""Vertical illuminance of that finished picture, integrated over it."""


class Office(NamedTuple):
    """A bracket of 18 exposures with everything that its authors measured."""

    pictures: FisheyePictures
    nits: float


@pytest.fixture(scope="module")
def office(shared_data: Path) -> Office:
    """The office and the luminance of white at the reference exposure (13 s), cd/m2.

    Chain of the authors' tool: hdrgen (Ward) makes 87 N^2 / (t S) cd/m2 of white, then the equisolid lens of 180
    degrees, vignetting and the factor 1.18 of f/5.6 apply; no filter was before the lens.
    """
    folder = shared_data / "fisheye" / "indoor_hdr_bracket_office"
    rows = list(csv.DictReader((folder / "exposures.csv").read_text().splitlines()))
    exposures_s = tuple(float(row["exposure_s"]) for row in rows)
    pictures = tuple(
        decode_rgb(
            (folder / "jpeg_quarter" / row["file"].lower().replace("img", "IMG")).read_bytes(), row["file"]
        )
        for row in rows
    )
    polynomials = np.loadtxt(folder / "Response_function.rsp")[:, 1:]
    response = np.stack([np.polyval(each, np.arange(256) / 255) for each in polynomials], axis=1)
    # r = 2 f sin(angle/2), as Kannala-Brandt's series; the circle of 3612 px at full size holds 180 degrees.
    radius, shrink = 3612 / 2, 4
    focal = radius / np.sqrt(2) / shrink
    centre = (np.array([1019 + radius, 3744 - 74 - radius]) / shrink) - 0.5
    matrix = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    series = np.array([-1 / 24, 1 / 1920, -1 / 322560, 1 / 92897280])
    height, width = pictures[0].shape[:2]
    lens = EquidistantLens(CameraModel(width, height, matrix, "equidistant", series), radius / shrink)
    # vignetting_f5d6.cal is a polynomial of the share of 90 degrees.
    share = 2 / np.pi
    vignetting = (0.1755458928191 * share**2, -0.528613562104476 * share**4)
    calibration = FisheyeCalibration(lens, response.astype(np.float32), vignetting)
    nits = 87 * 5.6**2 / (max(exposures_s) * 100) * 1.18
    return Office(FisheyePictures(0, pictures, exposures_s, calibration), nits)


def luminance(result: RadianceMap, nits: float) -> Float64[np.ndarray, "n n"]:
    # Radiance's colours are luminance/179, and so is hdrgen's white.
    return np.asarray(result.radiance @ (EFFICACY / 179.0) * nits)


def illuminance(result: RadianceMap, nits: float) -> float:
    cosine = texel_directions(SIZE)[..., 2]
    return float((luminance(result, nits) * texel_solid_angles(SIZE) * cosine).sum())


@pytest.mark.data
def test_the_offices_illuminance_is_the_measured_one(office: Office) -> None:
    result = radiance_map(office.pictures, np.eye(4), SIZE)
    assert result.seen.mean() > 0.99
    assert result.clipped_share == 0
    assert light_warnings(result) == []
    lux = illuminance(result, office.nits)
    print(f"office: {lux:.1f} lx, finished picture {MEASURED_LX} lx")
    assert lux == pytest.approx(MEASURED_LX, rel=0.05)


@pytest.mark.data
def test_the_office_looks_like_the_finished_picture(office: Office, shared_data: Path) -> None:
    """Median luminance of 10 degree cells within 10 %: the finished picture is turned and scaled by about 1 %."""
    path = shared_data / "fisheye" / "indoor_hdr_bracket_office" / "calibrated_luminance_1000x1000.hdr"
    calibrated = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert calibrated is not None
    finished = calibrated[..., ::-1] @ EFFICACY
    result = radiance_map(office.pictures, np.eye(4), SIZE)
    directions = texel_directions(SIZE).astype(np.float64)
    angle = np.arccos(directions[..., 2])
    around = np.arctan2(directions[..., 1], directions[..., 0])
    place = (angle / (np.pi / 2) * 500)[..., None] * np.stack([np.cos(around), np.sin(around)], -1) + 499.5
    expected = cv2.remap(
        cv2.GaussianBlur(finished, (0, 0), 2), place.astype(np.float32), None, cv2.INTER_LINEAR
    )
    ours = luminance(result, office.nits)
    ratios = []
    for low in np.radians(np.arange(0, 80, 10)):
        for start in np.radians(np.arange(-180, 180, 30)):
            cell = (angle >= low) & (angle < low + np.radians(10))
            cell &= (around >= start) & (around < start + np.radians(30))
            ratios.append(np.median(ours[cell]) / np.median(expected[cell]))
    print(f"office, cells: median ratio {np.median(ratios):.3f}, quartiles {np.percentile(ratios, [25, 75])}")
    assert np.median(ratios) == pytest.approx(1, abs=0.05)
    assert np.percentile(ratios, 25) > 0.9
    assert np.percentile(ratios, 75) < 1.15


@pytest.mark.data
def test_the_response_estimated_from_the_bracket_is_the_given_one(office: Office) -> None:
    pictures = office.pictures
    given = pictures.calibration.response
    assert given is not None
    estimated = estimate_response(pictures.pictures, [each or 0.0 for each in pictures.exposures_s])
    rms = float(np.sqrt(np.mean((estimated - given / given[255]) ** 2)))
    print(f"response: rms {rms:.4f} of white")
    assert rms < 0.03
    calibration = FisheyeCalibration(pictures.calibration.lens, estimated, pictures.calibration.vignetting)
    result = radiance_map(replace(pictures, calibration=calibration), np.eye(4), SIZE)
    lux = illuminance(result, office.nits)
    print(f"office with the estimated response: {lux:.1f} lx")
    assert lux == pytest.approx(MEASURED_LX, rel=0.1)


@pytest.mark.data
def test_a_single_exposure_of_the_office_says_that_it_is_overexposed(office: Office) -> None:
    pictures = office.pictures
    single = FisheyePictures(0, pictures.pictures[6:7], pictures.exposures_s[6:7], pictures.calibration)
    result = radiance_map(single, np.eye(4), SIZE)
    assert 0.2 < result.clipped_share < 0.4
    assert "overexposed" in light_warnings(result)[0]


DOWNLIGHTS = (981, 154), (1152, 231), (922, 283), (797, 479), (1380, 504)
"""Columns and rows near them."""


def blob(gray: Float32[np.ndarray, "h w"], near: tuple[int, int]) -> Float64[np.ndarray, "2"]:
    """Centroid of what is white within 40 pixels of a place."""
    left, top = (max(each - 40, 0) for each in near)
    rows, columns = np.nonzero(gray[top : top + 80, left : left + 80] >= 250)
    return np.array([columns.mean() + left, rows.mean() + top])


@pytest.mark.data
def test_ceiling_lamps_are_the_brightest_above_the_horizon(shared_data: Path) -> None:
    """Five downlights of a corridor, the camera level: they come out at their own directions, and nothing else."""
    folder = shared_data / "fisheye" / "ocam_indoor_apriltags"
    picture = decode_rgb((folder / "img0.jpg").read_bytes(), "img0.jpg")
    lens = load_ocam_results(folder / "calib_results_0.txt")
    result = radiance_map(FisheyePictures(0, (picture,), (None,), FisheyeCalibration(lens)), np.eye(4), SIZE)
    assert result.seen.all()
    assert "overexposed" in light_warnings(result)[0], "a single exposure that shows lamps"
    gray = picture.min(axis=-1).astype(np.float32)
    lamps = [lens.directions(blob(gray, near)[None])[0] for near in DOWNLIGHTS]
    level = result.radiance.min(axis=-1)
    for lamp in lamps:
        column, row = (hemisphere_uv(lamp) * SIZE).astype(int)
        assert level[row, column] > 0.9
    directions = texel_directions(SIZE)
    ceiling = (directions[..., 1] < -0.5) & (directions[..., 2] > 0.2)
    brightest = directions[ceiling & (level > 0.9)].astype(np.float64)
    between = np.degrees(np.arccos(np.clip(brightest @ np.array(lamps).T, -1, 1))).min(axis=1)
    assert len(brightest) > 10
    assert between.max() < 4
