"""Byte vectors of SPEC.md, both ways: bytes to meaning and meaning to bytes."""

import base64
import json
import re
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from deltalight.protocol.codecs import decode_color, decode_depth, decode_raw, decode_response
from deltalight.protocol.envelope import decode, encode
from deltalight.protocol.light_codecs import fisheye_pictures, lamp_poses, radiance_map, sky_lights
from deltalight.protocol.messages import (
    MAX_HEADER_BYTES,
    MAX_PART_BYTES,
    MESSAGE_TYPES,
    SCHEMA_VERSION,
    FisheyeMessage,
    LampsMessage,
    LightsMessage,
    Message,
    RadianceMessage,
)
from deltalight.protocol.scene_lights import LightCut
from deltalight.protocol.sky_lights import Region
from deltalight.protocol.vectors import FOLDER, frame_pieces, unframe_pieces

MessageT = TypeVar("MessageT", bound=Message)
NAMES = sorted(path.stem for path in Path(FOLDER).glob("*.bin"))
SPEC = (Path(FOLDER).parent / "SPEC.md").read_text()


def load(name: str) -> tuple[list[bytes], dict[str, Any]]:
    return (
        unframe_pieces((FOLDER / f"{name}.bin").read_bytes()),
        json.loads((FOLDER / f"{name}.json").read_text()),
    )


def decoded(kind: type[MessageT], name: str) -> tuple[MessageT, list[memoryview]]:
    message, parts = decode(load(name)[0])
    assert isinstance(message, kind)
    return message, parts


def pictures(message: Message, parts: list[memoryview]) -> list[np.ndarray]:
    """What the parts show, in the units of the vector: codes, linear values, or steps of depth."""
    if message.stream in ("depth", "clean_depth"):
        depth, valid = decode_depth(parts[0], message.encoding, message.shape, message.depth_scale_m)
        np.testing.assert_array_equal(depth > 0, valid)
        return [np.rint(depth / np.float32(message.depth_scale_m))]
    if message.stream == "fisheye":
        return list(fisheye_pictures(message, parts).pictures)
    if message.stream == "radiance":
        light = radiance_map(message, parts)
        return [light.radiance, light.seen]
    if message.stream == "lights":
        sky = sky_lights(message, parts)
        return [sky.residual, sky.seen]
    assert message.stream in ("color", "composite")
    return [decode_color(parts[0], message.encoding, message.shape)]


@pytest.mark.parametrize("name", NAMES)
def test_bytes_mean_what_is_written(name: str) -> None:
    pieces, meaning = load(name)
    message, parts = decode(pieces)
    assert pieces[0].decode() == meaning["topic"]
    assert message.model_dump(mode="json") == meaning["header"]
    assert [base64.b64encode(part).decode() for part in parts] == meaning["parts"]
    if "values" in meaning:
        shown = [picture.ravel().tolist() for picture in pictures(message, parts)]
        assert shown == meaning["values"]


@pytest.mark.parametrize("name", NAMES)
def test_meaning_gives_the_same_bytes(name: str) -> None:
    pieces, meaning = load(name)
    message = MESSAGE_TYPES[meaning["header"]["stream"]].model_validate(meaning["header"])
    coded = encode(message, [base64.b64decode(part) for part in meaning["parts"]])
    assert coded == pieces
    assert frame_pieces(coded) == (FOLDER / f"{name}.bin").read_bytes()


def test_every_stream_has_a_vector() -> None:
    assert {load(name)[1]["header"]["stream"] for name in NAMES} == set(MESSAGE_TYPES)


def test_the_jpeg_vector_shows_the_raw_picture() -> None:
    message, parts = decode(load("color_jpeg")[0])
    assert message.stream == "color"
    raw = decode(load("color_raw")[0])[1][0]
    jpeg = decode_color(parts[0], "jpeg", message.shape)
    assert np.abs(jpeg.astype(int) - decode_raw(raw, message.shape, "uint8")).mean() < 30


def test_the_response_vector_is_the_straight_line() -> None:
    response = decode_response(decode(load("color_raw")[0])[1][1])
    np.testing.assert_allclose(response, np.repeat(np.arange(256)[:, None] / 255, 3, axis=1), atol=1e-7)


def test_the_light_vectors_tell_lens_response_and_places() -> None:
    calibration = fisheye_pictures(*decoded(FisheyeMessage, "fisheye_coded_raw")).calibration
    assert (calibration.lens.width, calibration.lens.height, calibration.vignetting) == (4, 2, (-0.05,))
    assert np.asarray(calibration.response)[51, 0] == pytest.approx(0.2)
    lamps = lamp_poses(decoded(LampsMessage, "lamps")[0])
    assert [lamp.marker for lamp in lamps] == [40, 41]
    assert lamps[1].world_from_marker[:3, 3].tolist() == [0.25, -0.5, 0.75]
    light = radiance_map(*decoded(RadianceMessage, "radiance_raw"))
    assert light.clipped_share == 0.125
    assert light.world_from_fisheye.tolist() == lamps[0].world_from_marker.tolist()
    sky = sky_lights(*decoded(LightsMessage, "lights_raw"))
    assert sky.cut == LightCut()
    assert [one.identity for one in sky.lights] == [3, 5]
    assert sky.lights[0].to_light.tolist() == [0, 0.6, 0.8]
    assert sky.regions == (Region(0, 2, 1, 4),)


@pytest.mark.parametrize("stream", sorted(MESSAGE_TYPES))
def test_the_spec_lists_every_field_of_every_message(stream: str) -> None:
    heading = f"### `{stream}`"
    own = next(text for text in re.split(r"^(?=### )", SPEC, flags=re.M) if text.startswith(heading))
    common = SPEC.split("### Common fields")[1].split("\n### ")[0]
    listed = set(re.findall(r"^\| `(\w+)` \|", common + own, flags=re.M))
    assert listed == set(MESSAGE_TYPES[stream].model_fields)


def test_the_spec_names_the_limits_and_every_vector() -> None:
    assert f"schema version {SCHEMA_VERSION}" in SPEC
    assert f"{MAX_HEADER_BYTES} bytes" in SPEC
    assert f"{MAX_PART_BYTES} bytes" in SPEC
    assert set(re.findall(r"^\| `(\w+)\.bin` \|", SPEC, flags=re.M)) == set(NAMES)
