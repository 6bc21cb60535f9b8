"""Codecs: round trips within the stated precision, and coded data that lies about its size."""

import random
import struct
from typing import Literal

import blosc2
import cv2
import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from deltalight.protocol.codecs import (
    DEFAULT_DEPTH_SCALE_M,
    decode_array,
    decode_color,
    decode_depth,
    decode_raw,
    decode_response,
    encode_array,
    encode_color,
    encode_depth,
    jpeg_size,
)
from deltalight.protocol.envelope import EnvelopeError
from deltalight.protocol.messages import DType

Coding = Literal["raw", "blosc2"]
pictures = hnp.arrays(np.uint8, st.tuples(st.integers(1, 24), st.integers(1, 24), st.just(3)))


def smooth_picture(height: int = 48, width: int = 64) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width]
    return np.stack([rows * 4, columns * 3, 200 - rows * 2], axis=-1).astype(np.uint8)


def smooth_depth(height: int = 60, width: int = 80) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width]
    noise = np.random.default_rng(1).normal(0, 0.002, rows.shape)
    return (1 + 0.01 * rows + 0.002 * columns + noise).astype(np.float32)


@given(pictures)
def test_raw_colour_is_exact(pixels: np.ndarray) -> None:
    np.testing.assert_array_equal(decode_color(encode_color(pixels, "raw"), "raw", pixels.shape), pixels)


@given(pictures)
def test_jpeg_keeps_the_shape_of_any_picture(pixels: np.ndarray) -> None:
    code = encode_color(pixels, quality=95)
    assert jpeg_size(code) == pixels.shape[:2]
    assert decode_color(code, "jpeg", pixels.shape).shape == pixels.shape


def test_jpeg_is_close_and_keeps_red_red() -> None:
    pixels = smooth_picture()
    pixels[:16, :16] = (220, 20, 30)
    back = decode_color(encode_color(pixels, quality=95), "jpeg", pixels.shape)
    assert np.abs(back[4:12, 4:12].astype(int) - (220, 20, 30)).max() < 8
    assert np.abs(back.astype(int) - pixels).mean() < 2


def test_jpeg_that_is_turned_by_its_metadata_is_read_as_stored() -> None:
    code = encode_color(smooth_picture())
    tiff = b"II*\0\x08\0\0\0" + struct.pack("<HHHIHHI", 1, 0x0112, 3, 1, 6, 0, 0)
    exif = b"Exif\0\0" + tiff
    turned = code[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + code[2:]
    shown = cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape == (64, 48, 3)
    np.testing.assert_array_equal(
        decode_color(turned, "jpeg", (48, 64, 3)), decode_color(code, "jpeg", (48, 64, 3))
    )


@given(
    hnp.arrays(np.uint16, st.tuples(st.integers(1, 40), st.integers(1, 40))),
    st.sampled_from([0.0002, 0.001, 1 / 5000, 0.00025]),
    st.sampled_from(["raw", "blosc2"]),
)
def test_depth_that_was_made_of_steps_is_exact(steps: np.ndarray, scale: float, encoding: Coding) -> None:
    depth = steps.astype(np.float32) * np.float32(scale)
    back, valid = decode_depth(encode_depth(depth, steps > 0, encoding, scale), encoding, steps.shape, scale)
    np.testing.assert_array_equal(back, depth)
    np.testing.assert_array_equal(valid, steps > 0)


@pytest.mark.parametrize("encoding", ["raw", "blosc2"])
def test_depth_is_right_to_half_a_step(encoding: Coding) -> None:
    depth = smooth_depth()
    part = encode_depth(depth, np.ones_like(depth, bool), encoding)
    back, valid = decode_depth(part, encoding, depth.shape, DEFAULT_DEPTH_SCALE_M)
    assert valid.all()
    assert np.abs(back - depth).max() <= DEFAULT_DEPTH_SCALE_M * 0.501
    assert encoding == "raw" or len(part) < depth.size * 2


def test_depth_that_cannot_be_told_is_unknown_and_never_near() -> None:
    depth = np.array([[1.0, 1.0, np.nan, np.inf, -1.0, 0.0, 1e9, 13.2]], np.float32)
    valid = np.array([[True, False, True, True, True, True, True, True]])
    back, known = decode_depth(encode_depth(depth, valid), "blosc2", (1, 8), DEFAULT_DEPTH_SCALE_M)
    np.testing.assert_array_equal(known, [[True] + [False] * 7])
    np.testing.assert_array_equal(back[~known], 0)


@given(
    st.sampled_from(["uint8", "uint16", "float32"]),
    st.integers(1, 40),
    st.integers(1, 40),
    st.integers(0, 2**32 - 1),
    st.sampled_from(["raw", "blosc2"]),
)
def test_arrays_of_every_type_are_exact(
    dtype: DType, rows: int, columns: int, seed: int, encoding: Coding
) -> None:
    values = np.random.default_rng(seed).integers(0, 1000, (rows, columns)).astype(dtype)
    values[: seed % rows] = 0
    part = encode_array(values, encoding)
    back = decode_array(part, encoding, values.shape, dtype)
    assert back.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(back, values)


def test_an_array_of_another_type_of_the_same_length_is_refused() -> None:
    values = np.arange(4096, dtype=np.float32)
    with pytest.raises(EnvelopeError, match="zstd with bit shuffle"):
        decode_array(encode_array(values, "blosc2"), "blosc2", (8192,), "uint16")


def test_response_comes_back_and_nonsense_in_it_is_refused() -> None:
    response = np.linspace(0, 1, 768, dtype=np.float32).reshape(256, 3)
    np.testing.assert_array_equal(decode_response(response.tobytes()), response)
    for wrong in (np.nan, -1.0, np.inf):
        response[3, 1] = wrong
        with pytest.raises(EnvelopeError, match="response"):
            decode_response(response.tobytes())
    with pytest.raises(EnvelopeError):
        decode_response(response[:100].tobytes())


def test_raw_views_are_read_only() -> None:
    view = decode_raw(bytearray(24), (2, 4, 3), "uint8")
    with pytest.raises(ValueError, match="read-only"):
        view[0, 0, 0] = 1


@pytest.mark.parametrize(
    "picture", [np.zeros((2, 3)), np.zeros((2, 3, 4), np.uint8), np.zeros((0, 3, 3), np.uint8)]
)
def test_what_is_no_picture_is_not_encoded(picture: np.ndarray) -> None:
    with pytest.raises(EnvelopeError, match="picture"):
        encode_color(picture)


def test_mask_of_another_shape_is_not_encoded() -> None:
    with pytest.raises(EnvelopeError, match="mask"):
        encode_depth(np.zeros((2, 3), np.float32), np.zeros((3, 2), bool))


def _memory() -> int:
    return int(psutil.Process().memory_info().rss)


def test_blosc2_bomb_is_refused_before_it_is_unpacked() -> None:
    bomb = blosc2.compress2(np.zeros(256 * 1024 * 1024, np.uint8), typesize=2, nthreads=1)
    assert len(bomb) < 100_000
    before = _memory()
    with pytest.raises(EnvelopeError, match="unpacks to"):
        decode_depth(bomb, "blosc2", (480, 640), 0.001)
    assert _memory() - before < 8e6


def test_blosc2_chunk_with_a_forged_size_is_refused() -> None:
    depth = smooth_depth()
    chunk = bytearray(encode_depth(depth, depth > 0))
    forged = bytearray(chunk)
    forged[4:8] = struct.pack("<I", 480 * 640 * 2)
    for shape in ((480, 640), (60, 80)):
        with pytest.raises(EnvelopeError):
            decode_depth(bytes(forged), "blosc2", shape, 0.001)


@pytest.mark.parametrize("codec", [blosc2.Codec.LZ4, blosc2.Codec.BLOSCLZ, blosc2.Codec.ZLIB])
def test_other_codecs_and_filters_are_refused(codec: blosc2.Codec) -> None:
    steps = (smooth_depth() * 5000).astype(np.uint16)
    other = blosc2.compress2(steps, typesize=2, codec=codec, filters=[blosc2.Filter.BITSHUFFLE], nthreads=1)
    delta = blosc2.compress2(
        steps, typesize=2, codec=blosc2.Codec.ZSTD, filters=[blosc2.Filter.DELTA], nthreads=1
    )
    for chunk in (other, delta):
        with pytest.raises(EnvelopeError, match="zstd"):
            decode_depth(chunk, "blosc2", steps.shape, 0.001)


def test_jpeg_bomb_is_refused_before_it_is_decoded() -> None:
    code = bytearray(encode_color(smooth_picture()))
    at = code.find(b"\xff\xc0")
    code[at + 5 : at + 9] = struct.pack(">HH", 30000, 30000)
    before = _memory()
    with pytest.raises(EnvelopeError, match="30000"):
        decode_color(bytes(code), "jpeg", (48, 64, 3))
    assert _memory() - before < 8e6


@pytest.mark.parametrize(
    "part",
    [
        b"",
        b"\xff\xd8",
        b"\xff\xd8\xff\xd9",
        b"\x89PNG\r\n",
        b"\xff\xd8" + b"\xff" * 4000 + b"\xff\xd9",
        bytes(5000),
    ],
)
def test_what_is_no_jpeg_is_refused(part: bytes) -> None:
    with pytest.raises(EnvelopeError, match="jpeg"):
        decode_color(part, "jpeg", (48, 64, 3))


def test_other_picture_files_and_cut_jpegs_are_refused() -> None:
    pixels = smooth_picture()
    _, png = cv2.imencode(".png", pixels)
    code = encode_color(pixels)
    for part in (png.tobytes(), code[:-2], code[: len(code) // 2]):
        with pytest.raises(EnvelopeError, match="jpeg"):
            decode_color(part, "jpeg", pixels.shape)


def test_mutated_codes_raise_nothing_but_envelope_errors() -> None:
    rng = random.Random(4)
    depth = smooth_depth()
    chunks = [encode_depth(depth, depth > 1.3), encode_depth(depth, depth < 0)]
    jpeg = encode_color(smooth_picture())
    refused = 0
    for i in range(4000):
        code = bytearray(jpeg if i % 3 == 2 else chunks[i % 3])
        for _ in range(rng.randint(1, 3)):
            code[rng.randrange(min(len(code), 40) if rng.random() < 0.4 else len(code))] = rng.randrange(256)
        try:
            if i % 3 == 2:
                assert decode_color(bytes(code), "jpeg", (48, 64, 3)).shape == (48, 64, 3)
            else:
                assert decode_depth(bytes(code), "blosc2", depth.shape, 0.0002)[0].shape == depth.shape
        except EnvelopeError:
            refused += 1
    assert refused > 500
