"""A token that comes by a file, as container engines and systemd hand secrets over."""

import hashlib
import hmac
from pathlib import Path

from protocol.errors import DeltalightError
from services.api.passes import Pass

SHORTEST, LONGEST = 32, 512  # characters; 32 hex digits are 128 bits
NAME = "token file"


class SecretToken:
    """Compares what is sent with the content of the file, by hashes, so that the time tells nothing of it."""

    def __init__(self, path: Path) -> None:
        try:
            token = path.read_text(encoding="ascii").strip()
        except (OSError, UnicodeDecodeError) as fault:
            raise DeltalightError(
                f"the token file {path} cannot be read as text; give one that can."
            ) from fault
        if not SHORTEST <= len(token) <= LONGEST or not token.isprintable() or " " in token:
            raise DeltalightError(
                f"the token file {path} must hold one word of {SHORTEST} to {LONGEST} characters; make one with "
                "`openssl rand -hex 32`."
            )
        self._hash = _hash(token)

    def verify(self, given: str) -> Pass | None:
        """The rights of who sends this, None where it is another word."""
        return Pass("control", name=NAME) if hmac.compare_digest(self._hash, _hash(given)) else None


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()
