"""Byte vectors of the wire: for every kind of message its bytes (`NAME.bin`) and their meaning (`NAME.json`).

A `.bin` holds one multipart: for each piece its length (4 bytes, little-endian) and then its bytes. The
`.json` has `topic`, `header` (the fields), `parts` (base64), and `values`: what the pictures decode to, flat
in C order (not for jpeg, whose pixels depend on the decoder). See SPEC.md, section 8.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

FOLDER = Path(__file__).parent


def frame_pieces(pieces: Sequence[bytes]) -> bytes:
    """Returns the bytes of a `.bin` file from the pieces of a multipart."""
    return b"".join(struct.pack("<I", len(piece)) + piece for piece in pieces)


def unframe_pieces(data: bytes) -> list[bytes]:
    """Returns the pieces of a multipart from the bytes of a `.bin` file."""
    pieces, place = [], 0
    while place < len(data):
        (length,) = struct.unpack_from("<I", data, place)
        pieces.append(data[place + 4 : place + 4 + length])
        place += 4 + length
    return pieces
