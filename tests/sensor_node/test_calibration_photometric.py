"""Response and paper: a known response and albedo come back, pictures that cannot show them are refused."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Float32, UInt8

from deltalight.protocol.board import GreyCard
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.sensor_node.calibration.photometric import (
    Bracket,
    bracket_residual,
    calibrate_response,
    paper_albedo,
    parse_card,
    read_bracket,
)
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera, srgb_codes
from deltalight.sensor_node.cameras.synthetic_scene import PAPER_ALBEDO, irradiance

GAMMA = 2.6
TRUTH = np.repeat((np.arange(256) / 255)[:, None] ** GAMMA, 3, axis=1).astype(np.float32)
EXPOSURES_S = (0.002, 0.008, 0.03, 0.12)
# Over marker 5 and the paper about it.
CARD = GreyCard(center_m=(0.09, -0.09), size_m=(0.07, 0.06), rotation_deg=15, albedo=0.18)


def bracket(exposures_s: tuple[float, ...] = EXPOSURES_S, gain: float = 1.0) -> Bracket:
    """A scene of smooth light over three decades, 8 bits with noise; `gain` is a secret one of the second shot."""
    random = np.random.default_rng(4)
    ramp = 10 ** np.linspace(-0.5, 3, 160)[None, :, None] * np.linspace(0.5, 1, 90)[:, None, None]
    light = np.repeat(ramp, 3, axis=2) * (1.0, 0.7, 0.4)
    pictures = []
    for number, exposure in enumerate(exposures_s):
        linear = light * exposure * (gain if number == 1 else 1.0)
        codes = 255 * np.clip(linear, 0, 1) ** (1 / GAMMA) + random.normal(0, 0.7, light.shape)
        pictures.append(np.clip(np.rint(codes), 0, 255).astype(np.uint8))
    return Bracket(tuple(pictures), exposures_s)


def test_a_known_response_comes_back_with_its_residual() -> None:
    found = calibrate_response(bracket())
    ratio = found.table[40:236] / found.table[128] / (TRUTH[40:236] / TRUTH[128])
    assert np.abs(np.log(ratio)).max() < 0.06
    # Noise of 0.7 codes is 0.7 gamma / code, about 2 % in the middle.
    assert 0.005 < found.residual < 0.06
    assert found.table[255] == pytest.approx(1.0)


def test_a_wrong_response_or_another_light_shows_in_the_residual() -> None:
    shots = bracket()
    assert bracket_residual(shots, TRUTH) < 0.06
    assert bracket_residual(shots, TRUTH**0.6) > 0.2
    moved = shots.pictures[1][:, ::-1]
    mixed = Bracket((shots.pictures[0], moved, *shots.pictures[2:]), EXPOSURES_S)
    with pytest.raises(DeltalightError, match="exposures disagree about the light by"):
        calibrate_response(mixed)


@pytest.mark.parametrize("exposures", [(0.01, 0.02), (0.01, 0.02, 0.03)])
def test_too_few_or_too_similar_exposures_are_refused(exposures: tuple[float, ...]) -> None:
    with pytest.raises(DeltalightError, match="three exposures over two stops"):
        calibrate_response(bracket(exposures))


def test_a_bracket_is_read_from_a_list_or_from_exif(tmp_path: Path) -> None:
    from PIL import Image

    for name, seconds in (("a", 0.5), ("b", 0.125)):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x829A] = seconds
        picture = np.full((20, 30, 3), int(400 * seconds), np.uint8)
        Image.fromarray(picture).save(tmp_path / f"{name}.jpg", exif=exif)
    read = read_bracket(tmp_path, "rgb")
    assert read.exposures_s == (0.5, 0.125)
    assert [int(picture.mean()) for picture in read.pictures] == [200, 50]
    (tmp_path / "fisheye.txt").write_text("0 a.jpg 3\n0 b.jpg 1\n")
    assert read_bracket(tmp_path, "fisheye").exposures_s == (3.0, 1.0)


def test_a_picture_without_exposure_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(DeltalightError, match="has no exposure"):
        read_bracket(tmp_path, "rgb")
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(DeltalightError, match=r"a\.png has no exposure"):
        read_bracket(tmp_path, "rgb")
    with pytest.raises(DeltalightError, match="is not a folder"):
        read_bracket(tmp_path / "nowhere", "rgb")


def with_card(
    synthetic: SyntheticCamera, index: int, *, light: float = 1.0, slope: float = 0.0
) -> SensorFrame:
    """A frame with a grey card on the sheet; light falls off along x by `slope` a metre."""
    pose = synthetic.pose_at(index)
    fine = synthetic.camera.resized(1280, 960)
    linear = synthetic.scene.picture(fine, pose)
    corners = synthetic.camera.project((CARD.outline() - pose[:3, 3]) @ pose[:3, :3])
    card = CARD.albedo * irradiance(np.array([0, 0, 1.0])) / np.pi
    cv2.fillConvexPoly(linear, np.rint(16 * corners).astype(np.int32), (float(card),) * 3, cv2.LINE_AA, 4)
    linear *= light * (1 + slope * sheet_x(synthetic, pose))[..., None]
    return replace(synthetic.frame_at(index), color=srgb_codes(linear))


def sheet_x(synthetic: SyntheticCamera, pose: np.ndarray) -> Float32[np.ndarray, "h w"]:
    return synthetic.scene.trace(synthetic.camera, pose).x


def test_the_papers_albedo_comes_back_also_under_uneven_light(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    even = paper_albedo([with_card(synthetic, index) for index in (0, 30)], synthetic.board, CARD)
    assert even.albedo == pytest.approx(PAPER_ALBEDO, rel=0.015)
    assert even.pictures == 2
    assert even.spread < 0.01
    slanted = paper_albedo([with_card(synthetic, 0, slope=2.0, light=0.8)], synthetic.board, CARD)
    assert slanted.albedo == pytest.approx(PAPER_ALBEDO, rel=0.03)


def test_what_no_paper_can_be_is_refused(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    frames = [with_card(synthetic, 0)]
    with pytest.raises(DeltalightError, match="no white paper has"):
        paper_albedo(frames, synthetic.board, CARD.replaced(albedo=0.5))
    with pytest.raises(DeltalightError, match="overexposed"):
        paper_albedo([with_card(synthetic, 0, light=1.6)], synthetic.board, CARD)
    blank: UInt8[np.ndarray, "h w 3"] = np.zeros_like(frames[0].color)
    with pytest.raises(DeltalightError, match="no picture shows the board"):
        paper_albedo([replace(frames[0], color=blank)], synthetic.board, CARD)
    outside = CARD.replaced(center_m=(5.0, 5.0))
    with pytest.raises(DeltalightError, match="outside the picture"):
        paper_albedo(frames, synthetic.board, outside)


def test_a_card_is_two_opposite_corners() -> None:
    card = parse_card("0.10,-0.02,0.02,-0.08", 0.18)
    assert card.center_m == pytest.approx((0.06, -0.05))
    assert card.size_m == pytest.approx((0.08, 0.06))
    for text in ("1,2,3", "a,b,c,d", "0,0,0,0.1"):
        with pytest.raises(DeltalightError, match="two opposite corners"):
            parse_card(text, 0.18)
