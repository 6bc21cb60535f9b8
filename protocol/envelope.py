"""Multipart envelope: topic, msgpack header, raw parts (SPEC.md, section 2).

Everything that arrives is validated before anything of its size is allocated; any fault raises `EnvelopeError` and
nothing else.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import msgpack
import numpy as np
from pydantic import ValidationError

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import (
    MAX_HEADER_BYTES,
    MAX_PART_BYTES,
    MESSAGE_TYPES,
    OLDEST_SCHEMA_VERSION,
    SCHEMA_VERSION,
    Message,
    PartRule,
)

MAX_TOPIC_BYTES = 128
MAX_PARTS = 32

Buffer = bytes | bytearray | memoryview
Part = Buffer | np.ndarray


class EnvelopeError(DeltalightError):
    """A message, header or encoded part violates the wire format."""


def encode(message: Message, parts: Sequence[Part] = ()) -> list[bytes]:
    """Returns the multipart of a message and its raw parts: [topic, header, part...].

    Arrays must have the dtype and shape that the message states; they are sent in C order.

    Raises:
        EnvelopeError: a part does not fit the message, or the header is larger than 64 kB.
    """
    rules = message.part_rules()
    _check_count(message.stream, rules, len(parts))
    coded = [_part_bytes(part, rule) for part, rule in zip(parts, rules, strict=True)]
    for part, rule in zip(coded, rules, strict=True):
        _check_length(len(part), rule)
    return [message.topic.encode("ascii"), pack_header(message), *coded]


def decode(multipart: Sequence[Buffer]) -> tuple[Message, list[memoryview]]:
    """Returns message and raw parts (read-only views, not copied) of a multipart [topic, header, part...].

    Raises:
        EnvelopeError: it is malformed in any way.
    """
    if not 2 <= len(multipart) <= MAX_PARTS + 2:
        raise EnvelopeError(
            f"a message has a topic, a header and at most {MAX_PARTS} parts, not {len(multipart)} pieces"
        )
    topic, header, *parts = (_view(piece) for piece in multipart)
    message = unpack_header(header)
    if len(topic) > MAX_TOPIC_BYTES or topic != message.topic.encode("ascii"):
        raise EnvelopeError(f"the topic is not {message.topic}, which the header names: correct one")
    rules = message.part_rules()
    _check_count(message.stream, rules, len(parts))
    for part, rule in zip(parts, rules, strict=True):
        _check_length(len(part), rule)
    return message, parts


def pack_header(message: Message) -> bytes:
    """Returns the header of a message: msgpack map of its fields, in the order of the model.

    Raises:
        EnvelopeError: the header is larger than 64 kB or holds an integer of more than 64 bits.
    """
    try:
        header: bytes = msgpack.packb(message.model_dump(), use_bin_type=True)
    except (ValueError, OverflowError, TypeError) as error:
        raise EnvelopeError(f"the {message.stream} header cannot be written as msgpack: {error}") from error
    if len(header) > MAX_HEADER_BYTES:
        raise EnvelopeError(
            f"the {message.stream} header has {len(header)} bytes, {MAX_HEADER_BYTES} are allowed: cut it"
        )
    return header


def unpack_header(header: Buffer) -> Message:
    """Returns the message of a msgpack header.

    Raises:
        EnvelopeError: not a header, a schema version that is not read (all are named), or a field out of its range.
    """
    if len(header) > MAX_HEADER_BYTES:
        raise EnvelopeError(f"the header has {len(header)} bytes, {MAX_HEADER_BYTES} are allowed: cut it")
    try:
        fields = msgpack.unpackb(header, raw=False, strict_map_key=True)
    except Exception as error:  # the unpacker documents no closed set, and extension types add their own
        raise EnvelopeError(f"the header is not msgpack ({error}): keep to protocol/SPEC.md") from error
    if not isinstance(fields, dict):
        raise EnvelopeError("the header is not a map: keep to protocol/SPEC.md")
    _check_version(fields.get("schema_version"))
    stream = fields.get("stream")
    if not isinstance(stream, str) or stream not in MESSAGE_TYPES:
        raise EnvelopeError(f"the header names no known stream: use one of {', '.join(MESSAGE_TYPES)}")
    with refusing(stream):
        return MESSAGE_TYPES[stream].model_validate(fields)


@contextmanager
def refusing(stream: str) -> Iterator[None]:
    """Turns what is wrong with the fields of a message that is made within the block into `EnvelopeError`."""
    try:
        yield
    except ValidationError as error:
        raise EnvelopeError(_sentence(stream, error)) from error


def is_readable_version(version: int) -> bool:
    """Whether messages of a schema version are read here."""
    return OLDEST_SCHEMA_VERSION <= version <= SCHEMA_VERSION


def _check_version(version: object) -> None:
    if type(version) is not int:
        raise EnvelopeError(f"the header has no schema_version: send {SCHEMA_VERSION}")
    if not is_readable_version(version):
        raise EnvelopeError(
            f"the message has schema version {version} and this program reads versions {OLDEST_SCHEMA_VERSION} to "
            f"{SCHEMA_VERSION}: upgrade the older side"
        )


def _check_count(stream: str, rules: Sequence[PartRule], count: int) -> None:
    if count != len(rules):
        names = ", ".join(rule.name for rule in rules) or "none"
        raise EnvelopeError(
            f"this {stream} message needs {len(rules)} parts ({names}) and has {count}: correct one"
        )


def _check_length(length: int, rule: PartRule) -> None:
    if rule.compressed:
        if not 1 <= length <= MAX_PART_BYTES:
            raise EnvelopeError(f"the {rule.name} takes {length} bytes: send 1 to {MAX_PART_BYTES}")
    elif length != rule.raw_bytes:
        raise EnvelopeError(
            f"the {rule.name} has {length} bytes and {rule.shape} of {rule.dtype} takes {rule.raw_bytes}: "
            "correct one"
        )


def _part_bytes(part: Part, rule: PartRule) -> bytes:
    if not isinstance(part, np.ndarray):
        return bytes(part)
    if rule.compressed:
        raise EnvelopeError(f"the {rule.name} is to be compressed: pass its coded bytes, not an array")
    if part.dtype != np.dtype(rule.dtype) or part.shape != rule.shape:
        raise EnvelopeError(
            f"the {rule.name} is {part.shape} of {part.dtype}, the message says {rule.shape} of {rule.dtype}"
        )
    return part.astype(np.dtype(rule.dtype).newbyteorder("<"), copy=False).tobytes()


def _view(piece: Buffer) -> memoryview:
    try:
        return memoryview(piece).cast("B").toreadonly()
    except TypeError as error:
        raise EnvelopeError(f"a piece of the message is not a run of bytes: {error}") from error


def _sentence(stream: str, error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = ".".join(str(step) for step in first["loc"])[:200] or "its fields together"
    return f"the {stream} header is wrong at {place}: {first['msg'][:300]}; keep to protocol/SPEC.md"
