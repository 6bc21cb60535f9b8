"""CBOR (RFC 8949) as far as JSON reaches: numbers, text, arrays, maps, true, false, null; of definite length."""

import struct
from typing import Any

from deltalight.protocol.errors import DeltalightError

MAX_DEPTH = 32
FLOATS = {25: ">e", 26: ">f", 27: ">d"}
SIMPLE = {20: False, 21: True, 22: None, 23: None}


class CborError(DeltalightError):
    """The bytes are no CBOR, or more of it than is read here."""

    def __init__(self) -> None:
        super().__init__("it is not CBOR of definite length")


def decode_cbor(data: bytes) -> Any:  # noqa: ANN401 - as json.loads
    """Decodes one item that fills the bytes.

    Raises:
        CborError: it does not, or is malformed.
    """
    reader = _Reader(data)
    try:
        value = reader.item(0)
    except (struct.error, UnicodeDecodeError, TypeError) as fault:
        raise CborError from fault
    if reader.offset != len(data):
        raise CborError
    return value


class _Reader:
    def __init__(self, data: bytes) -> None:
        self.data, self.offset = data, 0

    def item(self, depth: int) -> Any:  # noqa: ANN401
        """Decodes the item at the offset (RFC 8949, section 3): major type, argument, contents."""
        if depth > MAX_DEPTH:
            raise CborError
        (head,) = self._unpack(">B")
        major, short = head >> 5, head & 31
        if major == 7:
            return self._simple(short)
        count = self._argument(short)
        if major in (0, 1):
            return -1 - count if major else count
        if major in (2, 3):
            data = self._take(count)
            return data.decode() if major == 3 else data
        if major == 6:
            return self.item(depth + 1)  # a tag says what its item means
        return self._collection(major, count, depth + 1)

    def _collection(self, major: int, count: int, depth: int) -> Any:  # noqa: ANN401
        self._require(count)
        if major == 4:
            return [self.item(depth) for _ in range(count)]
        return {self.item(depth): self.item(depth) for _ in range(count)}

    def _simple(self, short: int) -> float | bool | None:
        if short in FLOATS:
            (number,) = self._unpack(FLOATS[short])
            return float(number)
        if short not in SIMPLE:
            raise CborError
        return SIMPLE[short]

    def _argument(self, short: int) -> int:
        if short < 24:
            return short
        if short > 27:
            raise CborError
        (number,) = self._unpack({24: ">B", 25: ">H", 26: ">I", 27: ">Q"}[short])
        return int(number)

    def _unpack(self, form: str) -> tuple[Any, ...]:
        return struct.unpack(form, self._take(struct.calcsize(form)))

    def _take(self, count: int) -> bytes:
        self._require(count)
        start, self.offset = self.offset, self.offset + count
        return self.data[start : self.offset]

    def _require(self, count: int) -> None:
        """Refuses before anything is allocated: each item takes a byte at least."""
        if count > len(self.data) - self.offset:
            raise CborError
