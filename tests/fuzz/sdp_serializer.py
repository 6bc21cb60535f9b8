"""A hook of schemathesis: offers of WHEP (`application/sdp`), which it cannot write by itself, are sent as text."""

import schemathesis


@schemathesis.serializer("application/sdp")
def as_text(_context: object, value: object) -> bytes:
    """Returns any generated value as the body of a request."""
    return value if isinstance(value, bytes) else str(value).encode(errors="replace")
