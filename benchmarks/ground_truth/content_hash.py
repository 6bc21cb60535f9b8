"""A hash of the whole content of a Mitsuba dictionary, files and pictures included."""

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np


def content_hash(*parts: object) -> str:
    """Returns 16 hexadecimal digits that change when any number, name, order or file behind `parts` does.

    Files are named by the key `filename` and hashed by their bytes, so their location does not matter.

    Raises:
        TypeError: a part is of an unsupported kind.
    """
    hasher = hashlib.sha256()
    for token in _tokens(parts):
        hasher.update(len(token).to_bytes(8, "big"))
        hasher.update(token)
    return hasher.hexdigest()[:16]


def _tokens(part: object) -> Iterator[bytes]:
    if part is None or isinstance(part, (str, bool, int, float)):
        yield f"{type(part).__name__} {part!r}".encode()
    elif isinstance(part, Mapping):
        yield f"mapping {len(part)}".encode()
        for key, value in part.items():
            yield from _tokens(key)
            yield from [Path(value).read_bytes()] if key == "filename" else _tokens(value)
    elif isinstance(part, (list, tuple)):
        yield f"sequence {len(part)}".encode()
        for value in part:
            yield from _tokens(value)
    else:
        array = _array(part)
        yield f"array {array.dtype} {array.shape}".encode()
        yield np.ascontiguousarray(array).tobytes()


def _array(part: object) -> np.ndarray:
    """Returns the numbers of an array, or of Mitsuba's transforms and bitmaps."""
    if isinstance(part, np.ndarray) and part.dtype != object:
        return part
    if type(part).__module__.startswith("mitsuba"):
        return np.array(getattr(part, "matrix", part))
    raise TypeError(f"the content of {type(part).__name__} cannot be hashed")
