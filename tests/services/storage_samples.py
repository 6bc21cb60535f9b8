"""Assets for tests of storage and REST API, and a probe that trusts them."""

import json
import struct
from pathlib import Path

from deltalight.services.storage.asset_kinds import AssetKind, Facts
from deltalight.services.storage.assets import Asset
from deltalight.services.storage.store import Store

TETRAHEDRON = b"""v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
f 2 3 4
f 3 1 4
"""


def trusting_probe(_path: Path, _kind: AssetKind, _name: str) -> Facts:
    return {"triangles": 4}


def upload(store: Store, content: bytes, name: str, limit_bytes: int = 1 << 20) -> Asset:
    with store.assets.receiving(limit_bytes) as incoming:
        incoming.write(content)
        return store.assets.keep(incoming, name)[0]


def glb(document: dict[str, object], binary: bytes = b"") -> bytes:
    """A .glb file with this JSON and this binary chunk."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    if binary:
        chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def lying_glb() -> bytes:
    """A few hundred bytes whose accessor asks for gigabytes."""
    return glb(
        {
            "asset": {"version": "2.0"},
            "buffers": [{"byteLength": 36}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 200_000_000}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
        },
        bytes(36),
    )
