"""Writing GLB files with all features of glTF used here: skins, morph targets, clips."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

_COMPONENT_TYPES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_JSON_CHUNK, _BIN_CHUNK = 0x4E4F534A, 0x004E4942


class GlbBuilder:
    """Collects entries of a document and the arrays that they refer to."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "Deltalight"}}
        self._binary = b""

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Appends to a top-level list of the document; returns the index there."""
        entries = self.document.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def view(self, values: Shaped[np.ndarray, "..."]) -> int:
        """Stores an array; returns the index of its buffer view."""
        data = np.ascontiguousarray(values).tobytes()
        view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(data)}
        self._binary += data + bytes(-len(data) % 4)
        return self.add("bufferViews", view)

    def described(self, values: Shaped[np.ndarray, "n ..."]) -> dict[str, Any]:
        """Returns an accessor's description of an array, its extent included."""
        rows = values.reshape(len(values), -1)
        return {
            "componentType": _COMPONENT_TYPES[values.dtype.str[1:]],
            "type": _TYPES[rows.shape[1]],
            "count": len(rows),
            "min": rows.min(axis=0).tolist(),
            "max": rows.max(axis=0).tolist(),
        }

    def array(self, values: Shaped[np.ndarray, "n ..."], *, normalized: bool = False) -> int:
        """Stores rows of numbers; returns the index of their accessor."""
        entry = {"bufferView": self.view(values), **self.described(values)}
        return self.add("accessors", {**entry, "normalized": True} if normalized else entry)

    def floats(self, values: Any) -> int:  # noqa: ANN401 - whatever numpy takes
        """Stores rows of numbers as float32; returns the index of their accessor."""
        return self.array(np.array(values, np.float32))

    def track(  # noqa: PLR0917 - a channel in one line
        self,
        clip: dict[str, Any],
        node: int,
        path: str,
        times: int,
        values: Any,  # noqa: ANN401 - whatever numpy takes
        interpolation: str = "LINEAR",
    ) -> None:
        """Appends a channel with its sampler to a clip; `times` is an accessor."""
        sampler = {"input": times, "output": self.floats(values), "interpolation": interpolation}
        clip.setdefault("samplers", []).append(sampler)
        channel = {"sampler": len(clip["samplers"]) - 1, "target": {"node": node, "path": path}}
        clip.setdefault("channels", []).append(channel)

    def data(self) -> bytes:
        """Returns the file's bytes."""
        document = {**self.document, "buffers": [{"byteLength": len(self._binary)}]}
        text = json.dumps(document, separators=(",", ":")).encode()
        chunks = _chunk(_JSON_CHUNK, text + b" " * (-len(text) % 4)) + _chunk(_BIN_CHUNK, self._binary)
        return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks

    def write(self, path: Path) -> Path:
        """Writes the file; returns its path."""
        path.write_bytes(self.data())
        return path


def _chunk(kind: int, data: bytes) -> bytes:
    return len(data).to_bytes(4, "little") + kind.to_bytes(4, "little") + data
