"""Payloads of requests and replies: those too long for a header travel as a part (SPEC.md, section 6)."""

import json
from collections.abc import Sequence
from typing import TypeVar

from pydantic import ValidationError

from deltalight.protocol.envelope import Buffer, EnvelopeError, decode, encode
from deltalight.protocol.messages import (
    MAX_HEADER_BYTES,
    MAX_PAYLOAD_BYTES,
    ControlReply,
    ControlRequest,
)

# A number takes 9 bytes in msgpack and at least 5 in JSON ("1.0, "), so a payload of this many characters takes less
# than half of a header.
# half of a header.
INLINE_CHARACTERS = MAX_HEADER_BYTES // 4

Control = TypeVar("Control", ControlRequest, ControlReply)


def encode_control(message: ControlRequest | ControlReply) -> list[bytes]:
    """Returns the multipart of a request or reply, with a long payload in a part.

    Raises:
        EnvelopeError: the payload takes more than 4 MB, or holds an integer of more than 64 bits.
    """
    text = json.dumps(message.payload)  # ASCII: one byte per character
    if len(text) <= INLINE_CHARACTERS:
        return encode(message)
    if len(text) > MAX_PAYLOAD_BYTES:
        raise EnvelopeError(
            f"the payload of the {message.stream} takes {len(text)} bytes, {MAX_PAYLOAD_BYTES} are allowed: cut it"
        )
    return encode(message.model_copy(update={"payload": {}, "payload_bytes": len(text)}), [text.encode()])


def decode_control(multipart: Sequence[Buffer], kind: type[Control]) -> Control:
    """Returns the request or reply of a multipart, with its payload in place.

    Raises:
        EnvelopeError: it is malformed in any way, or a message of another kind.
    """
    message, parts = decode(multipart)
    if not isinstance(message, kind):
        wanted = kind.model_fields["stream"].default
        raise EnvelopeError(f"a {message.stream} message came where a {wanted} belongs: see what sends it")
    return message if not parts else _with_payload(message, parts[0])


def _with_payload(message: Control, part: memoryview) -> Control:
    try:
        payload = json.loads(bytes(part).decode("utf-8"))
        fields = {**dict(message), "payload": payload, "payload_bytes": None}
        return type(message).model_validate(fields)
    except ValidationError as error:
        reason = error.errors(include_url=False, include_context=False, include_input=False)[0]["msg"]
        raise EnvelopeError(
            f"the payload of the {message.stream} is not plain data: {reason[:300]}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise EnvelopeError(
            f"the payload of the {message.stream} is not JSON text: {str(error)[:300]}"
        ) from error
