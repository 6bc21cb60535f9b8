"""Envelope: what is sent comes back, and whatever is malformed is refused with one sentence."""

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pydantic import ValidationError

from deltalight.protocol.envelope import EnvelopeError, decode, encode, pack_header, unpack_header
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.message_fields import matrix_rows
from deltalight.protocol.messages import (
    MAX_HEADER_BYTES,
    MESSAGE_TYPES,
    OLDEST_SCHEMA_VERSION,
    SCHEMA_VERSION,
    ColorMessage,
    ControlReply,
    ControlRequest,
    DepthMessage,
    FisheyeMessage,
    LampEntry,
    LampsMessage,
    Message,
    PoseMessage,
    StatsMessage,
)
from deltalight.protocol.vectors import FOLDER, unframe_pieces

CAMERA: dict[str, object] = {"width": 4, "height": 2, "distortion": [0.1, 0.0]}
IDENTITY = matrix_rows(np.eye(4))

nodes = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", fullmatch=True)
counts = st.integers(0, 2**63 - 1)
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=12),
)
plain = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=8,
)
plain_dicts = st.dictionaries(st.text(max_size=8), plain, max_size=4)
base_fields = st.fixed_dictionaries(
    {"node": nodes, "frame_id": counts, "capture_ns": counts},
    optional={"clock_offset_ns": st.integers(-(2**62), 2**62), "clock_bound_ns": st.none() | counts},
)


def color(**changes: object) -> ColorMessage:
    fields: dict[str, Any] = {
        "node": "desk",
        "frame_id": 1,
        "capture_ns": 5,
        "encoding": "raw",
        "shape": (2, 4, 3),
        "camera": CAMERA,
    }
    return ColorMessage.model_validate({**fields, **changes})


def header_of(message: Message, **changes: object) -> bytes:
    """Header with fields changed after validation, as a faulty sender would write it."""
    return bytes(msgpack.packb({**message.model_dump(), **changes}))


@given(
    base_fields,
    hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))),
    plain_dicts,
)
@pytest.mark.parametrize("has_response", [False, True])
def test_colour_comes_back(
    has_response: bool, base: dict[str, Any], pixels: np.ndarray, camera: dict[str, Any]
) -> None:
    message = ColorMessage(
        **base, encoding="raw", shape=pixels.shape, camera=camera, has_response=has_response
    )
    response = np.linspace(0, 1, 768, dtype=np.float32).reshape(256, 3)
    parts = [pixels, response][: 1 + has_response]
    received, raw = decode(encode(message, parts))
    assert received == message
    assert [bytes(part) for part in raw] == [part.tobytes() for part in parts]


@given(base_fields, plain_dicts, st.none() | st.just("4f0c"), st.none() | counts)
def test_control_comes_back(
    base: dict[str, Any], payload: dict[str, Any], scene_id: str | None, revision: int | None
) -> None:
    message = ControlRequest(
        **base, id="a-1", op="set_scene", scene_id=scene_id, revision=revision, payload=payload
    )
    assert decode(encode(message)) == (message, [])


def test_arrays_are_sent_in_c_order_and_never_big_endian() -> None:
    steps = np.arange(8, dtype=np.uint16).reshape(4, 2).T
    message = DepthMessage(
        node="desk", frame_id=0, capture_ns=0, encoding="raw", shape=(2, 4), depth_scale_m=0.001, camera={}
    )
    assert encode(message, [steps])[2] == np.ascontiguousarray(steps, "<u2").tobytes()
    with pytest.raises(EnvelopeError, match="uint16"):
        encode(message, [steps.astype(">u2")])


def test_topic_is_stream_and_node() -> None:
    assert encode(color(), [np.zeros((2, 4, 3), np.uint8)])[0] == b"color.desk"


@pytest.mark.parametrize("version", [0, 1, OLDEST_SCHEMA_VERSION - 1, SCHEMA_VERSION + 1, 999, -1])
def test_another_version_is_refused_and_all_are_named(version: int) -> None:
    readable = f"versions {OLDEST_SCHEMA_VERSION} to {SCHEMA_VERSION}"
    with pytest.raises(EnvelopeError, match=rf"version {version} .* {readable}"):
        unpack_header(header_of(color(), schema_version=version))


def test_the_version_before_is_read() -> None:
    assert OLDEST_SCHEMA_VERSION < SCHEMA_VERSION
    read = unpack_header(header_of(color(), schema_version=OLDEST_SCHEMA_VERSION))
    assert read == color(schema_version=OLDEST_SCHEMA_VERSION)


@pytest.mark.parametrize("version", [None, True, 1.0, "1", [1]])
def test_a_version_that_is_no_integer_is_refused(version: object) -> None:
    with pytest.raises(EnvelopeError, match="schema_version"):
        unpack_header(header_of(color(), schema_version=version))


def test_header_limit_holds_both_ways() -> None:
    request = ControlRequest(node="a", id="b", op="c", payload={"text": "x" * MAX_HEADER_BYTES})
    with pytest.raises(EnvelopeError, match="header has"):
        encode(request)
    with pytest.raises(EnvelopeError, match="header has"):
        decode([b"request.a", header_of(request)])
    fits = request.model_copy(update={"payload": {"text": "x" * (MAX_HEADER_BYTES - 400)}})
    assert decode(encode(fits))[0] == fits


@pytest.mark.parametrize(
    "changes",
    [
        {"shape": [2, 5, 3]},
        {"shape": [2, 4, 4]},
        {"shape": [0, 4, 3]},
        {"shape": [-2, -4, 3]},
        {"shape": [2, 4]},
        {"shape": [2**31, 2**31, 3]},
        {"shape": [16384, 16384, 3]},
        {"shape": [2.0, 4, 3]},
        {"shape": [True, 4, 3]},
        {"dtype": "object"},
        {"dtype": "float64"},
        {"dtype": "|O"},
        {"encoding": "png"},
        {"has_response": True},
        {"has_response": 1},
        {"frame_id": -1},
        {"frame_id": 2**63},
        {"frame_id": "1"},
        {"capture_ns": 1.5},
        {"exposure_s": float("nan")},
        {"exposure_s": 0.0},
        {"exposure_s": float("inf")},
        {"node": "a.b"},
        {"node": ""},
        {"stream": "colour"},
        {"stream": ["color"]},
        {"stream": "depth"},
        {"camera": {"fx": float("nan")}},
        {"camera": {"fx": b"\x80"}},
        {"camera": [1]},
        {"unknown": 1},
        {"clock_offset_ns": 2**63},
    ],
)
def test_lying_or_wrong_fields_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(EnvelopeError):
        decode([b"color.desk", header_of(color(), **changes), bytes(24)])


@pytest.mark.parametrize("length", [0, 23, 25, 10**6])
def test_a_raw_part_of_another_length_is_refused_both_ways(length: int) -> None:
    with pytest.raises(EnvelopeError, match=f"{length} bytes"):
        decode([b"color.desk", pack_header(color()), bytes(length)])
    with pytest.raises(EnvelopeError, match=f"{length} bytes"):
        encode(color(), [bytes(length)])


@pytest.mark.parametrize(
    "multipart",
    [
        [],
        [b"color.desk"],
        [b"color.desk", b""],
        [b"color.desk", b"\xc1"],
        [b"color.desk", b"\x91" * 4000],
        [b"color.desk", b"\xdd\xff\xff\xff\xff"],
        [b"color.desk", b"\xdf\xff\xff\xff\xff"],
        [b"color.desk", b"\xc6\xff\xff\xff\xff"],
        [b"color.desk", msgpack.packb([1, 2])],
        [b"color.desk", msgpack.packb({})],
        [b"color.desk", msgpack.packb({1: 2})],
        [b"color.desk", msgpack.packb({"schema_version": 1})],
        [b"color.desk", pack_header(color()) + b"\0", bytes(24)],
        [b"color.desk", pack_header(color())],
        [b"color.desk", pack_header(color()), bytes(24), bytes(24)],
        [b"color.desk", pack_header(color()), *[bytes(24)] * 40],
        [b"depth.desk", pack_header(color()), bytes(24)],
        [b"color.desk2", pack_header(color()), bytes(24)],
        [b"\xff" * 400, pack_header(color()), bytes(24)],
        ["color.desk", pack_header(color()), bytes(24)],
        [b"color.desk", None, bytes(24)],
        [b"color.desk", header_of(color(), camera={"t": msgpack.Timestamp(1)}), bytes(24)],
        [b"color.desk", header_of(color(), camera={"t": msgpack.ExtType(5, b"x")}), bytes(24)],
        [b"color.desk", b"\x81\xa1a\xd5\xff\x00\x00", bytes(24)],
    ],
)
def test_malformed_multiparts_are_refused(multipart: list[Any]) -> None:
    with pytest.raises(EnvelopeError):
        decode(multipart)


def test_deep_nesting_is_refused() -> None:
    nested: dict[str, Any] = {}
    for _ in range(30):
        nested = {"a": nested}
    with pytest.raises(EnvelopeError, match="nested"):
        unpack_header(header_of(color(), camera=nested))


def test_the_sentence_names_the_place_and_is_short() -> None:
    with pytest.raises(EnvelopeError, match=r"color header is wrong at shape\.0") as caught:
        unpack_header(header_of(color(), shape=["x" * 50_000, 4, 3]))
    assert len(str(caught.value)) < 400
    assert isinstance(caught.value, DeltalightError)


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([-1.0, 1, 1, 1]),
        np.diag([2.0, 2, 2, 1]),
        np.zeros((4, 4)),
        np.eye(4)[::-1],
        np.array([[1, 0, 0, np.nan], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        np.array([[1, 0, 0, 1e9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        np.eye(3),
    ],
)
def test_a_pose_must_be_a_rigid_transform(matrix: np.ndarray) -> None:
    good = PoseMessage(node="a", frame_id=0, capture_ns=0, status="ok", world_from_camera=IDENTITY)
    with pytest.raises(EnvelopeError, match="world_from_camera"):
        unpack_header(header_of(good, world_from_camera=matrix.tolist()))


def lamps_message(base: dict[str, Any], **lamp: object) -> LampsMessage:
    return LampsMessage.model_validate({**base, "lamps": [lamp]})


@pytest.mark.parametrize(
    "build",
    [
        lambda base: PoseMessage(**base, status="ok"),
        lambda base: PoseMessage(**base, status="no_board", world_from_camera=IDENTITY),
        lambda base: ControlReply(**base, id="a", ok=False),
        lambda base: ControlReply(**base, id="a", ok=True, error="no"),
        lambda base: FisheyeMessage(**base, encoding="jpeg", shape=(2, 2, 3), dtype="float32", camera={}),
        lambda base: LampsMessage(**base, lamps=(LampEntry(marker=1, world_from_marker=IDENTITY),) * 65),
        lambda base: lamps_message(base, marker=1, world_from_marker=np.diag([1, 1, 1, 2.0]).tolist()),
        lambda base: lamps_message(base, marker=-1, world_from_marker=IDENTITY),
        lambda base: StatsMessage(**base, state="running", rates={"color": -1.0}),
        lambda base: StatsMessage.model_validate({**base, "state": "running", "drops": {"color": 1.5}}),
    ],
)
def test_fields_that_contradict_each_other_are_refused(build: Callable[[dict[str, Any]], Message]) -> None:
    with pytest.raises(ValidationError):
        build({"node": "a", "frame_id": 0, "capture_ns": 0})


def test_an_integer_that_msgpack_cannot_hold_is_an_envelope_error() -> None:
    with pytest.raises(EnvelopeError, match="msgpack"):
        encode(ControlRequest(node="a", id="b", op="c", payload={"n": 2**70}))


def test_numpy_scalars_and_arrays_cannot_slip_into_a_header() -> None:
    with pytest.raises(ValidationError, match="plain"):
        color(camera={"matrix": np.eye(3)})
    with pytest.raises(ValidationError, match="plain"):
        color(camera={"width": np.int64(3)})


def test_every_stream_has_its_message_type() -> None:
    assert set(MESSAGE_TYPES) == {
        "color", "depth", "clean_depth", "fisheye", "radiance", "lights", "pose", "lamps", "composite", "stats",
        "cameras", "request", "reply",
    }  # fmt: skip


def _vector_pieces() -> list[list[bytes]]:
    return [unframe_pieces(path.read_bytes()) for path in sorted(Path(FOLDER).glob("*.bin"))]


def _mutated(rng: random.Random, pieces: list[bytes]) -> list[bytes]:
    """Vector with some bytes changed, cut, doubled, or with pieces swapped."""
    pieces = list(pieces)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(pieces))
        piece = bytearray(pieces[at])
        spot = rng.randrange(len(piece) + 1)
        kind = rng.randrange(6)
        if kind == 0 and piece:
            piece[spot % len(piece)] = rng.randrange(256)
        elif kind == 1:
            piece[spot:spot] = rng.randbytes(rng.randint(1, 9))
        elif kind == 2:
            del piece[spot : spot + rng.randint(1, 9)]
        elif kind == 3:
            piece += piece[:spot]
        elif kind == 4 and piece:
            piece[spot % len(piece)] ^= 1 << rng.randrange(8)
        else:
            pieces[at], pieces[0] = pieces[0], pieces[at]
            continue
        pieces[at] = bytes(piece)
    return pieces


def test_mutated_messages_raise_nothing_but_envelope_errors() -> None:
    rng = random.Random(20)
    vectors = _vector_pieces()
    refused = 0
    for _ in range(20_000):
        try:
            message, parts = decode(_mutated(rng, rng.choice(vectors)))
        except EnvelopeError:
            refused += 1
            continue
        assert decode(encode(message, parts)) == (message, parts)
    assert refused > 5_000


@settings(max_examples=2000)
@given(st.lists(st.binary(max_size=200), max_size=5))
def test_random_bytes_raise_nothing_but_envelope_errors(pieces: list[bytes]) -> None:
    with pytest.raises(EnvelopeError):
        decode(pieces)


@settings(max_examples=1500)
@given(st.sampled_from(_vector_pieces()), st.data())
def test_headers_with_a_foreign_value_raise_nothing_but_envelope_errors(
    pieces: list[bytes], data: st.DataObject
) -> None:
    fields = msgpack.unpackb(pieces[1])
    fields[data.draw(st.sampled_from(sorted(fields)))] = data.draw(
        plain | st.binary(max_size=5) | st.floats()
    )
    try:
        message, parts = decode([pieces[0], msgpack.packb(fields), *pieces[2:]])
    except EnvelopeError:
        return
    assert decode(encode(message, parts)) == (message, parts)
